//! Starts, watches and stops the processes of a run, and shows their progress.
//!
//! A run is prepared (`skein-prepare`) or resumed ([`resume`](mod@resume)), supervised
//! ([`supervisor`]) while a [`display`] shows its progress, drawn (`skein-reports`) and summed up
//! ([`conclusion`](mod@conclusion)), in this order. An experiment (`skein-experiments`) is many
//! runs, each by a `skein run` of its own. The supervisor knows the
//! learner and the actors as programs only: it shares no memory with them, so that nothing that
//! happens to them can harm it.

pub mod conclusion;
pub mod display;
pub mod interrupts;
pub mod resume;
pub mod supervisor;
