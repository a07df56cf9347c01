//! The training loop: delayed learning, in reading order.
//!
//! An epoch is a fixed number of episodes, all flown with one frozen snapshot. When the last of
//! them is committed, the learner takes them in, in episode order, updates the networks and
//! publishes the next snapshot. With direct updates, an epoch is one episode, flown in segments,
//! and the same happens after each segment.
//!
//! Everything follows from configuration, seed and committed episodes. A learner that was killed
//! resumes from a checkpoint with identical results (`saving`).

mod candidates;
mod curves;
mod error;
pub mod plan;
mod saving;
mod stop;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use skein_protocol::config::Config;
use skein_protocol::ids::{Epoch, PolicyVersion};
use skein_protocol::progress::LearnerPhase;
use skein_protocol::snapshot::{Snapshot, SnapshotLayout};
use skein_protocol::stages::{LapTimer, Stage};
use skein_protocol::summary::{RunEnding, RunSummary};
use skein_run::fault::{FaultPoint, die_if_armed};
use skein_run::{LearnerIncarnation, RunDirectory, RunIdentity};

use crate::checkpoint::{CheckpointWriter, EpochOrder, TrainingProgress};
use crate::curriculum;
use crate::disk::Disk;
use crate::episode::CommittedEpisode;
use crate::episodes::ReceiverError;
use crate::episodes::exchange::EpisodeBatch;
use crate::episodes::receiver::EpisodeReceiver;
use crate::metrics::{Metrics, Scalar};
use crate::report::Reporter;
use crate::trainer::Trainer;

use curves::EpochCurves;
pub use error::TrainingError;
use stop::StopMonitor;

/// A run in progress.
struct Training<'a> {
    config: &'a Config,
    identity: &'a RunIdentity,
    directory: &'a RunDirectory,
    stop: &'a AtomicBool,
    stop_monitor: StopMonitor<'a>,
    disk: Disk,
    layout: SnapshotLayout,
    trainer: Trainer,
    receiver: EpisodeReceiver,
    reporter: Reporter,
    metrics: Metrics,
    checkpoints: CheckpointWriter,
    started: Instant,
    epoch_started: Instant,
    curves: EpochCurves,
    /// Time of this thread by stage. Work between two laps counts to the later one.
    timer: LapTimer,
    /// Counters of the run. Those that trainer and metrics keep themselves are filled in for a
    /// checkpoint.
    progress: TrainingProgress,
    /// Progress in the newest checkpoint.
    saved: TrainingProgress,
    /// Snapshots in the newest checkpoint.
    saved_snapshots: BTreeMap<PolicyVersion, Snapshot>,
    /// VAE steps of the decoder in its file; `None` before this incarnation has written it.
    decoder_saved: Option<u64>,
    /// Number of earlier incarnations of the learner.
    resumes: u64,
    /// Epochs or segments that are ordered but not learned from.
    in_flight: VecDeque<OrderInFlight>,
    /// Open episode: its first segments are learned from, the rest is not flown. Holds no images.
    open_episode: Option<CommittedEpisode>,
    /// The newest snapshot, those of the orders in flight, and the best.
    snapshots: BTreeMap<PolicyVersion, Snapshot>,
}

/// One order in flight: the episodes of an epoch, or a segment of one.
struct OrderInFlight {
    order: EpochOrder,
    batch: EpisodeBatch,
    /// Episodes that have arrived.
    episodes: Vec<CommittedEpisode>,
}

/// Trains the run in `directory` to its end or until `stop` is set, in this `incarnation` of its
/// learner. Resumes from the newest undamaged checkpoint, if there is one. Writes and returns the
/// summary.
///
/// # Errors
/// [`TrainingError`]; the last checkpoint stays on disk.
pub fn run(
    directory: &RunDirectory,
    identity: &RunIdentity,
    incarnation: LearnerIncarnation,
    config: &Config,
    stop: &Arc<AtomicBool>,
) -> Result<RunSummary, TrainingError> {
    let mut training = Training::begin(directory, identity, incarnation, config, stop)?;
    let end = match training.train() {
        Ok(()) => training
            .save()
            .map(|progress| (RunEnding::Completed, progress)),
        Err(TrainingError::EpisodeReceiver(ReceiverError::Stopped)) => training
            .save()
            .map(|progress| (RunEnding::Interrupted, progress)),
        Err(TrainingError::Abandoned) => training
            .roll_back()
            .map(|progress| (RunEnding::Interrupted, progress)),
        Err(error) => Err(error),
    };
    training.conclude(end)
}

impl Training<'_> {
    fn train(&mut self) -> Result<(), TrainingError> {
        self.learn()?;
        // If the learner is killed in the final evaluation, only the evaluation is lost.
        self.checkpoint()?;
        self.evaluate_best()
    }

    /// Learns from all epochs that earlier incarnations have not learned from.
    fn learn(&mut self) -> Result<(), TrainingError> {
        let epochs = curriculum::epochs(self.config);
        // An earlier incarnation may have been stopped during a confirmation.
        self.confirm_if_candidate()?;
        while self.progress.epochs < epochs {
            let epoch = self.progress.epochs;
            self.order_ahead()?;
            self.learn_from_flown()?;
            while self.open_episode.is_some() {
                // The rest of the episode is flown with what its last segment taught.
                self.order(self.next_order(epoch))?;
                self.learn_from_flown()?;
            }
            self.progress.epochs += 1;
            tracing::debug!(
                epoch,
                episodes = self.progress.episodes,
                "epoch learned from"
            );
            self.write_curves()?;
            self.confirm_if_candidate()?;
            self.checkpoint_if_due()?;
        }
        Ok(())
    }

    /// Waits for the oldest order, learns from it, and publishes the result.
    fn learn_from_flown(&mut self) -> Result<(), TrainingError> {
        let flown = self.collect()?;
        self.learn_from(flown)
    }

    /// Learns from what was flown by one order, and publishes the result.
    fn learn_from(&mut self, flown: Vec<CommittedEpisode>) -> Result<(), TrainingError> {
        self.take_in(flown)?;
        let before = self.trainer.all_updates();
        self.train_vae()?;
        self.train_policy()?;
        self.publish_if_due(self.trainer.all_updates() - before)
    }

    /// Publishes the next version, after so many `updates`. After a segment without any, the
    /// present snapshot stays in use.
    fn publish_if_due(&mut self, updates: u64) -> Result<(), TrainingError> {
        if self.open_episode.is_some() && updates == 0 {
            return Ok(());
        }
        self.progress.version += 1;
        self.publish()
    }

    /// Publishes the present parameters.
    fn publish(&mut self) -> Result<(), TrainingError> {
        self.timer.lap(Stage::OtherTraining, 0);
        let snapshot = self.trainer.snapshot(self.progress.version());
        self.receiver.publish(snapshot.clone())?;
        self.snapshots.insert(snapshot.version, snapshot);
        self.forget_snapshots();
        self.timer.lap(Stage::Publish, 1);
        Ok(())
    }

    /// Drops snapshots that no later episode needs.
    fn forget_snapshots(&mut self) {
        let (progress, in_flight) = (&self.progress, &self.in_flight);
        self.snapshots.retain(|version, _| {
            plan::is_needed(
                *version,
                progress,
                in_flight.iter().map(|epoch| &epoch.order),
            )
        });
    }

    /// Orders the next epoch's episodes, if they are not ordered yet, with the newest snapshot.
    /// With policy lag 1, also those of the epoch after it: they are flown with the present
    /// snapshot while the next epoch is learned from.
    fn order_ahead(&mut self) -> Result<(), TrainingError> {
        let last_ordered = self.in_flight.back().map(|last| last.order.epoch);
        let done = self.progress.epochs;
        for epoch in plan::epochs_to_order(self.config, done, last_ordered) {
            self.order(self.next_order(epoch))?;
        }
        Ok(())
    }

    /// Returns an order for `epoch` with the present snapshot.
    fn next_order(&self, epoch: u64) -> EpochOrder {
        EpochOrder {
            epoch,
            policy_version: self.progress.version().0,
            exploration: self.trainer.exploration(),
            teacher_share: self.trainer.teacher_share(),
            keep: self.trainer.keep(),
        }
    }

    /// Orders the episodes of an epoch, or the next segment of the open episode.
    fn order(&mut self, order: EpochOrder) -> Result<(), TrainingError> {
        let flown = self
            .open_episode
            .as_ref()
            .map_or(&[][..], |episode| &episode.actions);
        let tickets = curriculum::training(self.config, self.identity.run, &order, flown);
        let batch = self.receiver.fly(Epoch(order.epoch), order.keep, tickets)?;
        let episodes = Vec::with_capacity(batch.remaining());
        self.in_flight.push_back(OrderInFlight {
            order,
            batch,
            episodes,
        });
        Ok(())
    }

    /// Waits for all episodes of the oldest order, or for its segment. Until they are complete, the
    /// order stays in flight.
    fn collect(&mut self) -> Result<Vec<CommittedEpisode>, TrainingError> {
        self.timer.lap(Stage::OtherTraining, 0);
        self.reporter
            .update(|progress| progress.phase = LearnerPhase::Flying);
        let (is_mid_episode, state) = (self.open_episode.is_some(), self.receiver.state());
        if let Some(OrderInFlight {
            batch, episodes, ..
        }) = self.in_flight.front_mut()
        {
            let watch = &mut self.stop_monitor;
            let mut next = || match is_mid_episode {
                true => batch.next_unless(|| watch.during_episode(&state)),
                false => Ok(batch.next(self.stop)?),
            };
            while let Some(episode) = next()? {
                self.reporter.update(|progress| {
                    progress.episodes += u64::from(episode.outcome.is_some());
                    progress.steps += episode.steps() as u64;
                });
                episodes.push(episode);
            }
        }
        self.timer.lap(Stage::TrainingIdle, 1);
        die_if_armed(FaultPoint::LearnerEpochCollected);
        Ok(self
            .in_flight
            .pop_front()
            .map(|epoch| epoch.episodes)
            .unwrap_or_default())
    }

    /// Adds what was flown to metrics and replay buffer, in episode order.
    fn take_in(&mut self, flown: Vec<CommittedEpisode>) -> Result<(), TrainingError> {
        let count = flown.len() as u64;
        for episode in flown {
            self.curves.steps += episode.steps();
            self.record(&episode)?;
            self.trainer.take_in(episode)?;
        }
        let windows = self.metrics.windows();
        self.reporter.update(|progress| {
            progress.phase = LearnerPhase::Learning;
            progress.walls_passed = windows.walls_passed.mean();
            progress.mean_return = windows.total_reward.mean();
        });
        self.timer.lap(Stage::TakeIn, count);
        Ok(())
    }

    /// Records an episode that has ended in the metrics, and keeps one that continues.
    fn record(&mut self, flown: &CommittedEpisode) -> Result<(), TrainingError> {
        let joined = self.open_episode.take().map(|mut episode| {
            episode.extend(flown);
            episode
        });
        if flown.outcome.is_none() {
            self.open_episode = joined.or_else(|| Some(flown.without_images()));
            return Ok(());
        }
        self.metrics.episode(joined.as_ref().unwrap_or(flown))?;
        self.progress.episodes += 1;
        Ok(())
    }

    /// Writes the curves' points of the epoch just learned from.
    fn write_curves(&mut self) -> Result<(), TrainingError> {
        let curves = std::mem::take(&mut self.curves);
        let faults = self.receiver.state().faults();
        let points = curves.points(
            self.config,
            self.epoch_started.elapsed(),
            self.trainer.replay(),
            &faults,
        );
        self.epoch_started = Instant::now();
        self.metrics.scalars(self.last_episode(), &points)?;
        Ok(self.metrics.flush()?)
    }

    /// Number of the newest episode, the curves' x-axis.
    fn last_episode(&self) -> u64 {
        self.progress.episodes.saturating_sub(1)
    }

    fn train_vae(&mut self) -> Result<(), TrainingError> {
        let version = self.progress.version();
        let (reporter, watch) = (&self.reporter, &mut self.stop_monitor);
        let trained = self
            .trainer
            .train_vae(version, &mut self.timer, |metrics| {
                reporter.update(|progress| {
                    progress.vae_updates += 1;
                    progress.vae_loss = Some(metrics.loss.into());
                });
                die_if_armed(FaultPoint::LearnerMidUpdates);
                watch.after_update()
            })?;
        self.curves.vae = trained.or(self.curves.vae);
        Ok(())
    }

    fn train_policy(&mut self) -> Result<(), TrainingError> {
        self.timer.lap(Stage::OtherTraining, 0);
        let version = self.progress.version();
        let started = Instant::now();
        let (reporter, watch) = (&self.reporter, &mut self.stop_monitor);
        let updates_before = self.trainer.updates();
        let means = &mut self.curves.policy;
        self.trainer
            .train_policy(version, &mut self.timer, means, |metrics| {
                let temperature = metrics
                    .iter()
                    .find(|(scalar, _)| *scalar == Scalar::Temperature);
                reporter.update(|progress| {
                    progress.updates += 1;
                    progress.temperature = temperature.map(|(_, value)| f64::from(*value));
                });
                die_if_armed(FaultPoint::LearnerMidUpdates);
                watch.after_update()
            })?;
        die_if_armed(FaultPoint::LearnerUpdated);
        self.curves.updates += self.trainer.updates() - updates_before;
        self.curves.updating += started.elapsed();
        Ok(())
    }
}
