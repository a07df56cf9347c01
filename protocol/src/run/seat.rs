//! The learner's seat: exactly one learner of a run, and a transport of its own for each of its lives.

use std::fs;
use std::path::PathBuf;

use super::RunDirectory;
use super::identity::{Announcement, Life, RunIdentity};
use super::place::{HeldLock, Locked, PlaceError, lock, make_folder};
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

/// Why there is no seat for this learner.
#[derive(Debug, thiserror::Error)]
pub enum SeatError {
    /// Another learner of this run lives.
    #[error("another learner of this run lives{}: it holds {}", pid.map_or(String::new(), |pid| format!(" (process {pid})")), lock.display())]
    Taken {
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
    /// One lock lies in the run's directory and one in the transport's folder: a copy of the directory is the same run.
    ///
    /// # Errors
    /// [`SeatError::Taken`] when another learner of this run lives.
    pub fn take(directory: &RunDirectory, identity: &RunIdentity) -> Result<Self, SeatError> {
        let in_directory = take_lock(directory.learner_lock())?;
        let presence = Presence::enter(identity)?;
        let in_transport = take_lock(identity.learner_lock())?;

        // The last life's number stands in the lock's file, which is there as long as a process lives that may know of that life.
        let last = in_transport.words()?.split_whitespace().nth(1).and_then(Life::parse);
        let life = Life::after(last);
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

fn take_lock(path: PathBuf) -> Result<HeldLock, SeatError> {
    match lock(&path)? {
        Locked::Mine(lock) => Ok(lock),
        Locked::Taken { words } => Err(SeatError::Taken {
            lock: path,
            pid: words.split_whitespace().next().and_then(|pid| pid.parse().ok()),
        }),
    }
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
