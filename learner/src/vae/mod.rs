//! The variational auto-encoder (VAE): compresses depth images for the policy.
//!
//! During the first steps of a run, it learns to reproduce depth images through a short latent
//! code; then it is frozen (the paper, section 3.3). The policy sees the code's mean.
//!
//! Two engines compute the same step: [`NativeVae`] on Skein's own kernels, [`TorchVae`] on
//! libtorch. They start from the same parameters, and tests compare them. With a U-Net as decoder
//! (see `Decoder` in `networks/decoder.rs`), libtorch is always used.

mod native;
mod torch;

use skein_protocol::config::{Engine, RunSection, VaeSection};
use tch::{Device, Tensor};

use crate::error::UpdateError;
use crate::noise::Noise;
use crate::state::{StatePart, Stateful};

pub use native::{LAYERS, LayerTimes, NativeVae, Pass, Targets};
pub use torch::{TorchVae, images_from_bytes};

/// Encoder, decoder and their optimizer, computed by the configured engine.
#[derive(Debug)]
#[expect(
    clippy::large_enum_variant,
    reason = "there is one of them in a process"
)]
pub enum Vae {
    /// Skein's own kernels, on the CPU.
    Native(NativeVae),
    /// libtorch, on any device.
    Libtorch(TorchVae),
}

/// Metrics of one VAE step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VaeMetrics {
    /// Minimised loss: the squared error summed over an image's pixels, plus the weighted
    /// divergence; mean over the batch.
    pub loss: f32,
    /// Mean squared error per pixel, depth in [0, 1].
    pub pixel_error: f32,
    /// Kullback-Leibler divergence of the latent code's distribution from the standard normal, in
    /// nats, mean over the batch. It measures how much information the code carries.
    pub divergence: f32,
}

impl Vae {
    /// Returns an untrained VAE; its parameters depend on the run's seed alone. `device` is
    /// libtorch's; the native engine always runs on the CPU.
    pub fn new(section: &VaeSection, run: &RunSection, device: Device) -> Self {
        match section.engine(run) {
            Engine::Native => Self::Native(NativeVae::new(section, run.seed, run.learner_threads)),
            Engine::Libtorch => Self::Libtorch(TorchVae::new(section, run.seed, device)),
        }
    }

    /// Makes one step of Adam on a minibatch of depth images, `[n, 72, 128]`.
    ///
    /// # Errors
    /// [`UpdateError::NonFinite`] names the value that was not finite and the step's number;
    /// nothing has changed then.
    pub fn update(&mut self, images: &[u8], noise: &mut Noise) -> Result<VaeMetrics, UpdateError> {
        match self {
            Self::Native(vae) => vae.update(images, noise),
            Self::Libtorch(vae) => vae.update(&images_from_bytes(images), noise),
        }
    }

    /// Reconstructs each image from its code's mean: `[n, 72, 128]` u8 to `[n, 72, 128]`, depth in
    /// [0, 1].
    pub fn reconstruct(&mut self, images: &[u8]) -> Vec<f32> {
        match self {
            Self::Native(vae) => vae.reconstruct(images),
            Self::Libtorch(vae) => {
                let mut seen = vec![0.0; images.len()];
                copy(&vae.reconstruct(&images_from_bytes(images)), &mut seen);
                seen
            }
        }
    }

    /// Length of the part of the parameters that actors need.
    pub fn published_len(&self) -> usize {
        match self {
            Self::Native(vae) => vae.published_len(),
            Self::Libtorch(vae) => vae.published_len(),
        }
    }

    /// Copies the encoder's part of a snapshot: convolutions and mean head, in the snapshot
    /// layout's order.
    ///
    /// # Panics
    /// When `into` is not [`Vae::published_len`] long.
    pub fn publish(&self, into: &mut [f32]) {
        match self {
            Self::Native(vae) => vae.publish(into),
            Self::Libtorch(vae) => vae.publish(into),
        }
    }

    /// Returns the decoder's parameters, the tensors of a
    /// [`TrainedDecoder`](skein_protocol::decoder_file::TrainedDecoder); `None` if it needs more
    /// than the code.
    pub fn decoder_values(&self) -> Option<Vec<f32>> {
        match self {
            Self::Native(vae) => Some(vae.decoder_values()),
            Self::Libtorch(vae) => vae.decoder_values(),
        }
    }

    /// Number of VAE steps done so far.
    pub fn updates(&self) -> u64 {
        match self {
            Self::Native(vae) => vae.updates(),
            Self::Libtorch(vae) => vae.updates(),
        }
    }
}

impl Stateful for Vae {
    fn parts(&mut self) -> Vec<(String, StatePart<'_>)> {
        match self {
            Self::Native(vae) => vae.parts(),
            Self::Libtorch(vae) => vae.parts(),
        }
    }
}

fn copy(tensor: &Tensor, into: &mut [f32]) {
    tensor
        .to_device(Device::Cpu)
        .contiguous()
        .copy_data(into, into.len());
}

#[cfg(test)]
mod tests;
