//! The variational auto-encoder: gives the policy its eyes.
//!
//! It learns to reproduce depth images through a code of 32 numbers, during the first steps of a run, and is then frozen (paper, section 3.3). The
//! policy sees the code's mean.

mod native;
mod torch;

pub use native::{LAYERS, NativeVae, Pass, Spent};
pub use torch::{TorchVae, images_from_bytes};

/// What one VAE step reports.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VaeMetrics {
    /// What was minimised: squared error summed over an image's pixels plus weighted divergence, mean over the batch.
    pub loss: f32,
    /// Mean squared error of a pixel, depth in [0, 1].
    pub pixel_error: f32,
    /// Kullback-Leibler divergence of the code's distribution from the standard normal, in nats, mean over the batch: how much the code tells.
    pub divergence: f32,
}
