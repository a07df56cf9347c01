//! Errors that end a training early.

use std::io;
use std::path::PathBuf;

use skein_protocol::snapshot::SnapshotError;

use crate::UpdateError;
use crate::checkpoint::CheckpointError;
use crate::episodes::ReceiverError;
use crate::evaluation::EvaluationWriteError;
use crate::metrics::MetricsError;
use crate::replay::InsertError;
use crate::trainer::{TrainerError, TrainerRestoreError};

/// Reason why a training ended early.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // every variant is named after the part that failed
pub enum TrainingError {
    #[error(transparent)]
    Trainer(#[from] TrainerError),
    #[error(transparent)]
    EpisodeReceiver(#[from] ReceiverError),
    #[error(transparent)]
    Insert(#[from] InsertError),
    #[error(transparent)]
    Update(#[from] UpdateError),
    #[error(transparent)]
    Metrics(#[from] MetricsError),
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    #[error(transparent)]
    Snapshot(#[from] SnapshotError),
    #[error(transparent)]
    Evaluation(#[from] EvaluationWriteError),
    #[error("cannot start a thread: {0}")]
    Thread(#[source] io::Error),
    #[error("{}: {source}", path.display())]
    File {
        path: PathBuf,
        #[source]
        source: io::Error,
    },
    /// A checkpoint is undamaged, but does not fit.
    #[error("the checkpoint of episode {episodes} cannot be resumed: {source}")]
    Restore {
        episodes: u64,
        #[source]
        source: TrainerRestoreError,
    },
    /// A checkpoint lacks a snapshot it should hold, or holds another one.
    #[error(
        "the checkpoint of episode {episodes} cannot be resumed: its snapshot {version} {problem}"
    )]
    RestoredSnapshot {
        episodes: u64,
        version: u64,
        problem: &'static str,
    },
    /// No checkpoint exists where there must have been one.
    #[error(
        "{} has {rows} episodes, but {} holds no checkpoint or does not exist; \
         one is written every {first_after} episodes: put the checkpoints back; \
         or, to train again from the first episode, remove episodes.csv",
        episodes_csv.display(),
        checkpoints.display()
    )]
    CheckpointsLost {
        episodes_csv: PathBuf,
        rows: u64,
        checkpoints: PathBuf,
        first_after: u64,
    },
    /// The run was stopped before the end of an epoch's updates, or of the episode in progress.
    #[error("stopped in the middle of an epoch")]
    Abandoned,
}

impl TrainingError {
    /// `true` if a new incarnation of the learner may get further: the transport failed, and
    /// nothing that was computed is at fault. Any other error would recur.
    pub fn is_transport_failure(&self) -> bool {
        matches!(self, Self::EpisodeReceiver(ReceiverError::Transport(_)))
    }
}

#[cfg(test)]
mod tests {
    use skein_protocol::ids::EpisodeId;

    use super::*;
    use crate::episodes::dispatcher::HopelessEpisode;

    #[test]
    fn only_a_failed_transport_is_worth_another_incarnation() {
        let hopeless = HopelessEpisode {
            episode: EpisodeId(3),
            failures: 3,
            why: "the simulator broke down".to_owned(),
        };
        let error = |error: ReceiverError| TrainingError::from(error);
        assert!(error(ReceiverError::Transport("no memory".to_owned())).is_transport_failure());
        assert!(!error(hopeless.into()).is_transport_failure());
        let diverged = UpdateError::NonFinite {
            tensor: "critic loss",
            update: 7,
        };
        assert!(!TrainingError::from(diverged).is_transport_failure());
    }
}
