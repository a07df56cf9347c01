//! The configuration of a run: one file, one struct, one section each.
//!
//! Every key has a default beside its documentation, unknown keys are refused, and
//! [`Config::validate`] says which key is wrong, why, and what would happen. The `[simulator]`
//! section belongs to the simulator and is passed on untouched: this crate does not know physics.

mod courses;
mod evaluation;
mod file;
mod learning;
mod portable;
mod replay;
mod run;
mod sac;
mod td3;
mod transport;
mod vae;

use serde::{Deserialize, Serialize};

use crate::segment::MOST_FLOWN;

pub use courses::CoursesSection;
pub use evaluation::{ConfirmOn, EvaluationSection};
pub use file::{ConfigError, culprit};
pub use learning::{
    AlgorithmName, CriticInput, EncoderTraining, LearningSection, Observation, View,
};
pub use replay::{ReplaySection, SuccessRule};
pub use run::{CheckpointSection, Device, Engine, RunSection};
pub use sac::{SacSection, TargetEntropy};
pub use td3::Td3Section;
pub use transport::TransportSection;
pub use vae::{DecoderName, VaeSection};

/// Everything that determines a run.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Seed, length, device.
    pub run: RunSection,
    /// What is flown through.
    pub courses: CoursesSection,
    /// Delayed learning: epochs, lag, warm-up, updates.
    pub learning: LearningSection,
    /// Soft actor-critic.
    pub sac: SacSection,
    /// Twin delayed deep deterministic policy gradient.
    pub td3: Td3Section,
    /// Variational auto-encoder.
    pub vae: VaeSection,
    /// Split replay buffer.
    pub replay: ReplaySection,
    /// Evaluation episodes.
    pub evaluation: EvaluationSection,
    /// What is stored, and when.
    pub checkpoints: CheckpointSection,
    /// Limits and deadlines between the processes; without influence on what is learned.
    pub transport: TransportSection,
    /// Vehicle, camera, reward, course generator, disturbances: see the simulator's
    /// `SimulatorSettings`.
    pub simulator: toml::Table,
}

impl Config {
    /// Transitions in a minibatch of the algorithm that is used.
    pub fn batch_size(&self) -> usize {
        self.batch_size_by_key().1
    }

    fn batch_size_by_key(&self) -> (&'static str, usize) {
        match self.learning.algorithm {
            AlgorithmName::Sac => ("sac.batch_size", self.sac.batch_size),
            AlgorithmName::Td3 => ("td3.batch_size", self.td3.batch_size),
        }
    }

    /// What the policy sees.
    pub fn view(&self) -> View {
        View {
            moment: self.learning.observation,
            latent: self.vae.latent,
            history_steps: self.learning.history_steps.clone(),
        }
    }

    /// Engine of policy and critic: the run's engine, but libtorch for TD3 and for learning from
    /// images, which the native engine lacks.
    pub fn policy_engine(&self) -> Engine {
        match (self.learning.algorithm, self.learning.encoder) {
            (AlgorithmName::Sac, EncoderTraining::Vae) => self.run.engine(),
            (AlgorithmName::Td3, _) | (_, EncoderTraining::EndToEnd) => Engine::Libtorch,
        }
    }

    /// Checks every key, and keys against each other.
    ///
    /// # Errors
    /// [`Invalid`] names the first key found wrong, its value, the bound and the consequence.
    pub fn validate(&self) -> Result<(), Invalid> {
        self.run.validate()?;
        self.courses.validate()?;
        self.learning.validate()?;
        self.sac.validate()?;
        self.td3.validate()?;
        self.vae.validate()?;
        self.replay.validate()?;
        self.evaluation.validate()?;
        self.checkpoints.validate()?;
        self.transport.validate()?;
        let depth = 1 + self.simulator.values().map(nesting).max().unwrap_or(0);
        require(
            depth <= DEEPEST,
            "simulator",
            format!("nested {depth} deep"),
            format!("is deeper than {DEEPEST}: what is written of it could not be read back"),
        )?;
        require(
            self.learning.warmup_steps <= self.replay.capacity,
            "learning.warmup_steps",
            self.learning.warmup_steps,
            format!(
                "exceeds replay.capacity = {}: the learner would wait for ever",
                self.replay.capacity
            ),
        )?;
        self.validate_segments()?;
        self.validate_encoder()?;
        let (key, batch_size) = self.batch_size_by_key();
        require(
            batch_size <= self.learning.warmup_steps.max(1),
            key,
            batch_size,
            format!(
                "exceeds learning.warmup_steps = {}: the first update would have too few transitions to draw from",
                self.learning.warmup_steps
            ),
        )
    }

    /// What ways of training the encoder ask of other sections.
    fn validate_encoder(&self) -> Result<(), Invalid> {
        let (end_to_end, decoder) = (self.learning.end_to_end(), self.vae.decoder);
        require(
            !end_to_end || decoder == DecoderName::Plain,
            "vae.decoder",
            "u-net",
            "does not go with learning.encoder = \"end-to-end\", where there is no VAE: set it to \"plain\", or learning.encoder to \"vae\"",
        )?;
        require(
            !end_to_end || self.replay.capacity <= MOST_WITH_IMAGES,
            "replay.capacity",
            self.replay.capacity,
            format!(
                "is above {MOST_WITH_IMAGES}, and learning.encoder = \"end-to-end\": every transition keeps a depth image, 9 KiB"
            ),
        )?;
        let is_native = self.run.engine == Some(Engine::Native);
        let td3 = self.learning.algorithm == AlgorithmName::Td3;
        for (asked, key) in [
            (td3, "learning.algorithm = \"td3\""),
            (end_to_end, "learning.encoder = \"end-to-end\""),
            (decoder == DecoderName::UNet, "vae.decoder = \"u-net\""),
        ] {
            require(
                !(is_native && asked),
                "run.engine",
                Engine::Native,
                format!(
                    "does not compute {key}, which is written for libtorch: leave run.engine out, or set it to \"libtorch\""
                ),
            )?;
        }
        Ok(())
    }

    /// What episodes in segments ask of other sections.
    fn validate_segments(&self) -> Result<(), Invalid> {
        let (segment_steps, longest) = (
            self.learning.segment_steps,
            self.transport.max_records_per_episode,
        );
        require(
            !self.learning.in_segments()
                || self.replay.success == SuccessRule::LevelUp
                || self.replay.success_share == 0.0,
            "replay.success",
            "approach",
            format!(
                "does not go with learning.segment_steps = {segment_steps}: the steps before a level-up are stored and learned from by then; set it to \"level-up\", or learning.segment_steps to 0"
            ),
        )?;
        require(
            !self.learning.in_segments() || longest <= MOST_FLOWN,
            "transport.max_records_per_episode",
            longest,
            format!(
                "is above {MOST_FLOWN}, and learning.segment_steps = {segment_steps}: the ticket of a segment has no room for more actions flown before; lower it, and simulator.max_steps if need be, or set learning.segment_steps to 0"
            ),
        )
    }
}

/// Transitions held at most where each keeps its image: 1.8 GB of images.
const MOST_WITH_IMAGES: usize = 200_000;

/// How deep sections, tables and lists may lie within each other: the parser of TOML itself ends at
/// 80, and recursion at the end of the stack.
pub(crate) const DEEPEST: usize = 16;

/// Lists and tables within each other in `value`.
fn nesting(value: &toml::Value) -> usize {
    match value {
        toml::Value::Array(values) => 1 + values.iter().map(nesting).max().unwrap_or(0),
        toml::Value::Table(table) => 1 + table.values().map(nesting).max().unwrap_or(0),
        _ => 0,
    }
}

/// A key whose value makes no sense.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{key} = {value} {problem}")]
pub struct Invalid {
    /// `section.key`.
    pub key: &'static str,
    /// The value found.
    pub value: String,
    /// The bound and what its violation would lead to.
    pub problem: String,
}

/// The check of a network's width.
pub(crate) fn require_width(key: &'static str, width: usize) -> Result<(), Invalid> {
    require(
        (1..=4096).contains(&width),
        key,
        width,
        "is outside 1..=4096",
    )
}

/// The check of a minibatch of transitions.
pub(crate) fn require_batch_size(key: &'static str, transitions: usize) -> Result<(), Invalid> {
    require(
        (1..=65_536).contains(&transitions),
        key,
        transitions,
        "is outside 1..=65536",
    )
}

/// One network for both estimates, or one each.
pub(crate) fn require_critic_networks(key: &'static str, networks: usize) -> Result<(), Invalid> {
    require(
        (1..=2).contains(&networks),
        key,
        networks,
        "is neither 1 nor 2: a critic gives two estimates, from one network or from one each",
    )
}

/// The check of Adam's step size.
pub(crate) fn require_learning_rate(key: &'static str, rate: f64) -> Result<(), Invalid> {
    require(
        rate > 0.0 && rate <= 1.0,
        key,
        rate,
        "is outside (0, 1]: the optimizer would stand still or blow up",
    )
}

/// The check of γ.
pub(crate) fn require_discount(key: &'static str, discount: f64) -> Result<(), Invalid> {
    require(
        (0.0..1.0).contains(&discount),
        key,
        discount,
        "is outside [0, 1): returns would not converge",
    )
}

/// One check of one key: reads as "require that … holds".
#[allow(clippy::fn_params_excessive_bools)] // the condition is the point
pub(crate) fn require(
    holds: bool,
    key: &'static str,
    value: impl std::fmt::Display,
    problem: impl Into<String>,
) -> Result<(), Invalid> {
    if holds {
        Ok(())
    } else {
        Err(Invalid {
            key,
            value: value.to_string(),
            problem: problem.into(),
        })
    }
}
