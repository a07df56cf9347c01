//! The iceoryx2 services of a run: the only place that names or opens one, and sets every limit.
//!
//! | service | pattern | from → to | carries |
//! |---|---|---|---|
//! | `transitions` | publish-subscribe | actors → learner | [`TransitionRecord`], rendered into the loaned sample |
//! | `status` | publish-subscribe | actors → learner | [`StatusRecord`] |
//! | `control` | publish-subscribe | learner → actors | [`ControlRecord`]: tickets, heartbeats, the stop |
//! | `segments` | publish-subscribe | learner → actors | [`SegmentRecord`]: tickets of segments |
//! | `weights` | publish-subscribe | learner → actors | snapshots' bytes behind a [`SnapshotHeader`] |
//! | `wake-learner`, `wake-actors` | event | both | that there is something to read |
//!
//! Nothing here blocks and nothing here is trusted to arrive: iceoryx2 loses samples silently when
//! a peer dies or has not connected yet. Tickets bound what is outstanding, so no buffer can
//! overflow but that of a process that was stopped, which misses what does not fit; an episode with
//! a hole is discarded and its ticket issued again; every wait has a deadline.
//!
//! Each incarnation of a learner has services of its own, see [`LearnerIncarnation`]. Only the
//! learner creates them; everybody else joins those that it has announced.
//!
//! Services carry protocol version, run, configuration and snapshot layout as attributes: a process
//! that differs in one of them is refused on opening.
//!
//! [`TransitionRecord`]: skein_protocol::transition::TransitionRecord
//! [`StatusRecord`]: skein_protocol::status::StatusRecord
//! [`ControlRecord`]: skein_protocol::ticket::ControlRecord
//! [`SegmentRecord`]: skein_protocol::segment::SegmentRecord
//! [`SnapshotHeader`]: skein_protocol::snapshot::SnapshotHeader

mod actor;
mod dead;
mod joining;
mod learner;
mod memory;
mod opening;
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
pub use joining::JoinError;
pub use learner::{LearnerPorts, LearnerWaker};
pub use memory::shared_memory_needed;
use skein_run::{LearnerIncarnation, RunIdentity};
pub use wire::{LoanedTransition, ReceivedTransition};

type Ipc = ipc::Service;

/// Shortest wait for an event: the system counts in microseconds and takes none of them for no
/// limit at all.
const SHORTEST_WAIT: Duration = Duration::from_micros(1);

/// What a service could not do.
#[derive(Debug, thiserror::Error)]
#[error("{operation} of service `{service}` failed: {cause}{remedy}")]
pub struct ServiceError {
    /// The service.
    pub service: &'static str,
    /// What was tried.
    pub operation: &'static str,
    /// iceoryx2's word for it.
    pub cause: String,
    /// What to do about it.
    pub remedy: &'static str,
}

impl ServiceError {
    /// Whether trying again cannot help, with this learner or its next incarnation: the two
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
        let remedy = if cause.contains("IncompatibleAttributes")
            || cause.contains("IncompatibleTypes")
        {
            "; this process and the run differ in program version or configuration: start it from the same build and run directory"
        } else if cause.contains("DoesNotExist") {
            "; the learner of this run has not opened it, or is gone"
        } else if cause.contains("ExceedsMax") {
            "; no slot is free: raise transport.max_actors"
        } else if cause.contains("StorageFull") || cause.contains("code: 28") {
            "; /dev/shm is full: make it larger, or start fewer actors"
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

/// iceoryx2's settings for one incarnation of a run's learner. Called before anything else of
/// iceoryx2 is.
fn transport_config(
    identity: &RunIdentity,
    incarnation: LearnerIncarnation,
) -> Result<IceoryxConfig, ServiceError> {
    // Everything iceoryx2 would print goes wrong again, with our words, in the errors returned
    // here.
    set_log_level(LogLevel::Fatal);
    let mut config = IceoryxConfig::default();
    let root = identity.incarnation_folder(incarnation);
    config.global.set_root_path(
        &Path::new(root.as_os_str().as_bytes()).map_err(failed("all", "setting the root path"))?,
    );
    config.global.prefix = FileName::new(identity.incarnation_prefix(incarnation).as_bytes())
        .map_err(failed("all", "setting the prefix"))?;
    // The learner alone cleans up after the dead, at its heartbeats. Of an actor that is killed
    // while it does, iceoryx2 could not tell whether it still does, and nobody would go on with it.
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

/// Waits for an event or a signal, not longer than `timeout`.
fn wait(wake: &Listener<Ipc>, timeout: Duration) -> Result<(), ListenerWaitError> {
    match wake.timed_wait(|_| {}, timeout.max(SHORTEST_WAIT)) {
        // A process that was stopped and continued, from a terminal say, is interrupted too;
        // whoever waits looks round and waits again.
        Ok(_) | Err(ListenerWaitError::InterruptSignal) => Ok(()),
        Err(error) => Err(error),
    }
}
