//! Everything that the training thread and the receiving thread exchange: commands one way, the
//! receiver's state the other.

use std::sync::mpsc::Sender;
use std::sync::{PoisonError, RwLock};
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
