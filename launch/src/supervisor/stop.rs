//! How far a stop has come, and whether the learner still gets somewhere.

use std::time::Duration;

use skein_protocol::progress::Progress;
use tokio::time::Instant;

/// What the learner has done so far, as far as its reports show it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Work {
    flights: u64,
    updates: u64,
    vae_updates: u64,
}

impl Work {
    pub(super) fn of(progress: &Progress) -> Self {
        Self {
            flights: progress.flights,
            updates: progress.updates,
            vae_updates: progress.vae_updates,
        }
    }
}

/// How far a stop has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Stop {
    NotYet,
    /// The learner is told; it is killed at the deadline.
    InOrder {
        deadline: Instant,
    },
    AtOnce,
}

impl Stop {
    pub(super) fn interrupted(self, grace: Duration) -> Self {
        match self {
            Self::NotYet => Self::InOrder {
                deadline: Instant::now() + grace,
            },
            Self::InOrder { .. } | Self::AtOnce => Self::AtOnce,
        }
    }

    /// A learner that still gets somewhere is not killed.
    pub(super) fn progressed(self, grace: Duration) -> Self {
        match self {
            Self::InOrder { .. } => Self::InOrder {
                deadline: Instant::now() + grace,
            },
            Self::NotYet | Self::AtOnce => self,
        }
    }

    pub(super) fn deadline(self) -> Option<Instant> {
        match self {
            Self::InOrder { deadline } => Some(deadline),
            Self::NotYet | Self::AtOnce => None,
        }
    }
}
