//! Networks on the native kernels, forward and backward written out, and their learned vectors.

mod critic;
mod dense;
mod learned;
mod rows;

pub use critic::{CriticLayers, NativeCritic};
pub use dense::{Dense, Layers, output, output_mut};
pub use learned::{Learned, squared_norm};
pub use rows::{ESTIMATES, follow, join, pair, smaller, squash};
