//! Writes checkpoints on a separate thread, so that learning does not wait for the disk.

use std::path::PathBuf;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::{self, JoinHandle};

use tracing::info;

use super::{CheckpointError, CheckpointState, CheckpointStore};
use crate::disk::Disk;

/// Hands states to the writing thread.
///
/// At most one state is written at a time, and none queues: handing over the next one waits until
/// the thread is free. So there are never more than two in memory.
#[derive(Debug)]
pub struct CheckpointWriter {
    store: CheckpointStore,
    orders: SyncSender<WriteOrder>,
    /// Ends with the first error; taken when that error is returned.
    thread: Option<JoinHandle<Result<(), CheckpointError>>>,
}

/// A state to write, and the other files that it relies on.
#[derive(Debug)]
struct WriteOrder {
    state: CheckpointState,
    relied_on: Vec<PathBuf>,
}

impl CheckpointWriter {
    /// Starts the thread. It waits for room on `disk`.
    ///
    /// # Errors
    /// [`CheckpointError::Io`] when the system grants no thread.
    pub fn start(store: CheckpointStore, disk: Disk) -> Result<Self, CheckpointError> {
        let (orders, receiver) = sync_channel(0);
        let for_thread = store.clone();
        let thread = thread::Builder::new()
            .name("checkpoints".to_owned())
            .spawn(move || write_all(&for_thread, &disk, &receiver))
            .map_err(CheckpointError::io(
                "start a thread that writes to",
                store.directory(),
            ))?;
        Ok(Self {
            store,
            orders,
            thread: Some(thread),
        })
    }

    /// Hands over a state to write, and the files that it relies on: see [`CheckpointStore::save`].
    ///
    /// # Errors
    /// The error of an earlier write. The thread has ended then; writing again needs a new one.
    pub fn save(
        &mut self,
        state: CheckpointState,
        relied_on: Vec<PathBuf>,
    ) -> Result<(), CheckpointError> {
        self.orders
            .send(WriteOrder { state, relied_on })
            .or_else(|_| self.join().and_then(|()| Err(self.gone())))
    }

    /// Waits until everything handed over is on disk.
    ///
    /// # Errors
    /// The error of a write that was not returned yet.
    pub fn finish(mut self) -> Result<(), CheckpointError> {
        // The thread ends when nothing can be handed over any longer.
        self.orders = sync_channel(0).0;
        self.join()
    }

    fn join(&mut self) -> Result<(), CheckpointError> {
        let ended = self.thread.take().map(JoinHandle::join);
        ended.map_or(Ok(()), |ended| ended.unwrap_or_else(|_| Err(self.gone())))
    }

    fn gone(&self) -> CheckpointError {
        CheckpointError::WriterGone {
            directory: self.store.directory().to_owned(),
        }
    }
}

fn write_all(
    store: &CheckpointStore,
    disk: &Disk,
    orders: &Receiver<WriteOrder>,
) -> Result<(), CheckpointError> {
    for WriteOrder { state, relied_on } in orders {
        let started = std::time::Instant::now();
        let path = disk.with_room(store.directory(), || store.save(&state, &relied_on))?;
        info!(
            path = %path.display(),
            secs = started.elapsed().as_secs_f64(),
            "checkpoint written"
        );
    }
    Ok(())
}
