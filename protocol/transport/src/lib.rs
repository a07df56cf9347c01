//! The iceoryx2 services of a run. This is the only module that names or opens one, and it sets
//! every limit.
//!
//! | service | pattern | from → to | carries |
//! |---|---|---|---|
//! | `transitions` | publish-subscribe | actor → learner | [`TransitionRecord`] (in place) |
//! | `status` | publish-subscribe | actor → learner | [`StatusRecord`] |
//! | `control` | publish-subscribe | learner → actor | [`ControlRecord`]: ticket, heartbeat, stop |
//! | `segments` | publish-subscribe | learner → actor | [`SegmentRecord`]: tickets of segments |
//! | `weights` | publish-subscribe | learner → actor | [`SnapshotHeader`] and a snapshot's bytes |
//! | `wake-learner`, `wake-actors` | event | both | nothing: there is something to read |
//!
//! Nothing here blocks, and no sample is guaranteed to arrive: iceoryx2 drops samples silently when
//! a peer dies or has not connected yet. Tickets bound the data in flight, so only the buffers of a
//! process that was stopped can overflow; it misses what does not fit. An episode with a gap is
//! discarded and its ticket issued again. Every wait has a deadline.
//!
//! Each incarnation of a learner has its own services, see [`LearnerIncarnation`]. Only the learner
//! creates them; all others join those that it has announced.
//!
//! Services carry protocol version, run, configuration and snapshot layout as attributes: opening
//! one is refused to a process that differs in any of them.
//!
//! [`TransitionRecord`]: skein_protocol::transition::TransitionRecord
//! [`StatusRecord`]: skein_protocol::status::StatusRecord
//! [`ControlRecord`]: skein_protocol::ticket::ControlRecord
//! [`SegmentRecord`]: skein_protocol::segment::SegmentRecord
//! [`SnapshotHeader`]: skein_protocol::snapshot::SnapshotHeader

mod actor;
mod join;
mod learner;
mod memory;
mod open;
mod reclaim;
#[cfg(test)]
mod tests;
mod wire;

use std::fmt::Debug;
use std::os::unix::ffi::OsStrExt;
use std::time::Duration;

use iceoryx2::config::Config as IceoryxConfig;
use iceoryx2::node::Node;
use iceoryx2::port::listener::{Listener, ListenerWaitError};
use iceoryx2::prelude::*;

pub use actor::ActorPorts;
pub use join::JoinError;
pub use learner::{LearnerPorts, LearnerWaker};
pub use memory::shared_memory_needed;
use skein_run::{LearnerIncarnation, RunIdentity};
pub use wire::{LoanedTransition, ReceivedTransition};

type Ipc = ipc::Service;

/// Shortest wait for an event: the system counts microseconds and takes zero as "no limit".
const SHORTEST_WAIT: Duration = Duration::from_micros(1);

/// Error of a service.
#[derive(Debug, thiserror::Error)]
#[error("{operation} of service `{service}` failed: {cause}{remedy}")]
pub struct ServiceError {
    /// The service.
    pub service: &'static str,
    /// The failed operation.
    pub operation: &'static str,
    /// iceoryx2's error.
    pub cause: String,
    /// The remedy.
    pub remedy: &'static str,
}

impl ServiceError {
    /// Returns `true` if a retry cannot help, with this learner or its next incarnation: the two
    /// programs differ.
    fn is_final(&self) -> bool {
        self.cause.contains("Incompatible")
    }
}

fn failed<E: Debug>(
    service: &'static str,
    operation: &'static str,
) -> impl FnOnce(E) -> ServiceError {
    move |error| {
        let cause = format!("{error:?}");
        let remedy =
            if cause.contains("IncompatibleAttributes") || cause.contains("IncompatibleTypes") {
                "; this process and the run differ in program version or configuration: start it \
            from the same build and run directory"
            } else if cause.contains("DoesNotExist") {
                "; the learner of this run has not opened it yet, or has ended"
            } else if cause.contains("ExceedsMax") {
                "; no slot is free: raise transport.max_actors"
            } else if cause.contains("StorageFull") || cause.contains("code: 28") {
                "; /dev/shm is full: enlarge it, or start fewer actors"
            } else if cause.contains("InsufficientPermissions") {
                "; the run belongs to another user"
            } else {
                ""
            };
        ServiceError {
            service,
            operation,
            cause,
            remedy,
        }
    }
}

/// Returns iceoryx2's settings for one incarnation of a run's learner. Called before anything else
/// of iceoryx2.
fn transport_config(
    identity: &RunIdentity,
    incarnation: LearnerIncarnation,
) -> Result<IceoryxConfig, ServiceError> {
    // iceoryx2 would log every failure that is also returned here as an error.
    set_log_level(LogLevel::Fatal);
    let mut config = IceoryxConfig::default();
    let root = identity.incarnation_folder(incarnation);
    config.global.set_root_path(
        &Path::new(root.as_os_str().as_bytes()).map_err(failed("all", "setting the root path"))?,
    );
    config.global.prefix = FileName::new(identity.incarnation_prefix(incarnation).as_bytes())
        .map_err(failed("all", "setting the prefix"))?;
    // Only the learner cleans up after dead processes, at its heartbeats. If an actor were killed
    // during a cleanup, iceoryx2 could not detect it, and the cleanup would never finish.
    config.global.node.cleanup_dead_nodes_on_creation = false;
    config.global.node.cleanup_dead_nodes_on_destruction = false;
    config.global.service.cleanup_dead_nodes_on_open = false;
    Ok(config)
}

fn node(
    identity: &RunIdentity,
    incarnation: LearnerIncarnation,
    name: &str,
) -> Result<Node<Ipc>, ServiceError> {
    let config = transport_config(identity, incarnation)?;
    NodeBuilder::new()
        .name(&NodeName::new(name).map_err(failed("all", "naming the node"))?)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .config(&config)
        .create::<Ipc>()
        .map_err(failed("all", "creating the node"))
}

/// Waits for an event or a signal, at most `timeout`.
fn wait(wake: &Listener<Ipc>, timeout: Duration) -> Result<(), ListenerWaitError> {
    match wake.timed_wait(|_| {}, timeout.max(SHORTEST_WAIT)) {
        // A process that was stopped and continued, for example from a terminal, is interrupted
        // too; the caller checks and waits again.
        Ok(_) | Err(ListenerWaitError::InterruptSignal) => Ok(()),
        Err(error) => Err(error),
    }
}
