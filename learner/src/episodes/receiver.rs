//! The receiving thread: owns the transport's ports, feeds the dispatcher, and delivers episodes in
//! the order of the orders.
//!
//! The training thread uses it through [`EpisodeReceiver`]: it orders batches of episodes,
//! publishes snapshots, and takes episodes out of an [`EpisodeBatch`] one by one. While the
//! training thread updates the networks, this thread takes in records, issues tickets and sends
//! heartbeats.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, Receiver, RecvTimeoutError, Sender};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use skein_protocol::config::Config;
use skein_protocol::ids::Epoch;
use skein_protocol::snapshot::Snapshot;
use skein_protocol::ticket::Ticket;
use skein_run::{LearnerIncarnation, RunIdentity};
use skein_transport::{LearnerPorts, LearnerWaker};

use super::exchange::{Command, ReceiverError, ReceiverState};
use super::order::KeptData;
use super::server::Server;
use crate::episode::CommittedEpisode;

/// Longest time to open the services.
const OPENING_PATIENCE: Duration = Duration::from_secs(30);
/// Longest time for the receiving thread to end after the finish command.
const ENDING_PATIENCE: Duration = Duration::from_secs(5);
/// Interval at which a waiting training thread checks whether to stop.
const STOP_CHECK: Duration = Duration::from_millis(100);

/// The training thread's handle of the receiving thread.
#[derive(Debug)]
pub struct EpisodeReceiver {
    commands: Sender<Command>,
    waker: LearnerWaker,
    thread: Option<JoinHandle<()>>,
    state: Arc<ReceiverState>,
    next_batch: u64,
}

/// Episodes ordered together, taken out in order.
#[derive(Debug)]
pub struct EpisodeBatch {
    episodes: Receiver<CommittedEpisode>,
    remaining: usize,
    state: Arc<ReceiverState>,
}

impl EpisodeReceiver {
    /// Starts the receiving thread; returns once actors can attach to this `incarnation` of the
    /// learner.
    ///
    /// # Errors
    /// [`ReceiverError::Transport`] when the services cannot be opened.
    pub fn start(
        identity: &RunIdentity,
        incarnation: LearnerIncarnation,
        config: &Config,
    ) -> Result<Self, ReceiverError> {
        let (commands, inbox) = mpsc::channel();
        let (ready, is_ready) = mpsc::channel();
        let state = Arc::new(ReceiverState::default());
        let (thread_identity, thread_config, thread_shared) =
            (identity.clone(), config.clone(), state.clone());
        let thread = thread::Builder::new()
            .name("receiver".to_owned())
            .spawn(move || {
                serve(
                    &thread_identity,
                    incarnation,
                    &thread_config,
                    &inbox,
                    &thread_shared,
                    &ready,
                )
            })
            .map_err(|error| ReceiverError::transport(&error))?;
        match is_ready.recv_timeout(OPENING_PATIENCE) {
            Ok(opened) => opened?,
            Err(error) => return Err(ReceiverError::transport(&error)),
        }
        let waker = LearnerWaker::open(identity, incarnation, config)
            .map_err(|error| ReceiverError::transport(&error))?;
        Ok(Self {
            commands,
            waker,
            thread: Some(thread),
            state,
            next_batch: 0,
        })
    }

    /// State that the receiving thread shares at any time.
    pub fn state(&self) -> Arc<ReceiverState> {
        self.state.clone()
    }

    /// Publishes `snapshot` to all actors, including those that attach later.
    ///
    /// # Errors
    /// [`ReceiverError`] when the receiving thread has ended.
    pub fn publish(&self, snapshot: Snapshot) -> Result<(), ReceiverError> {
        self.send(Command::Publish(snapshot))
    }

    /// Orders episodes. They are flown after those ordered before, and delivered in the order of
    /// `tickets`.
    ///
    /// # Errors
    /// [`ReceiverError`] when the receiving thread has ended.
    pub fn fly(
        &mut self,
        epoch: Epoch,
        keep: KeptData,
        tickets: Vec<Ticket>,
    ) -> Result<EpisodeBatch, ReceiverError> {
        let (deliver, episodes) = mpsc::channel();
        let remaining = tickets.len();
        let batch = self.next_batch;
        self.next_batch += 1;
        self.send(Command::Fly {
            batch,
            epoch,
            keep,
            tickets,
            deliver,
        })?;
        Ok(EpisodeBatch {
            episodes,
            remaining,
            state: self.state.clone(),
        })
    }

    /// Tells all actors to stop, and ends the receiving thread.
    pub fn finish(mut self) {
        if self.send(Command::Finish).is_err() {
            return;
        }
        let Some(thread) = self.thread.take() else {
            return;
        };
        let deadline = Instant::now() + ENDING_PATIENCE;
        while !thread.is_finished() && Instant::now() < deadline {
            thread::sleep(Duration::from_millis(5));
        }
        if !thread.is_finished() {
            // It ends with the process.
            tracing::error!("the receiving thread does not end");
        } else if thread.join().is_err() {
            tracing::error!("the receiving thread panicked");
        }
    }

    fn send(&self, command: Command) -> Result<(), ReceiverError> {
        self.commands
            .send(command)
            .map_err(|_| self.state.failed())?;
        if let Err(error) = self.waker.wake() {
            // The thread also looks for commands at every heartbeat.
            tracing::debug!(%error, "receiving thread not woken");
        }
        Ok(())
    }
}

impl EpisodeBatch {
    /// Number of episodes that were not taken out yet.
    pub fn remaining(&self) -> usize {
        self.remaining
    }

    /// Waits for the next episode, in order; `None` after the last.
    ///
    /// # Errors
    /// [`ReceiverError`] when `stop` is set or the receiving thread has ended.
    pub fn next(&mut self, stop: &AtomicBool) -> Result<Option<CommittedEpisode>, ReceiverError> {
        self.next_unless(|| match stop.load(Ordering::Relaxed) {
            true => Err(ReceiverError::Stopped),
            false => Ok(()),
        })
    }

    /// Like [`EpisodeBatch::next`], but waits until `look` returns an error. Calls `look` ten times
    /// a second.
    ///
    /// # Errors
    /// [`ReceiverError`] when the receiving thread has ended; any error of `look`.
    pub fn next_unless<E: From<ReceiverError>>(
        &mut self,
        mut look: impl FnMut() -> Result<(), E>,
    ) -> Result<Option<CommittedEpisode>, E> {
        while self.remaining > 0 {
            look()?;
            match self.episodes.recv_timeout(STOP_CHECK) {
                Ok(episode) => {
                    self.remaining -= 1;
                    return Ok(Some(episode));
                }
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return Err(self.state.failed().into()),
            }
        }
        Ok(None)
    }
}

/// Body of the receiving thread.
fn serve(
    identity: &RunIdentity,
    incarnation: LearnerIncarnation,
    config: &Config,
    inbox: &Receiver<Command>,
    state: &ReceiverState,
    ready: &Sender<Result<(), ReceiverError>>,
) {
    let ports = match LearnerPorts::open(identity, incarnation, config) {
        Ok(ports) => ports,
        Err(error) => {
            // If the starting thread is gone, no other thread waits for this.
            let _ = ready.send(Err(ReceiverError::transport(&error)));
            return;
        }
    };
    let _ = ready.send(Ok(()));
    if let Err(error) = Server::new(identity, config, ports).run(inbox, state) {
        state.fail(error);
    }
    // Waiting threads notice the end of their channel.
}
