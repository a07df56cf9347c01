//! Transitions for tests.

use skein_protocol::IMAGE_PIXELS;

use crate::algorithm::Columns;
use crate::noise::Noise;

/// Transitions that own their columns.
#[derive(Clone)]
pub(crate) struct Transitions {
    pub(crate) observations: Vec<f32>,
    pub(crate) actions: Vec<f32>,
    pub(crate) rewards: Vec<f32>,
    pub(crate) next_observations: Vec<f32>,
    /// What the critic is told instead of the observations, and after the actions.
    pub(crate) told: Option<[Vec<f32>; 2]>,
    pub(crate) terminated: Vec<f32>,
    /// Of the observations and the next ones.
    pub(crate) images: Option<[Vec<u8>; 2]>,
}

impl Transitions {
    /// Numbers without a meaning, observations of `width`; every third transition is the last of
    /// its task.
    pub(crate) fn random(width: usize, rows: usize, noise: &mut Noise) -> Self {
        let mut draw =
            |count: usize| -> Vec<f32> { (0..count).map(|_| noise.uniform(1.0)).collect() };
        Self {
            observations: draw(rows * width),
            actions: draw(rows * 2),
            rewards: draw(rows),
            next_observations: draw(rows * width),
            told: None,
            terminated: (0..rows).map(|row| f32::from(row % 3 == 1)).collect(),
            images: None,
        }
    }

    /// The same, and the critic is told `width` numbers of each state.
    pub(crate) fn telling(mut self, width: usize, noise: &mut Noise) -> Self {
        let mut draw = || {
            (0..self.rewards.len() * width)
                .map(|_| noise.uniform(1.0))
                .collect()
        };
        self.told = Some([draw(), draw()]);
        self
    }

    /// A one-step task: the observation's first two numbers are the action that would have been
    /// right.
    pub(crate) fn guessing(width: usize, rows: usize, noise: &mut Noise) -> Self {
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
            told: None,
            terminated: vec![1.0; rows],
            images: None,
            observations,
            actions,
        }
    }

    /// A one-step task that only the image tells: a bright one is worth 1, a dark one -1, whatever
    /// is done.
    pub(crate) fn looking(width: usize, rows: usize, noise: &mut Noise) -> Self {
        let mut asked = Self::guessing(width, rows, noise);
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
        let [states, next_states] = match &self.told {
            Some(told) => told.each_ref(),
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
        }
    }
}

/// How bright a number in [-1, 1] is drawn.
pub(crate) fn shade(number: f32) -> u8 {
    (127.5 + 127.5 * number).round() as u8
}
