//! Locks of a run: exactly one learner, with a new transport for each of its incarnations, and
//! exactly one supervisor.
//!
//! Each consists of two file locks, one on the run's directory and one in the transport's folder,
//! because a copy of the directory is the same run.

use std::fs::{self, File, TryLockError};
use std::path::PathBuf;

use super::RunDirectory;
use super::identity::{Announcement, LearnerIncarnation, RunIdentity};
use super::presence::Presence;
use super::private_files::{FileLock, LockAttempt, PathError, is_locked, lock, make_folder};
use super::sweep::MACHINE;

/// The learner's lock of a run. The learner holds it as long as it is alive, and longer than its
/// ports.
#[derive(Debug)]
pub struct LearnerLock {
    incarnation: LearnerIncarnation,
    announcement: PathBuf,
    // Field order matters: locks are released before the presence, which may remove their files.
    _in_transport: FileLock,
    _in_directory: FileLock,
    _presence: Presence,
}

/// The supervisor's lock of a run, held as long as the run is supervised.
#[derive(Debug)]
pub struct SupervisorLock {
    // Field order matters: locks are released before the presence, which may remove their files.
    _in_transport: FileLock,
    _directory: File,
    _presence: Presence,
}

/// Reason why a lock cannot be taken.
#[derive(Debug, thiserror::Error)]
pub enum LockError {
    /// Another process of this run holds it.
    #[error(
        "another {who} of this run is alive{}: it holds {}",
        pid.map_or(String::new(), |pid| format!(" (process {pid})")),
        lock.display()
    )]
    Taken {
        /// Role of the process.
        who: &'static str,
        /// The lock that it holds.
        lock: PathBuf,
        /// Process id, if it could be read.
        pid: Option<u32>,
    },
    /// The transport's folder cannot be used.
    #[error(transparent)]
    Path(#[from] PathError),
}

impl LearnerLock {
    /// Takes the lock, removes what dead incarnations of this run left, and begins a new
    /// incarnation.
    ///
    /// # Errors
    /// [`LockError::Taken`] if another learner of this run is alive.
    pub fn take(directory: &RunDirectory, identity: &RunIdentity) -> Result<Self, LockError> {
        let in_directory = take_lock("learner", directory.learner_lock())?;
        let presence = Presence::enter(identity)?;
        let in_transport = take_lock("learner", identity.learner_lock())?;

        // Both files hold the last incarnation's number: the transport's folder may have been
        // removed while in use, and the directory may have been copied.
        let incarnation = LearnerIncarnation::after(
            last_incarnation(&in_transport)?.max(last_incarnation(&in_directory)?),
        );
        let content = format!("{} {incarnation}", std::process::id());
        in_transport.write(&content)?;
        in_directory.write(&content)?;

        let announcement = identity.announcement_file();
        remove_announcement(&announcement)?;
        MACHINE.remove_incarnations(identity.run);
        let folder = identity.incarnation_folder(incarnation);
        make_folder(&folder).map_err(PathError::at(&folder))?;
        Ok(Self {
            incarnation,
            announcement,
            _in_transport: in_transport,
            _in_directory: in_directory,
            _presence: presence,
        })
    }

    /// Returns this learner's incarnation.
    pub fn incarnation(&self) -> LearnerIncarnation {
        self.incarnation
    }
}

impl Drop for LearnerLock {
    fn drop(&mut self) {
        // Actors check the lock too, so a leftover file does no harm.
        let _ = fs::remove_file(&self.announcement);
    }
}

impl SupervisorLock {
    /// Takes the lock.
    ///
    /// # Errors
    /// [`LockError::Taken`] if another process supervises this run.
    pub fn take(directory: &RunDirectory, identity: &RunIdentity) -> Result<Self, LockError> {
        let root = directory.root();
        let locked = File::open(root).map_err(PathError::at(root))?;
        match locked.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                return Err(LockError::Taken {
                    who: "supervisor",
                    lock: root.to_owned(),
                    pid: None,
                });
            }
            Err(TryLockError::Error(error)) => return Err(PathError::at(root)(error).into()),
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
    /// Returns `true` if a process supervises the run in this directory, or is its learner. Copies
    /// of the directory are not checked.
    ///
    /// # Errors
    /// [`PathError`] if the locks cannot be read.
    pub fn is_running(&self) -> Result<bool, PathError> {
        Ok(is_locked(self.root())? || is_locked(&self.learner_lock())?)
    }
}

impl RunIdentity {
    /// Announces to actors that the services of `announcement`'s incarnation are open. Only the
    /// learner that holds the lock calls this.
    ///
    /// # Errors
    /// [`PathError`] if the file cannot be written.
    pub fn announce(&self, announcement: &Announcement) -> Result<(), PathError> {
        let path = self.announcement_file();
        let aside = path.with_extension("new");
        let json = serde_json::to_vec(announcement).expect("an announcement is plain data");
        fs::write(&aside, json)
            .and_then(|()| fs::rename(&aside, &path))
            .map_err(PathError::at(&path))
    }
}

fn take_lock(who: &'static str, path: PathBuf) -> Result<FileLock, LockError> {
    match lock(&path)? {
        LockAttempt::Acquired(lock) => Ok(lock),
        LockAttempt::HeldByOther { content } => Err(LockError::Taken {
            who,
            lock: path,
            pid: content
                .split_whitespace()
                .next()
                .and_then(|pid| pid.parse().ok()),
        }),
    }
}

/// Returns the incarnation that the last holder of `lock` wrote into it.
fn last_incarnation(lock: &FileLock) -> Result<Option<LearnerIncarnation>, PathError> {
    Ok(lock
        .content()?
        .split_whitespace()
        .nth(1)
        .and_then(LearnerIncarnation::parse))
}

fn remove_announcement(path: &std::path::Path) -> Result<(), PathError> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            Err(PathError::at(path)(error))
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
        let expected = format!(
            "another learner of this run is alive (process {}): it holds {}",
            std::process::id(),
            run.learner_lock().display()
        );
        assert_eq!(refusal, expected);

        let copied = tempfile::tempdir().unwrap();
        fs::copy(run.identity(), copied.path().join("run.json")).unwrap();
        let refusal = LearnerLock::take(&RunDirectory::new(copied.path()), &identity)
            .unwrap_err()
            .to_string();
        assert!(
            refusal.contains("another learner of this run is alive"),
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
    fn a_run_and_the_copies_of_its_directory_have_one_supervisor_at_a_time() {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        let identity = run.create(&Config::default()).unwrap();
        let copied = tempfile::tempdir().unwrap();
        fs::copy(run.identity(), copied.path().join("run.json")).unwrap();
        let copy = RunDirectory::new(copied.path());

        assert!(!run.is_running().unwrap());
        let lock = SupervisorLock::take(&run, &identity).unwrap();
        assert!(run.is_running().unwrap() && !copy.is_running().unwrap());
        for (other, lock) in [
            (&run, run.root().to_owned()),
            (&copy, identity.supervisor_lock()),
        ] {
            let refusal = SupervisorLock::take(other, &identity)
                .unwrap_err()
                .to_string();
            assert!(
                refusal.starts_with("another supervisor of this run is alive"),
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
    fn the_number_of_an_incarnation_is_not_reused_after_its_folder_was_removed() {
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
    fn a_new_incarnation_removes_what_dead_ones_left() {
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
            identity.current_incarnation().unwrap().unwrap().incarnation,
            dead
        );
        drop(lock);
        assert!(segment.exists());

        let lock = LearnerLock::take(&run, &identity).unwrap();
        assert!(!segment.exists() && !identity.incarnation_folder(dead).exists());
        assert!(identity.incarnation_folder(lock.incarnation()).exists());
        assert_eq!(
            identity.current_incarnation().unwrap(),
            None,
            "its services are not open"
        );
        drop((lock, supervisor));
        assert!(!identity.transport_folder().exists());
    }

    #[test]
    fn a_pipe_in_the_place_of_a_lock_is_not_waited_for() {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        let made = std::process::Command::new("mkfifo")
            .arg(run.learner_lock())
            .status();
        assert!(made.unwrap().success());
        let (sender, answer) = std::sync::mpsc::channel();
        std::thread::spawn(move || sender.send(run.is_running().unwrap()));
        let is_running = answer.recv_timeout(std::time::Duration::from_secs(20));
        assert_eq!(is_running, Ok(false));
    }
}
