//! The VAE on libtorch: encoder, decoder and loss with automatic gradients.
//!
//! It is the reference of the native engine, and the engine for CUDA devices and U-Net decoders.

use skein_protocol::config::{DecoderName, VaeSection};
use skein_protocol::seeds::{Purpose, derive};
use skein_protocol::{IMAGE_HEIGHT, IMAGE_PIXELS, IMAGE_WIDTH};
use tch::{Device, Kind, Tensor, no_grad_guard};

use super::VaeMetrics;
use crate::error::{UpdateError, finite};
use crate::networks::{DecoderNetwork, Encoded, EncoderNetwork, Layout, Parameters, pixels};
use crate::noise::Noise;
use crate::optimizer::Adam;
use crate::state::{StatePart, Stateful};

/// Images encoded or reconstructed at once outside of training: bounds memory at some 50 MB, at no
/// loss of speed.
const CHUNK: i64 = 64;

/// Encoder, decoder and their optimizer.
#[derive(Debug)]
pub struct TorchVae {
    /// Length of the latent code.
    latent: i64,
    encoder: EncoderNetwork,
    decoder: DecoderNetwork,
    /// Where the decoder begins in the parameters; `None` for one that needs more than the code.
    plain_decoder: Option<usize>,
    /// Parameters: the part that actors need, then the log-variance head, then the decoder.
    parameters: Parameters,
    optimizer: Adam,
    kl_weight: f64,
}

/// The loss and its parts, scalars; see [`VaeMetrics`].
struct LossTensors {
    loss: Tensor,
    error: Tensor,
    divergence: Tensor,
}

impl TorchVae {
    /// Returns an untrained VAE; its parameters depend on the run's seed alone.
    pub fn new(section: &VaeSection, run_seed: u64, device: Device) -> Self {
        let mut layout = Layout::default();
        let encoder = EncoderNetwork::describe(&mut layout, section.latent);
        let plain_decoder = (section.decoder == DecoderName::Plain).then(|| layout.len());
        let decoder = DecoderNetwork::describe(&mut layout, section.latent, section.decoder);
        let parameters =
            Parameters::initialise(layout, derive(run_seed, Purpose::VaeParameters, 0), device);
        let optimizer = Adam::new(parameters.flat(), section.learning_rate);
        Self {
            latent: section.latent as i64,
            encoder,
            decoder,
            plain_decoder,
            parameters,
            optimizer,
            kl_weight: section.kl_weight,
        }
    }

    /// Makes one step of Adam on a minibatch of depth images, `[n, 72, 128]` u8.
    ///
    /// # Errors
    /// [`UpdateError::NonFinite`] names the value that was not finite and the step's number;
    /// nothing has changed then.
    pub fn update(
        &mut self,
        images: &Tensor,
        noise: &mut Noise,
    ) -> Result<VaeMetrics, UpdateError> {
        let pixels = pixels(&images.to_device(self.device()));

        let code_noise = noise.normal(&[pixels.size()[0], self.latent], pixels.device());
        let LossTensors {
            loss,
            error,
            divergence,
        } = self.objective(&pixels, &code_noise);
        let gradient = self.parameters.gradient(&loss);

        let [loss, error, divergence] = finite(
            self.optimizer.steps() + 1,
            [
                ("vae loss", &loss),
                ("vae squared error", &error),
                ("vae divergence", &divergence),
            ],
            [("vae gradient", &gradient)],
        )?;
        self.optimizer.step(self.parameters.flat_mut(), &gradient);
        Ok(VaeMetrics {
            loss,
            pixel_error: error / IMAGE_PIXELS as f32,
            divergence,
        })
    }

    /// Computes the loss and its two parts for these pixels, `[n, 1, 72, 128]`, and standard normal
    /// noise, `[n, latent]`.
    fn objective(&self, pixels: &Tensor, code_noise: &Tensor) -> LossTensors {
        // The code is sampled as mean + std · noise, so that gradients reach mean and std
        // (arXiv:1312.6114, section 2.4).
        let Encoded {
            mean,
            log_variance,
            maps,
        } = self.encoder.encode(&self.parameters, pixels);
        let codes = &mean + (&log_variance * 0.5).exp() * code_noise;
        let reconstructed = self.decoder.forward(&self.parameters, &codes, &maps);

        let error = squared_error(&reconstructed, pixels);
        let divergence = divergence(&mean, &log_variance);
        LossTensors {
            loss: &error + &divergence * self.kl_weight,
            error,
            divergence,
        }
    }

    /// Returns the latent mean of each image, `[n, latent]`. `images`: `[n, 72, 128]` u8, any
    /// number of them.
    pub fn encode(&self, images: &Tensor) -> Tensor {
        self.in_chunks(images, |pixels| self.encoder.mean(&self.parameters, pixels))
            .unwrap_or_else(|| Tensor::zeros([0, self.latent], (Kind::Float, self.device())))
    }

    /// Reconstructs each image from its code's mean: `[n, 72, 128]` u8 to `[n, 72, 128]`, depth in
    /// [0, 1].
    pub fn reconstruct(&self, images: &Tensor) -> Tensor {
        let shape = [-1, IMAGE_HEIGHT as i64, IMAGE_WIDTH as i64];
        self.in_chunks(images, |pixels| {
            let Encoded { mean, maps, .. } = self.encoder.encode(&self.parameters, pixels);
            self.decoder
                .forward(&self.parameters, &mean, &maps)
                .view(shape)
        })
        .unwrap_or_else(|| Tensor::zeros([0, shape[1], shape[2]], (Kind::Float, self.device())))
    }

    /// Length of the part of the parameters that actors need.
    pub fn published_len(&self) -> usize {
        self.encoder.published_len()
    }

    /// Copies the encoder's part of a snapshot: convolutions and mean head, in the snapshot
    /// layout's order.
    ///
    /// # Panics
    /// When `into` is not [`TorchVae::published_len`] long.
    pub fn publish(&self, into: &mut [f32]) {
        self.parameters.copy_range(0..self.published_len(), into);
    }

    /// Returns the decoder's parameters, the tensors of a
    /// [`TrainedDecoder`](skein_protocol::decoder_file::TrainedDecoder); `None` if it needs more
    /// than the code.
    pub fn decoder_values(&self) -> Option<Vec<f32>> {
        let range = self.plain_decoder?..self.parameters.flat().numel();
        let mut values = vec![0.0; range.len()];
        self.parameters.copy_range(range, &mut values);
        Some(values)
    }

    /// Number of VAE steps done so far.
    pub fn updates(&self) -> u64 {
        self.optimizer.steps()
    }

    fn device(&self) -> Device {
        self.parameters.flat().device()
    }

    /// Applies `compute` to chunks of images; `None` when there are no images.
    fn in_chunks(&self, images: &Tensor, compute: impl Fn(&Tensor) -> Tensor) -> Option<Tensor> {
        let _guard = no_grad_guard();
        let count = images.size()[0];
        let parts: Vec<Tensor> = (0..count)
            .step_by(CHUNK as usize)
            .map(|start| {
                let chunk = images.narrow(0, start, CHUNK.min(count - start));
                compute(&pixels(&chunk.to_device(self.device())))
            })
            .collect();
        (!parts.is_empty()).then(|| Tensor::cat(&parts, 0))
    }
}

#[cfg(test)]
impl TorchVae {
    /// Converts the parameters to double precision.
    pub(super) fn in_double(mut self) -> Self {
        self.parameters = self.parameters.to_double();
        self
    }

    pub(super) fn layout(&self) -> &Layout {
        self.parameters.layout()
    }

    /// Returns [loss, squared error, divergence] in the parameters' precision, and the gradient.
    /// `images`: `[n, 72, 128]` u8; `noise`: standard normal, `[n, latent]`.
    pub(super) fn loss_and_gradient(&self, images: &Tensor, noise: &[f32]) -> ([f64; 3], Vec<f32>) {
        let kind = self.parameters.flat().kind();
        let pixels = pixels(images).to_kind(kind);
        let noise = Tensor::from_slice(noise)
            .view([-1, self.latent])
            .to_kind(kind);
        let LossTensors {
            loss,
            error,
            divergence,
        } = self.objective(&pixels, &noise);
        let values = [&loss, &error, &divergence].map(|scalar| scalar.double_value(&[]));
        let gradient = self.parameters.gradient(&loss).to_kind(Kind::Float);
        (
            values,
            Vec::try_from(gradient).expect("a flat vector of numbers"),
        )
    }
}

impl Stateful for TorchVae {
    fn parts(&mut self) -> Vec<(String, StatePart<'_>)> {
        let mut parts = self.optimizer.parts("vae.adam");
        parts.push((
            "vae.parameters".into(),
            StatePart::Tensor(self.parameters.flat().shallow_clone()),
        ));
        parts
    }
}

/// Converts the bytes of depth images, back to back, to a tensor, `[n, 72, 128]` u8.
///
/// # Panics
/// When the bytes are not whole images.
pub fn images_from_bytes(bytes: &[u8]) -> Tensor {
    assert_eq!(bytes.len() % IMAGE_PIXELS, 0, "whole images only");
    Tensor::from_slice(bytes).view([-1, IMAGE_HEIGHT as i64, IMAGE_WIDTH as i64])
}

/// Squared error summed over an image's pixels, mean over the batch.
fn squared_error(reconstructed: &Tensor, pixels: &Tensor) -> Tensor {
    (reconstructed - pixels).square().sum(None) / pixels.size()[0] as f64
}

/// Divergence of N(mean, exp(log_variance)) from N(0, 1), summed over the code, mean over the batch
/// (arXiv:1312.6114, appendix B).
fn divergence(mean: &Tensor, log_variance: &Tensor) -> Tensor {
    let terms: Tensor = mean.square() + log_variance.exp() - log_variance - 1.0;
    terms.sum(None) * (0.5 / mean.size()[0] as f64)
}

#[cfg(test)]
mod tests;
