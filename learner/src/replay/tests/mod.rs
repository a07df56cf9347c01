//! The buffer's claims one by one, and the buffer against a [`model`] of it.

mod end_to_end;
mod model;

use std::convert::Infallible;
use std::path::Path;

use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use skein_protocol::config::{CriticInput, Observation};
use skein_protocol::transition::Outcome;
use skein_protocol::{ActionSpace, GROUND_TRUTH, IMAGE_PIXELS, MAX_ACTION, critic_state};

use super::*;
use crate::episode::samples::{code, episode, shade, with_images};

/// Length of the latent codes.
const LATENT: usize = 16;

fn config(capacity: usize, observation: Observation) -> Config {
    let mut config = Config::default();
    config.replay.capacity = capacity;
    config.replay.success_share = 0.25;
    config.learning.observation = observation;
    config.vae.train_steps = 500;
    config.vae.latent = LATENT;
    config
}

/// A buffer whose VAE is frozen from the start.
fn frozen(config: &Config) -> Replay {
    let mut replay = Replay::new(config);
    replay.freeze();
    replay
}

fn encode(images: &[u8]) -> Result<Vec<LatentCode>, Infallible> {
    Ok(images
        .chunks_exact(IMAGE_PIXELS)
        .map(|image| final_code(image[0]))
        .collect())
}

/// Code of an image under the final encoder, different from [`code`].
fn final_code(shade: u8) -> LatentCode {
    code(shade).map(|value| -value - 1.0)
}

#[test]
fn a_minibatch_holds_the_configured_share_of_success() {
    let mut replay = frozen(&config(1000, Observation::Latent));
    let mut crossing = episode(1, 20, Outcome::Collided);
    crossing.level_up[7] = true;
    replay.insert(crossing).unwrap();
    let mut batch = Minibatch::default();
    for (count, success) in [(256, 64), (8, 2), (2, 1), (1, 0)] {
        replay.sample(&mut Pcg64Mcg::seed_from_u64(1), count, &mut batch);
        let marked = batch
            .rewards
            .iter()
            .filter(|&&reward| reward == 10.07)
            .count();
        assert_eq!((batch.rewards.len(), marked), (count, success));
        assert_eq!(batch.observations.len(), count * LATENT);
        assert_eq!(batch.next_observations.len(), count * LATENT);
        assert_eq!(batch.actions.len(), count * 2);
        assert_eq!(batch.terminated.len(), count);
    }
}

/// Splits `episode` into segments of `steps` steps, each with the images of all its observations.
fn in_segments(episode: &CommittedEpisode, steps: usize) -> Vec<CommittedEpisode> {
    let segment = |first: usize| {
        let end = (first + steps).min(episode.steps());
        let is_last = end == episode.steps();
        let images =
            &episode.depth.as_ref().unwrap()[first * IMAGE_PIXELS..(end + 1) * IMAGE_PIXELS];
        CommittedEpisode {
            first_step: first,
            action_before: first
                .checked_sub(1)
                .map_or([0.0; MAX_ACTION], |before| episode.actions[before]),
            observations: episode.observations[first..=end].to_vec(),
            actions: episode.actions[first..end].to_vec(),
            teacher_actions: episode.teacher_actions[first..end].to_vec(),
            rewards: episode.rewards[first..end].to_vec(),
            reward_terms: episode.reward_terms[first..end].to_vec(),
            level_up: episode.level_up[first..end].to_vec(),
            outcome: episode.outcome.filter(|_| is_last),
            depth: Some(images.to_vec()),
            ..episode.without_images()
        }
    };
    (0..episode.steps()).step_by(steps).map(segment).collect()
}

#[test]
fn an_episode_stored_in_segments_is_the_episode_stored_whole() {
    for (steps, outcome) in [
        (1, Outcome::Collided),
        (3, Outcome::TimedOut),
        (7, Outcome::ReachedEnd),
    ] {
        let config = config(1000, Observation::LatentVelocityAction);
        let (mut whole, mut segments) = (Replay::new(&config), Replay::new(&config));
        for number in 0..3 {
            let mut flown = with_images(episode(number, 7, outcome));
            flown.level_up[5] = true;
            let parts = in_segments(&flown, steps);
            let mut joined = parts[0].without_images();
            parts[1..].iter().for_each(|segment| joined.extend(segment));
            assert_eq!(joined, flown.without_images());
            parts
                .into_iter()
                .for_each(|segment| segments.insert(segment).unwrap());
            whole.insert(flown).unwrap();
        }
        assert_eq!(segments.state(), whole.state());
        segments.recode_latents(4, encode).unwrap();
        whole.recode_latents(4, encode).unwrap();
        assert_eq!(segments.state(), whole.state());
    }
}

#[test]
fn a_segment_that_does_not_follow_what_was_stored_last_is_refused() {
    let segments = |number| in_segments(&with_images(episode(number, 6, Outcome::Collided)), 2);
    let config = config(1000, Observation::Latent);
    let mut replay = Replay::new(&config);
    let refused = |segment: CommittedEpisode, replay: &mut Replay| {
        let before = replay.state();
        let error = replay.insert(segment).unwrap_err().to_string();
        assert_eq!(replay.state(), before);
        assert!(error.contains("episode 4 from its step 2 on"), "{error}");
    };
    refused(segments(4).remove(1), &mut replay);
    replay.insert(segments(3).remove(0)).unwrap();
    refused(segments(4).remove(1), &mut replay);
    replay.insert(segments(4).remove(0)).unwrap();
    replay.insert(segments(4).remove(1)).unwrap();
    refused(segments(4).remove(1), &mut replay);
    let mut restored = Replay::restore(&config, replay.state()).unwrap();
    assert!(
        restored.insert(segments(4).remove(2)).is_err(),
        "a checkpoint lies between episodes"
    );
}

#[test]
fn the_other_part_makes_up_for_an_empty_one() {
    for level_up in [false, true] {
        let mut replay = frozen(&config(1000, Observation::Latent));
        let mut one_sided = episode(1, 20, Outcome::Collided);
        one_sided.level_up.fill(level_up);
        replay.insert(one_sided).unwrap();
        let mut batch = Minibatch::default();
        replay.sample(&mut Pcg64Mcg::seed_from_u64(1), 64, &mut batch);
        assert_eq!(batch.rewards.len(), 64);
    }
}

#[test]
fn without_a_success_share_the_buffer_is_one_part_and_marks_no_success() {
    let mut config = config(1000, Observation::Latent);
    config.replay.success_share = 0.0;
    let mut replay = frozen(&config);
    for number in 0..50 {
        let mut crossing = episode(number, 20, Outcome::Collided);
        crossing.level_up[7] = true;
        replay.insert(crossing).unwrap();
    }
    assert_eq!((replay.len(), replay.success_len()), (1000, 0));
    let mut batch = Minibatch::default();
    replay.sample(&mut Pcg64Mcg::seed_from_u64(1), 20_000, &mut batch);
    // The level-up of the newest episode is one transition of a thousand.
    let level_up = 49_007.0_f32 / 100.0;
    let drawn = batch
        .rewards
        .iter()
        .filter(|&&reward| reward == level_up)
        .count();
    assert!((5..50).contains(&drawn), "{drawn}");
    assert_eq!(
        Replay::restore(&config, replay.state()).unwrap().state(),
        replay.state()
    );
}

#[test]
fn every_transition_of_a_part_is_equally_likely() {
    let mut replay = frozen(&config(1000, Observation::Latent));
    replay.insert(episode(0, 10, Outcome::Collided)).unwrap();
    let mut batch = Minibatch::default();
    replay.sample(&mut Pcg64Mcg::seed_from_u64(5), 100_000, &mut batch);
    for step in 0..10 {
        let drawn = batch
            .rewards
            .iter()
            .filter(|&&reward| reward == step as f32 / 100.0)
            .count();
        // Five standard deviations of a binomial count of 100,000 draws at 1/10.
        assert!(
            drawn.abs_diff(10_000) < 475,
            "step {step} was drawn {drawn} times"
        );
    }
}

#[test]
fn a_minibatch_is_a_function_of_content_and_seed() {
    let mut replay = frozen(&config(100, Observation::LatentVelocity));
    for number in 0..20 {
        replay
            .insert(episode(number, 9, Outcome::Collided))
            .unwrap();
    }
    let draw = |seed| {
        let mut batch = Minibatch::default();
        replay.sample(&mut Pcg64Mcg::seed_from_u64(seed), 64, &mut batch);
        batch
    };
    assert_eq!(draw(1), draw(1));
    assert_ne!(draw(1), draw(2));
}

#[test]
fn rows_of_a_minibatch_belong_together() {
    for action in ActionSpace::ALL {
        let mut config = config(256, Observation::LatentVelocityAction);
        config.learning.critic_input = CriticInput::GroundTruth;
        config.learning.warmup_steps = 256;
        let action = format!("simulator.vehicle.action={}", action.name());
        let config = config
            .overridden(Path::new("config.toml"), &[action])
            .unwrap();
        let mut replay = frozen(&config);
        for number in 0..20 {
            replay
                .insert(episode(number, 9, Outcome::Collided))
                .unwrap();
        }
        let mut batch = Minibatch::default();
        replay.sample(&mut Pcg64Mcg::seed_from_u64(1), 64, &mut batch);
        assert_rows_belong_together(&config, &batch);
    }
}

fn assert_rows_belong_together(config: &Config, batch: &Minibatch) {
    let (view, action) = (config.observation_layout(), config.action_space());
    let (width, numbers, state_len) = (view.len(), action.numbers(), critic_state(action));
    // The episodes' velocity forward never changes.
    let left = LATENT + view.velocity_len() - 2;
    for index in 0..64 {
        let observation = &batch.observations[index * width..][..width];
        let next = &batch.next_observations[index * width..][..width];
        let at = observation[left] - 0.25;
        assert_eq!(
            next[left],
            at + 1.25,
            "the next observation is one step later in the same episode"
        );
        assert_eq!(batch.rewards[index], at / 100.0);
        for (states, seen) in [
            (&batch.critic_states, observation),
            (&batch.next_critic_states, next),
        ] {
            let state = &states[index * state_len..][..state_len];
            assert_eq!(
                state[GROUND_TRUTH + 1..GROUND_TRUTH + 3],
                seen[left..left + 2],
                "the critic sees the same moment"
            );
            assert_eq!(
                state[state_len - numbers..],
                seen[left + 2..],
                "and the action before it"
            );
        }
        assert_eq!(
            batch.actions[numbers * index..][..numbers],
            next[left + 2..],
            "the present action is the previous one of the next observation"
        );
        assert_eq!(batch.terminated[index] == 1.0, at % 1000.0 == 8.0);
    }
}

#[test]
fn a_truncated_episode_is_not_terminated_anywhere() {
    for (outcome, expected) in [
        (Outcome::TimedOut, 0.0),
        (Outcome::Collided, 1.0),
        (Outcome::ReachedEnd, 1.0),
    ] {
        let mut replay = frozen(&config(100, Observation::Latent));
        replay.insert(episode(1, 6, outcome)).unwrap();
        let terminated: Vec<_> = (0..6)
            .map(|slot| replay.regular.row(slot).terminated)
            .collect();
        assert_eq!(terminated, [0.0, 0.0, 0.0, 0.0, 0.0, expected]);
    }
}

#[test]
fn memory_is_bounded_and_reserved_once() {
    let config = config(64, Observation::Latent);
    let mut replay = frozen(&config);
    replay.insert(episode(0, 1, Outcome::Collided)).unwrap();
    let first_row = replay.regular.row(0).observation.as_ptr();
    for number in 1..100 {
        replay
            .insert(episode(number, 9, Outcome::Collided))
            .unwrap();
    }
    assert_eq!(
        replay.len(),
        48,
        "the regular part is full, the success part empty"
    );
    assert_eq!(
        replay.regular.row(0).observation.as_ptr(),
        first_row,
        "no growth moved the rows"
    );
    let state = replay.state().regular;
    assert_eq!(
        (state.rows.len(), state.images.len()),
        (48 * (2 * LATENT + 4), 0)
    );
}

#[test]
fn more_images_than_training_can_need_are_refused_and_nothing_is_stored() {
    let mut config = config(64, Observation::Latent);
    config.vae.train_steps = 10;
    config.learning.episodes_per_epoch = 1;
    config.transport.max_records_per_episode = 20;
    let mut replay = Replay::new(&config);
    replay
        .insert(with_images(episode(0, 30, Outcome::Collided)))
        .unwrap();
    let before = replay.state();
    let error = replay
        .insert(with_images(episode(1, 9, Outcome::Collided)))
        .unwrap_err();
    assert!(
        matches!(
            error,
            InsertError::TooManyImages {
                found: 10,
                held: 31,
                limit: 40,
                ..
            }
        ),
        "{error}"
    );
    assert_eq!(replay.state(), before);
}

#[test]
fn an_episode_without_images_is_refused_while_the_vae_is_trained() {
    let mut replay = Replay::new(&config(64, Observation::Latent));
    let error = replay.insert(episode(7, 3, Outcome::Collided)).unwrap_err();
    assert_eq!(
        error,
        InsertError::NoImages {
            episode: EpisodeId(7)
        }
    );
    assert!(replay.is_empty());
}

#[test]
fn images_are_dropped_when_the_vae_is_frozen_and_no_more_are_taken() {
    let mut replay = Replay::new(&config(64, Observation::Latent));
    replay
        .insert(with_images(episode(0, 5, Outcome::Collided)))
        .unwrap();
    assert_eq!(replay.image_count(), Some(6));
    replay.freeze();
    replay
        .insert(with_images(episode(1, 5, Outcome::Collided)))
        .unwrap();
    assert_eq!(replay.image_count(), None);
    assert_eq!(replay.state().images, None);
}

#[test]
fn the_encoder_receives_pieces_of_one_size_whatever_the_episodes_lengths() {
    let mut replay = Replay::new(&config(64, Observation::Latent));
    for (number, steps) in [(0, 2), (1, 6), (2, 1)] {
        replay
            .insert(with_images(episode(number, steps, Outcome::Collided)))
            .unwrap();
    }
    let mut pieces = Vec::new();
    replay
        .recode_latents(5, |images| {
            pieces.push(images.len() / IMAGE_PIXELS);
            encode(images)
        })
        .unwrap();
    assert_eq!(pieces, [5, 5, 2]);
}

#[test]
fn a_failed_encoder_leaves_everything_as_it_was() {
    let mut replay = Replay::new(&config(64, Observation::Latent));
    replay
        .insert(with_images(episode(0, 5, Outcome::Collided)))
        .unwrap();
    let before = replay.state();
    let mut calls = 0;
    let result = replay.recode_latents(4, |images| {
        calls += 1;
        if calls == 2 {
            Err("out of memory")
        } else {
            encode(images).map_err(|never| match never {})
        }
    });
    assert_eq!(result, Err("out of memory"));
    assert_eq!(replay.state(), before);
}

#[test]
fn sampled_images_are_the_episodes_own_closing_ones_included() {
    let mut replay = Replay::new(&config(64, Observation::Latent));
    for number in 0..3 {
        replay
            .insert(with_images(episode(number, 2, Outcome::Collided)))
            .unwrap();
    }
    let mut images = Vec::new();
    replay.sample_images(&mut Pcg64Mcg::seed_from_u64(3), 200, &mut images);
    assert_eq!(images.len(), 200 * IMAGE_PIXELS);
    let mut drawn: Vec<_> = images
        .chunks_exact(IMAGE_PIXELS)
        .map(|image| image[0])
        .collect();
    drawn.sort_unstable();
    drawn.dedup();
    let mut expected: Vec<_> = (0..3)
        .flat_map(|number| (0..3).map(move |step| shade(number, step)))
        .collect();
    expected.sort_unstable();
    assert_eq!(drawn, expected);
}

#[test]
fn content_of_another_shape_is_not_restored() {
    let narrow = config(64, Observation::Latent);
    let mut replay = Replay::new(&narrow);
    replay
        .insert(with_images(episode(0, 5, Outcome::Collided)))
        .unwrap();
    let error =
        Replay::restore(&config(64, Observation::LatentVelocity), replay.state()).unwrap_err();
    assert_eq!(error.part, "regular part");
    let mut without_images = replay.state();
    without_images.images = None;
    assert_eq!(
        Replay::restore(&narrow, without_images).unwrap_err().part,
        "depth images"
    );
    let mut too_few = replay.state();
    too_few.images = Some(Vec::new());
    assert_eq!(
        Replay::restore(&narrow, too_few).unwrap_err().part,
        "depth images"
    );
    let mut endless = replay.state();
    endless.success.inserted = u64::MAX;
    let error = Replay::restore(&narrow, endless).unwrap_err();
    assert!(
        error.problem.contains("more than any run commits"),
        "{error}"
    );
}

/// Prints the time of a minibatch:
/// `cargo test --release -p skein-learner -- --ignored --nocapture minibatch_of_256`.
#[test]
#[ignore = "a measurement, not a claim"]
fn time_of_a_minibatch_of_256_from_a_full_buffer() {
    let mut config = config(1 << 17, Observation::LatentVelocityAction);
    config.replay.success_share = 0.125;
    let mut replay = frozen(&config);
    for number in 0..20_000 {
        let mut episode = episode(number, 50, Outcome::Collided);
        for step in 0..10 {
            episode.level_up[step * 5] = true;
        }
        replay.insert(episode).unwrap();
    }
    assert_eq!(replay.len(), 1 << 17);
    let mut batch = Minibatch::default();
    let mut rng = Pcg64Mcg::seed_from_u64(1);
    let mut micros: Vec<_> = (0..2000)
        .map(|_| {
            let start = std::time::Instant::now();
            replay.sample(&mut rng, 256, std::hint::black_box(&mut batch));
            start.elapsed().as_secs_f64() * 1e6
        })
        .collect();
    micros.sort_by(f64::total_cmp);
    println!(
        "minibatch of 256: median {:.1} µs, 99th percentile {:.1} µs",
        micros[1000], micros[1980]
    );
}
