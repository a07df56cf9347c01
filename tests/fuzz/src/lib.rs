//! Fuzzes everything that reads bytes from outside a process: files, shared memory, standard output
//! of a child, command lines.
//!
//! A [`Target`] takes any bytes. It panics if the reader panics, or if an accepted input violates a
//! guarantee: an accepted course can be flown, a committed episode is complete and finite, an
//! accepted configuration reads back equal. The test suite runs every target over its samples, the
//! corpus in `corpus/` and a few thousand mutations with a fixed seed. `tests/fuzz.sh` runs them
//! for any length of time, guided by coverage.
//! them for as long as wanted, following coverage.

#![allow(
    clippy::unwrap_used,
    reason = "a target reports a violated guarantee by panicking, as tests do"
)]

pub mod allocations;
mod corpus;
pub mod mutation;
mod scratch;
mod script;
pub mod targets;

pub use corpus::{committed, word_list};
pub use targets::{ReaderDecision, TARGETS, Target};
