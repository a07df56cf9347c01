//! That a process of a run lives.

use std::fs::{File, TryLockError};
use std::path::PathBuf;
use std::time::{Duration, Instant};

use rustix::fs::Mode;

use super::identity::RunIdentity;
use super::place::{PlaceError, is_still_at, make_folder, open_folder};
use super::sweep::{MACHINE, Machine};
use crate::ids::RunId;

/// How long a folder may be in the process of being removed.
const PATIENCE: Duration = Duration::from_secs(5);

/// That a process of a run lives: a shared lock on the run's transport folder.
///
/// Every process of a run holds one, from before it touches anything of the run's transport until after it has let go of it; the kernel frees it with
/// the process, however that ends. So whoever gets the lock for itself alone knows that no process of the run is left, and may remove what they left
/// ([`sweep_leftovers`](super::sweep_leftovers)). The lock also keeps systemd's cleaning of `/tmp` away from the folder.
///
/// The last one to go removes the transport.
#[derive(Debug)]
pub struct Presence {
    folder: File,
    path: PathBuf,
    run: RunId,
    machine: &'static Machine,
}

impl Presence {
    /// Enters the run: makes its transport folder, for this user alone, if it is not there. Whatever this process makes from now on is for its user
    /// alone.
    ///
    /// # Errors
    /// [`PlaceError::OtherUser`] when the folder is somebody else's.
    pub fn enter(identity: &RunIdentity) -> Result<Self, PlaceError> {
        // iceoryx2 gives one segment to everybody unless it is kept from it.
        rustix::process::umask(Mode::RWXG | Mode::RWXO);
        Self::enter_on(&MACHINE, identity.run)
    }

    pub(super) fn enter_on(machine: &'static Machine, run: RunId) -> Result<Self, PlaceError> {
        let path = machine.transport_folder(run);
        let deadline = Instant::now() + PATIENCE;
        while Instant::now() < deadline {
            make_folder(&path).map_err(PlaceError::at(&path))?;
            let Some(folder) = open_folder(&path)? else { continue };
            match folder.try_lock_shared() {
                // Between opening and locking it, a sweeper may have removed it; then the lock is on nothing.
                Ok(()) if is_still_at(&folder, &path).map_err(PlaceError::at(&path))? => {
                    return Ok(Self {
                        folder,
                        path,
                        run,
                        machine,
                    });
                }
                Ok(()) => {}
                Err(TryLockError::WouldBlock) => std::thread::sleep(Duration::from_millis(1)),
                Err(TryLockError::Error(error)) => return Err(PlaceError::at(&path)(error)),
            }
        }
        Err(PlaceError::Busy { path })
    }
}

impl Drop for Presence {
    fn drop(&mut self) {
        // A lock is not exchanged in one step: it is let go, then another one is tried. Whoever enters in between is respected.
        if self.folder.unlock().is_ok()
            && self.folder.try_lock().is_ok()
            && is_still_at(&self.folder, &self.path).unwrap_or(false)
        {
            self.machine.remove(self.run);
        }
    }
}
