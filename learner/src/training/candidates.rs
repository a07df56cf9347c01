//! Confirmation episodes, which judge candidates for the best snapshot, and the final evaluation of
//! the best one.

use skein_inference::Decoder;
use skein_kernels::Isa;
use skein_protocol::decoder_file::TrainedDecoder;
use skein_protocol::encoder_file::TrainedEncoder;
use skein_protocol::ids::{Epoch, PolicyVersion};
use skein_protocol::progress::LearnerPhase;
use skein_protocol::snapshot::Snapshot;
use skein_protocol::stages::Stage;
use skein_protocol::summary::Trained;
use skein_protocol::ticket::Ticket;
use skein_run::fault::{FaultPoint, die_if_armed};
use tracing::warn;

use super::{Training, TrainingError};
use crate::best::{is_better, is_candidate, may_replace, next_look};
use crate::checkpoint::{BestSnapshot, EpisodeWalls};
use crate::curriculum;
use crate::episode::CommittedEpisode;
use crate::episodes::assembly::KeptData;
use crate::evaluation::{self, EvaluationWriteError};
use crate::metrics::Scalar;

impl Training<'_> {
    /// Confirms the newest snapshot if it is a candidate, and keeps it if it is the best so far.
    /// The last snapshot always is a candidate, and so is a policy that training starts from.
    ///
    /// The result depends on the state alone, and a second call does nothing: a run stopped here
    /// repeats it when resumed.
    pub(super) fn confirm_if_candidate(&mut self) -> Result<(), TrainingError> {
        if !self.is_candidate() {
            return Ok(());
        }
        let version = self.progress.version();
        let mut candidate = BestSnapshot {
            policy_version: version.0,
            episodes: self.progress.episodes,
            window_walls_passed: self
                .metrics
                .windows()
                .walls_passed
                .mean()
                .unwrap_or_default(),
            confirmed: Vec::new(),
        };
        let may_be_best = self.fly_confirmation(&mut candidate)?;
        die_if_armed(FaultPoint::LearnerCandidateFlown);
        if may_be_best {
            self.note_trained(&candidate.confirmed);
        }
        self.metrics.scalars(
            self.last_episode(),
            &[(
                Scalar::EvaluationWallsPassed,
                candidate.confirmed_walls_passed(),
            )],
        )?;
        let best = self.progress.best.as_ref();
        tracing::info!(
            version = candidate.policy_version,
            episodes = candidate.episodes,
            walls_passed = candidate.confirmed_walls_passed(),
            confirmation_episodes = candidate.confirmed.len(),
            window_walls_passed = candidate.window_walls_passed,
            best_version = best.map(|best| best.policy_version),
            best_walls_passed = best.map(BestSnapshot::confirmed_walls_passed),
            "candidate for the best snapshot flown"
        );
        self.progress.latest_candidate = Some(self.progress.episodes);
        if may_be_best && is_better(&candidate, best) {
            self.progress.best = Some(candidate);
            self.save_snapshot(version, &self.directory.best_snapshot())?;
            die_if_armed(FaultPoint::LearnerBestSaved);
        }
        Ok(())
    }

    /// Flies the confirmation episodes of `candidate`, from look to look, and adds them to it.
    /// Returns `false` if it gave the candidate up before the last one.
    fn fly_confirmation(&mut self, candidate: &mut BestSnapshot) -> Result<bool, TrainingError> {
        let (run, number) = (self.identity.run, self.progress.evaluations);
        let version = PolicyVersion(candidate.policy_version);
        let mut tickets = curriculum::confirmation(self.config, run, number, version);
        let all = tickets.len() as u64;
        while !tickets.is_empty() {
            let flown = candidate.confirmed.len();
            let rest = tickets.split_off(next_look(flown).min(tickets.len()));
            let flown = self.fly(tickets, (flown as u64, all), KeptData::Latents)?;
            tickets = rest;
            candidate
                .confirmed
                .extend(flown.iter().map(|episode| EpisodeWalls {
                    passed: episode.walls_passed,
                    of: episode.course_walls,
                }));
            if !may_replace(candidate, self.progress.best.as_ref()) {
                break;
            }
        }
        self.count_evaluation(candidate.confirmed.len() as u64);
        Ok(tickets.is_empty())
    }

    /// Records the effort of training, the first time that the `confirmed` episodes reach the
    /// configured success rate.
    pub(super) fn note_trained(&mut self, confirmed: &[EpisodeWalls]) {
        let sum = |of: fn(&EpisodeWalls) -> u8| {
            confirmed
                .iter()
                .map(|walls| f64::from(of(walls)))
                .sum::<f64>()
        };
        let rate = sum(|walls| walls.passed) / sum(|walls| walls.of);
        if self.progress.trained.is_some() || rate < self.config.evaluation.trained_rate {
            return;
        }
        let trained = Trained {
            rate,
            confirmation_episodes: confirmed.len() as u64,
            episodes: self.progress.episodes,
            steps: self.trainer.steps(),
            updates: self.trainer.updates(),
            wall_secs: self.progress.spent.wall_secs + self.started.elapsed().as_secs_f64(),
        };
        tracing::info!(
            rate,
            confirmation_episodes = trained.confirmation_episodes,
            episodes = trained.episodes,
            steps = trained.steps,
            secs = trained.wall_secs,
            "trained"
        );
        self.progress.trained = Some(trained);
    }

    pub(super) fn is_candidate(&self) -> bool {
        let progress = &self.progress;
        let is_start = progress.episodes == 0 && self.config.learning.start_from.is_some();
        let is_end = progress.episodes == self.config.run.episodes;
        let is_new = progress.latest_candidate != Some(progress.episodes);
        let always = (is_start || is_end) && is_new;
        always
            || is_candidate(
                &self.config.evaluation,
                progress.episodes,
                progress.latest_candidate,
                &self.metrics.windows().walls_passed,
                progress.best.as_ref(),
            )
    }

    /// Flies `tickets`, whose snapshot is published. `progress`: episodes of this evaluation flown
    /// before, and all of them.
    fn fly(
        &mut self,
        tickets: Vec<Ticket>,
        progress: (u64, u64),
        keep: KeptData,
    ) -> Result<Vec<CommittedEpisode>, TrainingError> {
        self.timer.lap(Stage::OtherTraining, 0);
        let count = tickets.len() as u64;
        self.reporter.update(|report| {
            report.phase = LearnerPhase::Evaluating;
            report.evaluation_episodes = progress;
        });
        let mut batch = self
            .receiver
            .fly(Epoch(self.progress.epochs), keep, tickets)?;
        let mut flown = Vec::with_capacity(batch.remaining());
        while let Some(episode) = batch.next(self.stop)? {
            self.reporter
                .update(|report| report.evaluation_episodes.0 += 1);
            flown.push(episode);
        }
        self.timer.lap(Stage::Evaluate, count);
        Ok(flown)
    }

    /// Flies the final evaluation with a published snapshot. The first episode keeps its images, to
    /// be shown beside their reconstructions.
    fn fly_evaluation(
        &mut self,
        version: PolicyVersion,
    ) -> Result<Vec<CommittedEpisode>, TrainingError> {
        let (run, number) = (self.identity.run, self.progress.evaluations);
        let courses = self.config.courses.evaluation.len() as u32;
        let episodes = self.config.evaluation.episodes;
        let mut tickets =
            curriculum::evaluation(self.config, run, number, version, 0..courses, episodes);
        let total = tickets.len() as u64;
        let rest = tickets.split_off(tickets.len().min(1));
        let mut flown = self.fly(tickets, (0, total), KeptData::Depth)?;
        flown.extend(self.fly(rest, (1, total), KeptData::Latents)?);
        self.count_evaluation(total);
        Ok(flown)
    }

    /// Counts an evaluation of so many episodes.
    fn count_evaluation(&mut self, episodes: u64) {
        self.progress.evaluations += 1;
        self.progress.evaluation_episodes += episodes;
    }

    /// Evaluates the best snapshot on all courses and writes the report.
    pub(super) fn evaluate_best(&mut self) -> Result<(), TrainingError> {
        // Never missing: the last snapshot was a candidate, and the first candidate becomes the
        // best.
        let Some(version) = self
            .progress
            .best
            .as_ref()
            .map(|best| PolicyVersion(best.policy_version))
        else {
            return Ok(());
        };
        let best = self.kept_snapshot(version)?;
        let sha256 = best.sha256();
        let decoder = self.decoder_of(&best);
        self.receiver.publish(best)?;
        let flown = self.fly_evaluation(version)?;
        die_if_armed(FaultPoint::LearnerEvaluated);
        let (report, pictures) = self.disk.with_room(self.directory.root(), || {
            let report =
                evaluation::write_report(self.directory, self.config, version, &sha256, &flown)?;
            let trainer = &mut self.trainer;
            let decoder = decoder.as_ref();
            let pictures =
                evaluation::write_reconstructions(self.directory, trainer, decoder, &flown)?;
            Ok::<_, EvaluationWriteError>((report, pictures))
        })?;
        self.metrics.evaluation(self.last_episode(), &report)?;
        if let Some(pictures) = pictures {
            let episode = self.last_episode();
            self.metrics
                .reconstructions(episode, &pictures.depth, &pictures.reconstruction)?;
        }
        Ok(())
    }

    /// Returns the decoder that came with the snapshot's encoder, if it did. It serves pictures
    /// only: a damaged one is logged.
    fn decoder_of(&self, snapshot: &Snapshot) -> Option<Decoder> {
        let encoder = TrainedEncoder::of_snapshot(snapshot, self.config);
        match TrainedDecoder::of(&encoder.sha256(), &self.directory.decoder()) {
            Ok(trained) => Some(Decoder::new(Isa::best(), &trained?)),
            Err(error) => {
                warn!(%error, "cannot draw what latent codes hold");
                None
            }
        }
    }
}
