//! The VAE's encoder: depth image to the distribution of its latent code.

use skein_protocol::snapshot::{ENCODER_CHANNELS, ENCODER_FEATURES, ENCODER_KERNEL};
use skein_protocol::{IMAGE_HEIGHT, IMAGE_WIDTH};
use tch::{Kind, Tensor};

use super::{Convolution, Layout, Linear, Parameters};

/// Bound of the log-variance's magnitude: standard deviations from 0.0067 to 148. Far outside
/// anything a trained encoder gives (the prior's is 1), near enough that its exponential can never
/// overflow.
pub const LOG_VARIANCE_BOUND: f64 = 10.0;

/// Four 4 × 4 convolutions with stride 2 and ReLU, 32 to 256 channels, and a linear head (paper,
/// section 3.3; channels as in arXiv:1803.10122): what actors fly with, whatever trains it.
#[derive(Debug, Clone, Copy)]
pub struct ImageEncoder {
    convolutions: [Convolution; 4],
    mean: Linear,
}

impl ImageEncoder {
    /// Describes the layers, in the snapshot layout's order; the head gives `latent` numbers.
    pub fn describe(layout: &mut Layout, latent: usize) -> Self {
        let convolutions = std::array::from_fn(|index| {
            let [inputs, outputs] = [
                ENCODER_CHANNELS[index] as i64,
                ENCODER_CHANNELS[index + 1] as i64,
            ];
            let kernel = [ENCODER_KERNEL as i64; 2];
            Convolution::describe(
                layout,
                &format!("encoder.conv{}", index + 1),
                inputs,
                outputs,
                kernel,
            )
        });
        let mean = Linear::describe(
            layout,
            "encoder.mean",
            ENCODER_FEATURES as i64,
            latent as i64,
        );
        Self { convolutions, mean }
    }

    /// What the head gives, `[n, latent]`: what the policy sees. `pixels`: `[n, 1, 72, 128]` in [0,
    /// 1].
    pub fn forward(&self, parameters: &Parameters, pixels: &Tensor) -> Tensor {
        let [.., last] = self.maps(parameters, pixels);
        self.mean.forward(parameters, &last.flatten(1, -1))
    }

    /// What each convolution makes of the one before it, `[n, channels, h, w]`.
    fn maps(&self, parameters: &Parameters, pixels: &Tensor) -> [Tensor; 4] {
        let mut image = pixels.shallow_clone();
        self.convolutions.map(|convolution| {
            image = convolution.forward(parameters, &image).relu_();
            image.shallow_clone()
        })
    }
}

/// The VAE's encoder: an [`ImageEncoder`], whose head gives the mean of the code's distribution,
/// and a second head.
///
/// Mean head before log-variance head: what actors need is a prefix of the vector.
#[derive(Debug, Clone, Copy)]
pub struct Encoder {
    published: ImageEncoder,
    log_variance: Linear,
    published_len: usize,
}

/// What the VAE's encoder makes of images.
#[derive(Debug)]
pub struct Encoded {
    /// Mean of the latent code, `[n, latent]`.
    pub mean: Tensor,
    /// Logarithm of its variance, `[n, latent]`, bounded.
    pub log_variance: Tensor,
    /// What the first three convolutions gave, `[n, channels, h, w]`: 32 × 35 × 63, 64 × 16 × 30,
    /// 128 × 7 × 14.
    pub maps: [Tensor; 3],
}

impl Encoder {
    /// Describes the part that actors need, convolutions and mean head, and then the log-variance
    /// head; each head gives `latent` numbers.
    pub fn describe(layout: &mut Layout, latent: usize) -> Self {
        let published = ImageEncoder::describe(layout, latent);
        let published_len = layout.len();
        Self {
            published,
            log_variance: Linear::describe(
                layout,
                "encoder.log_variance",
                ENCODER_FEATURES as i64,
                latent as i64,
            ),
            published_len,
        }
    }

    /// Length of the part that actors need, from the beginning of the vector.
    pub fn published_len(&self) -> usize {
        self.published_len
    }

    /// The distribution of the latent code, and the maps that it was made from. `pixels`: `[n, 1,
    /// 72, 128]` in [0, 1].
    pub fn encode(&self, parameters: &Parameters, pixels: &Tensor) -> Encoded {
        let [first, second, third, last] = self.published.maps(parameters, pixels);
        let features = last.flatten(1, -1);
        let log_variance = self.log_variance.forward(parameters, &features);
        Encoded {
            mean: self.published.mean.forward(parameters, &features),
            log_variance: log_variance.clamp(-LOG_VARIANCE_BOUND, LOG_VARIANCE_BOUND),
            maps: [first, second, third],
        }
    }

    /// Mean of the latent code, `[n, latent]`: what the policy sees.
    pub fn mean(&self, parameters: &Parameters, pixels: &Tensor) -> Tensor {
        self.published.forward(parameters, pixels)
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
