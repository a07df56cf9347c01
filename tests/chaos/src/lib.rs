//! Looks at runs from outside: who is alive, what lies about on the machine, and whether two runs
//! came to the same.
//!
//! Nothing here takes part in a run. It is what `skein-chaos` and the whole-system tests judge by,
//! so it trusts no program of ours: processes are those the kernel lists, results are read from the
//! files.

mod curves;
mod leftovers;
mod outcome;
mod processes;

pub use curves::{Curves, CurvesError, read_curves};
pub use leftovers::{Footprint, footprint, leftovers};
pub use outcome::{Check, compare};
pub use processes::{Process, Role, Usage, processes_of};
