//! `[learning]`.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::{Invalid, require};
use crate::segment::MOST_FLOWN;
use crate::{ACTION, LatentCode};

/// Policy updates that can be averaged over at most.
const MOST_AVERAGED: usize = 1_000_000;
/// Earlier moments that can be seen at most.
const MOST_HISTORY: usize = 16;

/// `[learning]`: when is learned, how much, and from what.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LearningSection {
    /// What learns the policy: `sac` or `td3`, each with a section of its own. Default `sac`, as in
    /// the paper.
    pub algorithm: AlgorithmName,
    /// What trains the encoder that turns a depth image into the numbers the policy sees: `vae`, or
    /// `end-to-end`, where the critic's loss does and `[vae]` has no say but in the code's length.
    /// Every transition keeps its images then, 9 KiB each. Default `vae`, as in the paper.
    pub encoder: EncoderTraining,
    /// Episodes flown with one frozen snapshot before the networks are updated. 1 is the paper's
    /// delayed learning. Default 10.
    pub episodes_per_epoch: u64,
    /// Steps after which the networks are updated and the weights refreshed in the middle of an
    /// episode, which goes on with them. 0 waits for the episode's end, as delayed learning does; 1
    /// is direct updates, which the paper compares that with. One actor flies at a time then.
    /// Default 0.
    pub segment_steps: u64,
    /// Epochs a snapshot is behind when it is flown: 0 flies the newest; 1 lets actors fly while
    /// the learner updates. Default 0.
    pub policy_lag: u64,
    /// Policy updates per environment step, done at the end of the epoch. Default 0.5.
    pub updates_per_step: f64,
    /// Environment steps flown at random before the first update (paper: 2000). Default 2000.
    pub warmup_steps: usize,
    /// Episodes before training starts from the next level (paper: 10). Default 10.
    pub episodes_per_level: u64,
    /// Start levels that training goes through before it returns to the first (paper: 5); at most
    /// the walls of the training course. Default 5.
    pub levels: u8,
    /// What the policy sees of a moment. Default `latent`, as in the paper.
    pub observation: Observation,
    /// Earlier moments that it sees beside the present one, by how many steps they lie back,
    /// rising; before reset all was as at reset. What was in view a second ago no longer is when
    /// the drone is in an opening. Default none, as in the paper.
    pub history_steps: Vec<usize>,
    /// Whether every episode is learned from twice, the second time as seen in a mirror, where left
    /// and right change places. Twice the transitions for the same steps flown; they fill the
    /// replay twice as fast. Default false, as in the paper.
    pub mirror: bool,
    /// Policy updates over which the policy that flies is averaged, exponentially weighted; 0 flies
    /// the policy as the last update left it. Default 0, as in the paper.
    pub average_updates: usize,
    /// What the critic sees. It is needed in training alone, where the simulator can tell it more
    /// than the drone sees. Default `observation`, as in the paper.
    pub critic_input: CriticInput,
}

impl Default for LearningSection {
    fn default() -> Self {
        Self {
            algorithm: AlgorithmName::Sac,
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
    pub(super) fn validate(&self) -> Result<(), Invalid> {
        require(
            (1..=10_000).contains(&self.episodes_per_epoch),
            "learning.episodes_per_epoch",
            self.episodes_per_epoch,
            "is outside 1..=10000: the learner holds an epoch in memory before it learns from it",
        )?;
        require(
            self.policy_lag <= 1,
            "learning.policy_lag",
            self.policy_lag,
            "is above 1: flying two epochs behind gains nothing over one, whose updates already overlap the flying",
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
            self.average_updates <= MOST_AVERAGED,
            "learning.average_updates",
            self.average_updates,
            format!("is above {MOST_AVERAGED}: what flies would hardly ever change"),
        )?;
        let rising = |steps: &[usize]| {
            steps.is_sorted_by(|earlier, later| earlier < later) && !steps.starts_with(&[0])
        };
        require(
            rising(&self.history_steps),
            "learning.history_steps",
            format!("{:?}", self.history_steps),
            "does not rise from 1 or more: each is a number of steps back from the present, which is always seen",
        )?;
        require(
            self.history_steps.len() <= MOST_HISTORY,
            "learning.history_steps",
            format!("{:?}", self.history_steps),
            format!("names more than {MOST_HISTORY} moments: each is kept with every transition"),
        )
    }

    /// How often an episode's transitions are stored: twice if it is seen in a mirror as well.
    pub fn times_stored(&self) -> usize {
        1 + usize::from(self.mirror)
    }

    /// Whether episodes are flown in segments, so that the weights are refreshed in the middle of
    /// them.
    pub fn in_segments(&self) -> bool {
        self.segment_steps > 0
    }

    /// Whether policy and critic learn from depth images themselves.
    pub fn end_to_end(&self) -> bool {
        self.encoder == EncoderTraining::EndToEnd
    }

    /// What an encoder that the critic's loss trains does not go with.
    fn validate_encoder(&self) -> Result<(), Invalid> {
        require(
            !self.end_to_end() || self.history_steps.is_empty(),
            "learning.history_steps",
            format!("{:?}", self.history_steps),
            "does not go with learning.encoder = \"end-to-end\", which draws the images of two moments with each transition and no earlier ones: name none, or set learning.encoder to \"vae\"",
        )?;
        require(
            !self.end_to_end() || self.critic_input == CriticInput::Observation,
            "learning.critic_input",
            "ground-truth",
            "does not go with learning.encoder = \"end-to-end\": the critic's loss trains the encoder, and this critic sees no image; set it to \"observation\", or learning.encoder to \"vae\"",
        )?;
        require(
            !self.end_to_end() || self.average_updates == 0,
            "learning.average_updates",
            self.average_updates,
            "does not go with learning.encoder = \"end-to-end\": an averaged policy would see through an encoder that is not averaged; set it to 0, or learning.encoder to \"vae\"",
        )
    }

    /// One episode is under way in segments at a time: only then does each segment follow from all
    /// that was flown before.
    fn validate_segments(&self) -> Result<(), Invalid> {
        require(
            self.segment_steps <= MOST_FLOWN as u64,
            "learning.segment_steps",
            self.segment_steps,
            format!(
                "is above {MOST_FLOWN}, the longest episode in segments: 0 learns after whole episodes"
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
                    "does not go with learning.segment_steps = {}, which refreshes the weights in the middle of the one episode that is under way: set it to {needed}, or learning.segment_steps to 0",
                    self.segment_steps
                ),
            )?;
        }
        require(
            !self.in_segments() || !self.mirror,
            "learning.mirror",
            self.mirror,
            format!(
                "does not go with learning.segment_steps = {}: a segment is stored behind the one before it, where its mirror image would come between; set it to false, or learning.segment_steps to 0",
                self.segment_steps
            ),
        )?;
        require(
            !self.in_segments() || self.history_steps.is_empty(),
            "learning.history_steps",
            format!("{:?}", self.history_steps),
            format!(
                "does not go with learning.segment_steps = {}: who flies a segment has not seen the ones before; name none, or set learning.segment_steps to 0",
                self.segment_steps
            ),
        )
    }
}

/// A learning algorithm.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum AlgorithmName {
    /// Soft actor-critic.
    Sac,
    /// Twin delayed deep deterministic policy gradient.
    Td3,
}

impl fmt::Display for AlgorithmName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Sac => "sac",
            Self::Td3 => "td3",
        })
    }
}

/// What trains the encoder.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum EncoderTraining {
    /// A variational auto-encoder, which is then frozen (the paper).
    Vae,
    /// The critic's loss: policy and critic see through one convolutional encoder
    /// (arXiv:1910.01741, arXiv:2004.13649).
    EndToEnd,
}

/// What the critic judges an action by.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CriticInput {
    /// What the policy sees.
    Observation,
    /// What the simulator knows: where drone and openings are, how the drone moves, and what
    /// disturbs it (an asymmetric critic, arXiv:1710.06542).
    GroundTruth,
}

/// What the policy sees of the world at a moment, in this order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Observation {
    /// The latent code of the depth image alone (the paper's state).
    #[serde(rename = "latent")]
    Latent,
    /// The latent code and the vehicle's own lateral and vertical velocity in m/s: with a sluggish
    /// vehicle one image is not a state.
    #[serde(rename = "latent+velocity")]
    LatentVelocity,
    /// The above and the previous action.
    #[serde(rename = "latent+velocity+action")]
    LatentVelocityAction,
}

/// What the policy sees: the present moment, then earlier ones. Actor and learner build
/// observations by this alone.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct View {
    /// What is seen of each.
    pub moment: Observation,
    /// Length of the latent code, [`VaeSection::latent`](super::VaeSection::latent).
    pub latent: usize,
    /// How many steps back the earlier ones lie.
    pub history_steps: Vec<usize>,
}

impl View {
    /// The present moment alone, with a code of `latent` numbers.
    pub fn present(moment: Observation, latent: usize) -> Self {
        Self {
            moment,
            latent,
            history_steps: Vec::new(),
        }
    }

    /// Length of what is seen of a moment.
    pub fn moment_len(&self) -> usize {
        self.latent
            + match self.moment {
                Observation::Latent => 0,
                Observation::LatentVelocity => 2,
                Observation::LatentVelocityAction => 2 + ACTION,
            }
    }

    /// Length of the observation vector.
    pub fn len(&self) -> usize {
        self.moment_len() * (1 + self.history_steps.len())
    }

    /// Never: the present is always seen.
    pub fn is_empty(&self) -> bool {
        false
    }

    /// Writes what is seen of a moment: the latent code, `velocity_mps` the vehicle's forward, left
    /// and up velocity, `previous_action` zero at reset.
    ///
    /// # Panics
    /// When `into` is not [`View::moment_len`] long.
    pub fn write_moment(
        &self,
        code: &LatentCode,
        velocity_mps: &[f32; 3],
        previous_action: &[f32; ACTION],
        into: &mut [f32],
    ) {
        assert_eq!(
            into.len(),
            self.moment_len(),
            "what is seen has a fixed length"
        );
        self.write_code(code, into);
        let rest = &mut into[self.latent..];
        if self.moment != Observation::Latent {
            rest[..2].copy_from_slice(&velocity_mps[1..]);
        }
        if self.moment == Observation::LatentVelocityAction {
            rest[2..].copy_from_slice(previous_action);
        }
    }

    /// Writes the latent code alone, where it lies in what is seen of a moment.
    ///
    /// # Panics
    /// When `into` is shorter than the code.
    pub fn write_code(&self, code: &LatentCode, into: &mut [f32]) {
        into[..self.latent].copy_from_slice(&code[..self.latent]);
    }

    /// The moments seen at `step` of an episode, by their steps, in the vector's order; before
    /// reset there was the reset.
    pub fn moments(&self, step: usize) -> impl Iterator<Item = usize> {
        std::iter::once(0)
            .chain(self.history_steps.iter().copied())
            .map(move |back| step.saturating_sub(back))
    }

    /// Writes the observation vector at `step` of an episode, of which `write_moment` writes what
    /// is seen of a step's moment.
    ///
    /// # Panics
    /// When `into` is not [`View::len`] long.
    pub fn write(&self, step: usize, into: &mut [f32], write_moment: impl Fn(usize, &mut [f32])) {
        assert_eq!(into.len(), self.len(), "an observation has a fixed length");
        for (moment, into) in self
            .moments(step)
            .zip(into.chunks_exact_mut(self.moment_len()))
        {
            write_moment(moment, into);
        }
    }
}
