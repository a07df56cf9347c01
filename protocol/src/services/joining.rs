//! Joining a run: its services are there while its learner lives.

use std::path::PathBuf;
use std::thread::sleep;
use std::time::{Duration, Instant};

use iceoryx2::node::{Node, NodeState, NodeView};
use iceoryx2::prelude::*;

use super::{Ipc, ServiceError, failed, node, transport_config};
use crate::run::RunIdentity;

/// How long an actor waits for a learner that starts at the same time.
pub(super) const JOIN_PATIENCE: Duration = Duration::from_secs(20);
/// Time between two looks whether it is there.
pub(super) const JOIN_INTERVAL: Duration = Duration::from_millis(50);
/// The name of the learner's node, by which others know that it is alive.
pub(super) const LEARNER: &str = "learner";

/// Why a process could not join the services of a run.
#[derive(Debug, thiserror::Error)]
pub enum JoinError {
    /// The run is over, was never started on this machine, or its learner died.
    #[error("no learner of this run is there: none came to {} within {patience_secs} s", transport_root.display())]
    NoLearner {
        /// [`RunIdentity::transport_root`].
        transport_root: PathBuf,
        /// Seconds it was waited for.
        patience_secs: f64,
    },
    /// There is one, but its services cannot be used.
    #[error(transparent)]
    Service(#[from] ServiceError),
}

/// Whether the learner of a run is alive on this machine. Looking leaves no trace.
///
/// # Errors
/// [`ServiceError`] when the run's processes cannot be looked at: it belongs to another user.
pub fn is_learner_alive(identity: &RunIdentity) -> Result<bool, ServiceError> {
    if !identity.transport_root.exists() {
        return Ok(false);
    }
    let mut is_alive = false;
    Node::<Ipc>::list(&transport_config(identity)?, |state| {
        if let NodeState::Alive(node) = state {
            is_alive |= node
                .details()
                .as_ref()
                .is_some_and(|details| details.name().as_str() == LEARNER);
        }
        CallbackProgression::Continue
    })
    .map_err(failed("all", "looking for the learner"))?;
    Ok(is_alive)
}

/// A node called `name` for a process that joins a learner. It is made only once there is a learner, because making it creates the transport's folder.
pub(super) fn join_learner(identity: &RunIdentity, name: &str, patience: Duration) -> Result<Node<Ipc>, JoinError> {
    let deadline = Instant::now() + patience;
    while !is_learner_alive(identity)? {
        if Instant::now() >= deadline {
            return Err(JoinError::NoLearner {
                transport_root: identity.transport_root.clone(),
                patience_secs: patience.as_secs_f64(),
            });
        }
        sleep(JOIN_INTERVAL);
    }
    Ok(node(identity, name)?)
}
