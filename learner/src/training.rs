//! The training loop: delayed learning, in reading order.
//!
//! An epoch is a fixed number of episodes, all flown with one frozen snapshot. When the last of
//! them is committed, the learner takes them in, in episode order, updates the networks and
//! publishes the next snapshot. With direct updates an epoch is one episode, flown in segments, and
//! the same is done after each of them. Everything it does follows from configuration, seed and
//! committed episodes; a learner that died goes on from a checkpoint as if nothing had been
//! (`saving`).

mod candidates;
mod curves;
mod error;
mod saving;
mod stop;

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use skein_protocol::config::Config;
use skein_protocol::ids::{Epoch, PolicyVersion};
use skein_protocol::progress::Phase;
use skein_protocol::snapshot::{Snapshot, SnapshotLayout};
use skein_protocol::stages::{LapTimer, Stage};
use skein_protocol::summary::{Ending, Summary};
use skein_run::fault::{FaultPoint, pass};
use skein_run::{LearnerIncarnation, RunDirectory, RunIdentity};

use crate::checkpoint::{CheckpointWriter, EpochOrder, Progress};
use crate::curriculum;
use crate::disk::Disk;
use crate::episode::CommittedEpisode;
use crate::episodes::receiver::{Batch, EpisodeReceiver, ReceiverError};
use crate::metrics::{Metrics, Scalar};
use crate::report::Reporter;
use crate::trainer::Trainer;

use curves::EpochCurves;
pub use error::TrainingError;
use stop::StopWatch;

/// A run under way.
struct Training<'a> {
    config: &'a Config,
    identity: &'a RunIdentity,
    directory: &'a RunDirectory,
    stop: &'a AtomicBool,
    stop_watch: StopWatch<'a>,
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
    /// What this thread's time goes into: what it does between two laps is in the later one.
    timer: LapTimer,
    /// What is counted of the run. What trainer and metrics count themselves is filled in for a
    /// checkpoint.
    progress: Progress,
    /// The newest checkpoint's.
    saved: Progress,
    /// Times the learner was started before.
    resumes: u64,
    /// Ordered and not learned from.
    in_the_air: VecDeque<InTheAir>,
    /// The episode whose first segments are learned from, and whose next segment is not, as far as
    /// it was flown; without images.
    under_way: Option<CommittedEpisode>,
    /// The newest snapshot, those of the episodes in the air, and the best.
    snapshots: BTreeMap<PolicyVersion, Snapshot>,
}

/// Episodes of an epoch that are under way, or the segment of one.
struct InTheAir {
    order: EpochOrder,
    batch: Batch,
    /// Those that have come in.
    episodes: Vec<CommittedEpisode>,
}

/// Trains the run in `directory` to its end, in this `incarnation` of its learner, or until `stop`
/// is set; writes and returns what it came to. It goes on from the newest undamaged checkpoint, if
/// there is one.
///
/// # Errors
/// [`TrainingError`]; what was learned until the last checkpoint is on disk.
pub fn run(
    directory: &RunDirectory,
    identity: &RunIdentity,
    incarnation: LearnerIncarnation,
    config: &Config,
    stop: &Arc<AtomicBool>,
) -> Result<Summary, TrainingError> {
    let mut training = Training::begin(directory, identity, incarnation, config, stop)?;
    let end = match training.train() {
        Ok(()) => training
            .save()
            .map(|progress| (Ending::Completed, progress)),
        Err(TrainingError::EpisodeReceiver(ReceiverError::Stopped)) => training
            .save()
            .map(|progress| (Ending::Interrupted, progress)),
        Err(TrainingError::Abandoned) => training
            .go_back()
            .map(|progress| (Ending::Interrupted, progress)),
        Err(error) => Err(error),
    };
    training.conclude(end)
}

impl Training<'_> {
    fn train(&mut self) -> Result<(), TrainingError> {
        self.learn()?;
        // Whoever dies in the final evaluation has lost the evaluation alone.
        self.checkpoint()?;
        self.evaluate_best()
    }

    /// All epochs, those that an earlier incarnation has learned from apart.
    fn learn(&mut self) -> Result<(), TrainingError> {
        let epochs = curriculum::epochs(self.config);
        // An earlier incarnation may have been stopped while it looked.
        self.look_for_best()?;
        while self.progress.epochs < epochs {
            let epoch = self.progress.epochs;
            // With policy lag 1, the next epoch is flown with the snapshot at hand while this one
            // is learned from.
            self.order_until(epochs.min(epoch + 1 + self.config.learning.policy_lag))?;
            self.learn_from_flown()?;
            while self.under_way.is_some() {
                // The rest of the episode is flown with what its last segment has taught.
                self.order(self.next_order(epoch))?;
                self.learn_from_flown()?;
            }
            self.progress.epochs += 1;
            tracing::debug!(
                epoch,
                episodes = self.progress.episodes,
                "epoch learned from"
            );
            self.draw_curves()?;
            self.look_for_best()?;
            self.checkpoint_if_due()?;
        }
        Ok(())
    }

    /// Waits for the episodes or the segment ordered first, learns from them, and publishes what
    /// was learned.
    fn learn_from_flown(&mut self) -> Result<(), TrainingError> {
        let flown = self.collect()?;
        self.take_in(flown)?;
        let before = self.trainer.all_updates();
        self.train_vae()?;
        self.train_policy()?;
        // A segment that brings no update goes on with the snapshot there is.
        if self.under_way.is_none() || self.trainer.all_updates() > before {
            self.progress.version += 1;
            self.publish()?;
        }
        Ok(())
    }

    /// Publishes the parameters as they are now.
    fn publish(&mut self) -> Result<(), TrainingError> {
        self.timer.lap(Stage::OtherTraining, 0);
        let snapshot = self.trainer.snapshot(self.progress.version());
        self.receiver.publish(snapshot.clone())?;
        self.snapshots.insert(snapshot.version, snapshot);
        self.forget_snapshots();
        self.timer.lap(Stage::Publish, 1);
        Ok(())
    }

    /// Forgets snapshots that nobody will fly any more.
    fn forget_snapshots(&mut self) {
        let mut needed = vec![self.progress.version().0];
        needed.extend(
            self.in_the_air
                .iter()
                .map(|epoch| epoch.order.policy_version),
        );
        needed.extend(self.progress.best.as_ref().map(|best| best.policy_version));
        self.snapshots
            .retain(|version, _| needed.contains(&version.0));
    }

    /// Orders the episodes of all epochs before `end` that are not ordered yet, to be flown with
    /// the newest snapshot.
    fn order_until(&mut self, end: u64) -> Result<(), TrainingError> {
        let first = self
            .in_the_air
            .back()
            .map_or(self.progress.epochs, |last| last.order.epoch + 1);
        for epoch in first..end {
            self.order(self.next_order(epoch))?;
        }
        Ok(())
    }

    /// How what is ordered now of `epoch` is flown.
    fn next_order(&self, epoch: u64) -> EpochOrder {
        EpochOrder {
            epoch,
            policy_version: self.progress.version().0,
            exploration: self.trainer.exploration(),
            keep: self.trainer.keep(),
        }
    }

    /// Orders the episodes of an epoch, or the next segment of the one that is under way.
    fn order(&mut self, order: EpochOrder) -> Result<(), TrainingError> {
        let flown = self
            .under_way
            .as_ref()
            .map_or(&[][..], |episode| &episode.actions);
        let tickets = curriculum::training(
            self.config,
            self.identity.run,
            Epoch(order.epoch),
            PolicyVersion(order.policy_version),
            order.exploration,
            flown,
        );
        let batch = self.receiver.fly(Epoch(order.epoch), order.keep, tickets)?;
        let episodes = Vec::with_capacity(batch.remaining());
        self.in_the_air.push_back(InTheAir {
            order,
            batch,
            episodes,
        });
        Ok(())
    }

    /// Waits for all episodes of the epoch that was ordered first, or for its segment. Until they
    /// are there, it counts as in the air.
    fn collect(&mut self) -> Result<Vec<CommittedEpisode>, TrainingError> {
        self.timer.lap(Stage::OtherTraining, 0);
        self.reporter
            .update(|progress| progress.phase = Phase::Flying);
        let (is_amid_episode, shared) = (self.under_way.is_some(), self.receiver.shared());
        if let Some(InTheAir {
            batch, episodes, ..
        }) = self.in_the_air.front_mut()
        {
            let watch = &mut self.stop_watch;
            let mut next = || match is_amid_episode {
                true => batch.next_unless(|| watch.amid_episode(&shared)),
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
        pass(FaultPoint::LearnerEpochCollected);
        Ok(self
            .in_the_air
            .pop_front()
            .map(|epoch| epoch.episodes)
            .unwrap_or_default())
    }

    /// Takes what was flown into metrics and replay buffer, in episode order.
    fn take_in(&mut self, flown: Vec<CommittedEpisode>) -> Result<(), TrainingError> {
        let count = flown.len() as u64;
        for episode in flown {
            self.curves.steps += episode.steps();
            self.tell(&episode)?;
            self.trainer.take_in(episode)?;
        }
        let windows = self.metrics.windows();
        self.reporter.update(|progress| {
            progress.phase = Phase::Learning;
            progress.walls_passed = windows.walls_passed.mean();
            progress.mean_return = windows.total_reward.mean();
        });
        self.timer.lap(Stage::TakeIn, count);
        Ok(())
    }

    /// Tells the metrics of an episode that has ended, and keeps one that goes on.
    fn tell(&mut self, flown: &CommittedEpisode) -> Result<(), TrainingError> {
        let joined = self.under_way.take().map(|mut episode| {
            episode.extend(flown);
            episode
        });
        if flown.outcome.is_none() {
            self.under_way = joined.or_else(|| Some(flown.without_images()));
            return Ok(());
        }
        self.metrics.episode(joined.as_ref().unwrap_or(flown))?;
        self.progress.episodes += 1;
        Ok(())
    }

    /// Tells what the epoch that has just been learned from brought.
    fn draw_curves(&mut self) -> Result<(), TrainingError> {
        let curves = std::mem::take(&mut self.curves);
        let shared = self.receiver.shared();
        let points = curves.points(self.epoch_started.elapsed(), self.trainer.replay(), &shared);
        self.epoch_started = Instant::now();
        self.metrics.scalars(self.last_episode(), &points)?;
        Ok(self.metrics.flush()?)
    }

    /// The number of the newest episode: what curves are keyed by.
    fn last_episode(&self) -> u64 {
        self.progress.episodes.saturating_sub(1)
    }

    fn train_vae(&mut self) -> Result<(), TrainingError> {
        let version = self.progress.version();
        let (reporter, watch) = (&self.reporter, &mut self.stop_watch);
        let trained = self
            .trainer
            .train_vae(version, &mut self.timer, |metrics| {
                reporter.update(|progress| {
                    progress.vae_updates += 1;
                    progress.vae_loss = Some(metrics.loss.into());
                });
                pass(FaultPoint::LearnerMidUpdates);
                watch.after_update()
            })?;
        self.curves.vae = trained.or(self.curves.vae);
        Ok(())
    }

    fn train_policy(&mut self) -> Result<(), TrainingError> {
        self.timer.lap(Stage::OtherTraining, 0);
        let version = self.progress.version();
        let started = Instant::now();
        let (reporter, watch) = (&self.reporter, &mut self.stop_watch);
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
                pass(FaultPoint::LearnerMidUpdates);
                watch.after_update()
            })?;
        pass(FaultPoint::LearnerUpdated);
        self.curves.updates += self.trainer.updates() - updates_before;
        self.curves.updating += started.elapsed();
        Ok(())
    }
}
