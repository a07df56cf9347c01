//! Work done by a run, as shown by the learner's reports.

use skein_protocol::progress::ProgressReport;

/// Work done by a run. More work compares greater: first by episodes, then by the updates made from
/// them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct WorkDone {
    episodes: u64,
    vae_updates: u64,
    updates: u64,
    evaluation_episodes: u64,
}

impl WorkDone {
    pub(super) fn of(progress: &ProgressReport) -> Self {
        Self {
            episodes: progress.episodes,
            vae_updates: progress.vae_updates,
            updates: progress.updates,
            evaluation_episodes: progress.evaluation_episodes.0,
        }
    }

    /// Returns work of `updates` updates and nothing else.
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
