//! Errors of checkpoints.

use std::io;
use std::path::PathBuf;

/// Reason why a checkpoint cannot be written or used. Every variant names the file.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// The file system refuses.
    #[error("cannot {action} {}: {source}", path.display())]
    Io {
        /// Attempted action, as a verb.
        action: &'static str,
        /// Path of the file or directory.
        path: PathBuf,
        /// Cause.
        #[source]
        source: io::Error,
    },
    /// The manifest is not as this program wrote it.
    #[error("{} is damaged: {problem}", path.display())]
    Manifest {
        /// Path of the manifest.
        path: PathBuf,
        /// Description of the damage.
        problem: String,
    },
    /// Another version wrote the checkpoint.
    #[error(
        "{} has checkpoint format {found}, but this program reads format {expected}: \
         resume it with the version that wrote it",
        path.display()
    )]
    Format {
        /// Path of the manifest.
        path: PathBuf,
        /// Format of the manifest.
        found: u32,
        /// Format that this program reads.
        expected: u32,
    },
    /// The checkpoint belongs to another configuration.
    #[error(
        "{} was written under another configuration: {differences}; \
         a run is resumed under the configuration it started with",
        path.display()
    )]
    Configuration {
        /// Path of the checkpoint.
        path: PathBuf,
        /// Each differing key with both values.
        differences: String,
    },
    /// A file differs from what was written.
    #[error(
        "{} is damaged: {what} is {found} where the manifest says {expected}",
        path.display()
    )]
    Damaged {
        /// Path of the file.
        path: PathBuf,
        /// `size` or `checksum`.
        what: &'static str,
        /// Value of the file.
        found: String,
        /// Value in the manifest.
        expected: String,
    },
    /// A file's checksum is right, but its content is invalid.
    #[error("{} cannot be used: {problem}", path.display())]
    Content {
        /// Path of the file.
        path: PathBuf,
        /// Description of the problem.
        problem: String,
    },
    /// Files beside the checkpoint that it relies on have changed.
    #[error("the checkpoint of episode {episodes} does not fit: {problem}")]
    Unfit {
        /// Episode of the checkpoint.
        episodes: u64,
        /// Description of what does not fit, with the file.
        problem: String,
    },
    /// Checkpoints exist, but none can be used.
    #[error(
        "none of the {count} checkpoints in {} can be used. The newest: {newest}. Repair it; \
         or, to train again from the first episode, remove that folder and episodes.csv",
        directory.display()
    )]
    NoneUsable {
        /// Folder of the checkpoints.
        directory: PathBuf,
        /// Number of checkpoints.
        count: usize,
        /// Reason why the newest one cannot be used.
        #[source]
        newest: Box<CheckpointError>,
    },
    /// The writing thread has ended.
    #[error(
        "the thread that writes checkpoints to {} ended early",
        directory.display()
    )]
    WriterGone {
        /// Folder that it wrote to.
        directory: PathBuf,
    },
}

impl CheckpointError {
    /// `true` if the checkpoint is damaged, so that an older one may help. A checkpoint of another
    /// version or configuration is sound, and older ones are no better.
    pub(super) fn is_damage(&self) -> bool {
        !matches!(self, Self::Format { .. } | Self::Configuration { .. })
    }

    /// Adds `path` and `action` to an I/O error.
    pub(super) fn io(
        action: &'static str,
        path: impl Into<PathBuf>,
    ) -> impl FnOnce(io::Error) -> Self {
        let path = path.into();
        move |source| Self::Io {
            action,
            path,
            source,
        }
    }
}
