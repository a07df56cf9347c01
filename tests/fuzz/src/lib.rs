//! Throws bytes at everything that reads bytes from outside a process: files, shared memory,
//! standard output of a child, command lines.
//!
//! A [`Target`] takes any bytes and panics if the reader does, or if what the reader accepts is not
//! what it promises: an accepted course can be flown, a committed episode is whole and finite, an
//! accepted configuration reads back the same. The test suite drives every target over its samples,
//! the corpus in `corpus/` and a few thousand mutations with a fixed seed; `tests/fuzz.sh` drives
//! them for as long as wanted, following coverage.

#![allow(
    clippy::unwrap_used,
    reason = "a target reports a broken promise by panicking, as tests do"
)]

pub mod allocations;
mod corpus;
pub mod mutation;
mod scratch;
mod script;
pub mod targets;

pub use corpus::{committed, word_list};
pub use targets::{TARGETS, Target, Verdict};
