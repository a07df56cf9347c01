//! The agent: what it sees, and what it does about it.

use rand::{Rng, RngExt};
use skein_protocol::ACTION;
use skein_protocol::config::Observation;
use skein_protocol::stages::Stage;
use skein_protocol::ticket::Exploration;
use skein_protocol::transition::TransitionRecord;
use skein_simulator::simulator::Simulator;

use skein_inference::{Network, Scratch};

/// Working memory of one thread that looks and acts.
#[derive(Debug)]
pub struct Agent {
    observation: Observation,
    /// The policy's input, `[Observation::len]`.
    observed: Vec<f32>,
    scratch: Scratch,
}

impl Agent {
    /// An agent whose policy sees `observation`.
    pub fn new(observation: Observation) -> Self {
        Self {
            observation,
            observed: vec![0.0; observation.len()],
            scratch: Scratch::default(),
        }
    }

    /// Looks through the drone's camera: the image is rendered into `record`, wherever that lies, and encoded from there. `lap` is called after each.
    pub fn observe(
        &mut self,
        simulator: &mut Simulator,
        network: &Network,
        record: &mut TransitionRecord,
        mut lap: impl FnMut(Stage),
    ) {
        simulator.render(&mut record.depth);
        lap(Stage::Camera);
        record.latent = network.encode(&record.depth, &mut self.scratch);
        let state = simulator.state();
        record.position_m = state.position_m.coords.into();
        record.orientation = state.world_from_body.coords.into();
        record.velocity_mps = state.velocity_mps.into();
        lap(Stage::Encoder);
    }

    /// Chooses an action on the observation in `record`, each command in [-1, 1]. `noise` is drawn from unless the policy's mode is asked for.
    pub fn act(
        &mut self,
        exploration: Exploration,
        network: &Network,
        record: &TransitionRecord,
        previous_action: &[f32; ACTION],
        noise: &mut impl Rng,
    ) -> [f32; ACTION] {
        let mut distribution = || {
            let Self {
                observation,
                observed,
                scratch,
            } = self;
            observation.write(&record.latent, &record.velocity_mps, previous_action, observed);
            network.distribution(observed, scratch)
        };
        match exploration {
            Exploration::Uniform => std::array::from_fn(|_| noise.random_range(-1.0..=1.0)),
            Exploration::Sample => distribution().sample(noise),
            Exploration::Mode => distribution().mode(),
        }
    }
}
