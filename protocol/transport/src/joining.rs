//! Joining a run: its services are there while its learner incarnations.

use super::ServiceError;
use skein_protocol::config::Config;
use skein_run::{Announcement, Difference, PlaceError, RunIdentity};

/// Why a process could not join the learner of a run.
#[derive(Debug, thiserror::Error)]
pub enum JoinError {
    /// The run is over, was never started on this machine, or its learner died or has not opened
    /// its services yet.
    #[error("no learner of run {run:016x} is there", run = .0.run.0)]
    NoLearner(RunIdentity),
    /// There is one that this process does not fit.
    #[error(transparent)]
    Difference(#[from] Difference),
    /// The run's folder cannot be looked at.
    #[error(transparent)]
    Place(#[from] PlaceError),
    /// Its services cannot be used: it died or ended just now, or they are out of order.
    #[error(transparent)]
    Service(#[from] ServiceError),
}

impl JoinError {
    /// Whether trying again cannot help.
    pub fn is_final(&self) -> bool {
        match self {
            Self::NoLearner(_) => false,
            Self::Difference(_) => true,
            Self::Place(error) => matches!(error, PlaceError::OtherUser { .. }),
            Self::Service(error) => error.is_final(),
        }
    }
}

/// The learner to join, which this process fits.
pub(super) fn learner_of(
    identity: &RunIdentity,
    config: &Config,
) -> Result<Announcement, JoinError> {
    let learner = identity
        .present_incarnation()?
        .ok_or_else(|| JoinError::NoLearner(identity.clone()))?;
    learner.check(identity, config)?;
    Ok(learner)
}
