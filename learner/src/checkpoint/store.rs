//! The folder of checkpoints: writing into place, finding, loading, removing old ones.
//!
//! Names that begin with a dot are work in progress and never read: a checkpoint is written under
//! such a name, all of it brought to disk, and renamed; to be removed, it is renamed back to one
//! first. One that is written again, for the same episode, keeps its predecessor beside it until it
//! is in place: there is no moment without a sound checkpoint, once there is one.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use skein_protocol::config::Config;
use skein_run::durable;
use skein_run::fault::{FaultPoint, pass};
use tracing::warn;

use super::manifest::{self, Manifest};
use super::{CheckpointError, CheckpointState, files};

/// Ends the name of a checkpoint that is about to be replaced by one of the same episode.
const REPLACED: &str = ".replaced";

/// The checkpoints of a run.
#[derive(Debug, Clone)]
pub struct CheckpointStore {
    directory: PathBuf,
    config: Config,
    keep: usize,
}

/// A checkpoint in the folder.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Place {
    episodes: u64,
    path: PathBuf,
}

/// Where in `checkpoints` the state after `episodes` committed episodes lies.
pub fn checkpoint_directory(checkpoints: &Path, episodes: u64) -> PathBuf {
    checkpoints.join(format!("episode-{episodes}"))
}

impl CheckpointStore {
    /// The checkpoints in `directory` of the run configured by `config`; the newest few that are
    /// sound are kept, as many as `config` says.
    pub fn new(directory: &Path, config: &Config) -> Self {
        Self {
            directory: directory.to_owned(),
            config: config.clone(),
            keep: config.checkpoints.keep.max(1),
        }
    }

    /// Where they lie.
    pub fn directory(&self) -> &Path {
        &self.directory
    }

    /// Writes `state`, and removes those beyond the newest few. Returns where it lies.
    ///
    /// `relied_on` are files outside whose content up to now the state counts on: they are brought
    /// to disk before the checkpoint is in place.
    ///
    /// # Errors
    /// [`CheckpointError`]; what was there before still is, and what was half written takes no
    /// room.
    pub fn save(
        &self,
        state: &CheckpointState,
        relied_on: &[PathBuf],
    ) -> Result<PathBuf, CheckpointError> {
        let episodes = state.progress.episodes;
        // One name for all: whatever an interrupted write left, of this episode or another, makes
        // room for the next.
        let aside = self.directory.join(".writing");
        remove(&aside)?;
        if let Err(error) = self.write_aside(&aside, state, relied_on) {
            remove(&aside)?;
            return Err(error);
        }
        pass(FaultPoint::CheckpointSynced);
        let place = checkpoint_directory(&self.directory, episodes);
        self.make_way(&place)?;
        fs::rename(&aside, &place).map_err(CheckpointError::io("rename into place", &aside))?;
        sync(&self.directory)?;
        pass(FaultPoint::CheckpointRenamed);
        self.remove_others(episodes)?;
        Ok(place)
    }

    fn write_aside(
        &self,
        aside: &Path,
        state: &CheckpointState,
        relied_on: &[PathBuf],
    ) -> Result<(), CheckpointError> {
        durable::create_private_directory(aside).map_err(CheckpointError::io("create", aside))?;
        pass(FaultPoint::CheckpointCreated);
        files::write(aside, state, &self.config.portable())?;
        self.seal(aside, state.progress.episodes)?;
        pass(FaultPoint::CheckpointManifest);
        for name in files::NAMES.iter().chain([&manifest::NAME]) {
            sync(&aside.join(name))?;
        }
        sync(aside)?;
        // A new file's name is in its folder, which has to be brought to disk as well.
        let folders: BTreeSet<&Path> = relied_on.iter().filter_map(|path| path.parent()).collect();
        let mut all = relied_on.iter().map(PathBuf::as_path).chain(folders);
        all.try_for_each(sync_once)
    }

    /// Writes the manifest of the files in `directory` as they are now, and so makes them a
    /// checkpoint after `episodes` episodes.
    ///
    /// # Errors
    /// [`CheckpointError::Io`] names the file.
    pub fn seal(&self, directory: &Path, episodes: u64) -> Result<(), CheckpointError> {
        let manifest = Manifest::of(directory, &files::NAMES, episodes, self.config.digest())?;
        files::write_bytes(
            &directory.join(manifest::NAME),
            manifest.to_text().as_bytes(),
        )
    }

    /// Gives the checkpoint at `place`, if there is a sound one, the name under which it is still
    /// found until the new one is in its place.
    fn make_way(&self, place: &Path) -> Result<(), CheckpointError> {
        if !is_sound(place) {
            // Perhaps its predecessor still lies beside it: that one stays.
            return self.retire(place);
        }
        let replaced = replaced(place);
        self.retire(&replaced)?;
        fs::rename(place, replaced).map_err(CheckpointError::io("rename", place))
    }

    /// The episodes of which there is a checkpoint, the newest first.
    ///
    /// # Errors
    /// [`CheckpointError::Io`] when the folder cannot be read; a folder that does not exist has
    /// none.
    pub fn list(&self) -> Result<Vec<u64>, CheckpointError> {
        let mut episodes: Vec<u64> = self.places()?.iter().map(|place| place.episodes).collect();
        episodes.dedup();
        Ok(episodes)
    }

    /// All checkpoints, the newest first; of two of one episode, the one that replaces the other.
    fn places(&self) -> Result<Vec<Place>, CheckpointError> {
        if !self.directory.exists() {
            return Ok(Vec::new());
        }
        let io = || CheckpointError::io("list", &self.directory);
        let mut found = Vec::new();
        for entry in fs::read_dir(&self.directory).map_err(io())? {
            let entry = entry.map_err(io())?;
            // A checkpoint is a directory; whatever else lies here is nobody's business.
            if !entry.file_type().is_ok_and(|kind| kind.is_dir()) {
                continue;
            }
            let name = entry.file_name();
            let episodes = name.to_str().and_then(|name| {
                let number = name.strip_prefix("episode-")?;
                number
                    .strip_suffix(REPLACED)
                    .unwrap_or(number)
                    .parse::<u64>()
                    .ok()
            });
            found.extend(episodes.map(|episodes| Place {
                episodes,
                path: self.directory.join(&name),
            }));
        }
        // The shorter of two names is that of the newer one.
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
        self.load_from(&Place {
            episodes,
            path: checkpoint_directory(&self.directory, episodes),
        })
    }

    fn load_from(&self, place: &Place) -> Result<CheckpointState, CheckpointError> {
        let manifest = Manifest::read(&place.path)?;
        let config = manifest.read_file(&place.path, files::CONFIG)?;
        if !manifest.is_of(self.config.digest()) {
            return Err(self.other_configuration(&place.path, &config));
        }
        let state = files::read(&place.path, &manifest)?;
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

    fn other_configuration(&self, path: &Path, config: &[u8]) -> CheckpointError {
        let differences = self.config.differences(&String::from_utf8_lossy(config));
        CheckpointError::Configuration {
            path: path.to_owned(),
            differences: match differences {
                Ok(differences) if !differences.is_empty() => differences.join(", "),
                _ => "its config.toml says which".to_owned(),
            },
        }
    }

    /// Loads the newest checkpoint that is undamaged; `None` when there is none at all. Resuming
    /// from an older one costs time, never the result. Each damaged one that is newer is given to
    /// `passed_over`, and so is one that does not fit what lies beside it, of which `check` tells.
    ///
    /// # Errors
    /// [`CheckpointError::NoneUsable`] when all are damaged: a run is not begun anew without a
    /// word. [`CheckpointError::Format`] or [`CheckpointError::Configuration`] when the newest
    /// undamaged one is of another version or configuration.
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
                Ok(state) => return Ok(Some(state)),
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

    /// Keeps the checkpoint just written and the newest sound ones before it. Later ones are of a
    /// future that this run has left by resuming from an earlier one.
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
            if is_sound(&place.path) {
                sound.insert(place.episodes);
            }
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
        pass(FaultPoint::CheckpointRetired);
        remove(&aside)
    }
}

/// Whether there is a checkpoint at `place` all of whose files are what was written.
fn is_sound(place: &Path) -> bool {
    match Manifest::read(place).and_then(|manifest| manifest.verify(place)) {
        Ok(()) => true,
        Err(error) => {
            if place.exists() {
                warn!(%error, "a checkpoint is damaged");
            }
            false
        }
    }
}

/// The name of the checkpoint at `place` while it is replaced.
fn replaced(place: &Path) -> PathBuf {
    let mut name = place.as_os_str().to_owned();
    name.push(REPLACED);
    PathBuf::from(name)
}

fn remove(path: &Path) -> Result<(), CheckpointError> {
    let removed = match fs::remove_dir_all(path) {
        // Somebody put a file where only directories of ours are.
        Err(error) if error.kind() == std::io::ErrorKind::NotADirectory => fs::remove_file(path),
        removed => removed,
    };
    match removed {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            Err(CheckpointError::io("remove", path)(error))
        }
        _ => Ok(()),
    }
}

/// Brings to disk what others wrote. Whatever this fails of may be lost, and trying again may
/// succeed without bringing it back: so not even a full disk is waited for.
fn sync_once(path: &Path) -> Result<(), CheckpointError> {
    durable::sync(path).map_err(|error| {
        CheckpointError::io("write to disk", path)(std::io::Error::other(error.to_string()))
    })
}

/// Brings a file or directory to disk.
fn sync(path: &Path) -> Result<(), CheckpointError> {
    durable::sync(path).map_err(CheckpointError::io("write to disk", path))
}
