//! Contents of the replay buffer, as found in a checkpoint with valid checksums. Restored contents
//! can be sampled and continued.

use std::sync::Arc;

use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use skein_learner::episode::{CommittedEpisode, StepObservation};
use skein_learner::replay::{Minibatch, Replay, ReplayState, RingState};
use skein_protocol::config::{Config, EncoderTraining};
use skein_protocol::ids::{ActorId, EpisodeId, Epoch, PolicyVersion};
use skein_protocol::transition::Outcome;
use skein_protocol::{GROUND_TRUTH, IMAGE_PIXELS, MAX_ACTION, MAX_LATENT, REWARD_TERMS};

use super::{ReaderDecision, Target, USUAL};
use crate::script::Script;

pub(super) const REPLAY: Target = Target {
    name: "replay",
    reads: "contents of a replay buffer, built from a script of lengths and numbers",
    longest_bytes: 512,
    weight: USUAL / 10,
    samples: || {
        vec![
            Vec::new(),
            vec![0; 40],
            [2, 3, 1].repeat(20),
            (0..=255).collect(),
        ]
    },
    run: restore,
};

/// Length of the latent codes, the default.
const LATENT: usize = 32;
/// Values in a row of the smallest buffer: two observations, action, reward, end.
const ROW: usize = 2 * LATENT + 2 + 2;

pub(super) fn config() -> Config {
    let mut config = Config::default();
    config.replay.capacity = 256;
    config.vae.train_steps = 16;
    config.learning.episodes_per_epoch = 1;
    config.transport.max_records_per_episode = 16;
    config
}

fn restore(bytes: &[u8]) -> ReaderDecision {
    let (config, mut script) = (config(), Script::new(bytes));
    let state = ReplayState {
        images: images(&mut script),
        success: ring(&mut script, 32),
        regular: ring(&mut script, 224),
    };
    restore_end_to_end(state.clone());
    let Ok(mut replay) = Replay::restore(&config, state.clone()) else {
        return ReaderDecision::Refused;
    };
    assert_eq!(replay.state(), state);
    let mut rng = Pcg64Mcg::seed_from_u64(1);
    if !replay.is_empty() {
        replay.sample(&mut rng, 8, &mut Minibatch::default());
    }
    if replay.image_count().is_some_and(|images| images > 0) {
        replay.sample_images(&mut rng, 2, &mut Vec::new());
    }
    // One more episode: stored, or refused because its images do not fit.
    let _ = replay.insert(episode());
    let encode = |images: &[u8]| Ok::<_, ()>(vec![[0.5; MAX_LATENT]; images.len() / IMAGE_PIXELS]);
    replay.recode_latents(8, encode).unwrap();
    replay.freeze();
    assert_eq!(replay.image_count(), None);
    ReaderDecision::Accepted
}

/// Restores the same contents where a policy learns from the images. Accepted contents can be
/// sampled with their images, and continued until images are dropped.
fn restore_end_to_end(state: ReplayState) {
    let mut config = config();
    config.learning.encoder = EncoderTraining::EndToEnd;
    let Ok(mut replay) = Replay::restore(&config, state.clone()) else {
        return;
    };
    assert_eq!(replay.state(), state);
    let (mut rng, mut drawn) = (Pcg64Mcg::seed_from_u64(1), Minibatch::default());
    for _ in 0..3 {
        replay.insert(episode()).unwrap();
        replay.sample(&mut rng, 4, &mut drawn);
        assert_eq!(
            [drawn.images.len(), drawn.next_images.len()],
            [4 * IMAGE_PIXELS; 2]
        );
    }
}

fn images(script: &mut Script<'_>) -> Option<Vec<Arc<Vec<u8>>>> {
    let blocks = script.u8();
    let block = |script: &mut Script<'_>| {
        let odd = usize::from(script.u8() == 255);
        Arc::new(vec![7; usize::from(script.u8() % 5) * IMAGE_PIXELS + odd])
    };
    (!blocks.is_multiple_of(3)).then(|| (0..blocks % 6).map(|_| block(script)).collect())
}

/// Returns mostly as many rows and image numbers as were inserted.
fn ring(script: &mut Script<'_>, capacity: usize) -> RingState {
    let inserted = match script.u8() {
        255 => script.u64(),
        few => u64::from(few % 64),
    };
    let filled = usize::try_from(inserted)
        .unwrap_or(usize::MAX)
        .min(capacity);
    let extra = usize::from(script.u8() == 255);
    let numbers = match script.u8() % 3 {
        0 => filled + extra,
        1 => 0,
        _ => usize::from(script.u8()),
    };
    RingState {
        inserted,
        rows: vec![0.25; filled * ROW + extra],
        images: (0..numbers).map(|_| u32::from(script.u8() % 16)).collect(),
    }
}

pub(super) fn episode() -> CommittedEpisode {
    let seen = StepObservation {
        latent: [0.0; MAX_LATENT],
        velocity_mps: [0.0; 3],
        goal_m: [0.0; 3],
        position_m: [0.0; 3],
        orientation: [0.0, 0.0, 0.0, 1.0],
        ground_truth: [0.0; GROUND_TRUTH],
    };
    CommittedEpisode {
        episode: EpisodeId(1),
        epoch: Epoch(0),
        policy_version: PolicyVersion(0),
        actor: ActorId(0),
        level: 1,
        first_step: 0,
        action_before: [0.0; MAX_ACTION],
        observations: vec![seen; 3],
        actions: vec![[0.0; MAX_ACTION]; 2],
        teacher_actions: vec![[0.0; MAX_ACTION]; 2],
        rewards: vec![1.0; 2],
        reward_terms: vec![[0.0; REWARD_TERMS]; 2],
        level_up: vec![false, true],
        outcome: Some(Outcome::Collided),
        walls_passed: 1,
        course_walls: 5,
        hit_wall: None,
        depth: Some(vec![9; 3 * IMAGE_PIXELS]),
    }
}
