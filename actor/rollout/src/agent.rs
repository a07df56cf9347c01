//! The agent: what it sees, and what it does about it.

use rand::{Rng, RngExt};
use skein_protocol::ACTION;
use skein_protocol::config::View;
use skein_protocol::stages::Stage;
use skein_protocol::ticket::Exploration;
use skein_protocol::transition::TransitionRecord;
use skein_simulator::simulator::Simulator;

use skein_inference::{Network, Scratch};

/// Working memory of one thread that looks and acts.
#[derive(Debug)]
pub struct Agent {
    view: View,
    /// What was seen of each moment of the episode so far, `[steps, View::moment_len]`.
    moments: Vec<f32>,
    /// The policy's input, `[View::len]`.
    observed: Vec<f32>,
    scratch: Scratch,
}

impl Agent {
    /// An agent whose policy sees `view`.
    pub fn new(view: View) -> Self {
        Self {
            moments: Vec::new(),
            observed: vec![0.0; view.len()],
            view,
            scratch: Scratch::default(),
        }
    }

    /// Looks through the drone's camera: the image is rendered into `record`, wherever that lies,
    /// and encoded from there. `lap` is called after each.
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
        record.ground_truth = simulator.ground_truth().numbers();
        lap(Stage::Encoder);
    }

    /// Chooses an action on the observation in `record`, each command in [-1, 1]. `noise` is drawn
    /// from unless the policy's mode is asked for. Called for each step of an episode, in order;
    /// the record of step 0 begins another one.
    pub fn act(
        &mut self,
        exploration: Exploration,
        network: &Network,
        record: &TransitionRecord,
        previous_action: &[f32; ACTION],
        noise: &mut impl Rng,
    ) -> [f32; ACTION] {
        self.remember(record, previous_action);
        let mut distribution = || {
            let Self {
                view,
                moments,
                observed,
                scratch,
            } = self;
            let len = view.moment_len();
            view.write(record.step as usize, observed, |step, into| {
                into.copy_from_slice(&moments[step * len..][..len]);
            });
            network.distribution(observed, scratch)
        };
        match exploration {
            Exploration::Uniform => std::array::from_fn(|_| noise.random_range(-1.0..=1.0)),
            Exploration::Sample => distribution().sample(noise),
            Exploration::Mode => distribution().mode(),
        }
    }

    /// Keeps what is seen of the moment in `record`, and forgets what was seen in an earlier
    /// episode.
    fn remember(&mut self, record: &TransitionRecord, previous_action: &[f32; ACTION]) {
        let len = self.view.moment_len();
        let first = record.step as usize * len;
        self.moments.resize(first + len, 0.0);
        self.view.write_moment(
            &record.latent,
            &record.velocity_mps,
            previous_action,
            &mut self.moments[first..],
        );
    }
}
