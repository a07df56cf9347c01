//! Transitions for the benchmarks of SAC's update.

use skein_learner::algorithm::Columns;
use skein_learner::noise::Noise;

/// Width of an observation, as in `one-course.toml`.
pub(crate) const OBSERVATION: usize = 34;

/// Numbers of a lateral action.
pub(crate) const ACTION: usize = 2;

/// A minibatch of random numbers.
pub(crate) struct Transitions {
    observations: Vec<f32>,
    actions: Vec<f32>,
    rewards: Vec<f32>,
    next_observations: Vec<f32>,
    terminated: Vec<f32>,
}

impl Transitions {
    pub(crate) fn random(rows: usize) -> Self {
        let mut noise = Noise::new(1);
        let mut draw = |width: usize| (0..rows * width).map(|_| noise.uniform(1.0)).collect();
        Self {
            observations: draw(OBSERVATION),
            actions: draw(ACTION),
            rewards: draw(1),
            next_observations: draw(OBSERVATION),
            terminated: vec![0.0; rows],
        }
    }

    pub(crate) fn columns(&self) -> Columns<'_> {
        Columns {
            observations: &self.observations,
            actions: &self.actions,
            rewards: &self.rewards,
            next_observations: &self.next_observations,
            states: &self.observations,
            next_states: &self.next_observations,
            terminated: &self.terminated,
            images: None,
            teacher_actions: None,
        }
    }
}
