//! Soft actor-critic with learned temperature (Haarnoja et al. 2018, arXiv:1812.05905).
//!
//! Two engines do the same update: one on kernels of our own, one on libtorch. Parameters, noise,
//! metrics and what a checkpoint holds are the same of both; sums round differently.

pub mod losses;
mod native;
mod torch;

use crate::metrics::Scalar;

pub use native::NativeSac;
pub use torch::TorchSac;

/// What an update reports. The temperature is that before it.
const REPORTED: [Scalar; 5] = [
    Scalar::CriticLoss,
    Scalar::PolicyLoss,
    Scalar::Temperature,
    Scalar::Entropy,
    Scalar::MeanValue,
];

/// `values`, in the order of [`REPORTED`], as points of their curves.
fn reported(values: [f32; REPORTED.len()]) -> Vec<(Scalar, f32)> {
    REPORTED.into_iter().zip(values).collect()
}

#[cfg(test)]
pub(crate) mod samples;
#[cfg(test)]
mod tests;
