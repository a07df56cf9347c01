//! Errors of a supervised run, or of actors added to one.

use std::io;
use std::path::PathBuf;

/// Reason why a run failed.
#[derive(Debug, thiserror::Error)]
pub enum SupervisorError {
    /// A program file does not exist.
    #[error(
        "{} is missing: build it with `cargo build --release --workspace --bins`",
        .0.display()
    )]
    Missing(PathBuf),
    /// The supervisor could not set up its own resources.
    #[error("cannot start: {0}")]
    Setup(#[source] io::Error),
    /// A program cannot be started.
    #[error("cannot start {}: {source}", program.display())]
    Start {
        /// The program.
        program: PathBuf,
        /// The operating system's error.
        #[source]
        source: io::Error,
    },
    /// The learner ended before its first report and gave this reason.
    #[error("the learner cannot start: {0}")]
    LearnerCannotStart(String),
    /// The learner ended unexpectedly and is not restarted.
    #[error("the learner {how}; its log {} ends with\n{tail}", log.display())]
    LearnerFailed {
        /// End of its process.
        how: String,
        /// Its log file.
        log: PathBuf,
        /// The log's last lines.
        tail: String,
    },
    /// The learner of a run to which actors were added has ended.
    #[error("the learner of the run in {} has ended", .0.display())]
    LearnerGone(PathBuf),
    /// The run's directory is gone, or no run's any more.
    #[error(
        "{} was removed or moved while the run was under way, so nothing more can be saved: \
         start a new run",
        .0.display()
    )]
    DirectoryGone(PathBuf),
    /// No actor is left.
    #[error("no actor is left: {0}")]
    NoActors(String),
}

impl SupervisorError {
    /// Returns `true` if the message is complete without a log: a process could not be started, or
    /// it printed itself why it could not begin.
    pub fn is_self_explanatory(&self) -> bool {
        match self {
            Self::Missing(_)
            | Self::Setup(_)
            | Self::Start { .. }
            | Self::LearnerCannotStart(_)
            | Self::DirectoryGone(_) => true,
            Self::LearnerFailed { .. } | Self::LearnerGone(_) | Self::NoActors(_) => false,
        }
    }
}
