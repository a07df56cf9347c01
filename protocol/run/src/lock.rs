//! The locks of a run: exactly one learner, with a transport of its own for each of its
//! incarnations, and exactly one supervisor.
//!
//! A lock is taken by two locks, one on the run's directory and one in the transport's folder: a
//! copy of the directory is the same run.

use std::fs::{self, File, TryLockError};
use std::path::PathBuf;

use super::RunDirectory;
use super::identity::{Announcement, LearnerIncarnation, RunIdentity};
use super::place::{HeldLock, Locked, PlaceError, is_locked, lock, make_folder};
use super::presence::Presence;
use super::sweep::MACHINE;

/// The learner's lock of a run, taken. To be held as long as the learner lives, and longer than its
/// ports.
#[derive(Debug)]
pub struct LearnerLock {
    incarnation: LearnerIncarnation,
    announcement: PathBuf,
    // In this order: locks are let go before the presence, which may remove their files.
    _in_transport: HeldLock,
    _in_directory: HeldLock,
    _presence: Presence,
}

/// The supervisor's lock of a run, taken. To be held as long as the run is supervised.
#[derive(Debug)]
pub struct SupervisorLock {
    // Locks are let go before the presence, which may remove their files.
    _in_transport: HeldLock,
    _directory: File,
    _presence: Presence,
}

/// Why there is no lock for this process.
#[derive(Debug, thiserror::Error)]
pub enum LockError {
    /// Another process of this run has it.
    #[error("another {who} of this run lives{}: it holds {}", pid.map_or(String::new(), |pid| format!(" (process {pid})")), lock.display())]
    Taken {
        /// What it is.
        who: &'static str,
        /// The lock it holds.
        lock: PathBuf,
        /// Its process, if it could be read.
        pid: Option<u32>,
    },
    /// The transport's folder cannot be used.
    #[error(transparent)]
    Place(#[from] PlaceError),
}

impl LearnerLock {
    /// Takes the lock, removes what dead incarnations of this run left, and begins a new
    /// incarnation.
    ///
    /// # Errors
    /// [`LockError::Taken`] when another learner of this run incarnations.
    pub fn take(directory: &RunDirectory, identity: &RunIdentity) -> Result<Self, LockError> {
        let in_directory = take_lock("learner", directory.learner_lock())?;
        let presence = Presence::enter(identity)?;
        let in_transport = take_lock("learner", identity.learner_lock())?;

        // The last incarnation's number stands in both files: the transport's folder may have been
        // removed from under its processes, and of a directory there may be copies.
        let incarnation = LearnerIncarnation::after(
            last_incarnation(&in_transport)?.max(last_incarnation(&in_directory)?),
        );
        let words = format!("{} {incarnation}", std::process::id());
        in_transport.write(&words)?;
        in_directory.write(&words)?;

        let announcement = identity.announcement_file();
        remove_announcement(&announcement)?;
        MACHINE.remove_incarnations(identity.run);
        let folder = identity.incarnation_folder(incarnation);
        make_folder(&folder).map_err(PlaceError::at(&folder))?;
        Ok(Self {
            incarnation,
            announcement,
            _in_transport: in_transport,
            _in_directory: in_directory,
            _presence: presence,
        })
    }

    /// This learner's incarnation.
    pub fn incarnation(&self) -> LearnerIncarnation {
        self.incarnation
    }
}

impl Drop for LearnerLock {
    fn drop(&mut self) {
        // Actors look at the lock too, so a file that stays behind misleads nobody.
        let _ = fs::remove_file(&self.announcement);
    }
}

impl SupervisorLock {
    /// Takes the lock.
    ///
    /// # Errors
    /// [`LockError::Taken`] when another process supervises this run.
    pub fn take(directory: &RunDirectory, identity: &RunIdentity) -> Result<Self, LockError> {
        let root = directory.root();
        let locked = File::open(root).map_err(PlaceError::at(root))?;
        match locked.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                return Err(LockError::Taken {
                    who: "supervisor",
                    lock: root.to_owned(),
                    pid: None,
                });
            }
            Err(TryLockError::Error(error)) => return Err(PlaceError::at(root)(error).into()),
        }
        let presence = Presence::enter(identity)?;
        let in_transport = take_lock("supervisor", identity.supervisor_lock())?;
        in_transport.write(&std::process::id().to_string())?;
        Ok(Self {
            _in_transport: in_transport,
            _directory: locked,
            _presence: presence,
        })
    }
}

impl RunDirectory {
    /// Whether a process supervises the run in this very directory, or is its learner.
    ///
    /// # Errors
    /// [`PlaceError`] when it cannot be looked at.
    pub fn is_under_way(&self) -> Result<bool, PlaceError> {
        Ok(is_locked(self.root())? || is_locked(&self.learner_lock())?)
    }
}

impl RunIdentity {
    /// Tells actors that the services of `announcement`'s incarnation are open. For the learner
    /// that holds the lock.
    ///
    /// # Errors
    /// [`PlaceError`] when the file cannot be written.
    pub fn announce(&self, announcement: &Announcement) -> Result<(), PlaceError> {
        let path = self.announcement_file();
        let aside = path.with_extension("new");
        let json = serde_json::to_vec(announcement).expect("an announcement is plain data");
        fs::write(&aside, json)
            .and_then(|()| fs::rename(&aside, &path))
            .map_err(PlaceError::at(&path))
    }
}

fn take_lock(who: &'static str, path: PathBuf) -> Result<HeldLock, LockError> {
    match lock(&path)? {
        Locked::Mine(lock) => Ok(lock),
        Locked::Taken { words } => Err(LockError::Taken {
            who,
            lock: path,
            pid: words
                .split_whitespace()
                .next()
                .and_then(|pid| pid.parse().ok()),
        }),
    }
}

/// The incarnation that whoever held `lock` last wrote into it.
fn last_incarnation(lock: &HeldLock) -> Result<Option<LearnerIncarnation>, PlaceError> {
    Ok(lock
        .words()?
        .split_whitespace()
        .nth(1)
        .and_then(LearnerIncarnation::parse))
}

fn remove_announcement(path: &std::path::Path) -> Result<(), PlaceError> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            Err(PlaceError::at(path)(error))
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use skein_protocol::config::Config;

    #[test]
    fn a_second_learner_is_refused_on_the_run_and_on_a_copy_of_its_directory() {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        let identity = run.create(&Config::default()).unwrap();
        let _supervisor = Presence::enter(&identity).unwrap();
        let lock = LearnerLock::take(&run, &identity).unwrap();
        let refusal = LearnerLock::take(&run, &identity).unwrap_err().to_string();
        let told = format!(
            "another learner of this run lives (process {}): it holds {}",
            std::process::id(),
            run.learner_lock().display()
        );
        assert_eq!(refusal, told);

        let copied = tempfile::tempdir().unwrap();
        fs::copy(run.identity(), copied.path().join("run.json")).unwrap();
        let refusal = LearnerLock::take(&RunDirectory::new(copied.path()), &identity)
            .unwrap_err()
            .to_string();
        assert!(
            refusal.contains("another learner of this run lives"),
            "{refusal}"
        );
        assert!(
            refusal.contains(&identity.learner_lock().display().to_string()),
            "{refusal}"
        );

        let first = lock.incarnation();
        drop(lock);
        assert!(LearnerLock::take(&run, &identity).unwrap().incarnation() > first);
    }

    #[test]
    fn a_run_has_one_supervisor_at_a_time_whichever_copy_of_its_directory_it_is_given() {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        let identity = run.create(&Config::default()).unwrap();
        let copied = tempfile::tempdir().unwrap();
        fs::copy(run.identity(), copied.path().join("run.json")).unwrap();
        let copy = RunDirectory::new(copied.path());

        assert!(!run.is_under_way().unwrap());
        let lock = SupervisorLock::take(&run, &identity).unwrap();
        assert!(run.is_under_way().unwrap() && !copy.is_under_way().unwrap());
        for (other, lock) in [
            (&run, run.root().to_owned()),
            (&copy, identity.supervisor_lock()),
        ] {
            let refusal = SupervisorLock::take(other, &identity)
                .unwrap_err()
                .to_string();
            assert!(
                refusal.starts_with("another supervisor of this run lives"),
                "{refusal}"
            );
            assert!(refusal.contains(&lock.display().to_string()), "{refusal}");
        }
        drop(lock);
        assert!(!identity.transport_folder().exists());
        drop(SupervisorLock::take(&copy, &identity).unwrap());
        SupervisorLock::take(&run, &identity).unwrap();
    }

    #[test]
    fn an_incarnation_whose_folder_was_removed_is_not_lived_again() {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        let identity = run.create(&Config::default()).unwrap();
        let first = LearnerLock::take(&run, &identity).unwrap();
        let incarnation = first.incarnation();
        fs::remove_dir_all(identity.transport_folder()).unwrap();
        drop(first);
        assert!(LearnerLock::take(&run, &identity).unwrap().incarnation() > incarnation);
    }

    #[test]
    fn a_new_incarnation_removes_what_the_dead_ones_left_and_meets_nothing_of_it() {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        let identity = run.create(&Config::default()).unwrap();
        let supervisor = Presence::enter(&identity).unwrap();
        let lock = LearnerLock::take(&run, &identity).unwrap();
        let dead = lock.incarnation();
        let segment = PathBuf::from(format!("/dev/shm/{}x", identity.incarnation_prefix(dead)));
        fs::write(&segment, "").unwrap();
        fs::write(identity.incarnation_folder(dead).join("details"), "").unwrap();
        identity
            .announce(&Announcement::new(&identity, dead, &Config::default()))
            .unwrap();
        assert_eq!(
            identity.present_incarnation().unwrap().unwrap().incarnation,
            dead
        );
        drop(lock);
        assert!(segment.exists());

        let lock = LearnerLock::take(&run, &identity).unwrap();
        assert!(!segment.exists() && !identity.incarnation_folder(dead).exists());
        assert!(identity.incarnation_folder(lock.incarnation()).exists());
        assert_eq!(
            identity.present_incarnation().unwrap(),
            None,
            "its services are not open"
        );
        drop((lock, supervisor));
        assert!(!identity.transport_folder().exists());
    }
}
