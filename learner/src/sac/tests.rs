//! The whole update on both engines: exactness, determinism, and that it learns.

use skein_kernels::{Isa, Team};
use skein_protocol::config::{Engine, Observation, ObservationLayout, SacSection};
use skein_protocol::snapshot::SnapshotLayout;
use tch::{Device, Tensor, no_grad_guard};

use super::samples::Transitions;
use super::{NativeSac, TorchSac};
use crate::UpdateError;
use crate::algorithm::{Algorithm, Inputs};
use crate::metrics::Scalar;
use crate::networks::{Layout, Parameters, PolicyNetwork};
use crate::noise::Noise;
use crate::state::{NamedTensor, TensorValues};

/// Width of an observation.
const OBSERVATION: usize = 32;
pub(super) const ENGINES: [Engine; 2] = [Engine::Native, Engine::Libtorch];

fn small() -> SacSection {
    SacSection {
        hidden_width: 32,
        batch_size: 32,
        ..SacSection::default()
    }
}

fn sac(engine: Engine, section: &SacSection, seed: u64) -> Box<dyn Algorithm> {
    crate::device::use_threads(1);
    let inputs = Inputs::same(OBSERVATION);
    match engine {
        Engine::Native => Box::new(NativeSac::new(section, inputs, seed, Isa::best())),
        Engine::Libtorch => Box::new(TorchSac::new(section, inputs, seed, Device::Cpu)),
    }
}

type Metrics = Vec<(Scalar, f32)>;

fn update(
    sac: &mut dyn Algorithm,
    transitions: &Transitions,
    noise: &mut Noise,
) -> Result<Metrics, UpdateError> {
    sac.update(&mut Team::new(1), transitions.columns(), noise)
}

fn train(sac: &mut dyn Algorithm, updates: usize, seed: u64) -> Vec<Metrics> {
    let (mut data, mut noise) = (Noise::new(seed), Noise::new(seed + 1));
    (0..updates)
        .map(|_| {
            update(
                sac,
                &Transitions::one_step_task(OBSERVATION, 32, &mut data),
                &mut noise,
            )
            .unwrap()
        })
        .collect()
}

fn state(sac: &mut dyn Algorithm) -> Vec<NamedTensor> {
    sac.named_tensors()
}

fn published(sac: &dyn Algorithm) -> Vec<f32> {
    let mut published = vec![0.0; sac.policy_layout().len()];
    sac.publish(&mut published);
    published
}

/// The published policy's action without noise, `[n, 2]`.
fn mode(sac: &dyn Algorithm, section: &SacSection, observations: &[f32]) -> Vec<f32> {
    let mut layout = Layout::default();
    let inputs = Inputs::same(OBSERVATION);
    let policy = PolicyNetwork::describe(&mut layout, inputs, section.hidden_width as i64);
    let mut parameters = Parameters::initialise(layout, 0, Device::Cpu);
    let _guard = no_grad_guard();
    parameters
        .flat_mut()
        .copy_(&Tensor::from_slice(&published(sac)));
    let observations = Tensor::from_slice(observations).view([-1, OBSERVATION as i64]);
    Vec::try_from(policy.mode(&parameters, &observations).reshape([-1])).unwrap()
}

#[test]
fn equal_seeds_give_equal_bits() {
    for engine in ENGINES {
        let [mut one, mut other] = [sac(engine, &small(), 1), sac(engine, &small(), 1)];
        assert_eq!(train(&mut *one, 20, 5), train(&mut *other, 20, 5));
        assert_eq!(state(&mut *one), state(&mut *other));
        let mut third = sac(engine, &small(), 2);
        train(&mut *third, 20, 5);
        assert_ne!(state(&mut *one), state(&mut *third));
    }
}

#[test]
fn a_restored_sac_continues_bit_for_bit() {
    for engine in ENGINES {
        let mut sac = sac(engine, &small(), 1);
        train(&mut *sac, 10, 5);
        let mut resumed = self::sac(engine, &small(), 77);
        resumed.load_named(&state(&mut *sac)).unwrap();
        assert_eq!(resumed.updates(), 10);
        assert_eq!(train(&mut *sac, 10, 8), train(&mut *resumed, 10, 8));
        assert_eq!(state(&mut *sac), state(&mut *resumed));
    }
}

#[test]
fn every_part_of_the_state_moves_with_an_update() {
    for engine in ENGINES {
        let mut sac = sac(engine, &small(), 1);
        let before = state(&mut *sac);
        train(&mut *sac, 1, 5);
        for (was, is) in before.iter().zip(&state(&mut *sac)) {
            assert_ne!(was, is, "{engine}: {} stood still", was.name);
        }
    }
}

#[test]
fn an_update_that_is_not_finite_changes_nothing() {
    for engine in ENGINES {
        let mut sac = sac(engine, &small(), 1);
        train(&mut *sac, 3, 5);
        let before = state(&mut *sac);
        let sound = Transitions::one_step_task(OBSERVATION, 32, &mut Noise::new(1));
        let mut refused = |damage: fn(&mut Transitions)| {
            let mut damaged = sound.clone();
            damage(&mut damaged);
            let error = update(&mut *sac, &damaged, &mut Noise::new(2)).unwrap_err();
            assert_eq!(before, state(&mut *sac), "{engine}");
            error
        };
        let of = |tensor| UpdateError::NonFinite { tensor, update: 4 };
        assert_eq!(
            refused(|batch| batch.rewards[4] = f32::NAN),
            of("critic loss")
        );
        assert_eq!(
            refused(|batch| batch.rewards[31] = f32::INFINITY),
            of("critic loss")
        );
        assert_eq!(
            refused(|batch| batch.observations[7] = f32::NAN),
            of("critic loss")
        );
        // Their squares are still finite; the gradient's squared norm is not.
        let UpdateError::NonFinite { tensor, .. } = refused(|batch| batch.rewards.fill(1.5e19));
        assert!(tensor.starts_with("critic"), "{engine}: {tensor}");
    }
}

#[test]
fn a_truncated_episode_still_bootstraps() {
    for engine in ENGINES {
        // Metrics after learning from one transition, the last of its episode, for a given next
        // state.
        let learned = |terminated: f32, next: f32| {
            let mut sac = sac(engine, &small(), 1);
            let mut last = Transitions::one_step_task(OBSERVATION, 1, &mut Noise::new(1));
            last.terminated[0] = terminated;
            last.next_observations.fill(next);
            let metrics = update(&mut *sac, &last, &mut Noise::new(2)).unwrap();
            metrics[0]
        };
        let (crashed, truncated) = (1.0, 0.0);
        assert_eq!(
            learned(crashed, 0.1),
            learned(crashed, -0.7),
            "a crash has no future"
        );
        assert_ne!(
            learned(truncated, 0.1),
            learned(truncated, -0.7),
            "a step limit has one"
        );
    }
}

#[test]
fn the_published_part_is_the_snapshots_policy() {
    for engine in ENGINES {
        let mut sac = sac(engine, &small(), 1);
        let layout = SnapshotLayout::new(
            &ObservationLayout::present(Observation::Latent, OBSERVATION),
            32,
        );
        assert_eq!(layout.policy().len(), sac.policy_layout().len());
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
        let published = published(&*sac);
        let policy = sac
            .named_tensors()
            .into_iter()
            .find(|tensor| tensor.name == "sac.policy.parameters");
        assert_eq!(policy.unwrap().values, TensorValues::F32(published));
    }
}

#[test]
fn the_right_action_is_learned_in_a_one_step_task() {
    let section = SacSection {
        policy_learning_rate: 3e-3,
        critic_learning_rate: 3e-3,
        temperature_learning_rate: 1e-2,
        ..small()
    };
    for engine in ENGINES {
        for seed in 1..=3 {
            let mut sac = sac(engine, &section, seed);
            train(&mut *sac, 600, seed);
            let test = Transitions::one_step_task(OBSERVATION, 256, &mut Noise::new(seed + 100));
            let actions = mode(&*sac, &section, &test.observations);
            let observations = test.observations.chunks_exact(OBSERVATION);
            let squared = observations
                .zip(actions.chunks_exact(2))
                .map(|(wanted, done)| {
                    (wanted[0] - done[0]).powi(2) + (wanted[1] - done[1]).powi(2)
                });
            let error = squared.sum::<f32>() / actions.len() as f32;
            // Always answering zero has a mean squared error of 0.8² / 3 = 0.21.
            assert!(error < 0.03, "{engine}, seed {seed}: {error}");
        }
    }
}
