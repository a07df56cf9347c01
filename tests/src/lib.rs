//! Whole-system tests: what only holds, or fails, between the packages. They lie in `tests/`, one
//! file a subject.
//!
//! Here is what they share: runs of the real programs, with a time limit on every wait and nothing
//! left behind, however a test ends.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

mod episodes;
mod programs;
mod run;

pub use episodes::{Episode, Learned, episodes};
pub use programs::{Output, program, repository, run_program};
pub use run::{Ended, Recipe, Running};
pub use skein_chaos::{Process, Role, leftovers, processes_of};
