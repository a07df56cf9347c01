//! The interface between a learning algorithm and the rest of the learner.
//!
//! An algorithm receives minibatches and noise, and yields a policy. Replay, transport and actors
//! know nothing of it. To add one: write a module beside [`crate::sac`], [`crate::td3`] and
//! [`crate::distill`] that implements [`Algorithm`], add its settings section to
//! `skein_protocol::config` and its name to `AlgorithmName`. The compiler then points at every
//! other place that must know it.

use std::fmt;

use skein_kernels::Team;
use skein_protocol::config::{Config, CriticInput};
use skein_protocol::{ActionSpace, IMAGE_PIXELS, critic_state};

use crate::error::UpdateError;
use crate::metrics::Scalar;
use crate::networks::Layout;
use crate::noise::Noise;
use crate::state::Stateful;

/// A method that learns a policy from transitions.
///
/// [`Stateful::parts`] names its whole state. Networks start as functions of the run's seed and all
/// noise comes from the caller, so an algorithm restored from its state continues bit for bit.
pub trait Algorithm: Stateful + fmt::Debug {
    /// Makes one update from a minibatch, on the threads of `team`. Returns the values to plot,
    /// under the same names each time.
    ///
    /// # Errors
    /// [`UpdateError::NonFinite`] names the value that was not finite and the update's number;
    /// nothing has changed then.
    ///
    /// # Panics
    /// When the columns differ in their number of rows, or have none.
    fn update(
        &mut self,
        team: &mut Team,
        columns: Columns<'_>,
        noise: &mut Noise,
    ) -> Result<Vec<(Scalar, f32)>, UpdateError>;

    /// Number of updates done so far.
    fn updates(&self) -> u64;

    /// Names and shapes of the parameters that [`Algorithm::publish`] copies.
    fn policy_layout(&self) -> &Layout;

    /// Replaces the untrained policy by these parameters, in the snapshot layout's order.
    ///
    /// # Panics
    /// When `policy` is not as long as the layout.
    fn start_from(&mut self, policy: &[f32]);

    /// Copies the policy's part of a snapshot, in the snapshot layout's order.
    ///
    /// # Panics
    /// When `into` is not as long as the layout.
    fn publish(&self, into: &mut [f32]);

    /// Copies the encoder's part of a snapshot, in the snapshot layout's order. An algorithm that
    /// trains no encoder ([`Inputs::from_image`] is `None`) leaves `into` alone.
    ///
    /// # Panics
    /// When `into` is not as long as the encoder.
    fn publish_encoder(&self, into: &mut [f32]);
}

/// Input widths of policy and critic, and where the inputs come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Inputs {
    /// Width of the policy's input, the observation.
    pub policy: usize,
    /// Width of the critic's input, the action not counted.
    pub critic: usize,
    /// Numbers of an action.
    pub action: ActionSpace,
    /// Number of leading inputs that an encoder trained end to end computes from the images in each
    /// update; `None` where the latent code is the VAE's.
    pub from_image: Option<usize>,
}

impl Inputs {
    /// Returns the inputs of the run that `config` describes.
    pub fn of(config: &Config) -> Self {
        let same = Self {
            from_image: config.learning.end_to_end().then_some(config.vae.latent),
            action: config.action_space(),
            ..Self::same(config.observation_layout().len())
        };
        match config.learning.critic_input {
            CriticInput::Observation => same,
            CriticInput::GroundTruth => Self {
                critic: critic_state(same.action),
                ..same
            },
        }
    }

    /// Policy and critic both see an observation of this width, the VAE's latent code included;
    /// actions are lateral.
    pub fn same(observation: usize) -> Self {
        Self {
            policy: observation,
            critic: observation,
            action: ActionSpace::Lateral,
            from_image: None,
        }
    }
}

/// A minibatch as the replay gathers it: one f32 slice per column, rows back to back.
#[derive(Debug, Clone, Copy)]
pub struct Columns<'a> {
    /// Observations before the action, `[rows, observation]`.
    pub observations: &'a [f32],
    /// Actions, `[rows, action]`.
    pub actions: &'a [f32],
    /// Rewards, `[rows]`.
    pub rewards: &'a [f32],
    /// Observations after the action, also where the episode ended there, `[rows, observation]`.
    pub next_observations: &'a [f32],
    /// Critic inputs before the action, `[rows, critic input]`: the observations, or the ground
    /// truth.
    pub states: &'a [f32],
    /// Critic inputs after the action, `[rows, critic input]`.
    pub next_states: &'a [f32],
    /// 1 where the state after the action ends the task (a crash, the end wall), else 0, `[rows]`.
    /// An episode cut off by its step limit is truncated, not terminated.
    pub terminated: &'a [f32],
    /// Depth images before and after the action, `[rows, 72, 128]` each. Present only where the
    /// encoder is trained end to end: its codes change with every update, so the replay cannot
    /// store them.
    pub images: Option<[&'a [u8]; 2]>,
    /// The teacher's actions for the observations before the action, `[rows, action]`. Present only
    /// where there is a teacher.
    pub teacher_actions: Option<&'a [f32]>,
}

impl Columns<'_> {
    /// Checks that the columns fit together; returns their number of rows.
    ///
    /// # Panics
    /// When the columns differ in their number of rows, or have none.
    pub(crate) fn check(&self, inputs: Inputs) -> usize {
        let rows = self.rewards.len();
        assert!(rows > 0, "a minibatch has at least one transition");
        for (column, width) in [
            (self.observations, inputs.policy),
            (self.actions, inputs.action.numbers()),
            (self.next_observations, inputs.policy),
            (self.states, inputs.critic),
            (self.next_states, inputs.critic),
            (self.terminated, 1),
        ]
        .into_iter()
        .chain(
            self.teacher_actions
                .map(|actions| (actions, inputs.action.numbers())),
        ) {
            let len = column.len();
            assert_eq!(
                len,
                rows * width,
                "every column of a minibatch has one row for each transition"
            );
        }
        let images = self.images.map(|images| images.map(<[u8]>::len));
        let expected = inputs.from_image.map(|_| [rows * IMAGE_PIXELS; 2]);
        assert_eq!(
            images, expected,
            "two images for each transition, exactly where the encoder is trained end to end"
        );
        rows
    }
}
