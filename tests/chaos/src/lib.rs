//! Inspects runs from outside: live processes, leftovers on the machine, and equality of two runs.
//!
//! Nothing here takes part in a run. `skein-chaos` and the whole-system tests judge by it, so it
//! trusts no program of Skein: it reads processes from the kernel and results from files.

mod curves;
mod leftovers;
mod outcome;
mod processes;

pub use curves::{Curves, CurvesError, read_curves};
pub use leftovers::{Footprint, footprint, leftovers};
pub use outcome::{OutcomeCheck, compare};
pub use processes::{ListedProcess, Role, Usage, processes_of};
