//! The VAE's encoder: depth image to the distribution of its latent code.

use skein_protocol::snapshot::{ENCODER_CHANNELS, ENCODER_FEATURES, ENCODER_KERNEL};
use skein_protocol::{IMAGE_HEIGHT, IMAGE_WIDTH};
use tch::{Kind, Tensor};

use super::{ConvolutionLayer, Layout, LinearLayer, Parameters};

/// Bound on the magnitude of the log-variance: standard deviations from 0.0067 to 148. Trained
/// encoders stay far inside it (the prior's standard deviation is 1), and the exponential cannot
/// overflow.
pub const LOG_VARIANCE_BOUND: f64 = 10.0;

/// Four 4 × 4 convolutions with stride 2 and ReLU, 32 to 256 channels, and a linear head (the
/// paper, section 3.3; channels as in arXiv:1803.10122). This is the part that actors fly with,
/// whatever trains it.
#[derive(Debug, Clone, Copy)]
pub struct ImageEncoder {
    convolutions: [ConvolutionLayer; 4],
    mean: LinearLayer,
}

impl ImageEncoder {
    /// Describes the layers, in the snapshot layout's order; the head outputs `latent` numbers.
    pub fn describe(layout: &mut Layout, latent: usize) -> Self {
        let convolutions = std::array::from_fn(|index| {
            let [inputs, outputs] = [
                ENCODER_CHANNELS[index] as i64,
                ENCODER_CHANNELS[index + 1] as i64,
            ];
            let kernel = [ENCODER_KERNEL as i64; 2];
            ConvolutionLayer::describe(
                layout,
                &format!("encoder.conv{}", index + 1),
                inputs,
                outputs,
                kernel,
            )
        });
        let mean = LinearLayer::describe(
            layout,
            "encoder.mean",
            ENCODER_FEATURES as i64,
            latent as i64,
        );
        Self { convolutions, mean }
    }

    /// Returns the head's output, `[n, latent]`, which the policy sees. `pixels`: `[n, 1, 72, 128]`
    /// in [0, 1].
    pub fn forward(&self, parameters: &Parameters, pixels: &Tensor) -> Tensor {
        let [.., last] = self.maps(parameters, pixels);
        self.mean.forward(parameters, &last.flatten(1, -1))
    }

    /// Returns the output of each convolution, `[n, channels, h, w]`.
    fn maps(&self, parameters: &Parameters, pixels: &Tensor) -> [Tensor; 4] {
        let mut image = pixels.shallow_clone();
        self.convolutions.map(|convolution| {
            image = convolution.forward(parameters, &image).relu_();
            image.shallow_clone()
        })
    }
}

/// The VAE's encoder: an [`ImageEncoder`], whose head gives the mean of the latent code, and a
/// second head for its log-variance.
///
/// The mean head comes first, so that the part actors need is a prefix of the parameter vector.
#[derive(Debug, Clone, Copy)]
pub struct EncoderNetwork {
    published: ImageEncoder,
    log_variance: LinearLayer,
    published_len: usize,
}

/// Output of the VAE's encoder.
#[derive(Debug)]
pub struct Encoded {
    /// Mean of the latent code, `[n, latent]`.
    pub mean: Tensor,
    /// Logarithm of its variance, `[n, latent]`, bounded.
    pub log_variance: Tensor,
    /// Outputs of the first three convolutions, `[n, channels, h, w]`: 32 × 35 × 63, 64 × 16 × 30,
    /// 128 × 7 × 14.
    pub maps: [Tensor; 3],
}

impl EncoderNetwork {
    /// Describes the part that actors need, convolutions and mean head, then the log-variance head.
    /// Each head outputs `latent` numbers.
    pub fn describe(layout: &mut Layout, latent: usize) -> Self {
        let published = ImageEncoder::describe(layout, latent);
        let published_len = layout.len();
        Self {
            published,
            log_variance: LinearLayer::describe(
                layout,
                "encoder.log_variance",
                ENCODER_FEATURES as i64,
                latent as i64,
            ),
            published_len,
        }
    }

    /// Length of the part that actors need, a prefix of the parameter vector.
    pub fn published_len(&self) -> usize {
        self.published_len
    }

    /// Returns the distribution of the latent code and the feature maps on the way. `pixels`:
    /// `[n, 1, 72, 128]` in [0, 1].
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

    /// Returns the mean of the latent code, `[n, latent]`, which the policy sees.
    pub fn mean(&self, parameters: &Parameters, pixels: &Tensor) -> Tensor {
        self.published.forward(parameters, pixels)
    }
}

/// Converts depth images to encoder input: `[n, 72, 128]` u8 to `[n, 1, 72, 128]` f32 in [0, 1].
pub fn pixels(images: &Tensor) -> Tensor {
    let shape = [-1, 1, IMAGE_HEIGHT as i64, IMAGE_WIDTH as i64];
    images
        .view(shape)
        .to_kind(Kind::Float)
        .divide_scalar_(f64::from(u8::MAX))
}
