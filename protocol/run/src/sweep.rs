//! Removes what killed processes leave on the machine: segments in shared memory, folders of the
//! transport.
//!
//! A run is removed only by a process that holds the lock on its transport folder exclusively, see
//! [`Presence`](super::Presence). Only Skein's names are touched, and only what belongs to this
//! user; links are never followed.

use std::collections::BTreeSet;
use std::ffi::OsString;
use std::fs::{self, File};
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use super::identity::LearnerIncarnation;
use super::private_files::{is_still_at, make_folder, open_folder, open_private, run_of, user};
use skein_protocol::ids::RunId;

/// Directories that hold the transport of runs.
#[derive(Debug)]
pub(super) struct Machine {
    /// Parent of each run's folder.
    folders: &'static str,
    /// Directory of the shared-memory segments.
    segments: &'static str,
}

/// The directories of this machine. On Linux, iceoryx2 keeps shared memory nowhere else.
pub(super) static MACHINE: Machine = Machine {
    folders: "/tmp",
    segments: "/dev/shm",
};

const FOLDER_PREFIX: &str = "skein-";
const SHARED_MEMORY_PREFIX: &str = "skein_";

/// Returns the first characters of the names of a run's segments.
pub(super) fn shared_memory_prefix(run: RunId) -> String {
    format!("{SHARED_MEMORY_PREFIX}{:016x}_", run.0)
}

/// Suffix of the file in shared memory that shows a run's processes where another `/tmp` hides its
/// folder.
const PRESENCE: &str = ".presence";

/// Returns the learner's lock in a run's folder.
pub(super) fn learner_lock(folder: &Path) -> PathBuf {
    folder.join("learner.lock")
}

/// Returns the supervisor's lock in a run's folder.
pub(super) fn supervisor_lock(folder: &Path) -> PathBuf {
    folder.join("supervisor.lock")
}

/// Result of a sweep.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct SweepResult {
    /// Runs with removed leftovers.
    pub runs: Vec<RunId>,
    /// Leftovers that could not be removed, with the cause.
    pub failures: Vec<String>,
}

/// Removes the shared memory and the transport folders of all runs of this user that have no living
/// process.
///
/// Never touches a living or starting run: every process of a run holds a
/// [`Presence`](super::Presence).
pub fn sweep_leftovers() -> SweepResult {
    MACHINE.sweep()
}

impl Machine {
    pub(super) fn transport_folder(&self, run: RunId) -> PathBuf {
        Path::new(self.folders).join(format!("{FOLDER_PREFIX}{:016x}", run.0))
    }

    /// Returns the file that every process of the run locks, as it locks the folder: containers and
    /// services may share the memory but not the folder.
    pub(super) fn presence_file(&self, run: RunId) -> PathBuf {
        Path::new(self.segments).join(format!("{SHARED_MEMORY_PREFIX}{:016x}{PRESENCE}", run.0))
    }

    fn sweep(&self) -> SweepResult {
        let mut swept = SweepResult::default();
        for run in self.runs() {
            match self.sweep_run(run) {
                Ok(true) => swept.runs.push(run),
                Ok(false) => {}
                Err(failure) => swept.failures.push(failure),
            }
        }
        swept
    }

    /// Returns the runs of this user that left a trace.
    fn runs(&self) -> BTreeSet<RunId> {
        let folders = own_entries(Path::new(self.folders)).filter_map(|(name, about)| {
            let (run, length) = run_of(&name, FOLDER_PREFIX)?;
            (about.is_dir() && name.len() == length).then_some(RunId(run))
        });
        let segments = own_entries(Path::new(self.segments)).filter_map(|(name, about)| {
            let (run, length) = run_of(&name, SHARED_MEMORY_PREFIX)?;
            let rest = &name.as_encoded_bytes()[length..];
            let is_its = rest.first() == Some(&b'_') || rest == PRESENCE.as_bytes();
            (about.is_file() && is_its).then_some(RunId(run))
        });
        folders.chain(segments).collect()
    }

    /// Removes the leftovers of `run` if none of its processes is alive; returns `true` if there
    /// were any.
    fn sweep_run(&self, run: RunId) -> Result<bool, String> {
        let path = self.transport_folder(run);
        let at_path = |error: io::Error| format!("{}: {error}", path.display());
        // Segments may have no folder whose lock could be checked. A starting process would create
        // it, so it is created here.
        make_folder(&path).map_err(at_path)?;
        let Some(folder) = open_folder(&path).map_err(|error| error.to_string())? else {
            return Ok(false);
        };
        if folder.try_lock().is_err() || !is_still_at(&folder, &path).map_err(at_path)? {
            return Ok(false);
        }
        if !is_ours(&path).map_err(at_path)? {
            return Ok(false);
        }
        // Held until all is removed: a starting process waits for it.
        let Some(_presence) = self.lock_presence(run).map_err(at_path)? else {
            // The run is alive, with its folder under another `/tmp`; this one was created above.
            let _ = fs::remove_dir(&path);
            return Ok(false);
        };
        self.remove(run);
        if path.exists() {
            return Err(format!(
                "{}: it could not be removed completely",
                path.display()
            ));
        }
        Ok(true)
    }

    /// Takes the exclusive lock of a run's presence in shared memory; returns `None` if a process
    /// of the run is alive.
    fn lock_presence(&self, run: RunId) -> io::Result<Option<File>> {
        let path = self.presence_file(run);
        let presence = open_private(&path)?;
        let is_alone = presence.try_lock().is_ok() && is_still_at(&presence, &path)?;
        Ok(is_alone.then_some(presence))
    }

    /// Removes everything of `run`. The caller holds the locks of its folder and its presence
    /// exclusively.
    pub(super) fn remove(&self, run: RunId) {
        self.remove_incarnations(run);
        let folder = self.transport_folder(run);
        // The lock files come last: they mark the folder as Skein's, should this process die
        // meanwhile.
        let [learner, supervisor] = [learner_lock(&folder), supervisor_lock(&folder)];
        for file in [
            folder.join("incarnation.new"),
            folder.join("incarnation"),
            learner,
            supervisor,
        ] {
            warn_unless_removed(&file, fs::remove_file(&file));
        }
        warn_unless_removed(&folder, fs::remove_dir(&folder));
        let presence = self.presence_file(run);
        warn_unless_removed(&presence, fs::remove_file(&presence));
    }

    /// Removes all incarnations of `run`: segments and folders. The caller holds the learner's
    /// lock.
    pub(super) fn remove_incarnations(&self, run: RunId) {
        for segment in self.segments(&shared_memory_prefix(run)) {
            warn_unless_removed(&segment, fs::remove_file(&segment));
        }
        let folder = self.transport_folder(run);
        let incarnations = own_entries(&folder).filter_map(|(name, about)| {
            let incarnation = LearnerIncarnation::parse(name.to_str()?)?;
            about.is_dir().then_some(incarnation)
        });
        for incarnation in incarnations {
            let path = folder.join(incarnation.to_string());
            warn_unless_removed(&path, fs::remove_dir_all(&path));
        }
    }

    /// Returns the segments of this user whose names begin with `prefix`.
    pub(super) fn segments(&self, prefix: &str) -> impl Iterator<Item = PathBuf> + use<> {
        let (segments, prefix) = (Path::new(self.segments), prefix.to_owned());
        own_entries(segments)
            .filter(move |(name, about)| {
                about.is_file() && name.as_encoded_bytes().starts_with(prefix.as_bytes())
            })
            .map(|(name, _)| segments.join(name))
    }
}

/// Returns `true` if a folder is a run's: empty, or with a lock in it. A folder with content and
/// without a lock could belong to a living process, and nothing would show it.
fn is_ours(folder: &Path) -> io::Result<bool> {
    let has_lock = learner_lock(folder).exists() || supervisor_lock(folder).exists();
    Ok(has_lock || fs::read_dir(folder)?.next().is_none())
}

/// Returns the entries of `folder` that belong to this user. Links are not followed.
fn own_entries(folder: &Path) -> impl Iterator<Item = (OsString, fs::Metadata)> {
    let user = user();
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    entries.filter_map(move |entry| {
        let about = entry.metadata().ok()?;
        (about.uid() == user).then(|| (entry.file_name(), about))
    })
}

/// Logs a warning if `path` could not be removed. A missing file is what was wanted.
fn warn_unless_removed(path: &Path, removed: io::Result<()>) {
    match removed {
        Err(error) if error.kind() != io::ErrorKind::NotFound => {
            tracing::warn!(path = %path.display(), %error, "leftover not removed");
        }
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::super::Presence;
    use super::*;

    const RUN: RunId = RunId(0x00ab_0000_0000_00cd);

    /// Directories that only this test uses.
    fn machine() -> (&'static Machine, tempfile::TempDir) {
        let directory = tempfile::tempdir().unwrap();
        let directory_named = |name: &str| {
            let path = directory.path().join(name);
            fs::create_dir(&path).unwrap();
            &*path.to_str().unwrap().to_owned().leak()
        };
        let machine = Machine {
            folders: directory_named("tmp"),
            segments: directory_named("shm"),
        };
        (Box::leak(Box::new(machine)), directory)
    }

    fn segment(machine: &Machine, name: &str) -> PathBuf {
        let path = Path::new(machine.segments).join(name);
        fs::write(&path, "").unwrap();
        path
    }

    /// Creates the leftovers of a killed run.
    fn leave(machine: &Machine) -> PathBuf {
        let folder = machine.transport_folder(RUN);
        let incarnation = folder.join(LearnerIncarnation::after(None).to_string());
        fs::create_dir_all(incarnation.join("nodes/7")).unwrap();
        fs::write(incarnation.join("nodes/7/details"), "").unwrap();
        fs::write(folder.join("incarnation"), "{}").unwrap();
        fs::write(learner_lock(&folder), "1\n").unwrap();
        segment(
            machine,
            &format!("{}0123_connection", shared_memory_prefix(RUN)),
        );
        folder
    }

    fn is_empty(machine: &Machine) -> bool {
        [machine.folders, machine.segments]
            .iter()
            .all(|folder| fs::read_dir(folder).unwrap().next().is_none())
    }

    #[test]
    fn leftovers_of_a_dead_run_are_removed() {
        let (machine, _directory) = machine();
        leave(machine);
        assert_eq!(machine.sweep().runs, [RUN]);
        assert!(is_empty(machine));
        assert_eq!(machine.sweep(), SweepResult::default());
    }

    #[test]
    fn segments_of_a_living_run_with_another_tmp_are_kept() {
        let (machine, directory) = machine();
        let elsewhere = directory.path().join("elsewhere");
        fs::create_dir(&elsewhere).unwrap();
        let other: &'static Machine = Box::leak(Box::new(Machine {
            folders: elsewhere.to_str().unwrap().to_owned().leak(),
            segments: machine.segments,
        }));
        let living = Presence::enter_on(other, RUN).unwrap();
        let segment = segment(machine, &format!("{}0123", shared_memory_prefix(RUN)));
        assert_eq!(machine.sweep(), SweepResult::default());
        assert!(segment.exists() && !machine.transport_folder(RUN).exists());
        drop(living);
        assert!(is_empty(machine) && is_empty(other));
    }

    #[test]
    fn segments_without_a_folder_are_removed() {
        let (machine, _directory) = machine();
        segment(machine, &format!("{}0123", shared_memory_prefix(RUN)));
        assert_eq!(machine.sweep().runs, [RUN]);
        assert!(is_empty(machine));
    }

    #[test]
    fn a_living_or_starting_run_is_kept_and_its_last_process_removes_it() {
        let (machine, _directory) = machine();
        let first = Presence::enter_on(machine, RUN).unwrap();
        assert_eq!(machine.sweep(), SweepResult::default());
        let folder = leave(machine);
        let second = Presence::enter_on(machine, RUN).unwrap();
        drop(first);
        assert_eq!(machine.sweep(), SweepResult::default());
        assert!(learner_lock(&folder).exists());
        drop(second);
        assert!(is_empty(machine));
    }

    #[test]
    fn foreign_names_and_links_are_kept() {
        let (machine, directory) = machine();
        let outside = directory.path().join("outside");
        fs::create_dir(&outside).unwrap();
        fs::write(outside.join("precious"), "").unwrap();
        let folders = Path::new(machine.folders);
        for name in [
            "skein-00ab",
            "skein-00ab0000000000cdx",
            "skein-00AB0000000000CD",
            "other",
        ] {
            fs::create_dir(folders.join(name)).unwrap();
        }
        symlink(&outside, folders.join("skein-00000000000000ee")).unwrap();
        for name in ["skein_00ab0000000000cd", "skein_report", "iox2_1"] {
            segment(machine, name);
        }
        // Content without a lock: its owner may be alive.
        fs::create_dir_all(folders.join("skein-00000000000000dd/nodes")).unwrap();
        assert_eq!(machine.sweep(), SweepResult::default());
        assert_eq!(fs::read_dir(machine.segments).unwrap().count(), 3);
        assert_eq!(fs::read_dir(machine.folders).unwrap().count(), 6);

        // A link within a removed folder is not followed either.
        let folder = leave(machine);
        symlink(&outside, folder.join("2")).unwrap();
        machine.sweep();
        assert!(outside.join("precious").exists());
    }

    #[test]
    fn a_process_that_enters_during_a_sweep_keeps_its_folder() {
        let (machine, _directory) = machine();
        let swept = std::sync::atomic::AtomicBool::new(false);
        std::thread::scope(|scope| {
            scope.spawn(|| {
                while !swept.load(std::sync::atomic::Ordering::Relaxed) {
                    machine.sweep();
                }
            });
            for _ in 0..300 {
                let presence = Presence::enter_on(machine, RUN).unwrap();
                let file = machine.transport_folder(RUN).join("incarnation");
                fs::write(&file, "").unwrap();
                std::thread::yield_now();
                assert!(file.exists());
                drop(presence);
            }
            swept.store(true, std::sync::atomic::Ordering::Relaxed);
        });
    }
}
