//! Networks on the kernels, forward and backward written out, and the vectors that they learn.

mod critic;
mod dense;
mod learned;
mod rows;

pub use critic::{CriticLayers, NativeCritic};
pub use dense::{Dense, Layers, output, output_mut};
pub use learned::{Learned, squared_norm};
pub use rows::{ESTIMATES, follow, join, pair, smaller};
