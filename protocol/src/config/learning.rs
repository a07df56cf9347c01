//! The `[learning]` section.

use std::fmt;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::{InvalidValue, require};
use crate::heading::in_heading_frame;
use crate::segment::MAX_PRIOR_ACTIONS;
use crate::{Action, ActionSpace, LatentCode};

/// Largest `learning.average_updates`.
const MAX_AVERAGED_UPDATES: usize = 1_000_000;
/// Most entries of `learning.history_steps`.
const MAX_HISTORY: usize = 16;

/// The `[learning]` section: the algorithm, its inputs, and how updates alternate with flying.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LearningSection {
    /// Learning algorithm: `sac`, `td3` or `distill`, each with a section of its own. `distill`
    /// needs a `[teacher]`. Default `sac`, as in the paper.
    pub algorithm: AlgorithmName,
    /// Snapshot whose policy `sac` or `distill` starts from, instead of a random one. The policy
    /// must see what this run's policy sees, by the same encoder: name the same file in
    /// `vae.start_from`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub start_from: Option<PathBuf>,
    /// Training of the encoder, which turns a depth image into the policy's input. `vae` trains it
    /// as a variational auto-encoder. `end-to-end` trains it by the critic's loss; then `[vae]`
    /// sets only the code's length, and every transition keeps its images, 9 KiB each. Default
    /// `vae`, as in the paper.
    pub encoder: EncoderTraining,
    /// Episodes flown with one frozen snapshot before the networks are updated, 1 to 10,000. 1 is
    /// the paper's delayed learning. Default 10.
    pub episodes_per_epoch: u64,
    /// Steps of a segment. After each segment the networks are updated, and the episode continues
    /// with the new weights. 0 updates only after whole episodes, as delayed learning does; 1 is
    /// direct updates, which the paper compares with. With segments, one actor flies at a time. At
    /// most 256. Default 0.
    pub segment_steps: u64,
    /// Epochs by which the flown snapshot lags behind: 0 flies the newest, 1 lets actors fly while
    /// the learner updates. Default 0.
    pub policy_lag: u64,
    /// Policy updates per environment step, done at the end of the epoch; 0 to 100. Default 0.5.
    pub updates_per_step: f64,
    /// Environment steps with random actions before the first update; at most `replay.capacity`.
    /// Default 2000, as in the paper.
    pub warmup_steps: usize,
    /// Episodes before training moves to the next start level; at least 1. Default 10, as in the
    /// paper.
    pub episodes_per_level: u64,
    /// Start levels of training, before it returns to the first; at least 1, at most the walls of
    /// the training course. Default 5, as in the paper.
    pub levels: u8,
    /// Policy input per step: `latent`, `latent+velocity` or `latent+velocity+action`, each also
    /// with `+goal`. Default `latent`, as in the paper.
    pub observation: Observation,
    /// Earlier steps that the policy also sees, as rising numbers of steps back; at most 16. A step
    /// is a `simulator.vehicle.control_period_secs`. Steps before the reset count as the reset. A
    /// wall seen a second ago is out of view when the drone is in its opening. Default none, as in
    /// the paper.
    pub history_steps: Vec<usize>,
    /// `true` stores every episode a second time, mirrored left to right. Twice the transitions
    /// come from the same steps; they fill the replay twice as fast. Default false, as in the
    /// paper.
    pub mirror: bool,
    /// Policy updates over which the flown policy is averaged, exponentially weighted; at most
    /// 1,000,000. 0 flies the policy as the last update left it. Default 0, as in the paper.
    pub average_updates: usize,
    /// Critic input: `observation` or `ground-truth`. The critic is needed only in training, where
    /// the simulator provides more than the drone sees. Default `observation`, as in the paper.
    pub critic_input: CriticInput,
}

impl Default for LearningSection {
    fn default() -> Self {
        Self {
            algorithm: AlgorithmName::Sac,
            start_from: None,
            encoder: EncoderTraining::Vae,
            episodes_per_epoch: 10,
            segment_steps: 0,
            policy_lag: 0,
            updates_per_step: 0.5,
            warmup_steps: 2000,
            episodes_per_level: 10,
            levels: 5,
            observation: Observation::Latent,
            history_steps: Vec::new(),
            mirror: false,
            average_updates: 0,
            critic_input: CriticInput::Observation,
        }
    }
}

impl LearningSection {
    pub(super) fn validate(&self) -> Result<(), InvalidValue> {
        require(
            (1..=10_000).contains(&self.episodes_per_epoch),
            "learning.episodes_per_epoch",
            self.episodes_per_epoch,
            "is outside 1..=10000: the learner holds a whole epoch in memory before it updates",
        )?;
        require(
            self.policy_lag <= 1,
            "learning.policy_lag",
            self.policy_lag,
            "is above 1: a lag of 1 already overlaps updates with flying, so 2 gains nothing",
        )?;
        self.validate_segments()?;
        self.validate_encoder()?;
        require(
            (0.0..=100.0).contains(&self.updates_per_step),
            "learning.updates_per_step",
            self.updates_per_step,
            "is outside [0, 100]",
        )?;
        require(
            self.episodes_per_level >= 1,
            "learning.episodes_per_level",
            self.episodes_per_level,
            "is below 1: no episode could start",
        )?;
        require(
            self.levels >= 1,
            "learning.levels",
            self.levels,
            "is below 1: no episode could start",
        )?;
        require(
            self.average_updates <= MAX_AVERAGED_UPDATES,
            "learning.average_updates",
            self.average_updates,
            format!("is above {MAX_AVERAGED_UPDATES}: the flown policy would hardly ever change"),
        )?;
        let rising = |steps: &[usize]| {
            steps.is_sorted_by(|earlier, later| earlier < later) && !steps.starts_with(&[0])
        };
        require(
            rising(&self.history_steps),
            "learning.history_steps",
            format!("{:?}", self.history_steps),
            "must rise from 1 or more: each is a number of steps back from the present, which is \
            always seen",
        )?;
        require(
            self.history_steps.len() <= MAX_HISTORY,
            "learning.history_steps",
            format!("{:?}", self.history_steps),
            format!("lists more than {MAX_HISTORY} steps: each is stored with every transition"),
        )
    }

    /// Returns how often an episode's transitions are stored: twice with `mirror`, else once.
    pub fn copies_per_transition(&self) -> usize {
        1 + usize::from(self.mirror)
    }

    /// Returns `true` if episodes are flown in segments, with new weights after each.
    pub fn in_segments(&self) -> bool {
        self.segment_steps > 0
    }

    /// Returns `true` if policy and critic learn from depth images themselves.
    pub fn end_to_end(&self) -> bool {
        self.encoder == EncoderTraining::EndToEnd
    }

    /// Checks the keys that an encoder trained by the critic's loss rules out.
    fn validate_encoder(&self) -> Result<(), InvalidValue> {
        require(
            !self.end_to_end() || self.history_steps.is_empty(),
            "learning.history_steps",
            format!("{:?}", self.history_steps),
            "does not go with learning.encoder = \"end-to-end\", which loads the images of two \
            steps with each transition, and no earlier ones: set it to [], or set \
            learning.encoder to \"vae\"",
        )?;
        require(
            !self.end_to_end() || self.critic_input == CriticInput::Observation,
            "learning.critic_input",
            "ground-truth",
            "does not go with learning.encoder = \"end-to-end\": the critic's loss trains the \
            encoder, and this critic sees no image; set it to \"observation\", or \
            learning.encoder to \"vae\"",
        )?;
        require(
            !self.end_to_end() || self.average_updates == 0,
            "learning.average_updates",
            self.average_updates,
            "does not go with learning.encoder = \"end-to-end\": an averaged policy would see \
            through an encoder that is not averaged; set it to 0, or learning.encoder to \"vae\"",
        )
    }

    /// Checks the keys that segments rule out. Only with a single episode in progress does each
    /// segment follow from everything flown before.
    fn validate_segments(&self) -> Result<(), InvalidValue> {
        require(
            self.segment_steps <= MAX_PRIOR_ACTIONS as u64,
            "learning.segment_steps",
            self.segment_steps,
            format!(
                "is above {MAX_PRIOR_ACTIONS}, the longest episode in segments; set it to 0 to \
                update after whole episodes"
            ),
        )?;
        for (key, value, needed) in [
            ("learning.episodes_per_epoch", self.episodes_per_epoch, 1),
            ("learning.policy_lag", self.policy_lag, 0),
        ] {
            require(
                !self.in_segments() || value == needed,
                key,
                value,
                format!(
                    "does not go with learning.segment_steps = {}, which updates the weights in \
                    the middle of the only episode in progress: set it to {needed}, or \
                    learning.segment_steps to 0",
                    self.segment_steps
                ),
            )?;
        }
        require(
            !self.in_segments() || !self.mirror,
            "learning.mirror",
            self.mirror,
            format!(
                "does not go with learning.segment_steps = {}: segments are stored back to back, \
                and the mirrored copy would come between; set it to false, or \
                learning.segment_steps to 0",
                self.segment_steps
            ),
        )?;
        require(
            !self.in_segments() || self.history_steps.is_empty(),
            "learning.history_steps",
            format!("{:?}", self.history_steps),
            format!(
                "does not go with learning.segment_steps = {}: an actor that flies a segment has \
                not seen the earlier ones; set it to [], or set learning.segment_steps to 0",
                self.segment_steps
            ),
        )
    }
}

/// Learning algorithm.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum AlgorithmName {
    /// Soft actor-critic.
    Sac,
    /// Twin delayed deep deterministic policy gradient.
    Td3,
    /// Regression on a teacher's actions.
    Distill,
}

impl fmt::Display for AlgorithmName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Sac => "sac",
            Self::Td3 => "td3",
            Self::Distill => "distill",
        })
    }
}

/// Training of the encoder.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum EncoderTraining {
    /// Variational auto-encoder, frozen after its training (the paper).
    Vae,
    /// The critic's loss: policy and critic share one convolutional encoder (arXiv:1910.01741,
    /// arXiv:2004.13649).
    EndToEnd,
}

/// Input of the critic beside the action.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CriticInput {
    /// The policy's observation.
    Observation,
    /// The simulator's ground truth: positions of drone and openings, motion, disturbances (an
    /// asymmetric critic, arXiv:1710.06542).
    GroundTruth,
}

/// Policy input per step, in this order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Observation {
    /// The latent code of the depth image alone (the paper's state).
    #[serde(rename = "latent")]
    Latent,
    /// The latent code and the vehicle's own velocity in m/s: to the left and up, and first
    /// forward where the action chooses the speed. With a vehicle that responds slowly, one image
    /// is not a full state.
    #[serde(rename = "latent+velocity")]
    LatentVelocity,
    /// The above and the previous action.
    #[serde(rename = "latent+velocity+action")]
    LatentVelocityAction,
    /// The latent code and the goal: its direction in the heading frame, and its distance.
    #[serde(rename = "latent+goal")]
    LatentGoal,
    /// Latent code, velocity and goal.
    #[serde(rename = "latent+velocity+goal")]
    LatentVelocityGoal,
    /// Latent code, velocity, previous action and goal.
    #[serde(rename = "latent+velocity+action+goal")]
    LatentVelocityActionGoal,
}

impl Observation {
    /// All observations.
    pub const ALL: [Self; 6] = [
        Self::Latent,
        Self::LatentVelocity,
        Self::LatentVelocityAction,
        Self::LatentGoal,
        Self::LatentVelocityGoal,
        Self::LatentVelocityActionGoal,
    ];

    /// Returns the name in the configuration.
    pub fn name(self) -> &'static str {
        match self {
            Self::Latent => "latent",
            Self::LatentVelocity => "latent+velocity",
            Self::LatentVelocityAction => "latent+velocity+action",
            Self::LatentGoal => "latent+goal",
            Self::LatentVelocityGoal => "latent+velocity+goal",
            Self::LatentVelocityActionGoal => "latent+velocity+action+goal",
        }
    }

    /// Returns `true` if the vehicle's velocity is seen.
    pub fn has_velocity(self) -> bool {
        !matches!(self, Self::Latent | Self::LatentGoal)
    }

    /// Returns `true` if the previous action is seen.
    pub fn has_action(self) -> bool {
        matches!(
            self,
            Self::LatentVelocityAction | Self::LatentVelocityActionGoal
        )
    }

    /// Returns `true` if the goal is seen.
    pub fn has_goal(self) -> bool {
        matches!(
            self,
            Self::LatentGoal | Self::LatentVelocityGoal | Self::LatentVelocityActionGoal
        )
    }
}

/// Numbers of the goal: its direction, and its distance times [`GOAL_SCALE`].
const GOAL: usize = 4;

/// Factor that brings the goal's distance in metres to the size of the other numbers.
pub const GOAL_SCALE: f32 = 0.05;

/// Least distance of a goal whose direction is known, m.
pub const LEAST_GOAL_M: f32 = 1e-3;

/// One step as it may be seen.
#[derive(Debug, Clone, Copy)]
pub struct SeenStep<'a> {
    /// Latent code of the depth image.
    pub latent: &'a LatentCode,
    /// Velocity in the world: forward, left, up, m/s.
    pub velocity_mps: &'a [f32; 3],
    /// Orientation, world from body, as a unit quaternion (i, j, k, w).
    pub orientation: &'a [f32; 4],
    /// Goal from the drone in the heading frame, m.
    pub goal_m: &'a [f32; 3],
    /// Action of the step before; zero at the reset.
    pub previous_action: &'a Action,
}

/// Layout of the observation vector: the present step, then earlier ones. Actor and learner both
/// build observations by it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ObservationLayout {
    /// Input per step.
    pub per_step: Observation,
    /// Length of the latent code, [`VaeSection::latent`](super::VaeSection::latent).
    pub latent: usize,
    /// Numbers of an action.
    pub action: ActionSpace,
    /// Numbers of steps back of the earlier steps.
    pub history_steps: Vec<usize>,
}

impl ObservationLayout {
    /// Returns the layout of the present step alone, with a code of `latent` numbers and lateral
    /// actions.
    pub fn present(per_step: Observation, latent: usize) -> Self {
        Self {
            per_step,
            latent,
            action: ActionSpace::Lateral,
            history_steps: Vec::new(),
        }
    }

    /// Returns the input length per step.
    pub fn step_len(&self) -> usize {
        let part = |is_seen, len: usize| if is_seen { len } else { 0 };
        self.latent
            + part(self.per_step.has_velocity(), self.velocity_len())
            + part(self.per_step.has_action(), self.action.numbers())
            + part(self.per_step.has_goal(), GOAL)
    }

    /// Returns how many numbers of the velocity are seen: 2, left and up, of a drone that flies
    /// forward at a constant speed; else 3.
    pub fn velocity_len(&self) -> usize {
        2 + usize::from(self.action.has_speed())
    }

    /// Returns the length of the observation vector.
    pub fn len(&self) -> usize {
        self.step_len() * (1 + self.history_steps.len())
    }

    /// Returns `false`: the present step is always seen.
    pub fn is_empty(&self) -> bool {
        false
    }

    /// Writes the input of one step: latent code, then parts of velocity, previous action and goal.
    ///
    /// # Panics
    /// If `into` is not [`ObservationLayout::step_len`] long.
    pub fn write_step(&self, step: &SeenStep<'_>, into: &mut [f32]) {
        assert_eq!(
            into.len(),
            self.step_len(),
            "the input per step has a fixed length"
        );
        self.write_code(step.latent, into);
        let mut rest = &mut into[self.latent..];
        let mut put = |part: &[f32]| {
            let (own, others) = std::mem::take(&mut rest).split_at_mut(part.len());
            own.copy_from_slice(part);
            rest = others;
        };
        if self.per_step.has_velocity() {
            let velocity = match self.action {
                // The nose keeps pointing along the corridor.
                ActionSpace::Lateral | ActionSpace::Velocity => *step.velocity_mps,
                ActionSpace::VelocityYaw => in_heading_frame(*step.velocity_mps, *step.orientation),
            };
            put(&velocity[3 - self.velocity_len()..]);
        }
        if self.per_step.has_action() {
            put(&step.previous_action[..self.action.numbers()]);
        }
        if self.per_step.has_goal() {
            put(&goal_input(step.goal_m));
        }
    }

    /// Writes only the latent code, at its place within the input of one step.
    ///
    /// # Panics
    /// If `into` is shorter than the code.
    pub fn write_code(&self, code: &LatentCode, into: &mut [f32]) {
        into[..self.latent].copy_from_slice(&code[..self.latent]);
    }

    /// Returns the steps seen at `step` of an episode, in the vector's order. Steps before the
    /// reset are replaced by the reset.
    pub fn seen_steps(&self, step: usize) -> impl Iterator<Item = usize> {
        std::iter::once(0)
            .chain(self.history_steps.iter().copied())
            .map(move |back| step.saturating_sub(back))
    }

    /// Writes the observation vector at `step` of an episode. `write_step` writes the input of one
    /// step.
    ///
    /// # Panics
    /// If `into` is not [`ObservationLayout::len`] long.
    pub fn write(&self, step: usize, into: &mut [f32], write_step: impl Fn(usize, &mut [f32])) {
        assert_eq!(into.len(), self.len(), "an observation has a fixed length");
        for (seen_step, into) in self
            .seen_steps(step)
            .zip(into.chunks_exact_mut(self.step_len()))
        {
            write_step(seen_step, into);
        }
    }
}

/// Returns direction and scaled distance of a goal that lies `goal_m` from the drone.
fn goal_input(goal_m: &[f32; 3]) -> [f32; GOAL] {
    let distance_m = goal_m.iter().map(|part| part * part).sum::<f32>().sqrt();
    let [x, y, z] = goal_m.map(|part| part / distance_m.max(LEAST_GOAL_M));
    [x, y, z, distance_m * GOAL_SCALE]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::MAX_LATENT;

    #[test]
    fn every_part_that_is_seen_has_its_place_and_its_frame() {
        let half = std::f32::consts::FRAC_1_SQRT_2;
        let step = SeenStep {
            latent: &[0.5; MAX_LATENT],
            velocity_mps: &[1.0, 2.0, 3.0],
            // The nose points to the left.
            orientation: &[0.0, 0.0, half, half],
            goal_m: &[3.0, 0.0, 4.0],
            previous_action: &[0.1, 0.2, 0.3, 0.4],
        };
        let written = |per_step, action| {
            let layout = ObservationLayout {
                action,
                ..ObservationLayout::present(per_step, 2)
            };
            let mut vector = vec![f32::NAN; layout.step_len()];
            layout.write_step(&step, &mut vector);
            let rounded = vector.iter().map(|number| (number * 1e4).round() / 1e4);
            rounded.collect::<Vec<f32>>()
        };
        let goal = [0.6, 0.0, 0.8, 0.25];
        assert_eq!(
            written(Observation::LatentVelocityActionGoal, ActionSpace::Lateral),
            [&[0.5, 0.5, 2.0, 3.0, 0.1, 0.2][..], &goal].concat()
        );
        assert_eq!(
            written(Observation::LatentVelocityGoal, ActionSpace::Velocity),
            [&[0.5, 0.5, 1.0, 2.0, 3.0][..], &goal].concat()
        );
        assert_eq!(
            written(Observation::LatentVelocityAction, ActionSpace::VelocityYaw),
            [0.5, 0.5, 2.0, -1.0, 3.0, 0.1, 0.2, 0.3, 0.4]
        );
        assert_eq!(
            written(Observation::LatentGoal, ActionSpace::Lateral),
            [&[0.5, 0.5][..], &goal].concat()
        );
    }

    #[test]
    fn a_goal_that_is_reached_has_no_direction() {
        assert_eq!(goal_input(&[0.0; 3]), [0.0; GOAL]);
    }

    #[test]
    fn every_observation_is_called_as_in_the_configuration() {
        for observation in Observation::ALL {
            let text = toml::Value::from(observation.name());
            assert_eq!(text.try_into::<Observation>().unwrap(), observation);
        }
    }
}
