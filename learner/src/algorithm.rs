//! What a learning algorithm is to the rest of the learner, and which there are.
//!
//! It gets minibatches and noise, and gives a policy; replay, transport and actors know nothing of
//! it. Another one is a module beside [`crate::sac`] and [`crate::td3`] that implements
//! [`Algorithm`], a section of settings that `skein_protocol::config` reads and checks, and a name
//! in `AlgorithmName`, after which the compiler says where else it is asked for.

use std::fmt;

use skein_kernels::{Isa, Team};
use skein_protocol::config::{AlgorithmName, Config, CriticInput, Engine};
use skein_protocol::{ACTION, IMAGE_PIXELS, TRUE_STATE};
use tch::Device;

use crate::error::UpdateError;
use crate::metrics::Scalar;
use crate::networks::Layout;
use crate::noise::Noise;
use crate::sac::{NativeSac, TorchSac};
use crate::state::Stateful;
use crate::td3::{NativeTd3, TorchTd3};

/// A way to learn a policy from transitions.
///
/// Its state is what [`Stateful::parts`] names: networks begin as functions of the run's seed, and
/// all noise comes from the caller, so that an algorithm restored from its state goes on bit for
/// bit.
pub trait Algorithm: Stateful + fmt::Debug {
    /// One update from a minibatch, on the threads of `team`. What it returns are points of curves,
    /// the same ones each time.
    ///
    /// # Errors
    /// [`UpdateError::NonFinite`] names what was not finite and the update's number; nothing was
    /// changed then.
    ///
    /// # Panics
    /// When the columns have different numbers of rows, or none.
    fn update(
        &mut self,
        team: &mut Team,
        columns: Columns<'_>,
        noise: &mut Noise,
    ) -> Result<Vec<(Scalar, f32)>, UpdateError>;

    /// Updates done so far.
    fn updates(&self) -> u64;

    /// Names and shapes of what [`Algorithm::publish`] copies.
    fn policy_layout(&self) -> &Layout;

    /// Copies the policy's part of a snapshot, in the snapshot layout's order.
    ///
    /// # Panics
    /// When `into` is not as long as the layout.
    fn publish(&self, into: &mut [f32]);

    /// Copies the encoder's part of a snapshot, in the snapshot layout's order, if this trains an
    /// encoder ([`Inputs::from_image`]). What learns from the VAE's codes leaves `into` alone.
    ///
    /// # Panics
    /// When `into` is not as long as the encoder.
    fn publish_encoder(&self, into: &mut [f32]);
}

/// The algorithm that a configuration names, untrained. `device`: libtorch's; the native engine is
/// on the processor.
pub fn new(config: &Config, device: Device) -> Box<dyn Algorithm> {
    let (inputs, seed, engine) = (Inputs::of(config), config.run.seed, config.policy_engine());
    match (config.learning.algorithm, engine) {
        (AlgorithmName::Sac, Engine::Native) => {
            Box::new(NativeSac::new(&config.sac, inputs, seed, Isa::best()))
        }
        (AlgorithmName::Sac, Engine::Libtorch) => {
            Box::new(TorchSac::new(&config.sac, inputs, seed, device))
        }
        (AlgorithmName::Td3, Engine::Native) => {
            Box::new(NativeTd3::new(&config.td3, inputs, seed, Isa::best()))
        }
        (AlgorithmName::Td3, Engine::Libtorch) => {
            Box::new(TorchTd3::new(&config.td3, inputs, seed, device))
        }
    }
}

/// How many numbers the networks see of a state, and where they come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Inputs {
    /// The policy: an observation.
    pub policy: usize,
    /// The critic, beside the action.
    pub critic: usize,
    /// How many of them, the first ones, are made of the images in each update, by an encoder that
    /// is trained end to end; `None` where the code is the VAE's.
    pub from_image: Option<usize>,
}

impl Inputs {
    /// Those of the run configured by `config`.
    pub fn of(config: &Config) -> Self {
        let same = Self {
            from_image: config.learning.end_to_end().then_some(config.vae.latent),
            ..Self::same(config.view().len())
        };
        match config.learning.critic_input {
            CriticInput::Observation => same,
            CriticInput::GroundTruth => Self {
                critic: TRUE_STATE,
                ..same
            },
        }
    }

    /// Both see an observation of so many numbers, the VAE's code among them.
    pub fn same(observation: usize) -> Self {
        Self {
            policy: observation,
            critic: observation,
            from_image: None,
        }
    }
}

/// A minibatch as the replay gathers it: one f32 slice for each column, rows back to back.
#[derive(Debug, Clone, Copy)]
pub struct Columns<'a> {
    /// `[n, observation]`.
    pub observations: &'a [f32],
    /// `[n, 2]`.
    pub actions: &'a [f32],
    /// `[n]`.
    pub rewards: &'a [f32],
    /// `[n, observation]`: what was seen after the action, also where the episode ended there.
    pub next_observations: &'a [f32],
    /// What the critic sees, `[n, critic's input]`: the observations again, unless it is told more.
    pub states: &'a [f32],
    /// The same after the action.
    pub next_states: &'a [f32],
    /// `[n]`: 1 where the state after the action ends the task (a crash, the end wall), 0
    /// elsewhere. An episode cut off by its step limit is not terminated.
    pub terminated: &'a [f32],
    /// Depth images of the observations and of the next ones, `[n, 72, 128]` each; where the
    /// encoder is trained end to end, whose codes no row of the replay can hold.
    pub images: Option<[&'a [u8]; 2]>,
}

impl Columns<'_> {
    /// Looks whether the columns belong together; returns the number of their rows.
    ///
    /// # Panics
    /// When they have different numbers of rows, or none.
    pub(crate) fn check(&self, inputs: Inputs) -> usize {
        let rows = self.rewards.len();
        assert!(rows > 0, "a minibatch has at least one transition");
        for (column, width) in [
            (self.observations, inputs.policy),
            (self.actions, ACTION),
            (self.next_observations, inputs.policy),
            (self.states, inputs.critic),
            (self.next_states, inputs.critic),
            (self.terminated, 1),
        ] {
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
            "two images for each transition, where they are learned from"
        );
        rows
    }
}
