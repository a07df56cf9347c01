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
const REPORTED: [Scalar; 9] = [
    Scalar::CriticLoss,
    Scalar::PolicyLoss,
    Scalar::Temperature,
    Scalar::Entropy,
    Scalar::MeanValue,
    Scalar::SmallestValue,
    Scalar::LargestValue,
    Scalar::CriticGradient,
    Scalar::PolicyGradient,
];

/// Pairs `values`, in the order of [`REPORTED`], and the distance to the teacher, if there is one,
/// with their curves.
fn reported(values: [f32; REPORTED.len()], teacher_distance: Option<f32>) -> Vec<(Scalar, f32)> {
    let distance = teacher_distance.map(|distance| (Scalar::TeacherDistance, distance));
    REPORTED.into_iter().zip(values).chain(distance).collect()
}

#[cfg(test)]
pub(crate) mod samples;
#[cfg(test)]
mod tests;
