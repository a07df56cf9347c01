//! That a process of a run incarnations.

use std::fs::{File, TryLockError};
use std::path::{Path, PathBuf};
use std::thread::sleep;
use std::time::{Duration, Instant};

use rustix::fs::Mode;

use super::identity::RunIdentity;
use super::place::{PlaceError, is_still_at, make_folder, open_folder, open_private};
use super::sweep::{MACHINE, Machine};
use skein_protocol::ids::RunId;

/// How long a folder may be in the process of being removed.
const PATIENCE: Duration = Duration::from_secs(5);

/// That a process of a run lives: a shared lock on the run's transport folder, and one on a file of
/// the run in shared memory, for those who have another `/tmp`.
///
/// Every process of a run holds one, from before it touches anything of the run's transport until
/// after it has let go of it; the kernel frees it with the process, however that ends. So whoever
/// gets the lock for itself alone knows that no process of the run is left, and may remove what
/// they left ([`sweep_leftovers`](super::sweep_leftovers)). The lock also keeps systemd's cleaning
/// of `/tmp` away from the folder.
///
/// The last one to go removes the transport.
#[derive(Debug)]
pub struct Presence {
    folder: Held,
    in_memory: Held,
    run: RunId,
    machine: &'static Machine,
}

/// A file or folder on which this process holds a lock.
#[derive(Debug)]
struct Held {
    file: File,
    path: PathBuf,
}

impl Held {
    /// A shared lock on `file`; `None` if somebody holds it alone, or has removed it between
    /// opening and locking: then the lock is on nothing.
    fn shared(file: File, path: &Path) -> Result<Option<Self>, PlaceError> {
        match file.try_lock_shared() {
            Ok(()) => {
                let is_there = is_still_at(&file, path).map_err(PlaceError::at(path))?;
                let path = path.to_owned();
                Ok(is_there.then_some(Self { file, path }))
            }
            Err(TryLockError::WouldBlock) => Ok(None),
            Err(TryLockError::Error(error)) => Err(PlaceError::at(path)(error)),
        }
    }

    /// Exchanges the lock for one that nobody shares; whether that was to be had. A lock is not
    /// exchanged in one step: it is let go, then another one is tried. Whoever enters in between is
    /// respected.
    fn take_alone(&self) -> bool {
        self.file.unlock().is_ok()
            && self.file.try_lock().is_ok()
            && is_still_at(&self.file, &self.path).unwrap_or(false)
    }
}

impl Presence {
    /// Enters the run: makes its transport folder, for this user alone, if it is not there.
    /// Whatever this process makes from now on is for its user alone.
    ///
    /// # Errors
    /// [`PlaceError::OtherUser`] when the folder is somebody else's.
    pub fn enter(identity: &RunIdentity) -> Result<Self, PlaceError> {
        // iceoryx2 gives one segment to everybody unless it is kept from it.
        rustix::process::umask(Mode::RWXG | Mode::RWXO);
        Self::enter_on(&MACHINE, identity.run)
    }

    pub(super) fn enter_on(machine: &'static Machine, run: RunId) -> Result<Self, PlaceError> {
        let [path, in_memory] = [machine.transport_folder(run), machine.presence_file(run)];
        let deadline = Instant::now() + PATIENCE;
        while Instant::now() < deadline {
            make_folder(&path).map_err(PlaceError::at(&path))?;
            let Some(folder) = open_folder(&path)? else {
                continue;
            };
            if let Some(folder) = Held::shared(folder, &path)?
                && let file = open_private(&in_memory).map_err(PlaceError::at(&in_memory))?
                && let Some(in_memory) = Held::shared(file, &in_memory)?
            {
                return Ok(Self {
                    folder,
                    in_memory,
                    run,
                    machine,
                });
            }
            sleep(Duration::from_millis(1));
        }
        Err(PlaceError::Busy { path })
    }
}

impl Drop for Presence {
    fn drop(&mut self) {
        // Both are let go in any case.
        let is_alone = [&self.folder, &self.in_memory].map(Held::take_alone);
        if is_alone == [true; 2] {
            self.machine.remove(self.run);
        }
    }
}
