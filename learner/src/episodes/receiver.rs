//! The receiving thread: owns the transport's ports, feeds the dispatcher, and delivers episodes in
//! the order of the orders.
//!
//! The training thread uses it through [`EpisodeReceiver`]: it orders batches of episodes,
//! publishes snapshots, and takes episodes out of an [`EpisodeBatch`] one by one. While the
//! training thread updates the networks, this thread takes in records, issues tickets and sends
//! heartbeats.

use std::sync::Arc;
use std::sync::mpsc::{self, Sender};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use skein_protocol::config::Config;
use skein_protocol::ids::Epoch;
use skein_protocol::snapshot::Snapshot;
use skein_protocol::ticket::Ticket;
use skein_run::{LearnerIncarnation, RunIdentity};
use skein_transport::{LearnerPorts, LearnerWaker};

use super::exchange::{EpisodeBatch, Inbox, Orders, ReceiverError, ReceiverState};
use super::order::KeptData;
use super::server::Server;

/// Longest time to open the services.
const OPENING_PATIENCE: Duration = Duration::from_secs(30);
/// Longest time for the receiving thread to end after the finish command.
const ENDING_PATIENCE: Duration = Duration::from_secs(5);

/// The training thread's handle of the receiving thread.
#[derive(Debug)]
pub struct EpisodeReceiver {
    orders: Orders,
    waker: LearnerWaker,
    thread: Option<JoinHandle<()>>,
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
        let (orders, inbox) = Orders::new();
        let (ready, is_ready) = mpsc::channel();
        let (thread_identity, thread_config) = (identity.clone(), config.clone());
        let thread = thread::Builder::new()
            .name("receiver".to_owned())
            .spawn(move || serve(&thread_identity, incarnation, &thread_config, inbox, &ready))
            .map_err(|error| ReceiverError::transport(&error))?;
        match is_ready.recv_timeout(OPENING_PATIENCE) {
            Ok(opened) => opened?,
            Err(error) => return Err(ReceiverError::transport(&error)),
        }
        let waker = LearnerWaker::open(identity, incarnation, config)
            .map_err(|error| ReceiverError::transport(&error))?;
        Ok(Self {
            orders,
            waker,
            thread: Some(thread),
        })
    }

    /// State that the receiving thread shares at any time.
    pub fn state(&self) -> Arc<ReceiverState> {
        self.orders.state()
    }

    /// Publishes `snapshot` to all actors, including those that attach later.
    ///
    /// # Errors
    /// [`ReceiverError`] when the receiving thread has ended.
    pub fn publish(&self, snapshot: Snapshot) -> Result<(), ReceiverError> {
        self.orders.publish(snapshot)?;
        self.wake();
        Ok(())
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
        let batch = self.orders.fly(epoch, keep, tickets)?;
        self.wake();
        Ok(batch)
    }

    /// Tells all actors to stop, and ends the receiving thread.
    pub fn finish(mut self) {
        if self.orders.finish().is_err() {
            return;
        }
        self.wake();
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

    fn wake(&self) {
        if let Err(error) = self.waker.wake() {
            // The thread also looks for commands at every heartbeat.
            tracing::debug!(%error, "receiving thread not woken");
        }
    }
}

/// Body of the receiving thread.
fn serve(
    identity: &RunIdentity,
    incarnation: LearnerIncarnation,
    config: &Config,
    inbox: Inbox,
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
    let state = inbox.state.clone();
    if let Err(error) = Server::new(identity.run, config, ports, inbox).run() {
        state.fail(error);
    }
    // Waiting threads notice the end of their channel.
}
