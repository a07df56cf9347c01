//! A run on this machine: its directory, its identity, and the processes that belong to it.
//!
//! Begin with [`RunDirectory`]. Its identity ([`RunIdentity`]) names the folder of its transport,
//! where the learner announces its current incarnation. Locks keep out a second learner or
//! supervisor, and leftovers of dead processes are swept. Other modules hold what all of Skein's
//! programs share: atomically written files ([`durable`]), logs ([`logging`]), allocator settings
//! ([`allocation`]), errors on one line ([`failure`]), points at which tests kill a process
//! ([`fault`]), output for the terminal ([`terminal`], [`notes`], [`tables`]), ignored signals
//! ([`signals`]), limits of memory ([`control_groups`]).
//!
//! Identity and announcement are here and not in the protocol, because they name this machine's
//! folders and locks, and only processes of this machine read them.

pub mod allocation;
mod claims;
pub mod control_groups;
mod directory;
pub mod durable;
mod event_records;
pub mod failure;
pub mod fault;
mod identity;
mod inputs;
mod lock;
pub mod log_tail;
pub mod logging;
pub mod notes;
pub mod orphans;
mod presence;
mod private_files;
mod results;
pub mod signals;
mod sweep;
pub mod tables;
pub mod terminal;

pub use claims::ActorClaim;
pub use directory::{RunDirectory, RunError};
pub use event_records::{EventRecordError, split_event_record, write_event_record};
pub use identity::{Announcement, JoinMismatch, LearnerIncarnation, RunIdentity};
pub use lock::{LearnerLock, LockError, SupervisorLock};
pub use presence::Presence;
pub use private_files::PathError;
pub use results::save_snapshot;
pub use sweep::{SweepResult, sweep_leftovers};
