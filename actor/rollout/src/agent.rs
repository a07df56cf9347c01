//! The agent: from camera image to action.

use rand::{Rng, RngExt};
use skein_inference::{ActionDistribution, Network, Scratch};
use skein_protocol::config::{ObservationLayout, SeenStep};
use skein_protocol::stages::Stage;
use skein_protocol::ticket::Exploration;
use skein_protocol::transition::TransitionRecord;
use skein_protocol::{Action, LatentCode, MAX_ACTION};

use crate::world::World;

/// Working memory of one thread that observes and acts.
#[derive(Debug)]
pub struct Agent {
    layout: ObservationLayout,
    /// Inputs of the episode's steps so far, `[steps, ObservationLayout::step_len]`.
    step_inputs: Vec<f32>,
    /// The policy's input, `[ObservationLayout::len]`.
    observed: Vec<f32>,
    scratch: Scratch,
}

impl Agent {
    /// Creates an agent whose policy sees `layout`.
    pub fn new(layout: ObservationLayout) -> Self {
        Self {
            step_inputs: Vec::new(),
            observed: vec![0.0; layout.len()],
            layout,
            scratch: Scratch::default(),
        }
    }

    /// Renders the camera image into `record` and encodes it there. `lap` is called after each.
    pub fn observe(
        &mut self,
        world: &mut impl World,
        network: &Network,
        record: &mut TransitionRecord,
        mut lap: impl FnMut(Stage),
    ) {
        world.render(&mut record.depth);
        lap(Stage::Camera);
        record.latent = network.encode(&record.depth, &mut self.scratch);
        world.measure(record);
        lap(Stage::Encoder);
    }

    /// Chooses an action for the observation in `record`, each number in [-1, 1]. `noise` is used
    /// unless the policy's mode is asked for. Call it for each step of an episode, in order; step 0
    /// starts a new episode.
    pub fn act(
        &mut self,
        exploration: Exploration,
        network: &Network,
        record: &TransitionRecord,
        previous_action: &Action,
        noise: &mut impl Rng,
    ) -> Action {
        self.remember(record, &record.latent, previous_action);
        match exploration {
            Exploration::Uniform => self.uniform(noise),
            Exploration::Sample => self.distribution(record, network).sample(noise),
            Exploration::Mode => self.distribution(record, network).mode(),
        }
    }

    /// Draws an action, each number uniformly from [-1, 1].
    fn uniform(&self, noise: &mut impl Rng) -> Action {
        let mut action = [0.0; MAX_ACTION];
        action[..self.layout.action.numbers()].fill_with(|| noise.random_range(-1.0..=1.0));
        action
    }

    /// Returns what another policy, with an encoder of its own, would do for the image in `record`,
    /// without noise. Call it as [`Agent::act`], on an agent that nothing else is asked of.
    pub fn advise(
        &mut self,
        network: &Network,
        record: &TransitionRecord,
        previous_action: &Action,
    ) -> Action {
        let latent = network.encode(&record.depth, &mut self.scratch);
        self.remember(record, &latent, previous_action);
        self.distribution(record, network).mode()
    }

    /// Returns the policy's distribution of actions in the step of `record`, which is remembered.
    fn distribution(&mut self, record: &TransitionRecord, network: &Network) -> ActionDistribution {
        let Self {
            layout,
            step_inputs,
            observed,
            scratch,
        } = self;
        let len = layout.step_len();
        layout.write(record.step as usize, observed, |step, into| {
            into.copy_from_slice(&step_inputs[step * len..][..len]);
        });
        network.distribution(observed, scratch)
    }

    /// Stores the input of the step in `record`, and drops the inputs of earlier episodes.
    fn remember(
        &mut self,
        record: &TransitionRecord,
        latent: &LatentCode,
        previous_action: &Action,
    ) {
        let len = self.layout.step_len();
        let first = record.step as usize * len;
        self.step_inputs.resize(first + len, 0.0);
        let seen = SeenStep {
            latent,
            velocity_mps: &record.velocity_mps,
            orientation: &record.orientation,
            goal_m: &record.goal_m,
            previous_action,
        };
        self.layout
            .write_step(&seen, &mut self.step_inputs[first..]);
    }
}
