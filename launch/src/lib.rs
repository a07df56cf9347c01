//! Starts, watches and stops the processes of a run, and shows their progress.
//!
//! A run is prepared (`skein-prepare`) or resumed ([`resume`](mod@resume)), supervised
//! ([`supervisor`]) while a [`display`] shows its progress, drawn (`skein-reports`) and summarised
//! ([`conclusion`](mod@conclusion)), in this order. An experiment (`skein-experiments`) is many
//! runs, each started as a separate `skein run`. The supervisor knows the learner and the actors
//! only as programs. It shares no memory with them, so their failures cannot harm it.

pub mod conclusion;
pub mod display;
pub mod interrupts;
pub mod resume;
pub mod supervisor;
