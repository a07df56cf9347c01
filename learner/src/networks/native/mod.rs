//! Networks on the kernels, forward and backward written out, and the vectors that they learn.

mod dense;
mod learned;
mod rows;

pub use dense::{Dense, Layers, output, output_mut};
pub use learned::{Learned, squared_norm};
pub use rows::{ESTIMATES, follow, join, pair, smaller};
