//! Why a run, or actors added to one, failed.

use std::io;
use std::path::PathBuf;

/// Why a run failed.
#[derive(Debug, thiserror::Error)]
pub enum SupervisorError {
    /// A program is not where it should be.
    #[error("{} is missing: build it with `cargo build --release --workspace --bins`", .0.display())]
    Missing(PathBuf),
    /// The supervisor's own needs cannot be met.
    #[error("cannot start: {0}")]
    Setup(#[source] io::Error),
    /// A program cannot be started.
    #[error("cannot start {}: {source}", program.display())]
    Start {
        /// The program.
        program: PathBuf,
        /// Why.
        #[source]
        source: io::Error,
    },
    /// The learner ended before it had reported, for a reason that it told.
    #[error("the learner cannot start: {0}")]
    LearnerCannotStart(String),
    /// The learner ended where it should not have, and is not started again.
    #[error("the learner {how}; its log {} ends with\n{tail}", log.display())]
    LearnerFailed {
        /// How it ended.
        how: String,
        /// Its log file.
        log: PathBuf,
        /// The log's last lines.
        tail: String,
    },
    /// The learner of a run that actors were added to is no more.
    #[error("the learner of {} is gone", .0.display())]
    LearnerGone(PathBuf),
    /// No actor is left.
    #[error("no actor is left: {0}")]
    NoActors(String),
}

impl SupervisorError {
    /// Whether nobody needs to look into a log to know more: a process could not be started, or
    /// said itself why it could not begin.
    pub fn tells_all(&self) -> bool {
        match self {
            Self::Missing(_)
            | Self::Setup(_)
            | Self::Start { .. }
            | Self::LearnerCannotStart(_) => true,
            Self::LearnerFailed { .. } | Self::LearnerGone(_) | Self::NoActors(_) => false,
        }
    }
}
