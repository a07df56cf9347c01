//! What a run has done so far, as far as the learner's reports show it.

use skein_protocol::progress::Progress;

/// What a run has done so far. More work is greater: flights come first, then what is made of them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Work {
    flights: u64,
    vae_updates: u64,
    updates: u64,
    evaluation_flights: u64,
}

impl Work {
    pub(super) fn of(progress: &Progress) -> Self {
        Self {
            flights: progress.flights,
            vae_updates: progress.vae_updates,
            updates: progress.updates,
            evaluation_flights: progress.evaluation_flights.0,
        }
    }

    /// So many updates, and nothing else.
    #[cfg(test)]
    pub(super) fn test(updates: u64) -> Self {
        Self {
            flights: 0,
            vae_updates: 0,
            updates,
            evaluation_flights: 0,
        }
    }
}
