//! What the benchmarks measured, as a table and as pictures.
//!
//! The benchmarks themselves lie in the packages they measure. Which there are, what is asked of
//! each and what it is compared with stands in one place, `tests/bench/benchmarks.toml` ([`catalogue`]);
//! [`figures`] reads what they left, [`faults`] what is missing, and [`table`] sets the two beside
//! each other, under the [`machine`] that they ran on. Figure and baseline of a row were measured
//! by the same run.

pub mod catalogue;
pub mod faults;
pub mod figures;
pub mod machine;
pub mod table;
