//! Soft actor-critic with learned temperature (Haarnoja et al. 2018, arXiv:1812.05905).
//!
//! Two engines compute the same update: [`NativeSac`] on Skein's own kernels, [`TorchSac`] on
//! libtorch. Both share parameters, noise, metrics and the checkpoint's contents; only the rounding
//! of sums differs. The equations stand once, as plain functions, in [`losses`].

pub mod losses;
mod native;
mod torch;

use crate::metrics::Scalar;

pub use native::NativeSac;
pub use torch::TorchSac;

/// Metrics that an update reports. The temperature is the value before the update.
const REPORTED: [Scalar; 5] = [
    Scalar::CriticLoss,
    Scalar::PolicyLoss,
    Scalar::Temperature,
    Scalar::Entropy,
    Scalar::MeanValue,
];

/// Pairs `values`, in the order of [`REPORTED`], with their curves.
fn reported(values: [f32; REPORTED.len()]) -> Vec<(Scalar, f32)> {
    REPORTED.into_iter().zip(values).collect()
}

#[cfg(test)]
pub(crate) mod samples;
#[cfg(test)]
mod tests;
