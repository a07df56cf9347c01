//! Checkpoints of a run: what goes into one, how a learner resumes from one, and how a run ends.

use std::collections::{BTreeMap, VecDeque};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Instant;
use std::{fs, io};

use skein_protocol::config::{Config, LearningSection};
use skein_protocol::files::{self, TABLE_BYTES};
use skein_protocol::ids::PolicyVersion;
use skein_protocol::progress::{self, LearnerPhase};
use skein_protocol::snapshot::{Snapshot, SnapshotLayout};
use skein_protocol::stages::{LapTimer, Stage};
use skein_protocol::summary::{RunEnding, RunSummary};
use skein_run::fault::{FaultPoint, die_if_armed};
use skein_run::{LearnerIncarnation, RunDirectory, RunIdentity, durable, save_snapshot};

use super::plan::{self, Repetition};
use super::{EpochCurves, StopMonitor, Training, TrainingError};
use crate::checkpoint::{
    CheckpointError, CheckpointState, CheckpointStore, CheckpointWriter, TrainingProgress,
};
use crate::disk::Disk;
use crate::episodes::receiver::EpisodeReceiver;
use crate::incarnations::begin_incarnation;
use crate::metrics::{Metrics, MetricsError};
use crate::notice::notify_user;
use crate::report::Reporter;
use crate::threads;
use crate::trainer::Trainer;

impl<'a> Training<'a> {
    /// Starts a training at its newest undamaged checkpoint, or at episode 0. Orders again what was
    /// in flight.
    pub(super) fn begin(
        directory: &'a RunDirectory,
        identity: &'a RunIdentity,
        incarnation: LearnerIncarnation,
        config: &'a Config,
        stop: &'a Arc<AtomicBool>,
    ) -> Result<Self, TrainingError> {
        let (started, timer) = (Instant::now(), LapTimer::start());
        let disk = Disk::new(stop.clone());
        let mut trainer = Trainer::new(config)?;
        let store = CheckpointStore::new(&directory.checkpoints(), config);
        let fits = |state: &CheckpointState| {
            let metrics = &state.progress.metrics;
            metrics
                .check(directory)
                .map_err(|problem| CheckpointError::Unfit {
                    episodes: state.progress.episodes,
                    problem: problem.to_string(),
                })
        };
        let newest = store.load_newest(fits, |error| {
            notify_user(&format!("a checkpoint is not used: {error}"));
        })?;
        let (saved, snapshots) = match newest {
            Some(checkpoint) => {
                notify_user(&format!(
                    "resuming after episode {}",
                    checkpoint.progress.episodes
                ));
                restore(&mut trainer, checkpoint)?
            }
            // An incarnation killed before its first checkpoint may have left files: they are
            // dropped, as results after episode 0.
            None => {
                refuse_lost_checkpoints(directory, config)?;
                (start(config, &trainer), BTreeMap::new())
            }
        };
        let receiver = EpisodeReceiver::start(identity, incarnation, config)?;
        // Started before anything is written, so that waiting for a full disk is reported.
        let reporter =
            Reporter::start(first_report(config, &saved), receiver.state(), disk.clone())
                .map_err(TrainingError::Thread)?;
        let incarnations = directory.incarnations_csv();
        let resumes = disk
            .with_room(&incarnations, || {
                begin_incarnation(&incarnations, saved.episodes)
            })
            .map_err(file_error(&incarnations))?;
        if resumes > 0 && saved.episodes == 0 {
            notify_user("there is no checkpoint yet: starting from the first episode");
        }
        let mut metrics = resume_metrics(directory, &saved, &disk)?;
        if saved.episodes == 0 {
            metrics.describe(config)?;
        }
        let mut training = Self {
            config,
            identity,
            directory,
            stop,
            stop_monitor: StopMonitor::of(stop),
            layout: SnapshotLayout::of(config),
            trainer,
            reporter,
            receiver,
            metrics,
            checkpoints: CheckpointWriter::start(store, disk.clone())?,
            disk,
            started,
            epoch_started: started,
            curves: EpochCurves::default(),
            timer,
            progress: saved.clone(),
            saved,
            decoder_saved: None,
            saved_snapshots: snapshots.clone(),
            resumes,
            in_flight: VecDeque::new(),
            open_episode: None,
            snapshots,
        };
        training.reset_results()?;
        training.restore_orders()?;
        Ok(training)
    }

    /// Repeats what was published and ordered when the checkpoint was taken.
    fn restore_orders(&mut self) -> Result<(), TrainingError> {
        let repetitions: Vec<_> = plan::repetitions(&self.progress).collect();
        self.progress.in_flight.clear();
        if let Some(episodes) = (self.progress.epochs > 0).then_some(self.progress.episodes) {
            tracing::info!(
                episodes,
                epochs = self.progress.epochs,
                resumes = self.resumes,
                "resumed from a checkpoint"
            );
        }
        for repetition in repetitions {
            match repetition {
                Repetition::Order(order) => self.order(order)?,
                Repetition::Publish(present) if present == self.progress.version() => {
                    self.publish()?
                }
                Repetition::Publish(older) => {
                    let snapshot = self.kept_snapshot(older)?;
                    self.receiver.publish(snapshot)?;
                }
            }
        }
        Ok(())
    }

    /// Cuts the result files back to the newest checkpoint. What came later will be computed
    /// again.
    fn reset_results(&mut self) -> Result<(), TrainingError> {
        let best = self
            .progress
            .best
            .as_ref()
            .map(|best| PolicyVersion(best.policy_version));
        let latest = (self.progress.epochs > 0).then_some(self.progress.version());
        for (version, path) in [
            (best, self.directory.best_snapshot()),
            (latest, self.directory.latest_snapshot()),
            (None, self.directory.summary_json()),
            (None, self.directory.evaluation_json()),
            (None, self.directory.evaluation_trajectories_csv()),
            (None, self.directory.reconstructions()),
        ] {
            match version {
                Some(version) => self.save_snapshot(version, &path)?,
                None => remove(&path).map_err(file_error(&path))?,
            }
        }
        Ok(())
    }

    /// Returns a snapshot of this run that is still needed.
    pub(super) fn kept_snapshot(&self, version: PolicyVersion) -> Result<Snapshot, TrainingError> {
        let missing = || TrainingError::RestoredSnapshot {
            episodes: self.saved.episodes,
            version: version.0,
            problem: "is missing",
        };
        self.snapshots.get(&version).cloned().ok_or_else(missing)
    }

    /// Writes such a snapshot to a file.
    pub(super) fn save_snapshot(
        &self,
        version: PolicyVersion,
        path: &Path,
    ) -> Result<(), TrainingError> {
        let snapshot = self.kept_snapshot(version)?;
        Ok(self.disk.with_room(path, || {
            save_snapshot(&snapshot, path, &self.layout, self.config)
        })?)
    }

    pub(super) fn checkpoint_if_due(&mut self) -> Result<(), TrainingError> {
        if plan::is_checkpoint_due(self.config, &self.progress, &self.saved) {
            self.checkpoint()?;
        }
        Ok(())
    }

    /// Hands the state to the writing thread, unless the newest checkpoint already has it. Also
    /// saves the newest snapshot as a file.
    ///
    /// Called only between epochs, hence between episodes. There the state follows from the epochs
    /// done, the last candidate, and the orders in flight; no checkpoint holds half an episode.
    pub(super) fn checkpoint(&mut self) -> Result<(), TrainingError> {
        let (now, saved) = (&self.progress, &self.saved);
        if (now.epochs, now.latest_candidate) == (saved.epochs, saved.latest_candidate) {
            return Ok(());
        }
        self.timer.lap(Stage::OtherTraining, 0);
        self.metrics.flush()?;
        self.save_snapshot(self.progress.version(), &self.directory.latest_snapshot())?;
        self.save_decoder()?;
        self.timer.lap(Stage::Checkpoint, 0);
        let progress = self.full_progress();
        let snapshots = self.snapshots.clone();
        let state = CheckpointState {
            progress: progress.clone(),
            tensors: self.trainer.tensors(),
            replay: self.trainer.replay().state(),
            snapshots: snapshots.values().cloned().collect(),
        };
        self.checkpoints.save(state, self.metrics.files())?;
        (self.saved, self.saved_snapshots) = (progress, snapshots);
        self.timer.lap(Stage::Checkpoint, 1);
        Ok(())
    }

    /// Writes the VAE's decoder to its file, if the VAE has learned since the last one.
    fn save_decoder(&mut self) -> Result<(), TrainingError> {
        let updates = self.trainer.vae_updates();
        if self.decoder_saved != Some(updates)
            && let Some(decoder) = self.trainer.decoder()
        {
            let path = self.directory.decoder();
            self.disk
                .with_room(&path, || durable::replace(&path, &decoder.to_file()))
                .map_err(file_error(&path))?;
        }
        self.decoder_saved = Some(updates);
        Ok(())
    }

    /// Returns the progress, with the counters that other parts keep.
    fn full_progress(&self) -> TrainingProgress {
        let newest = self.snapshots.get(&self.progress.version());
        let receiver = self.receiver.state();
        TrainingProgress {
            policy_sha256: newest.map(Snapshot::sha256).unwrap_or_default(),
            environment_steps: self.trainer.steps(),
            vae_steps: self.trainer.vae_updates(),
            policy_updates: self.trainer.updates(),
            in_flight: self.in_flight.iter().map(|epoch| epoch.order).collect(),
            metrics: self.metrics.state(),
            spent: self.progress.spent.with_this_incarnation(
                self.started,
                self.timer.times(),
                &receiver.times(),
                &receiver.faults(),
            ),
            ..self.progress.clone()
        }
    }

    /// Saves everything; returns the progress.
    pub(super) fn save(&mut self) -> Result<TrainingProgress, TrainingError> {
        self.reporter
            .update(|progress| progress.phase = LearnerPhase::Finishing);
        self.metrics.flush()?;
        self.checkpoint()?;
        self.timer.lap(Stage::OtherTraining, 0);
        Ok(self.full_progress())
    }

    /// Gives up an epoch half done: resets the files to the newest checkpoint, from which the next
    /// incarnation resumes. Returns that checkpoint's progress.
    pub(super) fn roll_back(&mut self) -> Result<TrainingProgress, TrainingError> {
        tracing::warn!(
            episodes = self.progress.episodes,
            checkpoint = self.saved.episodes,
            "stopped, and the end of the epoch takes too long: back to the newest checkpoint"
        );
        self.reporter
            .update(|progress| progress.phase = LearnerPhase::Finishing);
        // Flush before the files are cut, so that nothing follows later.
        self.metrics.flush()?;
        self.metrics = resume_metrics(self.directory, &self.saved, &self.disk)?;
        self.metrics.flush()?;
        // A better snapshot may have been found since.
        self.progress = self.saved.clone();
        self.snapshots = self.saved_snapshots.clone();
        self.reset_results()?;
        Ok(self.saved.clone())
    }

    /// Finishes the checkpoint being written, writes the summary, and releases the actors.
    ///
    /// The order matters: a learner killed before everything is written is started again, and still
    /// needs its actors.
    pub(super) fn conclude(
        self,
        end: Result<(RunEnding, TrainingProgress), TrainingError>,
    ) -> Result<RunSummary, TrainingError> {
        // The times of a thread are gone once it has ended.
        let thread_cpu_secs = threads::cpu_secs();
        let written = self.checkpoints.finish();
        let summed_up = match (end, written) {
            (Ok((ending, progress)), Ok(())) => {
                let summary = RunSummary {
                    thread_cpu_secs,
                    ..summary(self.identity, self.config, ending, &progress, self.resumes)
                };
                save_summary(self.directory, &self.disk, &summary).map(|()| summary)
            }
            (Ok(_), Err(error)) => Err(error.into()),
            (Err(error), Ok(())) => Err(error),
            (Err(error), Err(second)) => {
                tracing::error!(error = %second, "the last checkpoint was not written");
                Err(error)
            }
        };
        self.receiver.finish();
        summed_up
    }
}

fn save_summary(
    directory: &RunDirectory,
    disk: &Disk,
    summary: &RunSummary,
) -> Result<(), TrainingError> {
    die_if_armed(FaultPoint::LearnerBeforeSummary);
    let path = directory.summary_json();
    disk.with_room(&path, || directory.save_summary(summary))
        .map_err(file_error(&path))
}

/// Reopens the metrics at the position of `saved`.
fn resume_metrics(
    directory: &RunDirectory,
    saved: &TrainingProgress,
    disk: &Disk,
) -> Result<Metrics, MetricsError> {
    disk.with_room(directory.root(), || {
        Metrics::resume(directory, saved.metrics.clone(), disk)
    })
}

/// Refuses to start from episode 0 a run that has had checkpoints. Their folder is gone, or
/// `episodes.csv` has more episodes than can be flown before the first checkpoint. Episodes flown
/// before any checkpoint are simply flown again.
fn refuse_lost_checkpoints(directory: &RunDirectory, config: &Config) -> Result<(), TrainingError> {
    let episodes_csv = directory.episodes_csv();
    let content = match files::read(&episodes_csv, TABLE_BYTES) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
        content => content.map_err(file_error(&episodes_csv))?,
    };
    let lines = content.iter().filter(|&&byte| byte == b'\n').count() as u64;
    let rows = lines.saturating_sub(1);
    let (checkpoints, first_after) = (directory.checkpoints(), config.checkpoints.every_episodes);
    // A checkpoint is taken at the end of an epoch, and training continues while it is written,
    // until the next one is due. The folder was created with the run's.
    if rows > 2 * (first_after + config.learning.episodes_per_epoch)
        || rows > 0 && !checkpoints.is_dir()
    {
        return Err(TrainingError::CheckpointsLost {
            episodes_csv,
            rows,
            checkpoints,
            first_after,
        });
    }
    Ok(())
}

/// Progress of a run that has not begun.
fn start(config: &Config, trainer: &Trainer) -> TrainingProgress {
    TrainingProgress {
        policy_sha256: trainer.snapshot(PolicyVersion(0)).sha256(),
        ..TrainingProgress::start(config.evaluation.window_episodes as usize)
    }
}

/// Restores a checkpoint into `trainer`; returns the rest of the checkpoint.
fn restore(
    trainer: &mut Trainer,
    checkpoint: CheckpointState,
) -> Result<(TrainingProgress, BTreeMap<PolicyVersion, Snapshot>), TrainingError> {
    let CheckpointState {
        progress,
        tensors,
        replay,
        snapshots,
    } = checkpoint;
    let episodes = progress.episodes;
    trainer
        .restore(&progress, &tensors, replay)
        .map_err(|source| TrainingError::Restore { episodes, source })?;
    let version = progress.version();
    // The parameters are stored twice, in the tensors and in the snapshot. A trainer that would
    // publish another snapshot was not restored correctly.
    if trainer.snapshot(version).sha256() != progress.policy_sha256 {
        return Err(TrainingError::RestoredSnapshot {
            episodes,
            version: version.0,
            problem: "is not that of its tensors",
        });
    }
    let snapshots = snapshots
        .into_iter()
        .map(|snapshot| (snapshot.version, snapshot))
        .collect();
    Ok((progress, snapshots))
}

/// First report of this incarnation.
fn first_report(config: &Config, saved: &TrainingProgress) -> progress::ProgressReport {
    let windows = &saved.metrics.windows;
    progress::ProgressReport {
        episodes: saved.episodes,
        steps: saved.environment_steps,
        updates: saved.policy_updates,
        vae_updates: saved.vae_steps,
        walls_passed: windows.walls_passed.mean(),
        mean_return: windows.total_reward.mean(),
        elapsed_secs: saved.spent.wall_secs,
        ..progress::ProgressReport::start(config.run.episodes)
    }
}

fn summary(
    identity: &RunIdentity,
    config: &Config,
    ending: RunEnding,
    progress: &TrainingProgress,
    resumes: u64,
) -> RunSummary {
    let best = progress.best.as_ref();
    RunSummary {
        skein_version: env!("SKEIN_VERSION").to_owned(),
        run: identity.run,
        seed: config.run.seed,
        ending,
        policy_sha256: progress.policy_sha256.clone(),
        final_version: progress.version(),
        best_version: best.map(|best| PolicyVersion(best.policy_version)),
        best_confirmed_walls_passed: best.map(|best| best.confirmed_walls_passed()),
        trained: progress.trained,
        untrained: untrained(
            &config.learning,
            progress.environment_steps,
            progress.policy_updates,
        ),
        episodes: progress.episodes,
        steps: progress.environment_steps,
        updates: progress.policy_updates,
        vae_updates: progress.vae_steps,
        evaluation_episodes: progress.evaluation_episodes,
        tickets_reissued: progress.spent.tickets_reissued.values().sum(),
        records_refused: progress.spent.records_refused.values().sum(),
        reissued_by_reason: progress.spent.tickets_reissued.clone(),
        refused_by_reason: progress.spent.records_refused.clone(),
        resumes,
        wall_secs: progress.spent.wall_secs,
        stages: progress.spent.stages,
        thread_cpu_secs: BTreeMap::new(),
    }
}

/// Returns the reason why a policy is untrained after `steps`, and the remedy, if there was no
/// update.
fn untrained(learning: &LearningSection, steps: u64, updates: u64) -> Option<String> {
    let (warmup, per_step) = (learning.warmup_steps, learning.updates_per_step);
    let reason = if updates > 0 {
        return None;
    } else if per_step == 0.0 {
        "learning.updates_per_step = 0 allows none; raise it".to_owned()
    } else if steps <= warmup as u64 {
        format!(
            "the warm-up of learning.warmup_steps = {warmup} was not over after {steps} steps; \
            raise run.episodes, or lower learning.warmup_steps"
        )
    } else {
        "the run ended before the first one was due; raise run.episodes".to_owned()
    };
    Some(format!(
        "The policy is untrained, because there was no update: {reason}."
    ))
}

fn remove(path: &Path) -> io::Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        result => result,
    }
}

fn file_error(path: &Path) -> impl FnOnce(io::Error) -> TrainingError {
    let path = path.to_owned();
    move |source| TrainingError::File { path, source }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_untrained_policy_is_called_so_with_the_reason_and_the_remedy() {
        let mut learning = Config::default().learning;
        learning.warmup_steps = 800;
        assert_eq!(untrained(&learning, 900, 1), None);
        let says = |learning: &LearningSection, steps, part: &str| {
            let reason = untrained(learning, steps, 0).unwrap();
            assert!(
                reason.starts_with("The policy is untrained") && reason.contains(part),
                "{reason}"
            );
        };
        says(
            &learning,
            305,
            "learning.warmup_steps = 800 was not over after 305 steps",
        );
        says(&learning, 801, "raise run.episodes");
        learning.updates_per_step = 0.0;
        says(&learning, 9000, "learning.updates_per_step = 0");
    }

    #[test]
    fn a_run_that_lost_its_checkpoints_is_not_silently_started_again() {
        let folder = tempfile::tempdir().unwrap();
        let directory = RunDirectory::new(folder.path());
        fs::create_dir(directory.checkpoints()).unwrap();
        let mut config = Config::default();
        config.checkpoints.every_episodes = 20;
        config.learning.episodes_per_epoch = 5;
        refuse_lost_checkpoints(&directory, &config).unwrap();
        let flown = |episodes| {
            fs::write(
                directory.episodes_csv(),
                format!("header\n{}", "row\n".repeat(episodes)),
            )
            .unwrap()
        };
        // The second checkpoint waits for the first, so many episodes can be flown without one.
        flown(50);
        refuse_lost_checkpoints(&directory, &config).unwrap();
        fs::remove_dir(directory.checkpoints()).unwrap();
        assert!(
            refuse_lost_checkpoints(&directory, &config).is_err(),
            "their folder is gone"
        );
        std::os::unix::fs::symlink(folder.path().join("missing"), directory.checkpoints()).unwrap();
        assert!(
            refuse_lost_checkpoints(&directory, &config).is_err(),
            "it leads nowhere"
        );
        fs::remove_file(directory.checkpoints()).unwrap();
        fs::create_dir(directory.checkpoints()).unwrap();
        flown(51);
        let error = refuse_lost_checkpoints(&directory, &config)
            .unwrap_err()
            .to_string();
        for part in [
            "episodes.csv has 51 episodes",
            "checkpoints",
            "remove episodes.csv",
        ] {
            assert!(error.contains(part), "`{error}` does not mention `{part}`");
        }
    }
}
