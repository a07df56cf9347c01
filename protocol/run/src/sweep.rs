//! Removes what runs leave on the machine when their processes are killed: segments in shared
//! memory, folders of the transport.
//!
//! A run is judged by the lock on its transport folder, see [`Presence`](super::Presence): it is
//! removed only by who holds that lock alone. Only names of ours are touched, and only what belongs
//! to this user; links are never followed.

use std::collections::BTreeSet;
use std::ffi::OsString;
use std::fs::{self, File};
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use super::identity::LearnerIncarnation;
use super::place::{is_still_at, make_folder, open_folder, open_private, run_of, user};
use skein_protocol::ids::RunId;

/// Where the transport of runs lies.
#[derive(Debug)]
pub(super) struct Machine {
    /// Where each run has a folder.
    folders: &'static str,
    /// Where shared-memory segments lie.
    segments: &'static str,
}

/// This machine. iceoryx2's shared memory has no other place on Linux.
pub(super) static MACHINE: Machine = Machine {
    folders: "/tmp",
    segments: "/dev/shm",
};

const FOLDER_PREFIX: &str = "skein-";
const SHARED_MEMORY_PREFIX: &str = "skein_";

/// First characters of a run's segments.
pub(super) fn shared_memory_prefix(run: RunId) -> String {
    format!("{SHARED_MEMORY_PREFIX}{:016x}_", run.0)
}

/// Ends the name of the file in shared memory by which a run's processes are seen where another
/// `/tmp` hides its folder.
const PRESENCE: &str = ".presence";

/// The learner's lock in a run's folder.
pub(super) fn learner_lock(folder: &Path) -> PathBuf {
    folder.join("learner.lock")
}

/// The supervisor's lock in a run's folder.
pub(super) fn supervisor_lock(folder: &Path) -> PathBuf {
    folder.join("supervisor.lock")
}

/// What a sweep did.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Swept {
    /// Runs of which something was removed.
    pub runs: Vec<RunId>,
    /// What could not be removed, and why.
    pub failures: Vec<String>,
}

/// Removes the shared memory and the transport folders of all runs of this user in which no process
/// lives, whatever ended them.
///
/// Never touches anything of a run that lives or starts: every process of a run holds a
/// [`Presence`](super::Presence).
pub fn sweep_leftovers() -> Swept {
    MACHINE.sweep()
}

impl Machine {
    pub(super) fn transport_folder(&self, run: RunId) -> PathBuf {
        Path::new(self.folders).join(format!("{FOLDER_PREFIX}{:016x}", run.0))
    }

    /// Locked, as the folder is, by every process of the run: containers and services may share the
    /// memory and not the folder.
    pub(super) fn presence_file(&self, run: RunId) -> PathBuf {
        Path::new(self.segments).join(format!("{SHARED_MEMORY_PREFIX}{:016x}{PRESENCE}", run.0))
    }

    fn sweep(&self) -> Swept {
        let mut swept = Swept::default();
        for run in self.runs() {
            match self.sweep_run(run) {
                Ok(true) => swept.runs.push(run),
                Ok(false) => {}
                Err(failure) => swept.failures.push(failure),
            }
        }
        swept
    }

    /// Runs of this user of which there is a trace.
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

    /// Removes what is left of `run` if no process of it lives; whether there was anything to
    /// remove.
    fn sweep_run(&self, run: RunId) -> Result<bool, String> {
        let path = self.transport_folder(run);
        let told = |error: io::Error| format!("{}: {error}", path.display());
        // Segments alone have no folder by which they could be judged; a process that starts would
        // make it, so it is made.
        make_folder(&path).map_err(told)?;
        let Some(folder) = open_folder(&path).map_err(|error| error.to_string())? else {
            return Ok(false);
        };
        if folder.try_lock().is_err() || !is_still_at(&folder, &path).map_err(told)? {
            return Ok(false);
        }
        if !is_ours(&path).map_err(told)? {
            return Ok(false);
        }
        // Held until all is removed: whoever starts waits for it.
        let Some(_presence) = self.lock_presence(run).map_err(told)? else {
            // Its folder lies in another place of that name; this one was made here.
            let _ = fs::remove_dir(&path);
            return Ok(false);
        };
        self.remove(run);
        if path.exists() {
            return Err(format!(
                "{}: not all of it could be removed",
                path.display()
            ));
        }
        Ok(true)
    }

    /// The lock of a run's presence in shared memory, had alone; `None` when a process of the run
    /// incarnations.
    fn lock_presence(&self, run: RunId) -> io::Result<Option<File>> {
        let path = self.presence_file(run);
        let presence = open_private(&path)?;
        let is_alone = presence.try_lock().is_ok() && is_still_at(&presence, &path)?;
        Ok(is_alone.then_some(presence))
    }

    /// Removes everything of `run`. For who holds the locks of its folder and its presence alone.
    pub(super) fn remove(&self, run: RunId) {
        self.remove_incarnations(run);
        let folder = self.transport_folder(run);
        // The locks' files come last: by them a folder is known as ours, should this process die on
        // the way.
        let [learner, supervisor] = [learner_lock(&folder), supervisor_lock(&folder)];
        for file in [
            folder.join("incarnation.new"),
            folder.join("incarnation"),
            learner,
            supervisor,
        ] {
            told(&file, fs::remove_file(&file));
        }
        told(&folder, fs::remove_dir(&folder));
        let presence = self.presence_file(run);
        told(&presence, fs::remove_file(&presence));
    }

    /// Removes all incarnations of `run`: segments and folders. For who holds the lock of its
    /// learner.
    pub(super) fn remove_incarnations(&self, run: RunId) {
        for segment in self.segments(&shared_memory_prefix(run)) {
            told(&segment, fs::remove_file(&segment));
        }
        let folder = self.transport_folder(run);
        let incarnations = own_entries(&folder).filter_map(|(name, about)| {
            let incarnation = LearnerIncarnation::parse(name.to_str()?)?;
            about.is_dir().then_some(incarnation)
        });
        for incarnation in incarnations {
            let path = folder.join(incarnation.to_string());
            told(&path, fs::remove_dir_all(&path));
        }
    }

    /// Segments of this user whose names begin with `prefix`.
    pub(super) fn segments(&self, prefix: &str) -> impl Iterator<Item = PathBuf> + use<> {
        let (segments, prefix) = (Path::new(self.segments), prefix.to_owned());
        own_entries(segments)
            .filter(move |(name, about)| {
                about.is_file() && name.as_encoded_bytes().starts_with(prefix.as_bytes())
            })
            .map(|(name, _)| segments.join(name))
    }
}

/// Whether a folder is one of this version: empty, or with a lock in it. Those of version 0.1 hold
/// no lock, so that it cannot be told whether their run incarnations.
fn is_ours(folder: &Path) -> io::Result<bool> {
    let has_lock = learner_lock(folder).exists() || supervisor_lock(folder).exists();
    Ok(has_lock || fs::read_dir(folder)?.next().is_none())
}

/// What in `folder` belongs to this user. Links are told as links.
fn own_entries(folder: &Path) -> impl Iterator<Item = (OsString, fs::Metadata)> {
    let user = user();
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    entries.filter_map(move |entry| {
        let about = entry.metadata().ok()?;
        (about.uid() == user).then(|| (entry.file_name(), about))
    })
}

/// Says what could not be removed. That it is gone already is what was wanted.
fn told(path: &Path, removed: io::Result<()>) {
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

    /// A machine of the test's own.
    fn machine() -> (&'static Machine, tempfile::TempDir) {
        let directory = tempfile::tempdir().unwrap();
        let place = |name: &str| {
            let path = directory.path().join(name);
            fs::create_dir(&path).unwrap();
            &*path.to_str().unwrap().to_owned().leak()
        };
        let machine = Machine {
            folders: place("tmp"),
            segments: place("shm"),
        };
        (Box::leak(Box::new(machine)), directory)
    }

    fn segment(machine: &Machine, name: &str) -> PathBuf {
        let path = Path::new(machine.segments).join(name);
        fs::write(&path, "").unwrap();
        path
    }

    /// What a killed run leaves.
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
    fn what_a_dead_run_left_is_removed() {
        let (machine, _directory) = machine();
        leave(machine);
        assert_eq!(machine.sweep().runs, [RUN]);
        assert!(is_empty(machine));
        assert_eq!(machine.sweep(), Swept::default());
    }

    #[test]
    fn segments_of_a_run_whose_folder_lies_in_another_place_are_left_alone() {
        let (machine, directory) = machine();
        let elsewhere = directory.path().join("elsewhere");
        fs::create_dir(&elsewhere).unwrap();
        let other: &'static Machine = Box::leak(Box::new(Machine {
            folders: elsewhere.to_str().unwrap().to_owned().leak(),
            segments: machine.segments,
        }));
        let living = Presence::enter_on(other, RUN).unwrap();
        let segment = segment(machine, &format!("{}0123", shared_memory_prefix(RUN)));
        assert_eq!(machine.sweep(), Swept::default());
        assert!(segment.exists() && !machine.transport_folder(RUN).exists());
        drop(living);
        assert!(is_empty(machine) && is_empty(other));
    }

    #[test]
    fn segments_that_have_lost_their_folder_are_removed() {
        let (machine, _directory) = machine();
        segment(machine, &format!("{}0123", shared_memory_prefix(RUN)));
        assert_eq!(machine.sweep().runs, [RUN]);
        assert!(is_empty(machine));
    }

    #[test]
    fn nothing_of_a_run_that_lives_or_starts_is_touched_and_the_last_one_to_go_removes_it() {
        let (machine, _directory) = machine();
        let first = Presence::enter_on(machine, RUN).unwrap();
        assert_eq!(machine.sweep(), Swept::default());
        let folder = leave(machine);
        let second = Presence::enter_on(machine, RUN).unwrap();
        drop(first);
        assert_eq!(machine.sweep(), Swept::default());
        assert!(learner_lock(&folder).exists());
        drop(second);
        assert!(is_empty(machine));
    }

    #[test]
    fn names_of_others_and_links_are_left_alone() {
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
        // A run of version 0.1 may be under way.
        fs::create_dir_all(folders.join("skein-00000000000000dd/nodes")).unwrap();
        assert_eq!(machine.sweep(), Swept::default());
        assert_eq!(fs::read_dir(machine.segments).unwrap().count(), 3);
        assert_eq!(fs::read_dir(machine.folders).unwrap().count(), 6);

        // Nor is a link followed within what is removed.
        let folder = leave(machine);
        symlink(&outside, folder.join("2")).unwrap();
        machine.sweep();
        assert!(outside.join("precious").exists());
    }

    #[test]
    fn whoever_enters_while_a_run_is_swept_is_present_in_the_end() {
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
