//! Snapshots and the summary as files of a run, written atomically.

use std::io;
use std::path::Path;

use skein_protocol::config::Config;
use skein_protocol::snapshot::{Snapshot, SnapshotError, SnapshotLayout};
use skein_protocol::summary::RunSummary;

use crate::{RunDirectory, durable};

/// Writes `snapshot` to `path` as safetensors, with `config` in its metadata.
///
/// # Errors
/// [`SnapshotError::Io`] names the file.
pub fn save_snapshot(
    snapshot: &Snapshot,
    path: &Path,
    layout: &SnapshotLayout,
    config: &Config,
) -> Result<(), SnapshotError> {
    durable::replace(path, &snapshot.to_file(layout, config)).map_err(|source| SnapshotError::Io {
        path: path.to_owned(),
        source,
    })
}

impl RunDirectory {
    /// Returns the run's summary; `None` if there is none, or it cannot be read.
    pub fn summary(&self) -> Option<RunSummary> {
        RunSummary::load(&self.summary_json())
    }

    /// Writes the run's summary.
    ///
    /// # Errors
    /// Errors of the file system.
    pub fn save_summary(&self, summary: &RunSummary) -> io::Result<()> {
        durable::replace(&self.summary_json(), summary.to_json().as_bytes())
    }
}
