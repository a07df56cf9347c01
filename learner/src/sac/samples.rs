//! Transitions for tests.

use skein_protocol::IMAGE_PIXELS;

use crate::algorithm::{Columns, Inputs};
use crate::noise::Noise;

/// Transitions that own their columns.
#[derive(Clone)]
pub(crate) struct Transitions {
    pub(crate) observations: Vec<f32>,
    pub(crate) actions: Vec<f32>,
    pub(crate) rewards: Vec<f32>,
    pub(crate) next_observations: Vec<f32>,
    /// Critic inputs before and after the actions, where they differ from the observations.
    pub(crate) critic_states: Option<[Vec<f32>; 2]>,
    pub(crate) terminated: Vec<f32>,
    /// Images before and after the actions.
    pub(crate) images: Option<[Vec<u8>; 2]>,
    /// The teacher's actions.
    pub(crate) teacher_actions: Option<Vec<f32>>,
}

impl Transitions {
    /// Random numbers without meaning, observations `width` wide. Every third transition ends its
    /// task.
    pub(crate) fn random(width: usize, rows: usize, noise: &mut Noise) -> Self {
        Self::random_for(Inputs::same(width), rows, noise)
    }

    /// The same, with observations and actions of `inputs`.
    pub(crate) fn random_for(inputs: Inputs, rows: usize, noise: &mut Noise) -> Self {
        let width = inputs.policy;
        let mut draw =
            |count: usize| -> Vec<f32> { (0..count).map(|_| noise.uniform(1.0)).collect() };
        Self {
            observations: draw(rows * width),
            actions: draw(rows * inputs.action.numbers()),
            rewards: draw(rows),
            next_observations: draw(rows * width),
            critic_states: None,
            terminated: (0..rows).map(|row| f32::from(row % 3 == 1)).collect(),
            images: None,
            teacher_actions: None,
        }
    }

    /// Gives the critic inputs of its own, `width` random numbers per state.
    pub(crate) fn with_critic_states(mut self, width: usize, noise: &mut Noise) -> Self {
        let mut draw = || {
            (0..self.rewards.len() * width)
                .map(|_| noise.uniform(1.0))
                .collect()
        };
        self.critic_states = Some([draw(), draw()]);
        self
    }

    /// Gives the transitions a teacher that does what the first two numbers of the observation say.
    pub(crate) fn with_teacher(mut self) -> Self {
        let width = self.observations.len() / self.rewards.len();
        let rows = self.observations.chunks_exact(width);
        self.teacher_actions = Some(rows.flat_map(|row| &row[..2]).copied().collect());
        self
    }

    /// A one-step task: the first two numbers of the observation are the best action.
    pub(crate) fn one_step_task(width: usize, rows: usize, noise: &mut Noise) -> Self {
        let mut draw =
            |count: usize| -> Vec<f32> { (0..count).map(|_| noise.uniform(0.8)).collect() };
        let (observations, actions) = (draw(rows * width), draw(rows * 2));
        let rewards = (0..rows).map(|row| {
            let (wanted, done) = (&observations[row * width..][..2], &actions[row * 2..][..2]);
            -((wanted[0] - done[0]).powi(2) + (wanted[1] - done[1]).powi(2))
        });
        Self {
            rewards: rewards.collect(),
            next_observations: observations.clone(),
            critic_states: None,
            terminated: vec![1.0; rows],
            images: None,
            teacher_actions: None,
            observations,
            actions,
        }
    }

    /// A one-step task whose reward only the image shows: 1 for a bright one, -1 for a dark one,
    /// whatever the action.
    pub(crate) fn one_step_task_in_images(width: usize, rows: usize, noise: &mut Noise) -> Self {
        let mut asked = Self::one_step_task(width, rows, noise);
        let ways: Vec<f32> = (0..rows)
            .map(|_| if noise.uniform(1.0) < 0.0 { -1.0 } else { 1.0 })
            .collect();
        let images: Vec<u8> = ways
            .iter()
            .flat_map(|&way| [shade(0.6 * way); IMAGE_PIXELS])
            .collect();
        asked.rewards = ways;
        for observations in [&mut asked.observations, &mut asked.next_observations] {
            observations.fill(0.0);
        }
        asked.images = Some([images.clone(), images]);
        asked
    }

    pub(crate) fn columns(&self) -> Columns<'_> {
        let [states, next_states] = match &self.critic_states {
            Some(critic_states) => critic_states.each_ref(),
            None => [&self.observations, &self.next_observations],
        };
        Columns {
            states,
            next_states,
            observations: &self.observations,
            actions: &self.actions,
            rewards: &self.rewards,
            next_observations: &self.next_observations,
            terminated: &self.terminated,
            images: self
                .images
                .as_ref()
                .map(|images| images.each_ref().map(Vec::as_slice)),
            teacher_actions: self.teacher_actions.as_deref(),
        }
    }
}

/// Brightness that encodes a number in [-1, 1].
pub(crate) fn shade(number: f32) -> u8 {
    (127.5 + 127.5 * number).round() as u8
}
