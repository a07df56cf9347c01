//! Progress of a stop.

use std::time::Duration;

use tokio::time::Instant;

/// Progress of a stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Stop {
    NotYet,
    /// The learner is stopping; it is killed at the deadline.
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

    /// Extends the deadline: a learner that still makes progress is not killed.
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
