//! Soft actor-critic with learned temperature (Haarnoja et al. 2018, arXiv:1812.05905).

mod batch;
pub mod losses;
mod update;

pub use batch::{Batch, Columns};
pub use update::{Sac, SacMetrics};

#[cfg(test)]
mod tests;
