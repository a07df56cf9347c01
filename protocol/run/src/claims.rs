//! Actor numbers, claimed by locks that end with their process.
//!
//! A dead process blocks no number: the kernel releases its lock. Locked files stay; only the lock
//! counts.

use std::fs::{File, OpenOptions};
use std::path::PathBuf;

use rustix::fs::{FlockOperation, flock};
use rustix::io::Errno;

use crate::{RunDirectory, RunError};
use skein_protocol::ids::ActorId;

/// Claim to an actor's number, held as a lock on the actor's log. No other process has the number
/// while this value exists.
#[derive(Debug)]
pub struct ActorClaim {
    id: ActorId,
    _lock: File,
}

impl ActorClaim {
    /// Returns the number.
    pub fn id(&self) -> ActorId {
        self.id
    }
}

impl RunDirectory {
    /// Claims the lowest number that no actor of this run uses. Logs are appended to, so a number
    /// can be reused after its actor has ended.
    ///
    /// # Errors
    /// [`RunError::Io`] names the log that cannot be written.
    pub fn claim_actor(&self) -> Result<ActorClaim, RunError> {
        for id in (0..).map(ActorId) {
            let path = self.actor_log(id);
            let log = OpenOptions::new().create(true).append(true).open(&path);
            if let Some(lock) = locked(path, log)? {
                return Ok(ActorClaim { id, _lock: lock });
            }
        }
        unreachable!("all 2^32 actor numbers are taken")
    }
}

/// Returns `file` locked, or `None` if another process has locked it.
fn locked(path: PathBuf, file: std::io::Result<File>) -> Result<Option<File>, RunError> {
    let outcome =
        file.and_then(
            |file| match flock(&file, FlockOperation::NonBlockingLockExclusive) {
                Ok(()) => Ok(Some(file)),
                Err(Errno::WOULDBLOCK) => Ok(None),
                Err(error) => Err(error.into()),
            },
        );
    outcome.map_err(|source| RunError::Io { path, source })
}

#[cfg(test)]
mod tests {
    use super::*;
    use skein_protocol::config::Config;

    #[test]
    fn a_number_is_free_again_when_its_actor_is_gone() {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        run.create(&Config::default()).unwrap();
        let claims = [(); 3].map(|()| run.claim_actor().unwrap());
        assert_eq!(
            [0, 1, 2].map(ActorId),
            claims.each_ref().map(ActorClaim::id)
        );
        let [first, _second, _third] = claims;
        drop(first);
        assert_eq!(run.claim_actor().unwrap().id(), ActorId(0));
    }
}
