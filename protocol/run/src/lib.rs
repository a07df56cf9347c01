//! A run on this machine: its directory, its identity, and the processes that belong to it.
//!
//! Begin with [`RunDirectory`]. Its identity ([`RunIdentity`]) names the folder of its transport,
//! where the learner announces its present incarnation; locks keep a second learner or supervisor
//! away, and what dead processes left is swept. The rest is what all of our programs do alike:
//! files written whole ([`durable`]), logs ([`logging`]), the allocator ([`allocation`]), errors on
//! one line ([`failure`]), points at which tests kill a process ([`fault`]), tables for the
//! terminal ([`tables`]), and the frames in TensorBoard's event files ([`write_event_record`]).
//!
//! Identity and announcement are here and not in the protocol: they name this machine's folders and
//! locks, and only processes of this machine read them.

pub mod allocation;
mod claims;
mod courses;
mod directory;
pub mod durable;
mod event_records;
pub mod failure;
pub mod fault;
mod identity;
mod lock;
pub mod log_tail;
pub mod logging;
pub mod orphans;
mod place;
mod presence;
mod results;
mod sweep;
pub mod tables;

pub use claims::ActorClaim;
pub use directory::{RunDirectory, RunError};
pub use event_records::{EventRecordError, split_event_record, write_event_record};
pub use identity::{Announcement, Difference, LearnerIncarnation, RunIdentity};
pub use lock::{LearnerLock, LockError, SupervisorLock};
pub use place::PlaceError;
pub use presence::Presence;
pub use results::save_snapshot;
pub use sweep::{Swept, sweep_leftovers};
