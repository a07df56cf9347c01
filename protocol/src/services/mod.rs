//! The iceoryx2 services of a run: the only place that names or opens one, and sets every limit.
//!
//! | service | pattern | from → to | carries |
//! |---|---|---|---|
//! | `transitions` | publish-subscribe | actors → learner | [`TransitionRecord`](crate::transition::TransitionRecord), rendered into the loaned sample |
//! | `status` | publish-subscribe | actors → learner | [`StatusRecord`](crate::status::StatusRecord) |
//! | `control` | publish-subscribe | learner → actors | [`ControlRecord`](crate::ticket::ControlRecord): tickets, signs of life, the stop |
//! | `weights` | publish-subscribe | learner → actors | snapshots' bytes behind a [`SnapshotHeader`](crate::snapshot::SnapshotHeader) |
//! | `wake-learner`, `wake-actors` | event | both | that there is something to read |
//!
//! Nothing here blocks and nothing here is trusted to arrive: iceoryx2 loses samples silently when a peer dies or has not connected yet. Tickets bound
//! what is in flight, so no buffer can overflow but that of a process that was stopped, which misses what does not fit; a flight with a hole is discarded
//! and its ticket issued again; every wait has a deadline.
//!
//! Only the learner creates services; everybody else joins those that are there, so that an actor of a run that is over leaves nothing behind.
//!
//! Services carry protocol version, run, configuration and snapshot layout as attributes: a process that differs in one of them is refused on opening.

mod actor;
mod joining;
mod learner;
mod opening;
#[cfg(test)]
mod tests;

use std::fmt::Debug;
use std::time::Duration;

use iceoryx2::config::Config as IceoryxConfig;
use iceoryx2::node::Node;
use iceoryx2::port::listener::{Listener, ListenerWaitError};
use iceoryx2::prelude::*;

use crate::run::RunIdentity;

pub use actor::{ActorPorts, LoanedTransition};
pub use joining::{JoinError, is_learner_alive};
pub use learner::{LearnerPorts, LearnerWaker, ReceivedTransition};

type Ipc = ipc::Service;

/// Shortest wait for an event: the system counts in microseconds and takes none of them for no limit at all.
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
    /// Whether waiting may help: the learner has not created the service yet, or its predecessor's is being removed.
    fn may_pass(&self) -> bool {
        ["DoesNotExist", "HangsInCreation", "IsMarkedForDestruction"]
            .iter()
            .any(|cause| self.cause.contains(cause))
    }
}

fn failed<E: Debug>(service: &'static str, operation: &'static str) -> impl FnOnce(E) -> ServiceError {
    move |error| {
        let cause = format!("{error:?}");
        let remedy = if cause.contains("IncompatibleAttributes") || cause.contains("IncompatibleTypes") {
            "; this process and the run differ in program version or configuration: start it from the same build and run directory"
        } else if cause.contains("DoesNotExist") {
            "; the learner of this run has not opened it, or is gone"
        } else if cause.contains("ExceedsMax") {
            "; no slot is free: raise transport.max_actors, or end the other learner of this run"
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

/// iceoryx2's settings for one run. Called before anything else of iceoryx2 is.
fn transport_config(identity: &RunIdentity) -> Result<IceoryxConfig, ServiceError> {
    // Everything iceoryx2 would print goes wrong again, with our words, in the errors returned here.
    set_log_level(LogLevel::Fatal);
    let mut config = IceoryxConfig::default();
    let root = identity.transport_root.to_string_lossy();
    config
        .global
        .set_root_path(&Path::new(root.as_bytes()).map_err(failed("all", "setting the root path"))?);
    config.global.prefix =
        FileName::new(identity.transport_prefix.as_bytes()).map_err(failed("all", "setting the prefix"))?;
    Ok(config)
}

fn node(identity: &RunIdentity, name: &str) -> Result<Node<Ipc>, ServiceError> {
    let config = transport_config(identity)?;
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
        // A process that was stopped and continued, from a terminal say, is interrupted too; whoever waits looks round and waits again.
        Ok(_) | Err(ListenerWaitError::InterruptSignal) => Ok(()),
        Err(error) => Err(error),
    }
}
