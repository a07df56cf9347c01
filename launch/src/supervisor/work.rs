//! What a run has done so far, as far as the learner's reports show it.

use skein_protocol::progress::ProgressReport;

/// What a run has done so far. More work is greater: episodes come first, then what is made of
/// them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Work {
    episodes: u64,
    vae_updates: u64,
    updates: u64,
    evaluation_episodes: u64,
}

impl Work {
    pub(super) fn of(progress: &ProgressReport) -> Self {
        Self {
            episodes: progress.episodes,
            vae_updates: progress.vae_updates,
            updates: progress.updates,
            evaluation_episodes: progress.evaluation_episodes.0,
        }
    }

    /// So many updates, and nothing else.
    #[cfg(test)]
    pub(super) fn test(updates: u64) -> Self {
        Self {
            episodes: 0,
            vae_updates: 0,
            updates,
            evaluation_episodes: 0,
        }
    }
}
