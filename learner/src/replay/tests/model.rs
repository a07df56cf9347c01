//! The buffer against a naive model of it: overwriting, sorting, freezing, storing and restoring at
//! any point.

use std::collections::VecDeque;

use proptest::prelude::*;
use skein_protocol::config::{Observation, SuccessRule};
use skein_protocol::transition::Outcome;

use super::super::*;
use super::{config, encode, final_code};
use crate::episode::samples::{episode, with_images};

/// A transition that owns its values.
#[derive(Debug, Clone, PartialEq)]
struct Transition {
    observation: Vec<f32>,
    next_observation: Vec<f32>,
    action: [f32; 2],
    reward: f32,
    terminated: f32,
}

/// The model: both parts as queues of owned transitions, the oldest in front.
struct Model {
    parts: [(VecDeque<Transition>, usize); 2],
    view: ObservationLayout,
    section: ReplaySection,
}

fn lateral(episode: &CommittedEpisode, step: usize) -> [f32; 2] {
    let [left, up, ..] = episode.actions[step];
    [left, up]
}

impl Model {
    fn new(config: &Config) -> Self {
        let (success, regular) = capacities(&config.replay);
        let parts = [(VecDeque::new(), success), (VecDeque::new(), regular)];
        Self {
            parts,
            view: config.observation_layout(),
            section: config.replay.clone(),
        }
    }

    fn insert(&mut self, episode: &CommittedEpisode) {
        for step in 0..episode.steps() {
            let moment = |step: usize| {
                let mut vector = episode.observations[step].latent[..self.view.latent].to_vec();
                if self.view.per_step.has_velocity() {
                    vector.extend(&episode.observations[step].velocity_mps[1..]);
                }
                if self.view.per_step.has_action() {
                    vector.extend(if step == 0 {
                        [0.0; 2]
                    } else {
                        lateral(episode, step - 1)
                    });
                }
                vector
            };
            let observed = |step: usize| {
                let mut vector = moment(step);
                for back in &self.view.history_steps {
                    vector.extend(moment(step.max(*back) - back));
                }
                vector
            };
            let ends = step + 1 == episode.steps() && episode.outcome != Some(Outcome::TimedOut);
            let transition = Transition {
                observation: observed(step),
                next_observation: observed(step + 1),
                action: lateral(episode, step),
                reward: episode.rewards[step],
                terminated: if ends { 1.0 } else { 0.0 },
            };
            let ahead = match self.section.success {
                SuccessRule::LevelUp => 0,
                SuccessRule::Approach => self.section.approach_steps,
            };
            let success = self.section.success_share > 0.0
                && episode.level_up[step..]
                    .iter()
                    .take(ahead + 1)
                    .any(|&level_up| level_up);
            let (part, capacity) = &mut self.parts[usize::from(!success)];
            part.push_back(transition);
            if part.len() > *capacity {
                part.pop_front();
            }
        }
    }

    fn set_latents(&mut self, latent: impl Fn(&[f32]) -> LatentCode) {
        for transition in self.parts.iter_mut().flat_map(|(part, _)| part) {
            for vector in [
                &mut transition.observation,
                &mut transition.next_observation,
            ] {
                for moment in vector.chunks_exact_mut(self.view.step_len()) {
                    let made = latent(moment);
                    moment[..self.view.latent].copy_from_slice(&made[..self.view.latent]);
                }
            }
        }
    }
}

/// A ring's transitions, the oldest first.
fn transitions(ring: &Ring) -> Vec<Transition> {
    let state = ring.state();
    let oldest = if state.inserted as usize > ring.len() {
        state.inserted as usize % ring.len()
    } else {
        0
    };
    (0..ring.len())
        .map(|index| ring.row((oldest + index) % ring.len()))
        .map(|row| Transition {
            observation: row.observation.to_vec(),
            next_observation: row.next_observation.to_vec(),
            action: row.action.try_into().unwrap(),
            reward: row.reward,
            terminated: row.terminated,
        })
        .collect()
}

fn assert_same(replay: &Replay, model: &Model) {
    assert_eq!(
        transitions(&replay.success),
        Vec::from(model.parts[0].0.clone())
    );
    assert_eq!(
        transitions(&replay.regular),
        Vec::from(model.parts[1].0.clone())
    );
}

prop_compose! {
    /// Episodes of 1 to 12 steps with crossings anywhere and every outcome.
    fn episodes()(
        shapes in prop::collection::vec(
            (prop::collection::vec(prop::bool::weighted(0.2), 1..12), 0..3_usize),
            1..20,
        )
    ) -> Vec<CommittedEpisode> {
        shapes
            .into_iter()
            .enumerate()
            .map(|(number, (level_up, outcome))| {
                let outcome = [Outcome::Collided, Outcome::ReachedEnd, Outcome::TimedOut][outcome];
                let mut episode = episode(number as u64, level_up.len(), outcome);
                episode.level_up = level_up;
                episode
            })
            .collect()
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// Overwriting, classification, freezing, saving and restoring at any point: the content is
    /// always the model's.
    #[test]
    fn holds_what_a_naive_model_holds(
        episodes in episodes(),
        capacity in 4..80_usize,
        freeze_after in 0..20_usize,
        observation in prop::sample::select(vec![
            Observation::Latent, Observation::LatentVelocity, Observation::LatentVelocityAction,
        ]),
        history in prop::sample::subsequence(vec![1_usize, 2, 5], 0..=3),
        latent in prop::sample::select(vec![8_usize, 16, 32, 64]),
        rule in prop::sample::select(vec![SuccessRule::LevelUp, SuccessRule::Approach]),
        chunk in 1..9_usize,
        share in prop::sample::select(vec![0.0, 0.25]),
    ) {
        let mut config = config(capacity, observation);
        config.learning.history_steps = history;
        config.vae.latent = latent;
        config.replay.success_share = share;
        config.replay.success = rule;
        config.replay.approach_steps = 3;
        let (mut replay, mut model) = (Replay::new(&config), Model::new(&config));
        for (number, episode) in episodes.iter().enumerate() {
            if number == freeze_after {
                replay.recode_latents(chunk, encode).unwrap();
                replay.freeze();
                model.set_latents(|vector| final_code(vector[0] as u8));
            }
            let images_live = replay.image_count().is_some();
            let flown = match images_live {
                true => with_images(episode.clone()),
                false => episode.clone(),
            };
            replay.insert(flown).unwrap();
            model.insert(episode);
            assert_same(&replay, &model);
            let restored = Replay::restore(&config, replay.state()).unwrap();
            prop_assert_eq!(restored.state(), replay.state());
            replay = restored;
        }
        prop_assert!(replay.len() <= capacity);
        prop_assert_eq!(replay.success_len(), model.parts[0].0.len());
    }
}
