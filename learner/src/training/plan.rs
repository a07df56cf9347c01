//! Bookkeeping of the training loop: which epochs to order, which snapshots to keep, when a
//! checkpoint is due, and what a resumed learner repeats.
//!
//! Free of networks, files and threads, so that a simulation drives the same code as the loop.

use std::ops::Range;

use skein_protocol::config::Config;
use skein_protocol::ids::PolicyVersion;

use crate::checkpoint::{EpochOrder, TrainingProgress};
use crate::curriculum;

/// Something that a resumed learner does again before it continues.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Repetition {
    /// Publish the snapshot of this version.
    Publish(PolicyVersion),
    /// Order the episodes of an epoch.
    Order(EpochOrder),
}

/// Epochs to order now: the next one, and with policy lag 1 also the one after it, unless they are
/// in flight. `done`: epochs learned from; `last_ordered`: the newest epoch in flight.
pub fn epochs_to_order(config: &Config, done: u64, last_ordered: Option<u64>) -> Range<u64> {
    let end = (done + 1 + config.learning.policy_lag).min(curriculum::epochs(config));
    last_ordered.map_or(done, |last| last + 1)..end
}

/// Returns `true` if a later episode needs the snapshot of this `version`: it is the newest or the
/// best, or one of the orders in flight names it.
pub fn is_needed<'a>(
    version: PolicyVersion,
    progress: &TrainingProgress,
    mut in_flight: impl Iterator<Item = &'a EpochOrder>,
) -> bool {
    let best = progress.best.as_ref();
    version == progress.version()
        || best.is_some_and(|best| best.policy_version == version.0)
        || in_flight.any(|order| order.policy_version == version.0)
}

/// Returns `true` if a checkpoint is due after an epoch. `saved`: progress in the newest one.
pub fn is_checkpoint_due(
    config: &Config,
    progress: &TrainingProgress,
    saved: &TrainingProgress,
) -> bool {
    progress.episodes - saved.episodes >= config.checkpoints.every_episodes
}

/// Returns what was published and ordered when the checkpoint with `progress` was taken, in order.
/// The present snapshot comes last, so that it is the newest for actors that attach now.
pub fn repetitions(progress: &TrainingProgress) -> impl Iterator<Item = Repetition> {
    let present = progress.version();
    let older = progress
        .in_flight
        .iter()
        .map(|order| PolicyVersion(order.policy_version))
        .filter(move |version| *version < present)
        .map(Repetition::Publish);
    let orders = progress.in_flight.iter().copied().map(Repetition::Order);
    older.chain(orders).chain([Repetition::Publish(present)])
}
