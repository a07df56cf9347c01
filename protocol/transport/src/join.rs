//! Joining a run: its services exist while its learner is alive.

use super::ServiceError;
use skein_protocol::config::Config;
use skein_run::{Announcement, JoinMismatch, PathError, RunIdentity};

/// Reason why a process could not join the learner of a run.
#[derive(Debug, thiserror::Error)]
pub enum JoinError {
    /// The run is over, was never started on this machine, or its learner died or has not opened
    /// its services yet.
    #[error("run {run:016x} has no learner", run = .0.run.0)]
    NoLearner(RunIdentity),
    /// The learner does not match this process.
    #[error(transparent)]
    Mismatch(#[from] JoinMismatch),
    /// The run's folder cannot be read.
    #[error(transparent)]
    Path(#[from] PathError),
    /// The services cannot be used: the learner has just died or ended, or they are damaged.
    #[error(transparent)]
    Service(#[from] ServiceError),
}

impl JoinError {
    /// Returns `true` if a retry cannot help.
    pub fn is_final(&self) -> bool {
        match self {
            Self::NoLearner(_) => false,
            Self::Mismatch(_) => true,
            Self::Path(error) => matches!(error, PathError::OtherUser { .. }),
            Self::Service(error) => error.is_final(),
        }
    }
}

/// Returns the announcement of the learner to join, after checking that this process matches it.
pub(super) fn find_learner(
    identity: &RunIdentity,
    config: &Config,
) -> Result<Announcement, JoinError> {
    let learner = identity
        .current_incarnation()?
        .ok_or_else(|| JoinError::NoLearner(identity.clone()))?;
    learner.check(identity, config)?;
    Ok(learner)
}
