//! The folder of checkpoints: writing, finding, loading, and removing old ones.
//!
//! Names that begin with a dot are work in progress and never read. A checkpoint is written under
//! such a name, synced to disk, and renamed. For removal it is first renamed back to such a name. A
//! checkpoint that replaces one of the same episode leaves the old one beside it until it is in
//! place. So there is always a sound checkpoint, once there is one.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use skein_protocol::config::Config;
use skein_run::fault::{FaultPoint, die_if_armed};
use tracing::warn;

use super::manifest::{self, Manifest};
use super::{CheckpointError, CheckpointState, Files, Storage, files};

/// Suffix of a checkpoint that is about to be replaced by one of the same episode.
const REPLACED: &str = ".replaced";

/// The checkpoints of a run, in the system's files or another storage.
#[derive(Debug, Clone)]
pub struct CheckpointStore<S = Files> {
    storage: S,
    directory: PathBuf,
    config: Config,
    /// `config` as it is stored, and its digest.
    portable: String,
    digest: u64,
    keep: usize,
}

/// A checkpoint in the folder.
#[derive(Debug, Clone, PartialEq, Eq)]
struct StoredCheckpoint {
    episodes: u64,
    path: PathBuf,
}

/// Path in `checkpoints` of the state after `episodes` committed episodes.
pub fn checkpoint_directory(checkpoints: &Path, episodes: u64) -> PathBuf {
    checkpoints.join(format!("episode-{episodes}"))
}

impl CheckpointStore {
    /// Opens the checkpoints in `directory` of the run that `config` describes. As many of the
    /// newest sound ones are kept as `config` says.
    pub fn new(directory: &Path, config: &Config) -> Self {
        Self::on(Files, directory, config)
    }
}

impl<S: Storage> CheckpointStore<S> {
    /// Like [`CheckpointStore::new`], in `storage`.
    pub fn on(storage: S, directory: &Path, config: &Config) -> Self {
        let portable = config.portable();
        Self {
            storage,
            directory: directory.to_owned(),
            config: config.clone(),
            digest: Config::digest_of(&portable),
            portable,
            keep: config.checkpoints.keep.max(1),
        }
    }

    /// Path of the folder.
    pub fn directory(&self) -> &Path {
        &self.directory
    }

    /// Writes `state`, and removes checkpoints beyond the newest few. Returns the new checkpoint's
    /// path.
    ///
    /// `relied_on`: other files on whose present content the state relies. They are synced to disk
    /// before the checkpoint is in place.
    ///
    /// # Errors
    /// [`CheckpointError`]; earlier checkpoints stay, and nothing half-written remains.
    pub fn save(
        &self,
        state: &CheckpointState,
        relied_on: &[PathBuf],
    ) -> Result<PathBuf, CheckpointError> {
        let episodes = state.progress.episodes;
        // A single name, so that the leftovers of any interrupted write are removed by the next.
        let aside = self.directory.join(".writing");
        self.remove(&aside)?;
        if let Err(error) = self.write_aside(&aside, state, relied_on) {
            self.remove(&aside)?;
            return Err(error);
        }
        die_if_armed(FaultPoint::CheckpointSynced);
        let place = checkpoint_directory(&self.directory, episodes);
        self.make_way(&place)?;
        let renamed = self.storage.rename(&aside, &place);
        renamed.map_err(CheckpointError::io("rename into place", &aside))?;
        self.sync(&self.directory)?;
        die_if_armed(FaultPoint::CheckpointRenamed);
        self.remove_others(episodes)?;
        Ok(place)
    }

    fn write_aside(
        &self,
        aside: &Path,
        state: &CheckpointState,
        relied_on: &[PathBuf],
    ) -> Result<(), CheckpointError> {
        // Not the run's own directory: a run that was removed does not come back as a folder.
        for folder in [&self.directory, aside] {
            let created = self.storage.create_directory(folder);
            created.map_err(CheckpointError::io("create", folder))?;
        }
        die_if_armed(FaultPoint::CheckpointCreated);
        files::write(&self.storage, aside, state, &self.portable)?;
        self.seal(aside, state.progress.episodes)?;
        die_if_armed(FaultPoint::CheckpointManifest);
        for name in files::NAMES.iter().chain([&manifest::NAME]) {
            self.sync(&aside.join(name))?;
        }
        self.sync(aside)?;
        // A new file's name lies in its folder, so the folder is synced too.
        let folders: BTreeSet<&Path> = relied_on.iter().filter_map(|path| path.parent()).collect();
        let mut all = relied_on.iter().map(PathBuf::as_path).chain(folders);
        all.try_for_each(|path| self.sync_once(path))
    }

    /// Writes the manifest of the files in `directory` as they are now, which makes them a
    /// checkpoint after `episodes` episodes.
    ///
    /// # Errors
    /// [`CheckpointError::Io`] names the file.
    pub fn seal(&self, directory: &Path, episodes: u64) -> Result<(), CheckpointError> {
        let manifest = Manifest::of(
            &self.storage,
            directory,
            &files::NAMES,
            episodes,
            self.digest,
        )?;
        files::write_bytes(
            &self.storage,
            &directory.join(manifest::NAME),
            manifest.to_text().as_bytes(),
        )
    }

    /// Renames a sound checkpoint at `place` to the name under which it is still found until the
    /// new one is in place.
    fn make_way(&self, place: &Path) -> Result<(), CheckpointError> {
        if !self.is_sound(place) {
            // The predecessor may still lie beside it; then that one stays.
            return self.retire(place);
        }
        let replaced = replaced(place);
        self.retire(&replaced)?;
        let renamed = self.storage.rename(place, &replaced);
        renamed.map_err(CheckpointError::io("rename", place))
    }

    /// Lists the episodes with a checkpoint, the newest first. A folder that does not exist has
    /// none.
    ///
    /// # Errors
    /// [`CheckpointError::Io`] when the folder cannot be read.
    pub fn list(&self) -> Result<Vec<u64>, CheckpointError> {
        let mut episodes: Vec<u64> = self.places()?.iter().map(|place| place.episodes).collect();
        episodes.dedup();
        Ok(episodes)
    }

    /// Lists all checkpoints, the newest first. Of two with one episode, the replacing one comes
    /// first.
    fn places(&self) -> Result<Vec<StoredCheckpoint>, CheckpointError> {
        if !self.storage.exists(&self.directory) {
            return Ok(Vec::new());
        }
        // A checkpoint is a directory; other entries are ignored.
        let names = self.storage.directories(&self.directory);
        let mut found = Vec::new();
        for name in names.map_err(CheckpointError::io("list", &self.directory))? {
            let episodes = name.to_str().and_then(|name| {
                let number = name.strip_prefix("episode-")?;
                number
                    .strip_suffix(REPLACED)
                    .unwrap_or(number)
                    .parse::<u64>()
                    .ok()
            });
            found.extend(episodes.map(|episodes| StoredCheckpoint {
                episodes,
                path: self.directory.join(&name),
            }));
        }
        // The shorter of two names belongs to the newer one.
        found.sort_by_key(|place| {
            (
                std::cmp::Reverse(place.episodes),
                place.path.as_os_str().len(),
            )
        });
        Ok(found)
    }

    /// Loads the checkpoint after `episodes` committed episodes.
    ///
    /// # Errors
    /// [`CheckpointError`] names the file that is missing, damaged, or of another version or
    /// configuration.
    pub fn load(&self, episodes: u64) -> Result<CheckpointState, CheckpointError> {
        self.load_from(&StoredCheckpoint {
            episodes,
            path: checkpoint_directory(&self.directory, episodes),
        })
    }

    fn load_from(&self, place: &StoredCheckpoint) -> Result<CheckpointState, CheckpointError> {
        let manifest = Manifest::read(&self.storage, &place.path)?;
        let config = manifest.read_file(&self.storage, &place.path, files::CONFIG)?;
        let shorter = match manifest.is_of(self.digest) {
            true => None,
            false => Some(self.before_lengthening(&place.path, &config)?),
        };
        let state = files::read(&self.storage, &place.path, &manifest)?;
        if let Some(end) = shorter {
            self.check_before_end(&state, end)?;
        }
        for (what, found) in [
            ("the directory's name", place.episodes),
            ("the manifest", manifest.episodes()),
        ] {
            if found != state.progress.episodes {
                return Err(CheckpointError::Content {
                    path: place.path.clone(),
                    problem: format!(
                        "it is of episode {}, but {what} says {found}",
                        state.progress.episodes
                    ),
                });
            }
        }
        let window = self.config.evaluation.window_episodes;
        if !state.progress.metrics.windows.are_over(window as usize) {
            return Err(CheckpointError::Content {
                path: place.path.clone(),
                problem: format!(
                    "its averages are not over evaluation.window_episodes = {window} episodes"
                ),
            });
        }
        Ok(state)
    }

    /// Returns `run.episodes` of the checkpoint at `path` with the configuration `config`, which is
    /// of this run before it was lengthened.
    fn before_lengthening(&self, path: &Path, config: &[u8]) -> Result<u64, CheckpointError> {
        self.config
            .lengthened_from(&String::from_utf8_lossy(config))
            .ok_or_else(|| self.other_configuration(path, config))
    }

    /// Checks that nothing in `state`, of a run of `end` episodes, would differ in a longer run.
    /// At its end, the last epoch may be short, the last snapshot is always a candidate, and no
    /// epoch after the last was ordered ahead.
    fn check_before_end(&self, state: &CheckpointState, end: u64) -> Result<(), CheckpointError> {
        let learning = &self.config.learning;
        let epochs = end.div_ceil(learning.episodes_per_epoch);
        if state.progress.epochs + learning.policy_lag.max(1) <= epochs {
            return Ok(());
        }
        Err(CheckpointError::Unfit {
            episodes: state.progress.episodes,
            problem: format!(
                "it is of the end of the run of {end} episodes, and a longer one resumes from \
                 before that"
            ),
        })
    }

    fn other_configuration(&self, path: &Path, config: &[u8]) -> CheckpointError {
        let differences = self.config.differences(&String::from_utf8_lossy(config));
        CheckpointError::Configuration {
            path: path.to_owned(),
            differences: match differences {
                Ok(differences) if !differences.is_empty() => differences.join(", "),
                _ => "see its config.toml".to_owned(),
            },
        }
    }

    /// Loads the newest undamaged checkpoint; `None` if there is no checkpoint at all. Resuming
    /// from an older one costs time but does not change the result. `check` may refuse a checkpoint
    /// that does not fit the files beside it. Every newer checkpoint that is damaged or refused is
    /// reported to `passed_over`.
    ///
    /// # Errors
    /// [`CheckpointError::NoneUsable`] when none is usable: a run is not silently started again.
    /// [`CheckpointError::Format`] or [`CheckpointError::Configuration`] when the newest undamaged
    /// one is of another version or configuration.
    pub fn load_newest(
        &self,
        check: impl Fn(&CheckpointState) -> Result<(), CheckpointError>,
        mut passed_over: impl FnMut(&CheckpointError),
    ) -> Result<Option<CheckpointState>, CheckpointError> {
        let places = self.places()?;
        let count = places.len();
        let mut newest = None;
        for place in places {
            let loaded = self.load_from(&place);
            match loaded.and_then(|state| check(&state).map(|()| state)) {
                Ok(state) => {
                    // A writer killed before it synced this name may have left it to a power cut.
                    self.sync(&self.directory)?;
                    return Ok(Some(state));
                }
                Err(error) if error.is_damage() => {
                    passed_over(&error);
                    newest = newest.or(Some(Box::new(error)));
                }
                Err(error) => return Err(error),
            }
        }
        newest.map_or(Ok(None), |newest| {
            Err(CheckpointError::NoneUsable {
                directory: self.directory.clone(),
                count,
                newest,
            })
        })
    }

    /// Keeps the checkpoint just written and the newest sound ones before it. Later ones belong to
    /// a future that this run left by resuming from an earlier one.
    fn remove_others(&self, newest: u64) -> Result<(), CheckpointError> {
        let mut sound = BTreeSet::from([newest]);
        for place in self.places()? {
            if place.path == checkpoint_directory(&self.directory, newest) {
                continue;
            }
            let superfluous = place.episodes >= newest
                || sound.len() >= self.keep
                || sound.contains(&place.episodes);
            if superfluous {
                self.retire(&place.path)?;
                continue;
            }
            if self.is_sound(&place.path) {
                sound.insert(place.episodes);
            }
        }
        Ok(())
    }

    /// Removes a checkpoint, if it exists. A half-removed one cannot be mistaken for a checkpoint.
    fn retire(&self, place: &Path) -> Result<(), CheckpointError> {
        if !self.storage.exists(place) {
            return Ok(());
        }
        let aside = self.directory.join(".removing");
        self.remove(&aside)?;
        let renamed = self.storage.rename(place, &aside);
        renamed.map_err(CheckpointError::io("rename", place))?;
        die_if_armed(FaultPoint::CheckpointRetired);
        self.remove(&aside)
    }

    /// `true` if there is a checkpoint at `place` whose files are all as they were written.
    fn is_sound(&self, place: &Path) -> bool {
        let manifest = Manifest::read(&self.storage, place);
        match manifest.and_then(|manifest| manifest.verify(&self.storage, place)) {
            Ok(()) => true,
            Err(error) => {
                if self.storage.exists(place) {
                    warn!(%error, "a checkpoint is damaged");
                }
                false
            }
        }
    }

    fn remove(&self, path: &Path) -> Result<(), CheckpointError> {
        let removed = self.storage.remove(path);
        removed.map_err(CheckpointError::io("remove", path))
    }

    /// Syncs to disk a file that others wrote. After a failure the content may be lost, and a
    /// second attempt may succeed without writing it. So this does not wait even for a full disk.
    fn sync_once(&self, path: &Path) -> Result<(), CheckpointError> {
        self.storage.sync(path).map_err(|error| {
            CheckpointError::io("write to disk", path)(std::io::Error::other(error.to_string()))
        })
    }

    /// Syncs a file or directory to disk.
    fn sync(&self, path: &Path) -> Result<(), CheckpointError> {
        let synced = self.storage.sync(path);
        synced.map_err(CheckpointError::io("write to disk", path))
    }
}

/// Name of the checkpoint at `place` while it is being replaced.
fn replaced(place: &Path) -> PathBuf {
    let mut name = place.as_os_str().to_owned();
    name.push(REPLACED);
    PathBuf::from(name)
}
