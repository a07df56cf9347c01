//! Tests of the whole system: properties that depend on several packages. They lie in `tests/`, one
//! file per subject.
//!
//! This library holds what they share: runs of the real programs, with a time limit on every wait,
//! that leave nothing behind however a test ends.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

mod episodes;
mod programs;
mod run;

pub use episodes::{LearnedResults, RecordedEpisode, episodes};
pub use programs::{ProgramOutput, program, repository, run_program};
pub use run::{EndedRun, RunRecipe, RunningRun};
pub use skein_chaos::{ListedProcess, Role, leftovers, processes_of};
