//! Writes checkpoints on a thread of its own, so that learning does not wait for the disk.

use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::{self, JoinHandle};

use tracing::info;

use super::{CheckpointError, CheckpointState, CheckpointStore};

/// Hands states to the writing thread.
///
/// At most one state is written at a time and none queues: handing over the next one waits until the thread is free, so never more than two are in memory.
#[derive(Debug)]
pub struct CheckpointWriter {
    store: CheckpointStore,
    states: SyncSender<CheckpointState>,
    /// Ends with the first error; taken when that is handed out.
    thread: Option<JoinHandle<Result<(), CheckpointError>>>,
}

impl CheckpointWriter {
    /// Starts the thread.
    ///
    /// # Errors
    /// [`CheckpointError::Io`] when the system grants no thread.
    pub fn start(store: CheckpointStore) -> Result<Self, CheckpointError> {
        let (states, receiver) = sync_channel(0);
        let for_thread = store.clone();
        let thread = thread::Builder::new()
            .name("checkpoints".to_owned())
            .spawn(move || write_all(&for_thread, &receiver))
            .map_err(CheckpointError::io("start a thread that writes to", store.directory()))?;
        Ok(Self {
            store,
            states,
            thread: Some(thread),
        })
    }

    /// Hands over a state to be written.
    ///
    /// # Errors
    /// What went wrong with an earlier one. The thread has ended then; whoever wants to go on writing starts another.
    pub fn save(&mut self, state: CheckpointState) -> Result<(), CheckpointError> {
        self.states
            .send(state)
            .or_else(|_| self.join().and_then(|()| Err(self.gone())))
    }

    /// Waits until everything handed over is on disk.
    ///
    /// # Errors
    /// What went wrong with it.
    pub fn finish(mut self) -> Result<(), CheckpointError> {
        // The thread ends when nobody can hand it anything any more.
        self.states = sync_channel(0).0;
        self.join()
    }

    fn join(&mut self) -> Result<(), CheckpointError> {
        let ended = self.thread.take().and_then(|thread| thread.join().ok());
        ended.unwrap_or_else(|| Err(self.gone()))
    }

    fn gone(&self) -> CheckpointError {
        CheckpointError::WriterGone {
            directory: self.store.directory().to_owned(),
        }
    }
}

fn write_all(store: &CheckpointStore, states: &Receiver<CheckpointState>) -> Result<(), CheckpointError> {
    for state in states {
        let started = std::time::Instant::now();
        let path = store.save(&state)?;
        info!(path = %path.display(), secs = started.elapsed().as_secs_f64(), "checkpoint written");
    }
    Ok(())
}
