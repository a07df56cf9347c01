//! Images that a policy learns from: they belong to the transitions, however often the rings wrap
//! around, and few others are kept.

use skein_protocol::config::EncoderTraining;

use super::*;

/// Configures episodes of at most 11 steps, one per epoch.
fn end_to_end(capacity: usize) -> Config {
    let mut config = config(capacity, Observation::LatentVelocity);
    config.learning.encoder = EncoderTraining::EndToEnd;
    config.learning.episodes_per_epoch = 1;
    config.transport.max_records_per_episode = 12;
    config
}

/// An episode of 1 to 11 steps; in some episodes, a wall is passed.
fn flown(number: u64) -> CommittedEpisode {
    let mut episode = episode(number, 1 + (number as usize * 7) % 11, Outcome::Collided);
    if number.is_multiple_of(3) {
        let middle = episode.steps() / 2;
        episode.level_up[middle] = true;
    }
    with_images(episode)
}

fn draw(replay: &Replay, seed: u64) -> Minibatch {
    let mut batch = Minibatch::default();
    replay.sample(&mut Pcg64Mcg::seed_from_u64(seed), 32, &mut batch);
    batch
}

/// Asserts that every sampled image belongs to its transition, which the reward identifies.
fn assert_images_belong(batch: &Minibatch) {
    let images = batch.images.chunks_exact(IMAGE_PIXELS);
    let next_images = batch.next_images.chunks_exact(IMAGE_PIXELS);
    assert_eq!((images.len(), next_images.len()), (32, 32));
    for ((reward, image), next) in batch.rewards.iter().zip(images).zip(next_images) {
        let at = (reward * 100.0).round() as u64;
        let (episode, step) = (at / 1000, (at % 1000) as usize);
        let shades = [shade(episode, step), shade(episode, step + 1)];
        assert!(
            image.iter().all(|&pixel| pixel == shades[0]),
            "episode {episode}, step {step}"
        );
        assert!(
            next.iter().all(|&pixel| pixel == shades[1]),
            "after episode {episode}, step {step}"
        );
    }
}

#[test]
fn a_minibatch_has_the_images_of_its_transitions_however_often_the_ring_wraps_around() {
    for segment_steps in [usize::MAX, 2] {
        let config = end_to_end(60);
        let (most, mut replay) = (2 * 60 + 12, Replay::new(&config));
        let (mut stored, mut swept) = (0, 0);
        for number in 0..60 {
            let episode = flown(number);
            stored += episode.steps() + 1;
            let held = replay.image_count().unwrap();
            for segment in in_segments(&episode, segment_steps.min(episode.steps())) {
                replay.insert(segment).unwrap();
            }
            let now = replay.image_count().unwrap();
            swept += usize::from(now < held + episode.steps() + 1);
            assert!(now <= most, "{now} images are stored");
            let batch = draw(&replay, number);
            assert_images_belong(&batch);
            // As after a checkpoint.
            let restored = Replay::restore(&config, replay.state()).unwrap();
            assert!(restored.state() == replay.state() && draw(&restored, number) == batch);
            replay = restored;
        }
        assert!(
            stored > 3 * most && swept > 3,
            "{stored} images, swept {swept} times"
        );
        assert!(replay.success_len() > 0 && replay.len() > replay.success_len());
    }
}

#[test]
fn a_buffer_restored_at_any_time_ends_with_the_same_content() {
    let config = end_to_end(60);
    let (mut undisturbed, mut restored) = (Replay::new(&config), Replay::new(&config));
    for number in 0..50 {
        undisturbed.insert(flown(number)).unwrap();
        restored.insert(flown(number)).unwrap();
        restored = Replay::restore(&config, restored.state()).unwrap();
        assert!(
            restored.state() == undisturbed.state(),
            "after episode {number}"
        );
    }
}

#[test]
fn transitions_are_sampled_as_without_images() {
    let config = end_to_end(60);
    let mut with = Replay::new(&config);
    let mut without = frozen(&self::config(60, Observation::LatentVelocity));
    for number in 0..40 {
        with.insert(flown(number)).unwrap();
        without.insert(flown(number)).unwrap();
        let drawn = draw(&with, number);
        assert!(!drawn.images.is_empty());
        let rows_alone = Minibatch {
            images: Vec::new(),
            next_images: Vec::new(),
            ..drawn
        };
        assert!(rows_alone == draw(&without, number));
    }
}

#[test]
fn an_episode_that_is_needed_whole_is_never_copied() {
    let mut replay = Replay::new(&end_to_end(60));
    for number in 0..30 {
        replay.insert(flown(number)).unwrap();
        let before = replay.state().images.unwrap();
        replay.insert(flown(number + 100)).unwrap();
        let after = replay.state().images.unwrap();
        // The second newest block stays in place, even if others were dropped.
        let newest = after.len() - 2;
        assert!(
            Arc::ptr_eq(&after[newest], before.last().unwrap()),
            "episode {number}"
        );
    }
}

#[test]
fn while_a_policy_learns_from_images_an_episode_or_a_checkpoint_without_them_is_refused() {
    let config = end_to_end(60);
    let mut replay = Replay::new(&config);
    let error = replay.insert(flown(4).without_images()).unwrap_err();
    assert_eq!(
        error,
        InsertError::NoImages {
            episode: EpisodeId(4)
        }
    );
    replay.insert(flown(4)).unwrap();
    let mut state = replay.state();
    state.images = None;
    state.success.images.clear();
    state.regular.images.clear();
    let error = Replay::restore(&config, state).unwrap_err();
    assert_eq!(error.part, "depth images");
    assert!(
        error.problem.contains("the policy learns from them"),
        "{error}"
    );
}
