//! Everything that the training thread and the receiving thread exchange: commands one way, the
//! receiver's state the other.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, Receiver, RecvTimeoutError, Sender, TryRecvError};
use std::sync::{Arc, PoisonError, RwLock};
use std::time::{Duration, Instant};

use skein_protocol::ids::Epoch;
use skein_protocol::snapshot::Snapshot;
use skein_protocol::stages::StageTimes;
use skein_protocol::ticket::Ticket;
use skein_run::failure::with_causes;

use super::dispatcher::{Dispatcher, HopelessEpisode};
use super::order::KeptData;
use super::situation::Situation;
use crate::episode::CommittedEpisode;
use crate::faults::Faults;

/// State that the receiving thread shares at any time.
#[derive(Debug, Default)]
pub struct ReceiverState {
    /// Attached actors, in ascending order.
    live_actors: RwLock<Vec<u32>>,
    faults: RwLock<Faults>,
    times: RwLock<StageTimes>,
    situation: RwLock<Option<(Instant, Situation)>>,
    /// Reason why the receiving thread ended early.
    failure: RwLock<Option<ReceiverError>>,
}

/// Reason why no episode arrives.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ReceiverError {
    /// The run was stopped.
    #[error("stopped while waiting for episodes")]
    Stopped,
    /// No actor can fly an episode, however often it is issued.
    #[error(transparent)]
    Hopeless(#[from] HopelessEpisode),
    /// The transport failed; nothing that was computed is at fault. A new incarnation of the
    /// learner has a new transport.
    #[error("the transport failed: {0}")]
    Transport(String),
}

impl ReceiverError {
    pub(super) fn transport(error: &(dyn std::error::Error + 'static)) -> Self {
        Self::Transport(with_causes(error))
    }
}

/// Interval at which a waiting training thread checks whether to stop.
const STOP_CHECK: Duration = Duration::from_millis(100);

/// The training thread's end: it orders episodes and publishes snapshots.
#[derive(Debug)]
pub struct Orders {
    commands: Sender<Command>,
    state: Arc<ReceiverState>,
    next_batch: u64,
}

/// The receiving thread's end.
#[derive(Debug)]
pub struct Inbox {
    commands: Receiver<Command>,
    pub(super) state: Arc<ReceiverState>,
}

/// Episodes ordered together, taken out in order.
#[derive(Debug)]
pub struct EpisodeBatch {
    episodes: Receiver<CommittedEpisode>,
    remaining: usize,
    state: Arc<ReceiverState>,
}

/// Commands of the training thread.
#[derive(Debug)]
pub(super) enum Command {
    Publish(Snapshot),
    Fly {
        batch: u64,
        epoch: Epoch,
        keep: KeptData,
        tickets: Vec<Ticket>,
        deliver: Sender<CommittedEpisode>,
    },
    Finish,
}

impl Orders {
    /// Creates both ends.
    pub fn new() -> (Self, Inbox) {
        let (commands, inbox) = mpsc::channel();
        let state = Arc::new(ReceiverState::default());
        let orders = Self {
            commands,
            state: state.clone(),
            next_batch: 0,
        };
        let inbox = Inbox {
            commands: inbox,
            state,
        };
        (orders, inbox)
    }

    /// State that the receiving thread shares at any time.
    pub fn state(&self) -> Arc<ReceiverState> {
        self.state.clone()
    }

    /// Publishes a snapshot to all actors, before any episode ordered later.
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
    ///
    /// # Errors
    /// [`ReceiverError`] when it has ended already.
    pub fn finish(&self) -> Result<(), ReceiverError> {
        self.send(Command::Finish)
    }

    fn send(&self, command: Command) -> Result<(), ReceiverError> {
        self.commands.send(command).map_err(|_| self.state.failed())
    }
}

impl Inbox {
    /// Returns the next command, if there is one.
    pub(super) fn next(&self) -> Result<Command, TryRecvError> {
        self.commands.try_recv()
    }
}

impl EpisodeBatch {
    /// Number of episodes that were not taken out yet.
    pub fn remaining(&self) -> usize {
        self.remaining
    }

    /// Returns the next episode, in order, if it arrives within `patience`; `None` too after the
    /// last.
    ///
    /// # Errors
    /// [`ReceiverError`] when the receiving thread has ended.
    pub fn next_within(
        &mut self,
        patience: Duration,
    ) -> Result<Option<CommittedEpisode>, ReceiverError> {
        if self.remaining == 0 {
            return Ok(None);
        }
        match self.episodes.recv_timeout(patience) {
            Ok(episode) => {
                self.remaining -= 1;
                Ok(Some(episode))
            }
            Err(RecvTimeoutError::Timeout) => Ok(None),
            Err(RecvTimeoutError::Disconnected) => Err(self.state.failed()),
        }
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
            if let Some(episode) = self.next_within(STOP_CHECK)? {
                return Ok(Some(episode));
            }
        }
        Ok(None)
    }
}

impl ReceiverState {
    /// Numbers of the attached actors, in ascending order.
    pub fn live_actors(&self) -> Vec<u32> {
        self.live_actors
            .read()
            .unwrap_or_else(PoisonError::into_inner)
            .clone()
    }

    /// Faults repaired since the learner's start.
    pub fn faults(&self) -> Faults {
        *self.faults.read().unwrap_or_else(PoisonError::into_inner)
    }

    /// Time by stage of the receiving thread and all actors since the learner's start, as last
    /// reported by each.
    pub fn times(&self) -> StageTimes {
        *self.times.read().unwrap_or_else(PoisonError::into_inner)
    }

    /// Situation at the receiving thread's last heartbeat, and its age; `None` before the first
    /// heartbeat.
    pub fn situation(&self) -> Option<(Duration, Situation)> {
        let situation = self
            .situation
            .read()
            .unwrap_or_else(PoisonError::into_inner);
        situation
            .as_ref()
            .map(|(at, situation)| (at.elapsed(), situation.clone()))
    }

    /// Reason why the receiving thread has ended. A panic leaves no reason; only a broken transport
    /// can cause one there.
    pub(super) fn failed(&self) -> ReceiverError {
        let failure = self.failure.read().unwrap_or_else(PoisonError::into_inner);
        failure.clone().unwrap_or_else(|| {
            ReceiverError::Transport("the receiving thread has ended".to_owned())
        })
    }

    pub(super) fn fail(&self, error: ReceiverError) {
        tracing::error!(%error, "receiving thread failed");
        *self.failure.write().unwrap_or_else(PoisonError::into_inner) = Some(error);
    }

    pub(super) fn update(&self, dispatcher: &Dispatcher) {
        let mut live = self
            .live_actors
            .write()
            .unwrap_or_else(PoisonError::into_inner);
        if !dispatcher
            .actors()
            .map(|actor| actor.0)
            .eq(live.iter().copied())
        {
            *live = dispatcher.actors().map(|actor| actor.0).collect();
        }
        *self.faults.write().unwrap_or_else(PoisonError::into_inner) = dispatcher.faults();
    }

    pub(super) fn update_times(&self, times: StageTimes) {
        *self.times.write().unwrap_or_else(PoisonError::into_inner) = times;
    }

    pub(super) fn update_situation(&self, situation: Situation, now: Instant) {
        *self
            .situation
            .write()
            .unwrap_or_else(PoisonError::into_inner) = Some((now, situation));
    }
}
