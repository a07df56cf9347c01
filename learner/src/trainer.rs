//! The networks and the replay buffer, and how many updates are due.
//!
//! The number of VAE steps and policy updates in an epoch follows from the steps flown so far
//! alone. Every random draw is seeded by the version of the snapshot that its updates start from;
//! no two series of updates start from the same one. So a trainer restored from a checkpoint
//! continues bit for bit.

use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use skein_inference::{Encoder, encoder};
use skein_kernels::{Isa, Team};
use skein_protocol::config::{AlgorithmName, Config, Engine};
use skein_protocol::decoder_file::TrainedDecoder;
use skein_protocol::encoder_file::{EncoderError, TrainedEncoder};
use skein_protocol::ids::PolicyVersion;
use skein_protocol::policy_file::{PolicyError, start_policy};
use skein_protocol::seeds::{Purpose, derive};
use skein_protocol::snapshot::{Snapshot, SnapshotLayout};
use skein_protocol::stages::{LapTimer, Stage};
use skein_protocol::ticket::Exploration;
use tch::Device;

use crate::algorithm::{Algorithm, Columns, Inputs};
use crate::average::PolicyAverage;
use crate::checkpoint::TrainingProgress;
use crate::device::{self, DeviceError};
use crate::distill::Distill;
use crate::episode::CommittedEpisode;
use crate::episodes::assembly::KeptData;
use crate::error::UpdateError;
use crate::metrics::Scalar;
use crate::noise::Noise;
use crate::replay::{self, InsertError, Minibatch, Replay, ReplayState};
use crate::sac::{NativeSac, TorchSac};
use crate::state::{self, NamedTensor, Stateful};
use crate::td3::Td3;
use crate::vae::{Vae, VaeMetrics};

/// Images encoded at once when stored latent codes are computed again.
const ENCODE_CHUNK: usize = 64;

/// Reason why a trainer cannot be created.
#[derive(Debug, thiserror::Error)]
pub enum TrainerError {
    /// The configured device does not exist.
    #[error(transparent)]
    Device(#[from] DeviceError),
    /// The configured encoder cannot be used.
    #[error(transparent)]
    Encoder(#[from] EncoderError),
    /// The policy to start from cannot be used.
    #[error(transparent)]
    Policy(#[from] PolicyError),
}

/// Reason why a stored state cannot be restored.
#[derive(Debug, thiserror::Error)]
pub enum TrainerRestoreError {
    /// The networks' state does not fit.
    #[error(transparent)]
    Networks(#[from] state::TensorRestoreError),
    /// The replay buffer's state does not fit.
    #[error(transparent)]
    Replay(#[from] replay::ReplayRestoreError),
    /// The tensors contain another count than the counters.
    #[error("the stored {what} are {found}, but its counters say {expected}")]
    Count {
        /// Name of the counter.
        what: &'static str,
        /// Count in the tensors.
        found: u64,
        /// Count in the counters.
        expected: u64,
    },
}

/// Source of the encoder's parameters.
#[derive(Debug)]
#[expect(
    clippy::large_enum_variant,
    reason = "there is one of them in a process"
)]
enum EncoderSource {
    /// A VAE, trained along and then frozen.
    Vae(Vae),
    /// A file; frozen from the first episode on.
    File(TrainedEncoder),
    /// The algorithm, which trains the encoder itself.
    Algorithm,
}

impl EncoderSource {
    fn vae(&self) -> Option<&Vae> {
        match self {
            Self::Vae(vae) => Some(vae),
            Self::File(_) | Self::Algorithm => None,
        }
    }

    fn file(&self) -> Option<&TrainedEncoder> {
        match self {
            Self::File(encoder) => Some(encoder),
            Self::Vae(_) | Self::Algorithm => None,
        }
    }

    fn vae_mut(&mut self) -> Option<&mut Vae> {
        match self {
            Self::Vae(vae) => Some(vae),
            Self::File(_) | Self::Algorithm => None,
        }
    }
}

/// Networks and replay buffer.
#[derive(Debug)]
pub(crate) struct Trainer {
    config: Config,
    layout: SnapshotLayout,
    /// Threads of the native engine.
    team: Team,
    source: EncoderSource,
    /// The actors' encoder, and the number of VAE updates it was made after.
    encoder: Option<(u64, Encoder)>,
    algorithm: Box<dyn Algorithm>,
    /// Average of the policy that flies in its place, if averaging is configured.
    average: Option<PolicyAverage>,
    replay: Replay,
    steps: u64,
    /// Number of times that stored latent codes were due for re-encoding since the run began.
    recodings: u64,
}

/// Returns the algorithm that a configuration names, untrained. `device` is libtorch's; the native
/// engine always runs on the CPU.
pub(crate) fn new_algorithm(config: &Config, device: Device) -> Box<dyn Algorithm> {
    let (inputs, seed, engine) = (Inputs::of(config), config.run.seed, config.policy_engine());
    let (sac, teacher) = (&config.sac, &config.teacher);
    match (config.learning.algorithm, engine) {
        (AlgorithmName::Sac, Engine::Native) => {
            Box::new(NativeSac::new(sac, inputs, seed, Isa::best()).with_teacher(teacher))
        }
        (AlgorithmName::Sac, Engine::Libtorch) => {
            Box::new(TorchSac::new(sac, inputs, seed, device).with_teacher(teacher))
        }
        (AlgorithmName::Td3, _) => Box::new(Td3::new(&config.td3, inputs, seed, device)),
        (AlgorithmName::Distill, _) => {
            Box::new(Distill::new(&config.distill, inputs, seed, Isa::best()))
        }
    }
}

impl Trainer {
    /// Creates untrained networks and an empty buffer. Starts the native engine's threads and sets
    /// the number of tensor threads of the calling thread, so training must stay on this thread.
    ///
    /// # Errors
    /// [`TrainerError`] when the configured device does not exist, or the configured encoder cannot
    /// be used.
    pub(crate) fn new(config: &Config) -> Result<Self, TrainerError> {
        device::use_threads(config.run.learner_threads);
        let device = device::open(config.run.device)?;
        let engine = config.policy_engine();
        let source = match TrainedEncoder::of(config)? {
            Some(encoder) => EncoderSource::File(encoder),
            None if config.learning.end_to_end() => EncoderSource::Algorithm,
            None => EncoderSource::Vae(Vae::new(&config.vae, &config.run, device)),
        };
        let vae_engine = source.vae().map(|_| config.vae.engine(&config.run));
        let (isa, threads) = (Isa::best(), config.run.learner_threads);
        tracing::info!(
            %engine,
            vae_engine = vae_engine.map(tracing::field::display),
            device = %config.run.device,
            %isa,
            threads,
            "engines chosen"
        );
        let mut algorithm = new_algorithm(config, device);
        if let Some(policy) = start_policy(config, source.file())? {
            algorithm.start_from(&policy);
        }
        let averaged = config.learning.average_updates;
        Ok(Self {
            layout: SnapshotLayout::of(config),
            average: (averaged > 0).then(|| PolicyAverage::new(averaged, algorithm.as_ref())),
            team: Team::new(match engine {
                Engine::Native => threads,
                Engine::Libtorch => 1,
            }),
            source,
            encoder: None,
            algorithm,
            replay: Replay::new(config),
            steps: 0,
            recodings: 0,
            config: config.clone(),
        })
    }

    /// Restores the state of a checkpoint; training then continues bit for bit.
    ///
    /// # Errors
    /// [`TrainerRestoreError`] names what does not fit; do not use the trainer then.
    pub(crate) fn restore(
        &mut self,
        progress: &TrainingProgress,
        tensors: &[NamedTensor],
        replay: ReplayState,
    ) -> Result<(), TrainerRestoreError> {
        if let Some(vae) = self.source.vae_mut() {
            vae.load_named(tensors)?;
        }
        self.encoder = None;
        self.algorithm.load_named(tensors)?;
        if let Some(average) = &mut self.average {
            average.load_named(tensors)?;
        }
        self.replay = Replay::restore(&self.config, replay)?;
        self.steps = progress.environment_steps;
        self.recodings = self.recodings_due();
        for (what, found, expected) in [
            ("VAE steps", self.vae_updates(), progress.vae_steps),
            ("policy updates", self.updates(), progress.policy_updates),
        ] {
            if found != expected {
                return Err(TrainerRestoreError::Count {
                    what,
                    found,
                    expected,
                });
            }
        }
        Ok(())
    }

    /// Environment steps learned from so far.
    pub(crate) fn steps(&self) -> u64 {
        self.steps
    }

    /// Policy updates done so far.
    pub(crate) fn updates(&self) -> u64 {
        self.algorithm.updates()
    }

    /// Policy updates and VAE steps done so far.
    pub(crate) fn all_updates(&self) -> u64 {
        self.updates() + self.vae_updates()
    }

    /// VAE steps done so far.
    pub(crate) fn vae_updates(&self) -> u64 {
        self.source.vae().map_or(0, Vae::updates)
    }

    /// The replay buffer.
    pub(crate) fn replay(&self) -> &Replay {
        &self.replay
    }

    /// Exploration of the next episodes to be ordered. A policy that training starts from flies the
    /// warm-up too.
    pub(crate) fn exploration(&self) -> Exploration {
        let learning = &self.config.learning;
        if self.steps < learning.warmup_steps as u64 && learning.start_from.is_none() {
            Exploration::Uniform
        } else {
            Exploration::Sample
        }
    }

    /// Share of the steps of the next episodes that the teacher flies; `None` without a teacher.
    pub(crate) fn teacher_share(&self) -> Option<f32> {
        let teacher = &self.config.teacher;
        teacher
            .is_configured()
            .then(|| teacher.flown_share_after(self.steps) as f32)
    }

    /// Data to keep of the next episodes to be ordered.
    pub(crate) fn keep(&self) -> KeptData {
        match self.has_images() || self.config.learning.mirror {
            true => KeptData::Depth,
            false => KeptData::Latents,
        }
    }

    /// `true` while images are learned from: until the VAE is frozen, or to the end if there is
    /// none.
    fn has_images(&self) -> bool {
        self.replay.image_count().is_some()
    }

    /// Stores an episode's transitions, and those of its mirror image if configured.
    ///
    /// # Errors
    /// [`InsertError`] when the episode's parts do not fit together.
    pub(crate) fn take_in(&mut self, mut episode: CommittedEpisode) -> Result<(), InsertError> {
        let learning = &self.config.learning;
        let mirrored = learning
            .mirror
            .then(|| episode.mirrored(self.config.action_space()));
        // With policy lag, some episodes arrive after the freeze that were flown with an older
        // encoder: encode them again. Without lag, images come only for the mirror, and likewise
        // with an encoder that never changes.
        let may_be_older = learning.policy_lag > 0 && self.source.vae().is_some();
        if !self.has_images() && (may_be_older || !learning.mirror) {
            self.encode(&mut episode);
        }
        self.steps += episode.steps() as u64;
        self.insert(episode)?;
        if let Some(mut mirrored) = mirrored {
            self.encode(&mut mirrored);
            self.insert(mirrored)?;
        }
        Ok(())
    }

    fn insert(&mut self, mut episode: CommittedEpisode) -> Result<(), InsertError> {
        if !self.has_images() {
            episode.depth = None;
        }
        self.replay.insert(episode)
    }

    /// Encodes an episode's images with the present encoder. Does nothing without images, or where
    /// the algorithm trains the encoder.
    fn encode(&mut self, episode: &mut CommittedEpisode) {
        let (Some(depth), EncoderSource::Vae(_) | EncoderSource::File(_)) =
            (&episode.depth, &self.source)
        else {
            return;
        };
        let (encoder, team, _) = self.encoder();
        let codes = encoder.encode_all(team, depth);
        for (observation, latent) in episode.observations.iter_mut().zip(codes) {
            observation.latent = latent;
        }
    }

    /// Makes the VAE steps that are due by the steps flown, seeded by snapshot `version`; freezes
    /// the VAE when its training ends. Calls `after_each` after every step and stops at its error.
    /// Books the time in `timer`.
    ///
    /// # Errors
    /// [`UpdateError`] when a number is no longer finite; any error of `after_each`.
    pub(crate) fn train_vae<E: From<UpdateError>>(
        &mut self,
        version: PolicyVersion,
        timer: &mut LapTimer,
        mut after_each: impl FnMut(&VaeMetrics) -> Result<(), E>,
    ) -> Result<Option<VaeMetrics>, E> {
        let has_images = self.has_images();
        let Some(vae) = self.source.vae_mut().filter(|_| has_images) else {
            return Ok(None);
        };
        let section = &self.config.vae;
        let counted = self.steps.min(section.train_steps as u64);
        let due = (counted as f64 * section.updates_per_step) as u64;
        let purposes = (Purpose::VaeBatches, Purpose::VaeNoise);
        let (mut rng, mut noise) = draws(&self.config, purposes, version);
        let (mut images, mut last) = (Vec::new(), None);
        while vae.updates() < due {
            self.replay
                .sample_images(&mut rng, self.config.vae.batch_size, &mut images);
            timer.lap(Stage::SampleImages, 1);
            let metrics = vae.update(&images, &mut noise)?;
            timer.lap(Stage::VaeStep, 1);
            after_each(&metrics)?;
            last = Some(metrics);
        }
        let due = self.recodings_due();
        let is_over = self.steps >= self.config.vae.train_steps as u64;
        if is_over || self.recodings < due {
            self.recode_latents();
            timer.lap(Stage::Recode, 1);
        }
        self.recodings = due;
        if is_over {
            tracing::info!(
                steps = self.steps,
                vae_updates = self.vae_updates(),
                "VAE frozen"
            );
            self.replay.freeze();
        }
        Ok(last)
    }

    fn recodings_due(&self) -> u64 {
        self.steps
            .checked_div(self.config.vae.recode_steps as u64)
            .unwrap_or(0)
    }

    /// Encodes all stored images again with the present encoder.
    fn recode_latents(&mut self) {
        let (encoder, team, replay) = self.encoder();
        let renewed: Result<(), std::convert::Infallible> =
            replay.recode_latents(ENCODE_CHUNK, |images| Ok(encoder.encode_all(team, images)));
        let Ok(()) = renewed;
    }

    /// Returns the encoder as actors have it, so that codes computed here equal theirs to the last
    /// bit. Also returns the team and the replay, which its callers need beside it.
    fn encoder(&mut self) -> (&Encoder, &mut Team, &mut Replay) {
        let updates = self.vae_updates();
        let made = self
            .encoder
            .take()
            .filter(|(made_after, _)| *made_after == updates);
        let make = || {
            let snapshot = self.snapshot(PolicyVersion(0));
            (updates, encoder(&snapshot, &self.layout))
        };
        let made = made.unwrap_or_else(make);
        let (_, encoder) = self.encoder.insert(made);
        (encoder, &mut self.team, &mut self.replay)
    }

    /// Makes the policy updates that are due by the steps flown since the warm-up, seeded by
    /// snapshot `version`. Adds their metrics to `means`. Calls `after_each` after every update and
    /// stops at its error. Books the time in `timer`.
    ///
    /// # Errors
    /// [`UpdateError`] when a number is no longer finite; any error of `after_each`.
    pub(crate) fn train_policy<E: From<UpdateError>>(
        &mut self,
        version: PolicyVersion,
        timer: &mut LapTimer,
        means: &mut MetricMeans,
        mut after_each: impl FnMut(&[(Scalar, f32)]) -> Result<(), E>,
    ) -> Result<(), E> {
        let learning = &self.config.learning;
        let counted = self.steps.saturating_sub(learning.warmup_steps as u64);
        let due = (counted as f64 * learning.updates_per_step) as u64;
        let purposes = (Purpose::PolicyBatches, Purpose::PolicyNoise);
        let (mut rng, mut noise) = draws(&self.config, purposes, version);
        let mut minibatch = Minibatch::default();
        while self.algorithm.updates() < due {
            self.replay
                .sample(&mut rng, self.config.batch_size(), &mut minibatch);
            timer.lap(Stage::Sample, 1);
            let metrics = self
                .algorithm
                .update(&mut self.team, columns(&minibatch), &mut noise)?;
            if let Some(average) = &mut self.average {
                average.take_in(self.algorithm.as_ref());
            }
            timer.lap(Stage::PolicyUpdate, 1);
            means.add(&metrics);
            after_each(&metrics)?;
        }
        Ok(())
    }

    /// Returns the parameters that actors fly with, as they are now.
    pub(crate) fn snapshot(&self, version: PolicyVersion) -> Snapshot {
        let mut values = vec![0.0; self.layout.values()];
        let encoder = &mut values[self.layout.encoder()];
        match &self.source {
            EncoderSource::Vae(vae) => vae.publish(encoder),
            EncoderSource::File(trained) => encoder.copy_from_slice(&trained.values),
            EncoderSource::Algorithm => self.algorithm.publish_encoder(encoder),
        }
        let policy = &mut values[self.layout.policy()];
        match &self.average {
            Some(average) => average.publish(policy),
            None => self.algorithm.publish(policy),
        }
        Snapshot { version, values }
    }

    /// Returns the numbers of a latent code.
    pub(crate) fn latent(&self) -> usize {
        self.config.vae.latent
    }

    /// Returns the VAE's reconstruction of `images`, both `[n, 72, 128]` u8; `None` without a VAE.
    pub(crate) fn reconstruct(&mut self, images: &[u8]) -> Option<Vec<u8>> {
        let vae = self.source.vae_mut()?;
        let depth = vae.reconstruct(images).into_iter();
        Some(
            depth
                .map(|depth| (depth * 255.0).round_ties_even() as u8)
                .collect(),
        )
    }

    /// Returns the VAE's decoder as it is now; `None` without a VAE, or if the decoder needs more
    /// than the code.
    pub(crate) fn decoder(&self) -> Option<TrainedDecoder> {
        let vae = self.source.vae()?;
        let latent = self.config.vae.latent;
        let mut values = vec![0.0; vae.published_len()];
        vae.publish(&mut values);
        Some(TrainedDecoder {
            values: vae.decoder_values()?,
            latent,
            encoder_sha256: TrainedEncoder { values, latent }.sha256(),
        })
    }

    /// Copies all tensors that updates change.
    pub(crate) fn tensors(&mut self) -> Vec<NamedTensor> {
        let mut all = self
            .source
            .vae_mut()
            .map(Vae::named_tensors)
            .unwrap_or_default();
        all.extend(self.algorithm.named_tensors());
        all.extend(
            self.average
                .as_mut()
                .map(PolicyAverage::named_tensors)
                .unwrap_or_default(),
        );
        all
    }
}

/// Returns what the updates that start from snapshot `version` draw their minibatches and their
/// noise with.
fn draws(
    config: &Config,
    (batches, noise): (Purpose, Purpose),
    version: PolicyVersion,
) -> (Pcg64Mcg, Noise) {
    let seed = |purpose| derive(config.run.seed, purpose, version.0);
    (
        Pcg64Mcg::seed_from_u64(seed(batches)),
        Noise::new(seed(noise)),
    )
}

fn columns(minibatch: &Minibatch) -> Columns<'_> {
    let (states, next_states) = match minibatch.critic_states.is_empty() {
        true => (&minibatch.observations, &minibatch.next_observations),
        false => (&minibatch.critic_states, &minibatch.next_critic_states),
    };
    Columns {
        states,
        next_states,
        observations: &minibatch.observations,
        actions: &minibatch.actions,
        rewards: &minibatch.rewards,
        next_observations: &minibatch.next_observations,
        terminated: &minibatch.terminated,
        images: (!minibatch.images.is_empty())
            .then_some([&minibatch.images, &minibatch.next_images]),
        teacher_actions: (!minibatch.teacher_actions.is_empty())
            .then_some(&minibatch.teacher_actions),
    }
}

/// MetricMeans of the metrics of an epoch's updates.
#[derive(Debug, Default)]
pub(crate) struct MetricMeans {
    sums: Vec<(Scalar, f64)>,
    count: usize,
}

impl MetricMeans {
    fn add(&mut self, metrics: &[(Scalar, f32)]) {
        if self.sums.is_empty() {
            self.sums = metrics.iter().map(|(scalar, _)| (*scalar, 0.0)).collect();
        }
        for ((_, sum), (_, value)) in self.sums.iter_mut().zip(metrics) {
            *sum += f64::from(*value);
        }
        self.count += 1;
    }

    /// Returns the means; empty if there was no update.
    pub(crate) fn finish(self) -> Vec<(Scalar, f64)> {
        let mean = |(scalar, sum)| (scalar, sum / self.count as f64);
        self.sums.into_iter().map(mean).collect()
    }
}

#[cfg(test)]
mod tests;
