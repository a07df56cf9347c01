//! The training loop: delayed learning, in reading order.
//!
//! An epoch is a fixed number of flights, all flown with one frozen snapshot. When the last of them is committed, the learner takes them in, in flight
//! order, updates the networks and publishes the next snapshot. Everything it does follows from configuration, seed and committed flights.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use skein_protocol::config::Config;
use skein_protocol::ids::{Epoch, PolicyVersion};
use skein_protocol::progress::Phase;
use skein_protocol::run::{Life, RunDirectory, RunIdentity};
use skein_protocol::snapshot::{Snapshot, SnapshotError, SnapshotLayout};
use skein_protocol::summary::{Ending, Summary};

use crate::UpdateError;
use crate::best::{is_better, is_candidate};
use crate::checkpoint::{BestSnapshot, CheckpointError, CheckpointState, CheckpointStore, CheckpointWriter, Progress};
use crate::curriculum;
use crate::device::DeviceError;
use crate::evaluation::{self, EvaluationError};
use crate::flight::CommittedFlight;
use crate::flights::assembly::Keep;
use crate::flights::reception::{Batch, Reception, ReceptionError};
use crate::metrics::{Metrics, MetricsError, Scalar};
use crate::replay::InsertError;
use crate::report::{Phases, Reporter};
use crate::sac::SacMetrics;
use crate::trainer::Trainer;

/// Why a training ended before its time.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // every variant is the error of the part it is named after
pub enum TrainingError {
    #[error(transparent)]
    Device(#[from] DeviceError),
    #[error(transparent)]
    Reception(#[from] ReceptionError),
    #[error(transparent)]
    Insert(#[from] InsertError),
    #[error(transparent)]
    Update(#[from] UpdateError),
    #[error(transparent)]
    Metrics(#[from] MetricsError),
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    #[error(transparent)]
    Snapshot(#[from] SnapshotError),
    #[error(transparent)]
    Evaluation(#[from] EvaluationError),
    #[error("cannot start a thread: {0}")]
    Thread(#[source] std::io::Error),
}

/// A run under way.
struct Training<'a> {
    config: &'a Config,
    identity: &'a RunIdentity,
    directory: &'a RunDirectory,
    stop: &'a AtomicBool,
    layout: SnapshotLayout,
    trainer: Trainer,
    reception: Reception,
    reporter: Reporter,
    metrics: Metrics,
    checkpoints: CheckpointWriter,
    phases: Phases,
    epoch_started: Instant,
    version: PolicyVersion,
    epochs_done: u64,
    flights: u64,
    last_checkpoint: u64,
    evaluations: u64,
    evaluation_flights: u64,
    latest_candidate: Option<u64>,
    best: Option<BestSnapshot>,
}

/// Trains the run in `directory` to its end, in this `life` of its learner, or until `stop` is set; returns what it came to.
///
/// # Errors
/// [`TrainingError`]; what was learned until the last checkpoint is on disk.
pub fn run(
    directory: &RunDirectory,
    identity: &RunIdentity,
    life: Life,
    config: &Config,
    stop: &AtomicBool,
) -> Result<Summary, TrainingError> {
    let started = Instant::now();
    let mut training = Training::new(directory, identity, life, config, stop)?;
    let ending = match training.learn().and_then(|()| training.evaluate_best()) {
        Ok(()) => Ending::Completed,
        Err(TrainingError::Reception(ReceptionError::Stopped)) => Ending::Interrupted,
        Err(error) => {
            training.reception.finish();
            return Err(error);
        }
    };
    training.finish(ending, started)
}

impl<'a> Training<'a> {
    fn new(
        directory: &'a RunDirectory,
        identity: &'a RunIdentity,
        life: Life,
        config: &'a Config,
        stop: &'a AtomicBool,
    ) -> Result<Self, TrainingError> {
        let trainer = Trainer::new(config)?;
        let store = CheckpointStore::new(
            &directory.checkpoints(),
            identity.config_digest,
            config.checkpoints.keep,
        );
        let reception = Reception::start(identity, life, config)?;
        Ok(Self {
            config,
            identity,
            directory,
            stop,
            layout: SnapshotLayout::of(config),
            trainer,
            reporter: Reporter::start(config.run.flights, reception.shared()).map_err(TrainingError::Thread)?,
            reception,
            metrics: Metrics::create(directory, config.evaluation.window_flights as usize)?,
            checkpoints: CheckpointWriter::start(store)?,
            phases: Phases::default(),
            epoch_started: Instant::now(),
            version: PolicyVersion(0),
            epochs_done: 0,
            flights: 0,
            last_checkpoint: 0,
            evaluations: 0,
            evaluation_flights: 0,
            latest_candidate: None,
            best: None,
        })
    }

    /// All epochs.
    fn learn(&mut self) -> Result<(), TrainingError> {
        let epochs = curriculum::epochs(self.config);
        let mut in_the_air: VecDeque<Batch> = VecDeque::new();
        let mut next_to_fly = 0;
        self.publish()?;
        for epoch in (0..epochs).map(Epoch) {
            // With policy lag 1, the next epoch is flown with the snapshot at hand while this one is learned from.
            while next_to_fly < epochs && next_to_fly <= epoch.0 + self.config.learning.policy_lag {
                in_the_air.push_back(self.fly(Epoch(next_to_fly))?);
                next_to_fly += 1;
            }
            let Some(batch) = in_the_air.pop_front() else {
                break;
            };
            let flights = self.collect(batch)?;
            self.take_in(flights)?;
            self.train_vae(epoch)?;
            self.train_policy(epoch)?;
            self.epochs_done = epoch.0 + 1;
            self.version = PolicyVersion(self.epochs_done);
            self.publish()?;
            tracing::debug!(epoch = epoch.0, flights = self.flights, version = %self.version, "epoch learned from");
            self.metrics.flush()?;
            self.look_for_best()?;
            self.checkpoint_if_due()?;
        }
        Ok(())
    }

    fn publish(&mut self) -> Result<(), TrainingError> {
        let started = Instant::now();
        self.reception.publish(self.trainer.snapshot(self.version))?;
        self.phases.add("publish", started);
        Ok(())
    }

    /// Orders the flights of `epoch`, to be flown with the newest snapshot.
    fn fly(&mut self, epoch: Epoch) -> Result<Batch, TrainingError> {
        let tickets = curriculum::training(
            self.config,
            self.identity.run,
            epoch,
            self.version,
            self.trainer.exploration(),
        );
        Ok(self.reception.fly(epoch, self.trainer.keep(), tickets)?)
    }

    /// Waits for all flights of an epoch.
    fn collect(&mut self, mut batch: Batch) -> Result<Vec<CommittedFlight>, TrainingError> {
        let started = Instant::now();
        self.reporter.update(|progress| progress.phase = Phase::Flying);
        let mut flights = Vec::with_capacity(batch.remaining());
        while let Some(flight) = batch.next(self.stop)? {
            self.reporter.update(|progress| {
                progress.flights += 1;
                progress.steps += flight.steps() as u64;
            });
            flights.push(flight);
        }
        self.phases.add("wait for flights", started);
        Ok(flights)
    }

    /// Takes the epoch's flights into metrics and replay buffer, in flight order.
    fn take_in(&mut self, flights: Vec<CommittedFlight>) -> Result<(), TrainingError> {
        let started = Instant::now();
        let steps: usize = flights.iter().map(CommittedFlight::steps).sum();
        let steps_per_sec = steps as f64 / self.epoch_started.elapsed().as_secs_f64();
        self.epoch_started = started;
        for flight in flights {
            self.metrics.flight(&flight)?;
            self.trainer.take_in(flight)?;
            self.flights += 1;
        }
        let windows = self.metrics.windows();
        self.reporter.update(|progress| {
            progress.phase = Phase::Learning;
            progress.walls_passed = windows.walls_passed.mean();
            progress.mean_return = windows.total_reward.mean();
        });
        let replay = self.trainer.replay();
        let sizes = [
            (Scalar::ReplayTransitions, replay.len() as f64),
            (Scalar::ReplaySuccess, replay.success_len() as f64),
            (Scalar::StepsPerSec, steps_per_sec),
        ];
        self.metrics.scalars(self.last_flight(), &sizes)?;
        self.phases.add("take flights in", started);
        Ok(())
    }

    /// The number of the newest flight: what curves are keyed by.
    fn last_flight(&self) -> u64 {
        self.flights.saturating_sub(1)
    }

    fn train_vae(&mut self, epoch: Epoch) -> Result<(), TrainingError> {
        let started = Instant::now();
        let reporter = &self.reporter;
        let trained = self.trainer.train_vae(epoch, |metrics| {
            reporter.update(|progress| {
                progress.vae_updates += 1;
                progress.vae_loss = Some(metrics.loss.into());
            });
        })?;
        self.phases.add("VAE steps", started);
        let Some(metrics) = trained else {
            return Ok(());
        };
        let curves = [
            (Scalar::VaeLoss, metrics.loss.into()),
            (Scalar::VaePixelError, metrics.pixel_error.into()),
            (Scalar::VaeDivergence, metrics.divergence.into()),
        ];
        Ok(self.metrics.scalars(self.last_flight(), &curves)?)
    }

    fn train_policy(&mut self, epoch: Epoch) -> Result<(), TrainingError> {
        let started = Instant::now();
        let reporter = &self.reporter;
        let updates_before = self.trainer.updates();
        let trained = self.trainer.train_policy(epoch, |metrics| {
            reporter.update(|progress| {
                progress.updates += 1;
                progress.temperature = Some(metrics.temperature.into());
            });
        })?;
        let done = self.trainer.updates() - updates_before;
        let updates_per_sec = done as f64 / started.elapsed().as_secs_f64();
        self.phases.add("SAC updates", started);
        let Some(SacMetrics {
            critic_loss,
            policy_loss,
            temperature,
            entropy,
            mean_value,
        }) = trained
        else {
            return Ok(());
        };
        let curves = [
            (Scalar::CriticLoss, critic_loss.into()),
            (Scalar::PolicyLoss, policy_loss.into()),
            (Scalar::Temperature, temperature.into()),
            (Scalar::Entropy, entropy.into()),
            (Scalar::MeanValue, mean_value.into()),
            (Scalar::UpdatesPerSec, updates_per_sec),
        ];
        Ok(self.metrics.scalars(self.last_flight(), &curves)?)
    }

    fn checkpoint_if_due(&mut self) -> Result<(), TrainingError> {
        if self.flights - self.last_checkpoint >= self.config.checkpoints.every_flights {
            self.checkpoint()?;
        }
        Ok(())
    }

    /// Hands the state at the end of an epoch to the writing thread, and keeps the newest snapshot as a file.
    fn checkpoint(&mut self) -> Result<(), TrainingError> {
        let started = Instant::now();
        self.trainer
            .snapshot(self.version)
            .save(&self.directory.latest_snapshot(), &self.layout, self.config)?;
        self.checkpoints.save(CheckpointState {
            progress: Progress {
                flights: self.flights,
                epochs: self.epochs_done,
                policy_version: self.version.0,
                environment_steps: self.trainer.steps(),
                vae_steps: self.trainer.vae_updates(),
                sac_updates: self.trainer.updates(),
                evaluations: self.evaluations,
                latest_candidate: self.latest_candidate,
                best: self.best.clone(),
                windows: self.metrics.windows().clone(),
            },
            tensors: self.trainer.tensors(),
            replay: self.trainer.replay().state(),
        })?;
        self.last_checkpoint = self.flights;
        self.phases.add("checkpoint", started);
        Ok(())
    }

    /// Confirms the newest snapshot by evaluation flights if it is a candidate; keeps it if it is the best. The last one always is a candidate.
    fn look_for_best(&mut self) -> Result<(), TrainingError> {
        let walls_passed = &self.metrics.windows().walls_passed;
        let last = self.flights == self.config.run.flights;
        let section = &self.config.evaluation;
        if !last
            && !is_candidate(
                section,
                self.flights,
                self.latest_candidate,
                walls_passed,
                self.best.as_ref(),
            )
        {
            return Ok(());
        }
        let window_walls_passed = walls_passed.mean().unwrap_or_default();
        let flown = self.evaluate(self.version, 0..1, section.confirm_flights, Keep::Latents)?;
        self.latest_candidate = Some(self.flights);
        let passed: f64 = flown.iter().map(|flight| f64::from(flight.walls_passed)).sum();
        let candidate = BestSnapshot {
            policy_version: self.version.0,
            flights: self.flights,
            window_walls_passed,
            confirmed_walls_passed: passed / flown.len() as f64,
        };
        self.metrics.scalars(
            self.last_flight(),
            &[(Scalar::EvaluationWallsPassed, candidate.confirmed_walls_passed)],
        )?;
        tracing::info!(?candidate, best = ?self.best, "candidate confirmed");
        if is_better(&candidate, self.best.as_ref()) {
            self.trainer
                .snapshot(self.version)
                .save(&self.directory.best_snapshot(), &self.layout, self.config)?;
            self.best = Some(candidate);
        }
        Ok(())
    }

    /// Flies `flights` evaluation flights on each of `courses` with a published snapshot.
    fn evaluate(
        &mut self,
        version: PolicyVersion,
        courses: std::ops::Range<u32>,
        flights: u64,
        keep: Keep,
    ) -> Result<Vec<CommittedFlight>, TrainingError> {
        let started = Instant::now();
        let run = self.identity.run;
        let tickets = curriculum::evaluation(self.config, run, self.evaluations, version, courses, flights);
        let total = tickets.len() as u64;
        self.evaluations += 1;
        self.reporter.update(|progress| {
            progress.phase = Phase::Evaluating;
            progress.evaluation_flights = (0, total);
        });
        let mut batch = self.reception.fly(Epoch(self.epochs_done), keep, tickets)?;
        let mut flown = Vec::with_capacity(batch.remaining());
        while let Some(flight) = batch.next(self.stop)? {
            self.reporter.update(|progress| progress.evaluation_flights.0 += 1);
            flown.push(flight);
        }
        self.evaluation_flights += total;
        self.phases.add("evaluation", started);
        Ok(flown)
    }

    /// Evaluates the best snapshot on all courses and writes what came of it.
    fn evaluate_best(&mut self) -> Result<(), TrainingError> {
        let (best, _) = Snapshot::load(&self.directory.best_snapshot())?;
        let (version, sha256) = (best.version, best.sha256());
        self.reception.publish(best)?;
        let courses = self.config.courses.evaluation.len() as u32;
        let flown = self.evaluate(version, 0..courses, self.config.evaluation.flights, Keep::Latents)?;
        let pictured = self.evaluate(version, 0..1, 1, Keep::Depth)?;
        evaluation::write_report(self.directory, self.config, version, &sha256, &flown)?;
        evaluation::write_reconstructions(self.directory, &self.trainer, &pictured)?;
        Ok(())
    }

    /// Writes what remains, lets the actors go, and sums up.
    fn finish(mut self, ending: Ending, started: Instant) -> Result<Summary, TrainingError> {
        self.reporter.update(|progress| progress.phase = Phase::Finishing);
        self.metrics.flush()?;
        self.checkpoint()?;
        self.checkpoints.finish()?;
        let shared = self.reception.shared();
        self.reception.finish();
        Ok(Summary {
            skein_version: env!("CARGO_PKG_VERSION").to_owned(),
            run: self.identity.run,
            seed: self.config.run.seed,
            ending,
            policy_sha256: self.trainer.snapshot(self.version).sha256(),
            final_version: self.version,
            best_version: self.best.as_ref().map(|best| PolicyVersion(best.policy_version)),
            best_confirmed_walls_passed: self.best.as_ref().map(|best| best.confirmed_walls_passed),
            flights: self.flights,
            steps: self.trainer.steps(),
            updates: self.trainer.updates(),
            vae_updates: self.trainer.vae_updates(),
            evaluation_flights: self.evaluation_flights,
            tickets_reissued: shared.reissued.load(Ordering::Relaxed),
            records_refused: shared.refused.load(Ordering::Relaxed),
            wall_secs: started.elapsed().as_secs_f64(),
            phase_secs: self.phases.to_map(),
        })
    }
}
