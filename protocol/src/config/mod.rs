//! The configuration of a run: one file, one struct, one struct per section.
//!
//! Every key documents its default, unknown keys are refused, and [`Config::validate`] reports the
//! wrong key, the reason and the consequence. The `[simulator]` section belongs to the simulator
//! and is passed on unread: this crate knows no physics.

mod courses;
mod distill;
mod encoder;
mod evaluation;
mod file;
mod learning;
mod portable;
mod replay;
mod run;
mod sac;
mod td3;
mod teacher;
mod transport;
mod vae;

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::ActionSpace;
use crate::segment::MAX_PRIOR_ACTIONS;
use crate::transition::RecordLengths;

pub use courses::CoursesSection;
pub use distill::DistillSection;
pub use encoder::EncoderSection;
pub use evaluation::{ConfirmOn, EvaluationSection};
pub use file::{ConfigError, FILE_KEYS, failing_override, integer_too_large};
pub use learning::{
    AlgorithmName, CriticInput, EncoderTraining, GOAL_SCALE, LEAST_GOAL_M, LearningSection,
    Observation, ObservationLayout, SeenStep,
};
pub use replay::{ReplaySection, SuccessRule};
pub use run::{CheckpointSection, Device, Engine, RunSection};
pub use sac::{SacSection, TargetEntropy};
pub use td3::Td3Section;
pub use teacher::{TeacherName, TeacherSection};
pub use transport::TransportSection;
pub use vae::{DecoderName, VaeSection};

/// The whole configuration of a run.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Seed, length, device, engine.
    pub run: RunSection,
    /// Courses.
    pub courses: CoursesSection,
    /// Delayed learning: epochs, lag, warm-up, updates.
    pub learning: LearningSection,
    /// Soft actor-critic.
    pub sac: SacSection,
    /// Twin delayed deep deterministic policy gradient.
    pub td3: Td3Section,
    /// Regression on a teacher's actions.
    pub distill: DistillSection,
    /// Teacher.
    pub teacher: TeacherSection,
    /// Variational auto-encoder.
    pub vae: VaeSection,
    /// Encoder trained before any run.
    pub encoder: EncoderSection,
    /// Split replay buffer.
    pub replay: ReplaySection,
    /// Evaluation episodes.
    pub evaluation: EvaluationSection,
    /// Checkpoints.
    pub checkpoints: CheckpointSection,
    /// Limits and deadlines between the processes. They do not influence learning.
    pub transport: TransportSection,
    /// Vehicle, camera, reward, course generator, disturbances: see the simulator's
    /// `SimulatorSettings`.
    pub simulator: toml::Table,
}

/// A key that names a file of parameters, which a run copies into its directory.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ParameterKey {
    /// `vae.start_from`.
    Encoder,
    /// `teacher.snapshot`.
    Teacher,
    /// `learning.start_from`.
    Policy,
}

impl ParameterKey {
    /// Returns the key as it stands in a configuration.
    pub fn name(self) -> &'static str {
        match self {
            Self::Encoder => "vae.start_from",
            Self::Teacher => "teacher.snapshot",
            Self::Policy => "learning.start_from",
        }
    }

    /// Returns the name of the copy in a run's directory.
    pub fn copy(self) -> &'static str {
        match self {
            Self::Encoder => "encoder.safetensors",
            Self::Teacher => "teacher.safetensors",
            Self::Policy => "policy.safetensors",
        }
    }
}

impl Config {
    /// Returns the number of transitions in a minibatch of the configured algorithm.
    pub fn batch_size(&self) -> usize {
        self.batch_size_by_key().1
    }

    fn batch_size_by_key(&self) -> (&'static str, usize) {
        match self.learning.algorithm {
            AlgorithmName::Sac => ("sac.batch_size", self.sac.batch_size),
            AlgorithmName::Td3 => ("td3.batch_size", self.td3.batch_size),
            AlgorithmName::Distill => ("distill.batch_size", self.distill.batch_size),
        }
    }

    /// Returns every file that the configuration names.
    pub fn files(&self) -> impl Iterator<Item = &PathBuf> {
        let parameters = self.parameter_files().map(|(_, path)| path);
        self.courses.paths().chain(parameters)
    }

    /// Returns the files of parameters that the configuration names, each with its key.
    pub fn parameter_files(&self) -> impl Iterator<Item = (ParameterKey, &PathBuf)> {
        [
            (ParameterKey::Encoder, &self.vae.start_from),
            (ParameterKey::Teacher, &self.teacher.snapshot),
            (ParameterKey::Policy, &self.learning.start_from),
        ]
        .into_iter()
        .filter_map(|(key, path)| path.as_ref().map(|path| (key, path)))
    }

    /// Returns every file that the configuration names, mutable.
    pub fn files_mut(&mut self) -> impl Iterator<Item = &mut PathBuf> {
        let Self {
            courses,
            vae,
            teacher,
            learning,
            ..
        } = self;
        let parameters = [
            &mut vae.start_from,
            &mut teacher.snapshot,
            &mut learning.start_from,
        ];
        courses.paths_mut().chain(parameters.into_iter().flatten())
    }

    /// As [`Config::parameter_files`], with paths that can be changed.
    pub fn parameter_files_mut(&mut self) -> impl Iterator<Item = (ParameterKey, &mut PathBuf)> {
        [
            (ParameterKey::Encoder, &mut self.vae.start_from),
            (ParameterKey::Teacher, &mut self.teacher.snapshot),
            (ParameterKey::Policy, &mut self.learning.start_from),
        ]
        .into_iter()
        .filter_map(|(key, path)| path.as_mut().map(|path| (key, path)))
    }

    /// Returns the numbers of an action: `simulator.vehicle.action`.
    ///
    /// It is the only key of the simulator's section that is read here, because the sizes of
    /// networks and records' contents follow from it. [`Config::validate`] refuses other values.
    pub fn action_space(&self) -> ActionSpace {
        self.read_action_space().unwrap_or_default()
    }

    /// Returns the lengths of what records hold.
    pub fn record_lengths(&self) -> RecordLengths {
        RecordLengths {
            latent: self.vae.latent,
            action: self.action_space(),
        }
    }

    fn read_action_space(&self) -> Option<ActionSpace> {
        let Some(action) = self.action_value() else {
            return Some(ActionSpace::default());
        };
        action.clone().try_into().ok()
    }

    fn action_value(&self) -> Option<&toml::Value> {
        self.simulator.get("vehicle")?.get("action")
    }

    /// Returns the layout of the policy's observation.
    pub fn observation_layout(&self) -> ObservationLayout {
        ObservationLayout {
            per_step: self.learning.observation,
            latent: self.vae.latent,
            action: self.action_space(),
            history_steps: self.learning.history_steps.clone(),
        }
    }

    /// Returns the engine of policy and critic: the run's engine, except that TD3 and learning from
    /// images exist for libtorch only, and distillation for the native engine only.
    pub fn policy_engine(&self) -> Engine {
        match (self.learning.algorithm, self.learning.encoder) {
            (AlgorithmName::Distill, _) => Engine::Native,
            (AlgorithmName::Sac, EncoderTraining::Vae) => self.run.engine(),
            (AlgorithmName::Td3, _) | (_, EncoderTraining::EndToEnd) => Engine::Libtorch,
        }
    }

    /// Checks every key, and combinations of keys.
    ///
    /// # Errors
    /// [`InvalidValue`] names the first wrong key, its value, the bound and the consequence.
    pub fn validate(&self) -> Result<(), InvalidValue> {
        self.run.validate()?;
        self.courses.validate()?;
        self.learning.validate()?;
        self.sac.validate()?;
        self.td3.validate()?;
        self.distill.validate()?;
        self.teacher.validate()?;
        self.vae.validate()?;
        self.encoder.validate()?;
        self.replay.validate()?;
        self.evaluation.validate()?;
        self.checkpoints.validate()?;
        self.transport.validate()?;
        let depth = 1 + self.simulator.values().map(nesting).max().unwrap_or(0);
        require(
            depth <= MAX_NESTING,
            "simulator",
            format!("nested {depth} deep"),
            format!(
                "is deeper than {MAX_NESTING}: the stored configuration could not be read back"
            ),
        )?;
        require(
            self.read_action_space().is_some(),
            "simulator.vehicle.action",
            self.action_value()
                .map_or_else(String::new, toml::Value::to_string),
            format!(
                "is none of {}: nothing else can be commanded",
                ActionSpace::ALL
                    .map(|space| format!("\"{}\"", space.name()))
                    .join(", ")
            ),
        )?;
        require(
            self.learning.warmup_steps <= self.replay.capacity,
            "learning.warmup_steps",
            self.learning.warmup_steps,
            format!(
                "exceeds replay.capacity = {}: the learner would wait forever",
                self.replay.capacity
            ),
        )?;
        self.validate_segments()?;
        self.validate_encoder()?;
        self.validate_teacher()?;
        self.validate_start()?;
        if let Some(every) = self.run.record_every {
            require(
                !self.learning.in_segments(),
                "run.record_every",
                every,
                format!(
                    "does not go with learning.segment_steps = {}: no actor has all records of \
                    an episode; leave it out, or set learning.segment_steps to 0",
                    self.learning.segment_steps
                ),
            )?;
        }
        let (key, batch_size) = self.batch_size_by_key();
        require(
            batch_size <= self.learning.warmup_steps.max(1),
            key,
            batch_size,
            format!(
                "exceeds learning.warmup_steps = {}: the first update would have too few \
                transitions to draw from",
                self.learning.warmup_steps
            ),
        )
    }

    /// Checks what `learning.encoder` requires of other sections.
    fn validate_encoder(&self) -> Result<(), InvalidValue> {
        let (end_to_end, decoder) = (self.learning.end_to_end(), self.vae.decoder);
        require(
            !end_to_end || decoder == DecoderName::Plain,
            "vae.decoder",
            "u-net",
            "does not go with learning.encoder = \"end-to-end\", where there is no VAE: set it \
            to \"plain\", or learning.encoder to \"vae\"",
        )?;
        if let Some(file) = &self.vae.start_from {
            require(
                !end_to_end,
                "vae.start_from",
                format!("\"{}\"", file.display()),
                "does not go with learning.encoder = \"end-to-end\", which trains an encoder of \
                its own: leave it out, or set learning.encoder to \"vae\"",
            )?;
        }
        require(
            !end_to_end || self.replay.capacity <= MAX_CAPACITY_WITH_IMAGES,
            "replay.capacity",
            self.replay.capacity,
            format!(
                "is above {MAX_CAPACITY_WITH_IMAGES}, and learning.encoder = \"end-to-end\": \
                every transition keeps a depth image of 9 KiB"
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
                    "does not compute {key}, which exists for libtorch only: leave run.engine \
                    out, or set it to \"libtorch\""
                ),
            )?;
        }
        Ok(())
    }

    /// Checks what a teacher, and learning from one, require of other sections.
    fn validate_teacher(&self) -> Result<(), InvalidValue> {
        let (algorithm, taught) = (self.learning.algorithm, self.teacher.is_configured());
        require(
            taught || algorithm != AlgorithmName::Distill,
            "teacher.policy",
            "none",
            "does not go with learning.algorithm = \"distill\", which learns from a teacher \
            alone: set it to \"oracle\"",
        )?;
        require(
            !taught || algorithm != AlgorithmName::Td3,
            "teacher.policy",
            self.teacher.policy,
            "does not go with learning.algorithm = \"td3\", which learns from rewards alone: set \
            it to \"none\"",
        )?;
        require(
            algorithm != AlgorithmName::Distill || !self.learning.end_to_end(),
            "learning.encoder",
            "end-to-end",
            "does not go with learning.algorithm = \"distill\", which has no critic to train the \
            encoder: set it to \"vae\"",
        )?;
        require(
            !taught || !self.learning.in_segments(),
            "learning.segment_steps",
            self.learning.segment_steps,
            "does not go with a teacher, who follows whole episodes: set it to 0, or \
            teacher.policy to \"none\"",
        )
    }

    /// Checks what `learning.start_from` requires of other keys.
    fn validate_start(&self) -> Result<(), InvalidValue> {
        let Some(file) = &self.learning.start_from else {
            return Ok(());
        };
        let (key, value) = (
            ParameterKey::Policy.name(),
            format!("\"{}\"", file.display()),
        );
        require(
            self.learning.algorithm != AlgorithmName::Td3,
            key,
            &value,
            "does not go with learning.algorithm = \"td3\", which starts from random parameters: \
            leave it out",
        )?;
        require(
            self.vae.start_from.is_some(),
            key,
            &value,
            "needs the encoder that the policy was trained with: name the same file in \
            vae.start_from, and set vae.train_steps to 0",
        )
    }

    /// Checks what segments require of other sections.
    fn validate_segments(&self) -> Result<(), InvalidValue> {
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
                "does not go with learning.segment_steps = {segment_steps}: the steps before a \
                level-up have already been stored and learned from; set it to \"level-up\", or \
                learning.segment_steps to 0"
            ),
        )?;
        require(
            !self.learning.in_segments() || longest <= MAX_PRIOR_ACTIONS,
            "transport.max_records_per_episode",
            longest,
            format!(
                "is above {MAX_PRIOR_ACTIONS}, and learning.segment_steps = {segment_steps}: the \
                ticket of a segment has no room for more earlier actions; lower it, and \
                simulator.max_steps if need be, or set learning.segment_steps to 0"
            ),
        )
    }
}

/// Largest `replay.capacity` if each transition keeps its image: 1.8 GB of images.
const MAX_CAPACITY_WITH_IMAGES: usize = 200_000;

/// Deepest nesting of sections, tables and lists. The TOML parser itself fails at 80, and deeper
/// recursion would overflow the stack.
pub(crate) const MAX_NESTING: usize = 16;

/// Returns the nesting depth of lists and tables in `value`.
fn nesting(value: &toml::Value) -> usize {
    match value {
        toml::Value::Array(values) => 1 + values.iter().map(nesting).max().unwrap_or(0),
        toml::Value::Table(table) => 1 + table.values().map(nesting).max().unwrap_or(0),
        _ => 0,
    }
}

/// A key with a wrong value.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{key} = {value} {problem}")]
pub struct InvalidValue {
    /// `section.key`.
    pub key: &'static str,
    /// The value.
    pub value: String,
    /// The violated bound and the consequence.
    pub problem: String,
}

/// Checks a network's width.
pub(crate) fn require_width(key: &'static str, width: usize) -> Result<(), InvalidValue> {
    require(
        (1..=4096).contains(&width),
        key,
        width,
        "is outside 1..=4096",
    )
}

/// Checks the size of a minibatch of transitions.
pub(crate) fn require_batch_size(
    key: &'static str,
    transitions: usize,
) -> Result<(), InvalidValue> {
    require(
        (1..=65_536).contains(&transitions),
        key,
        transitions,
        "is outside 1..=65536",
    )
}

/// Checks the number of critic networks: one for both estimates, or one each.
pub(crate) fn require_critic_networks(
    key: &'static str,
    networks: usize,
) -> Result<(), InvalidValue> {
    require(
        (1..=2).contains(&networks),
        key,
        networks,
        "is neither 1 nor 2: a critic gives two estimates, from one network or from one each",
    )
}

/// Checks Adam's step size.
pub(crate) fn require_learning_rate(key: &'static str, rate: f64) -> Result<(), InvalidValue> {
    require(
        rate > 0.0 && rate <= 1.0,
        key,
        rate,
        "is outside (0, 1]: the optimizer would stand still or blow up",
    )
}

/// Checks the discount γ.
pub(crate) fn require_discount(key: &'static str, discount: f64) -> Result<(), InvalidValue> {
    require(
        (0.0..1.0).contains(&discount),
        key,
        discount,
        "is outside [0, 1): returns would not converge",
    )
}

/// Returns an error if a condition on a key does not hold: reads as "require that … holds".
#[allow(clippy::fn_params_excessive_bools)] // the condition is the point
pub(crate) fn require(
    holds: bool,
    key: &'static str,
    value: impl std::fmt::Display,
    problem: impl Into<String>,
) -> Result<(), InvalidValue> {
    if holds {
        Ok(())
    } else {
        Err(InvalidValue {
            key,
            value: value.to_string(),
            problem: problem.into(),
        })
    }
}
