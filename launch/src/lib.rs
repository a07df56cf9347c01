//! Starts, watches and stops the processes of a run, shows their progress, and draws what they
//! leave behind.
//!
//! A run is prepared ([`prepare`](mod@prepare)) or taken up again ([`resume`](mod@resume)),
//! supervised ([`supervisor`]) under the eyes of a [`display`], drawn ([`reports`]) and told
//! ([`conclusion`](mod@conclusion)), in this order; [`benchmarks`] are told in a table of their
//! own. [`experiments`] are many runs, each by a `skein run` of its own. The supervisor knows the
//! learner and the actors as programs only: it shares no memory with them, so that nothing that
//! happens to them can harm it.

pub mod benchmarks;
pub mod conclusion;
pub mod display;
pub mod experiments;
pub mod inspection;
pub mod interrupts;
pub mod orphans;
pub mod prepare;
pub mod reports;
pub mod resume;
pub mod supervisor;
