//! The seats of a run: exactly one learner, with a transport of its own for each of its lives, and exactly one supervisor.
//!
//! A seat is taken by two locks, one on the run's directory and one in the transport's folder: a copy of the directory is the same run.

use std::fs::{self, File, TryLockError};
use std::path::PathBuf;

use super::RunDirectory;
use super::identity::{Announcement, Life, RunIdentity};
use super::place::{HeldLock, Locked, PlaceError, is_locked, lock, make_folder};
use super::presence::Presence;
use super::sweep::MACHINE;

/// The learner's seat of a run, taken. To be held as long as the learner lives, and longer than its ports.
#[derive(Debug)]
pub struct LearnerSeat {
    life: Life,
    announcement: PathBuf,
    // In this order: locks are let go before the presence, which may remove their files.
    _in_transport: HeldLock,
    _in_directory: HeldLock,
    _presence: Presence,
}

/// The supervisor's seat of a run, taken. To be held as long as the run is supervised.
#[derive(Debug)]
pub struct SupervisorSeat {
    // Locks are let go before the presence, which may remove their files.
    _in_transport: HeldLock,
    _directory: File,
    _presence: Presence,
}

/// Why there is no seat for this process.
#[derive(Debug, thiserror::Error)]
pub enum SeatError {
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

impl LearnerSeat {
    /// Takes the seat, removes what dead lives of this run left, and begins a new life.
    ///
    /// # Errors
    /// [`SeatError::Taken`] when another learner of this run lives.
    pub fn take(directory: &RunDirectory, identity: &RunIdentity) -> Result<Self, SeatError> {
        let in_directory = take_lock("learner", directory.learner_lock())?;
        let presence = Presence::enter(identity)?;
        let in_transport = take_lock("learner", identity.learner_lock())?;

        // The last life's number stands in both files: the transport's folder may have been removed from under its processes, and of a directory there
        // may be copies.
        let life = Life::after(last_life(&in_transport)?.max(last_life(&in_directory)?));
        let words = format!("{} {life}", std::process::id());
        in_transport.write(&words)?;
        in_directory.write(&words)?;

        let announcement = identity.announcement_file();
        remove_announcement(&announcement)?;
        MACHINE.remove_lives(identity.run);
        let folder = identity.life_folder(life);
        make_folder(&folder).map_err(PlaceError::at(&folder))?;
        Ok(Self {
            life,
            announcement,
            _in_transport: in_transport,
            _in_directory: in_directory,
            _presence: presence,
        })
    }

    /// This learner's life.
    pub fn life(&self) -> Life {
        self.life
    }
}

impl Drop for LearnerSeat {
    fn drop(&mut self) {
        // Actors look at the lock too, so a file that stays behind misleads nobody.
        let _ = fs::remove_file(&self.announcement);
    }
}

impl SupervisorSeat {
    /// Takes the seat.
    ///
    /// # Errors
    /// [`SeatError::Taken`] when another process supervises this run.
    pub fn take(directory: &RunDirectory, identity: &RunIdentity) -> Result<Self, SeatError> {
        let root = directory.root();
        let locked = File::open(root).map_err(PlaceError::at(root))?;
        match locked.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                return Err(SeatError::Taken {
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
    /// Tells actors that the services of `announcement`'s life are open. For the learner that holds the seat.
    ///
    /// # Errors
    /// [`PlaceError`] when the file cannot be written.
    pub(crate) fn announce(&self, announcement: &Announcement) -> Result<(), PlaceError> {
        let path = self.announcement_file();
        let aside = path.with_extension("new");
        let json = serde_json::to_vec(announcement).expect("an announcement is plain data");
        fs::write(&aside, json)
            .and_then(|()| fs::rename(&aside, &path))
            .map_err(PlaceError::at(&path))
    }
}

fn take_lock(who: &'static str, path: PathBuf) -> Result<HeldLock, SeatError> {
    match lock(&path)? {
        Locked::Mine(lock) => Ok(lock),
        Locked::Taken { words } => Err(SeatError::Taken {
            who,
            lock: path,
            pid: words.split_whitespace().next().and_then(|pid| pid.parse().ok()),
        }),
    }
}

/// The life that whoever held `lock` last wrote into it.
fn last_life(lock: &HeldLock) -> Result<Option<Life>, PlaceError> {
    Ok(lock.words()?.split_whitespace().nth(1).and_then(Life::parse))
}

fn remove_announcement(path: &std::path::Path) -> Result<(), PlaceError> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => Err(PlaceError::at(path)(error)),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;

    #[test]
    fn a_second_learner_is_refused_on_the_run_and_on_a_copy_of_its_directory() {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        let identity = run.create(&Config::default()).unwrap();
        let _supervisor = Presence::enter(&identity).unwrap();
        let seat = LearnerSeat::take(&run, &identity).unwrap();
        let refusal = LearnerSeat::take(&run, &identity).unwrap_err().to_string();
        let told = format!(
            "another learner of this run lives (process {}): it holds {}",
            std::process::id(),
            run.learner_lock().display()
        );
        assert_eq!(refusal, told);

        let copied = tempfile::tempdir().unwrap();
        fs::copy(run.identity(), copied.path().join("run.json")).unwrap();
        let refusal = LearnerSeat::take(&RunDirectory::new(copied.path()), &identity)
            .unwrap_err()
            .to_string();
        assert!(refusal.contains("another learner of this run lives"), "{refusal}");
        assert!(
            refusal.contains(&identity.learner_lock().display().to_string()),
            "{refusal}"
        );

        let first = seat.life();
        drop(seat);
        assert!(LearnerSeat::take(&run, &identity).unwrap().life() > first);
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
        let seat = SupervisorSeat::take(&run, &identity).unwrap();
        assert!(run.is_under_way().unwrap() && !copy.is_under_way().unwrap());
        for (other, lock) in [(&run, run.root().to_owned()), (&copy, identity.supervisor_lock())] {
            let refusal = SupervisorSeat::take(other, &identity).unwrap_err().to_string();
            assert!(refusal.starts_with("another supervisor of this run lives"), "{refusal}");
            assert!(refusal.contains(&lock.display().to_string()), "{refusal}");
        }
        drop(seat);
        assert!(!identity.transport_folder().exists());
        drop(SupervisorSeat::take(&copy, &identity).unwrap());
        SupervisorSeat::take(&run, &identity).unwrap();
    }

    #[test]
    fn a_life_whose_folder_was_removed_is_not_lived_again() {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        let identity = run.create(&Config::default()).unwrap();
        let first = LearnerSeat::take(&run, &identity).unwrap();
        let life = first.life();
        fs::remove_dir_all(identity.transport_folder()).unwrap();
        drop(first);
        assert!(LearnerSeat::take(&run, &identity).unwrap().life() > life);
    }

    #[test]
    fn a_new_life_removes_what_the_dead_ones_left_and_meets_nothing_of_it() {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        let identity = run.create(&Config::default()).unwrap();
        let supervisor = Presence::enter(&identity).unwrap();
        let seat = LearnerSeat::take(&run, &identity).unwrap();
        let dead = seat.life();
        let segment = PathBuf::from(format!("/dev/shm/{}x", identity.life_prefix(dead)));
        fs::write(&segment, "").unwrap();
        fs::write(identity.life_folder(dead).join("details"), "").unwrap();
        identity
            .announce(&Announcement::new(&identity, dead, &Config::default()))
            .unwrap();
        assert_eq!(identity.present_life().unwrap().unwrap().life, dead);
        drop(seat);
        assert!(segment.exists());

        let seat = LearnerSeat::take(&run, &identity).unwrap();
        assert!(!segment.exists() && !identity.life_folder(dead).exists());
        assert!(identity.life_folder(seat.life()).exists());
        assert_eq!(identity.present_life().unwrap(), None, "its services are not open");
        drop((seat, supervisor));
        assert!(!identity.transport_folder().exists());
    }
}
