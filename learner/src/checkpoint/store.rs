//! The folder of checkpoints: writing into place, finding, loading, removing old ones.
//!
//! Names that begin with a dot are work in progress and never read: a checkpoint is written under such a name, all of it brought to disk, and renamed; to be
//! removed, it is renamed back to one first.

use std::fs::{self, File};
use std::path::{Path, PathBuf};

use tracing::warn;

use super::manifest::{self, Manifest};
use super::{CheckpointError, CheckpointState, files};

/// The checkpoints of a run.
#[derive(Debug, Clone)]
pub struct CheckpointStore {
    directory: PathBuf,
    config_digest: u64,
    keep: usize,
}

/// Where in `checkpoints` the state after `flights` committed flights lies.
pub fn checkpoint_directory(checkpoints: &Path, flights: u64) -> PathBuf {
    checkpoints.join(format!("flight-{flights}"))
}

impl CheckpointStore {
    /// The checkpoints in `directory` of the run whose configuration has `config_digest`; the `keep` newest are kept.
    pub fn new(directory: &Path, config_digest: u64, keep: usize) -> Self {
        Self {
            directory: directory.to_owned(),
            config_digest,
            keep: keep.max(1),
        }
    }

    /// Where they lie.
    pub fn directory(&self) -> &Path {
        &self.directory
    }

    /// Writes `state`, and removes those beyond the newest few. Returns where it lies.
    ///
    /// # Errors
    /// [`CheckpointError`]; what was there before still is.
    pub fn save(&self, state: &CheckpointState) -> Result<PathBuf, CheckpointError> {
        let flights = state.progress.flights;
        // One name for all: whatever an interrupted write left, of this flight or another, makes room for the next.
        let aside = self.directory.join(".writing");
        remove(&aside)?;
        fs::create_dir_all(&aside).map_err(CheckpointError::io("create", &aside))?;
        files::write(&aside, state)?;
        let manifest = Manifest::of(&aside, &files::NAMES, flights, self.config_digest)?;
        let path = aside.join(manifest::NAME);
        fs::write(&path, manifest.to_json()).map_err(CheckpointError::io("write", &path))?;
        for name in files::NAMES.iter().chain([&manifest::NAME]) {
            sync(&aside.join(name))?;
        }
        sync(&aside)?;
        let place = checkpoint_directory(&self.directory, flights);
        self.retire(&place)?;
        fs::rename(&aside, &place).map_err(CheckpointError::io("rename into place", &aside))?;
        sync(&self.directory)?;
        self.remove_others(flights)?;
        Ok(place)
    }

    /// All checkpoints, the newest first, by the flights committed.
    ///
    /// # Errors
    /// [`CheckpointError::Io`] when the folder cannot be read; a folder that does not exist has none.
    pub fn list(&self) -> Result<Vec<u64>, CheckpointError> {
        if !self.directory.exists() {
            return Ok(Vec::new());
        }
        let io = || CheckpointError::io("list", &self.directory);
        let mut found = Vec::new();
        for entry in fs::read_dir(&self.directory).map_err(io())? {
            let name = entry.map_err(io())?.file_name();
            found.extend(
                name.to_str()
                    .and_then(|name| name.strip_prefix("flight-")?.parse::<u64>().ok()),
            );
        }
        found.sort_unstable_by(|left, right| right.cmp(left));
        Ok(found)
    }

    /// Loads the checkpoint after `flights` committed flights.
    ///
    /// # Errors
    /// [`CheckpointError`] names the file that is missing, damaged, or of another version or configuration.
    pub fn load(&self, flights: u64) -> Result<CheckpointState, CheckpointError> {
        let directory = checkpoint_directory(&self.directory, flights);
        let manifest = Manifest::read(&directory, self.config_digest)?;
        let state = files::read(&directory, &manifest)?;
        for (what, found) in [("the directory's name", flights), ("the manifest", manifest.flights())] {
            if found != state.progress.flights {
                return Err(CheckpointError::Content {
                    path: directory,
                    problem: format!("it is of flight {}, but {what} says {found}", state.progress.flights),
                });
            }
        }
        Ok(state)
    }

    /// Loads the newest checkpoint that is undamaged; `None` when there is none at all. Resuming from an older one costs time, never the result.
    ///
    /// # Errors
    /// The newest one's [`CheckpointError`] when none can be used.
    pub fn load_newest(&self) -> Result<Option<CheckpointState>, CheckpointError> {
        let mut refused = None;
        for flights in self.list()? {
            match self.load(flights) {
                Ok(state) => {
                    if let Some(error) = refused {
                        warn!(%error, resumed_from = flights, "newest checkpoint refused");
                    }
                    return Ok(Some(state));
                }
                Err(error) => refused = refused.or(Some(error)),
            }
        }
        refused.map_or(Ok(None), Err)
    }

    /// Keeps the checkpoint just written and the newest before it. Later ones are of a future that this run has left by resuming from an earlier one.
    fn remove_others(&self, newest: u64) -> Result<(), CheckpointError> {
        let (later, earlier): (Vec<_>, Vec<_>) = self.list()?.into_iter().partition(|&flights| flights > newest);
        for flights in later.into_iter().chain(earlier.into_iter().skip(self.keep)) {
            self.retire(&checkpoint_directory(&self.directory, flights))?;
        }
        Ok(())
    }

    /// Removes a checkpoint, if it is there; half removed, it is not taken for one.
    fn retire(&self, place: &Path) -> Result<(), CheckpointError> {
        if !place.exists() {
            return Ok(());
        }
        let aside = self.directory.join(".removing");
        remove(&aside)?;
        fs::rename(place, &aside).map_err(CheckpointError::io("rename", place))?;
        remove(&aside)
    }
}

fn remove(path: &Path) -> Result<(), CheckpointError> {
    match fs::remove_dir_all(path) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => Err(CheckpointError::io("remove", path)(error)),
        _ => Ok(()),
    }
}

/// Brings a file or directory to disk.
fn sync(path: &Path) -> Result<(), CheckpointError> {
    File::open(path)
        .and_then(|file| file.sync_all())
        .map_err(CheckpointError::io("write to disk", path))
}
