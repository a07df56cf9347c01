//! Presence of a process in a run, held by locks.

use std::fs::{File, TryLockError};
use std::path::{Path, PathBuf};
use std::thread::sleep;
use std::time::{Duration, Instant};

use rustix::fs::Mode;

use super::identity::RunIdentity;
use super::private_files::{PathError, is_still_at, make_folder, open_folder, open_private};
use super::sweep::{MACHINE, Machine};
use skein_protocol::ids::RunId;

/// Longest time to wait for a folder that is being removed.
const PATIENCE: Duration = Duration::from_secs(5);

/// Presence of a process in a run: a shared lock on the run's transport folder, and one on a file
/// of the run in shared memory, for processes that have another `/tmp`.
///
/// Every process of a run holds one from before it first touches the run's transport until after it
/// last does. The kernel releases it when the process ends, however that happens. So an exclusive
/// lock proves that no process of the run is left, and its holder may remove their leftovers
/// ([`sweep_leftovers`](super::sweep_leftovers)). The lock also keeps systemd from cleaning the
/// folder out of `/tmp`.
///
/// The last process to leave removes the transport.
#[derive(Debug)]
pub struct Presence {
    folder: SharedLock,
    in_memory: SharedLock,
    run: RunId,
    machine: &'static Machine,
}

/// A file or folder that this process has locked.
#[derive(Debug)]
struct SharedLock {
    file: File,
    path: PathBuf,
}

impl SharedLock {
    /// Takes a shared lock on `file`. Returns `None` if another process holds it exclusively, or
    /// removed the file between opening and locking: then the lock is on nothing.
    fn shared(file: File, path: &Path) -> Result<Option<Self>, PathError> {
        match file.try_lock_shared() {
            Ok(()) => {
                let is_there = is_still_at(&file, path).map_err(PathError::at(path))?;
                let path = path.to_owned();
                Ok(is_there.then_some(Self { file, path }))
            }
            Err(TryLockError::WouldBlock) => Ok(None),
            Err(TryLockError::Error(error)) => Err(PathError::at(path)(error)),
        }
    }

    /// Tries to make the lock exclusive; returns `true` if it was acquired. The kernel does not
    /// upgrade a lock in one step: it is released, then tried again, and a process that enters in
    /// between keeps its presence.
    fn make_exclusive(&self) -> bool {
        self.file.unlock().is_ok()
            && self.file.try_lock().is_ok()
            && is_still_at(&self.file, &self.path).unwrap_or(false)
    }
}

impl Presence {
    /// Enters the run: creates its transport folder, for this user only, if it does not exist.
    /// Everything that this process creates from now on is for its user only.
    ///
    /// # Errors
    /// [`PathError::OtherUser`] if the folder belongs to another user.
    pub fn enter(identity: &RunIdentity) -> Result<Self, PathError> {
        // iceoryx2 makes one segment accessible to all users unless the umask forbids it.
        rustix::process::umask(Mode::RWXG | Mode::RWXO);
        Self::enter_on(&MACHINE, identity.run)
    }

    pub(super) fn enter_on(machine: &'static Machine, run: RunId) -> Result<Self, PathError> {
        let [path, in_memory] = [machine.transport_folder(run), machine.presence_file(run)];
        let deadline = Instant::now() + PATIENCE;
        while Instant::now() < deadline {
            make_folder(&path).map_err(PathError::at(&path))?;
            let Some(folder) = open_folder(&path)? else {
                continue;
            };
            if let Some(folder) = SharedLock::shared(folder, &path)?
                && let file = open_private(&in_memory).map_err(PathError::at(&in_memory))?
                && let Some(in_memory) = SharedLock::shared(file, &in_memory)?
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
        Err(PathError::Busy { path })
    }
}

impl Drop for Presence {
    fn drop(&mut self) {
        // Both locks are released in any case.
        let is_alone = [&self.folder, &self.in_memory].map(SharedLock::make_exclusive);
        if is_alone == [true; 2] {
            self.machine.remove(self.run);
        }
    }
}
