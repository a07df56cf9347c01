//! The whole update: exactness, determinism, and that it learns.

use skein_protocol::config::{Observation, SacSection};
use skein_protocol::snapshot::SnapshotLayout;
use tch::Device;

use super::{Batch, Columns, Sac, SacMetrics};
use crate::UpdateError;
use crate::noise::Noise;
use crate::state::{NamedTensor, Stateful, TensorValues};

const OBSERVATION: Observation = Observation::Latent;

fn small() -> SacSection {
    SacSection {
        hidden_width: 32,
        batch_size: 32,
        ..SacSection::default()
    }
}

fn sac(section: &SacSection, seed: u64) -> Sac {
    crate::device::use_threads(1);
    Sac::new(section, OBSERVATION, seed, Device::Cpu)
}

/// Transitions of a one-step task: the observation's first two numbers are the action that would have been right.
fn guessing_batch(rows: usize, noise: &mut Noise) -> Batch {
    let width = OBSERVATION.len();
    let mut draw = |count: usize| -> Vec<f32> { (0..count).map(|_| noise.uniform(0.8)).collect() };
    let (observations, actions) = (draw(rows * width), draw(rows * 2));
    let rewards: Vec<f32> = (0..rows)
        .map(|row| {
            let (wanted, done) = (&observations[row * width..][..2], &actions[row * 2..][..2]);
            -((wanted[0] - done[0]).powi(2) + (wanted[1] - done[1]).powi(2))
        })
        .collect();
    let columns = Columns {
        observations: &observations,
        actions: &actions,
        rewards: &rewards,
        next_observations: &observations,
        terminated: &vec![1.0; rows],
    };
    Batch::new(columns, Device::Cpu)
}

fn state(sac: &mut Sac) -> Vec<NamedTensor> {
    sac.named_tensors()
}

fn train(sac: &mut Sac, updates: usize, seed: u64) -> Vec<SacMetrics> {
    let (mut data, mut noise) = (Noise::new(seed), Noise::new(seed + 1));
    (0..updates)
        .map(|_| sac.update(&guessing_batch(32, &mut data), &mut noise).unwrap())
        .collect()
}

#[test]
fn equal_seeds_give_equal_bits() {
    let [mut one, mut other] = [sac(&small(), 1), sac(&small(), 1)];
    assert_eq!(train(&mut one, 20, 5), train(&mut other, 20, 5));
    assert_eq!(state(&mut one), state(&mut other));
    let mut third = sac(&small(), 2);
    train(&mut third, 20, 5);
    assert_ne!(state(&mut one), state(&mut third));
}

#[test]
fn a_restored_sac_continues_bit_for_bit() {
    let mut sac = sac(&small(), 1);
    train(&mut sac, 10, 5);
    let mut resumed = self::sac(&small(), 77);
    resumed.load_named(&state(&mut sac)).unwrap();
    assert_eq!(resumed.updates(), 10);
    assert_eq!(train(&mut sac, 10, 8), train(&mut resumed, 10, 8));
    assert_eq!(state(&mut sac), state(&mut resumed));
}

#[test]
fn every_part_of_the_state_moves_with_an_update() {
    let mut sac = sac(&small(), 1);
    let before = state(&mut sac);
    train(&mut sac, 1, 5);
    for (was, is) in before.iter().zip(&state(&mut sac)) {
        assert_ne!(was, is, "{} stood still", was.name);
    }
}

#[test]
fn an_update_that_is_not_finite_changes_nothing() {
    let mut sac = sac(&small(), 1);
    train(&mut sac, 3, 5);
    let before = state(&mut sac);
    let batch = guessing_batch(32, &mut Noise::new(1));
    let _ = batch.rewards.select(0, 4).fill_(f64::NAN);
    let error = sac.update(&batch, &mut Noise::new(2)).unwrap_err();
    assert_eq!(
        error,
        UpdateError::NonFinite {
            tensor: "critic loss",
            update: 4
        }
    );
    assert_eq!(before, state(&mut sac));
}

#[test]
fn the_published_part_is_the_snapshots_policy() {
    let mut sac = sac(&small(), 1);
    let layout = SnapshotLayout::new(OBSERVATION.len(), 32);
    assert_eq!(layout.policy().len(), sac.published_len());
    let policys = layout
        .tensors()
        .iter()
        .filter(|tensor| tensor.name.starts_with("policy"));
    let mut start = layout.policy().start;
    for (ours, snapshots) in sac.policy_layout().tensors().iter().zip(policys) {
        let shape: Vec<usize> = ours.shape.iter().map(|&size| size as usize).collect();
        assert_eq!((&ours.name, &shape), (&snapshots.name, &snapshots.shape));
        assert_eq!(snapshots.range, start..start + ours.len());
        start += ours.len();
    }
    assert_eq!(start, layout.values());
    let mut published = vec![0.0; sac.published_len()];
    sac.publish(&mut published);
    assert_eq!(sac.named_tensors()[0].values, TensorValues::F32(published));
}

#[test]
fn the_right_action_is_learned_in_a_one_step_task() {
    let section = SacSection {
        policy_learning_rate: 3e-3,
        critic_learning_rate: 3e-3,
        temperature_learning_rate: 1e-2,
        ..small()
    };
    for seed in 1..=3 {
        let mut sac = sac(&section, seed);
        train(&mut sac, 600, seed);
        let test = guessing_batch(256, &mut Noise::new(seed + 100));
        let error = (sac.mode(&test.observations) - test.observations.narrow(1, 0, 2))
            .square()
            .mean(None);
        let error = error.double_value(&[]);
        // Always answering zero has a mean squared error of 0.8² / 3 = 0.21.
        assert!(error < 0.03, "seed {seed}: {error}");
    }
}
