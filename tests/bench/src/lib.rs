//! Tables and pictures of what the benchmarks measured.
//!
//! The benchmarks themselves lie in the packages that they measure. `tests/bench/benchmarks.toml`
//! ([`catalogue`]) lists them with their targets and baselines. [`figures`] reads the results,
//! [`faults`] lists what is missing, and [`table`] compares results with targets, below a
//! description of the [`machine`]. Figure and baseline of a row come from the same session.

pub mod catalogue;
pub mod faults;
pub mod figures;
pub mod machine;
pub mod table;
