//! Sampling a minibatch from a full split replay buffer, from small buffers to large ones.
//!
//! The configured size is 2^17; the others show the cost of a batch whose rows no longer fit into a
//! cache.

use criterion::{BenchmarkId, Criterion, Throughput};
use rand::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;
use skein_learner::episode::{CommittedEpisode, StepObservation};
use skein_learner::replay::{Minibatch, Replay};
use skein_protocol::config::{Config, Observation};
use skein_protocol::ids::{ActorId, EpisodeId, Epoch, PolicyVersion};
use skein_protocol::transition::Outcome;
use skein_protocol::{GROUND_TRUTH, MAX_ACTION, MAX_LATENT, REWARD_TERMS};

/// Transitions per minibatch.
const BATCH: usize = 256;
/// Steps of each episode that fills the buffer.
const STEPS: usize = 64;
/// Steps per passed wall: more walls than the success share, so that the success part fills no
/// later than the other.
const STEPS_PER_WALL: usize = 4;

fn main() {
    let mut criterion = Criterion::default().configure_from_args();
    let mut group = criterion.benchmark_group("replay");
    group.throughput(Throughput::Elements(1));
    for exponent in [17, 10, 12, 14, 16, 18, 20] {
        let mut replay = None;
        group.bench_function(BenchmarkId::new("sample", 1_usize << exponent), |bencher| {
            // Created on demand: large buffers take a while to fill.
            let replay = replay.get_or_insert_with(|| full(1 << exponent));
            let mut rng = Pcg64Mcg::seed_from_u64(1);
            let mut minibatch = Minibatch::default();
            bencher.iter(|| replay.sample(&mut rng, BATCH, &mut minibatch));
        });
    }
    group.finish();
    criterion.final_summary();
}

/// Returns a buffer for `capacity` transitions, both parts full.
fn full(capacity: usize) -> Replay {
    let mut config = Config::default();
    config.replay.capacity = capacity;
    config.learning.observation = Observation::LatentVelocity;
    let mut replay = Replay::new(&config);
    replay.freeze();
    let mut rng = Pcg64Mcg::seed_from_u64(2);
    for episode in 0.. {
        if replay.len() == capacity {
            break;
        }
        replay
            .insert(flown(episode, &mut rng))
            .expect("the episode's parts have one length");
    }
    replay
}

fn flown(number: u64, rng: &mut impl Rng) -> CommittedEpisode {
    let mut draw = || (rng.next_u32() as f32 / u32::MAX as f32) * 2.0 - 1.0;
    CommittedEpisode {
        episode: EpisodeId(number),
        epoch: Epoch(number),
        policy_version: PolicyVersion(0),
        actor: ActorId(0),
        level: 1,
        first_step: 0,
        action_before: [0.0; MAX_ACTION],
        observations: (0..=STEPS)
            .map(|_| StepObservation {
                latent: [(); MAX_LATENT].map(|()| draw()),
                velocity_mps: [(); 3].map(|()| draw()),
                goal_m: [(); 3].map(|()| draw()),
                position_m: [0.0; 3],
                orientation: [0.0, 0.0, 0.0, 1.0],
                ground_truth: [0.0; GROUND_TRUTH],
            })
            .collect(),
        actions: (0..STEPS).map(|_| [draw(), draw(), 0.0, 0.0]).collect(),
        teacher_actions: vec![[0.0; MAX_ACTION]; STEPS],
        rewards: (0..STEPS).map(|_| draw()).collect(),
        reward_terms: vec![[0.0; REWARD_TERMS]; STEPS],
        level_up: (0..STEPS).map(|step| step % STEPS_PER_WALL == 0).collect(),
        outcome: Some(Outcome::Collided),
        walls_passed: 0,
        course_walls: 5,
        hit_wall: None,
        depth: None,
    }
}
