//! The VAE's encoder: depth image to the distribution of its latent code.

use skein_protocol::snapshot::{ENCODER_CHANNELS, ENCODER_FEATURES, ENCODER_KERNEL};
use skein_protocol::{IMAGE_HEIGHT, IMAGE_WIDTH};
use tch::{Kind, Tensor};

use super::{Convolution, Layout, Linear, Parameters};

/// Bound of the log-variance's magnitude: standard deviations from 0.0067 to 148. Far outside anything a trained encoder gives (the prior's is 1), near enough
/// that its exponential can never overflow.
pub const LOG_VARIANCE_BOUND: f64 = 10.0;

/// Four 4 × 4 convolutions with stride 2 and ReLU, 32 to 256 channels, and two linear heads (paper, section 3.3; channels as in arXiv:1803.10122).
///
/// Mean head before log-variance head: what actors need is a prefix of the vector.
#[derive(Debug, Clone, Copy)]
pub struct Encoder {
    convolutions: [Convolution; 4],
    mean: Linear,
    log_variance: Linear,
    published_len: usize,
}

impl Encoder {
    /// Describes the part that actors need, convolutions and mean head, and then the log-variance head; each head gives `latent` numbers.
    pub fn describe(layout: &mut Layout, latent: usize) -> Self {
        let convolutions = std::array::from_fn(|index| {
            let [inputs, outputs] = [ENCODER_CHANNELS[index] as i64, ENCODER_CHANNELS[index + 1] as i64];
            let kernel = [ENCODER_KERNEL as i64; 2];
            Convolution::describe(layout, &format!("encoder.conv{}", index + 1), inputs, outputs, kernel)
        });
        let head =
            |layout: &mut Layout, name: &str| Linear::describe(layout, name, ENCODER_FEATURES as i64, latent as i64);
        let mean = head(layout, "encoder.mean");
        let published_len = layout.len();
        Self {
            convolutions,
            mean,
            log_variance: head(layout, "encoder.log_variance"),
            published_len,
        }
    }

    /// Length of the part that actors need, from the beginning of the vector.
    pub fn published_len(&self) -> usize {
        self.published_len
    }

    /// Mean and log-variance of the latent code, `[n, latent]` each. `pixels`: `[n, 1, 72, 128]` in [0, 1].
    pub fn distribution(&self, parameters: &Parameters, pixels: &Tensor) -> (Tensor, Tensor) {
        let features = self.features(parameters, pixels);
        let log_variance = self.log_variance.forward(parameters, &features);
        (
            self.mean.forward(parameters, &features),
            log_variance.clamp(-LOG_VARIANCE_BOUND, LOG_VARIANCE_BOUND),
        )
    }

    /// Mean of the latent code, `[n, latent]`: what the policy sees.
    pub fn mean(&self, parameters: &Parameters, pixels: &Tensor) -> Tensor {
        self.mean.forward(parameters, &self.features(parameters, pixels))
    }

    /// `[n, 3072]`, channel-major.
    fn features(&self, parameters: &Parameters, pixels: &Tensor) -> Tensor {
        let mut image = pixels.shallow_clone();
        for convolution in &self.convolutions {
            image = convolution.forward(parameters, &image).relu_();
        }
        image.flatten(1, -1)
    }
}

/// Depth images as the encoder takes them: `[n, 72, 128]` u8 to `[n, 1, 72, 128]` f32 in [0, 1].
pub fn pixels(images: &Tensor) -> Tensor {
    let shape = [-1, 1, IMAGE_HEIGHT as i64, IMAGE_WIDTH as i64];
    images
        .view(shape)
        .to_kind(Kind::Float)
        .divide_scalar_(f64::from(u8::MAX))
}
