//! What can go wrong with a checkpoint.

use std::io;
use std::path::PathBuf;

/// Why a checkpoint cannot be written or used. Every variant names the file.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// The file system refuses.
    #[error("cannot {action} {}: {source}", path.display())]
    Io {
        /// What was tried, as a verb.
        action: &'static str,
        /// The file or directory.
        path: PathBuf,
        /// Why.
        #[source]
        source: io::Error,
    },
    /// The manifest is not one that this program wrote.
    #[error("{} is damaged: {problem}", path.display())]
    Manifest {
        /// The manifest.
        path: PathBuf,
        /// What is wrong with it.
        problem: String,
    },
    /// It was written by another version.
    #[error("{} has checkpoint format {found}, but this program reads format {expected}: resume it with the version that wrote it", path.display())]
    Format {
        /// The manifest.
        path: PathBuf,
        /// Its format.
        found: u32,
        /// Ours.
        expected: u32,
    },
    /// It belongs to another configuration.
    #[error("{} was written under another configuration: {differences}; a run is resumed under the configuration it began with", path.display())]
    Configuration {
        /// The checkpoint.
        path: PathBuf,
        /// Each key with both values.
        differences: String,
    },
    /// A file is not what was written.
    #[error("{} is damaged: {what} is {found} where the manifest says {expected}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// `size` or `checksum`.
        what: &'static str,
        /// Found in the file.
        found: String,
        /// According to the manifest.
        expected: String,
    },
    /// A file's checksum is right, but its content makes no sense.
    #[error("{} cannot be used: {problem}", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        problem: String,
    },
    /// It counts on files beside it that are not as they were.
    #[error("the checkpoint of episode {episodes} does not fit: {problem}")]
    Unfit {
        /// The checkpoint.
        episodes: u64,
        /// What does not fit, with the file.
        problem: String,
    },
    /// There are checkpoints, but none can be used.
    #[error(
        "none of the {count} checkpoints in {} can be used. The newest: {newest}. Mend that; or, to train anew from the first episode, remove that folder and episodes.csv", directory.display()
    )]
    NoneUsable {
        /// Where they lie.
        directory: PathBuf,
        /// How many there are.
        count: usize,
        /// Why the newest cannot be used.
        #[source]
        newest: Box<CheckpointError>,
    },
    /// The writing thread is gone.
    #[error("the thread that writes checkpoints to {} ended early", directory.display())]
    WriterGone {
        /// Where it wrote to.
        directory: PathBuf,
    },
}

impl CheckpointError {
    /// Whether the checkpoint is damaged, so that an older one may do; one of another version or
    /// configuration is sound, and older ones are no better.
    pub(super) fn is_damage(&self) -> bool {
        !matches!(self, Self::Format { .. } | Self::Configuration { .. })
    }

    /// Names `path` and `action` of an I/O error.
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
