//! The update against automatic gradients, and that it learns.

use tch::Device;

use super::super::TorchTd3;
use super::*;
use crate::networks::Parameters;
use crate::sac::samples::Transitions;

/// Numbers in an observation.
const OBSERVATION: usize = 34;
/// Where the critic is told something else than the policy sees.
const TOLD: Inputs = Inputs {
    policy: OBSERVATION,
    critic: 19,
    from_image: None,
};

fn section() -> Td3Section {
    Td3Section {
        hidden_width: 24,
        ..Td3Section::default()
    }
}

fn td3(section: &Td3Section, seed: u64) -> NativeTd3 {
    NativeTd3::new(section, Inputs::same(OBSERVATION), seed, Isa::best())
}

fn numbers(parameters: &Parameters) -> Vec<f32> {
    let mut numbers = vec![0.0; parameters.layout().len()];
    parameters.copy_range(0..numbers.len(), &mut numbers);
    numbers
}

#[test]
fn forty_updates_stay_close_to_automatic_gradients() {
    crate::device::use_threads(1);
    // In the last, most of the noise is cut off at its bound.
    let cut_off = Td3Section {
        target_noise: 1.0,
        target_noise_bound: 0.3,
        ..section()
    };
    let apart = Td3Section {
        critic_networks: 2,
        ..section()
    };
    for (seed, section) in [(1, section()), (2, section()), (3, apart), (4, cut_off)] {
        let mut native = NativeTd3::new(&section, TOLD, seed, Isa::best());
        let mut torch = TorchTd3::new(&section, TOLD, seed, Device::Cpu);
        let (mut data, mut noise, mut same_noise) =
            (Noise::new(seed), Noise::new(9), Noise::new(9));
        let before = native.policy_parameters.values.clone();
        for number in 1..=40 {
            let transitions = Transitions::random(OBSERVATION, 50, &mut data)
                .with_critic_states(TOLD.critic, &mut data);
            let found = native
                .update(&mut Team::new(1), transitions.columns(), &mut noise)
                .unwrap();
            let expected = torch
                .update(&mut Team::new(1), transitions.columns(), &mut same_noise)
                .unwrap();
            for ((scalar, found), (same, expected)) in found.iter().zip(&expected) {
                assert_eq!(scalar, same);
                let apart = (found - expected).abs();
                assert!(
                    apart < 1e-4 * (1.0 + expected.abs()),
                    "update {number}, {scalar:?}: {found}, not {expected}"
                );
            }
        }
        let pairs = [
            (
                &native.policy_parameters.values,
                &torch.policy_parameters,
                6e-3,
            ),
            (
                &native.critic_parameters.values,
                &torch.critic_parameters,
                1.2e-2,
            ),
            (&native.target_policy, &torch.target_policy, 1e-3),
            (&native.target_critic, &torch.target_critic, 1e-3),
        ];
        for (found, expected, moved) in pairs {
            let expected = numbers(expected);
            let apart = found
                .iter()
                .zip(&expected)
                .map(|(found, expected)| (found - expected).abs());
            // Adam's steps are as large as its rate, however small a gradient; where one is nearly
            // nothing, its sign is chance.
            let far = apart.filter(|apart| *apart > 0.05 * moved).count();
            assert!(
                far <= 2 + found.len() / 200,
                "{far} of {} are far off",
                found.len()
            );
        }
        assert_ne!(
            before, native.policy_parameters.values,
            "the policy was never updated"
        );
        let layout = |algorithm: &mut dyn Algorithm| {
            let parts = algorithm.named_tensors().into_iter();
            let mut parts: Vec<_> = parts.map(|part| (part.name, part.shape)).collect();
            parts.sort();
            parts
        };
        assert_eq!(
            layout(&mut native),
            layout(&mut torch),
            "a checkpoint says nothing of the engine"
        );
    }
}

#[test]
fn the_policy_and_the_targets_wait_for_their_turn() {
    let mut algorithm = td3(&section(), 1);
    let (mut data, mut noise) = (Noise::new(1), Noise::new(2));
    let mut step = |algorithm: &mut NativeTd3| {
        let transitions = Transitions::random(OBSERVATION, 20, &mut data);
        algorithm
            .update(&mut Team::new(1), transitions.columns(), &mut noise)
            .unwrap();
        [
            algorithm.policy_parameters.values.clone(),
            algorithm.target_policy.clone(),
            algorithm.target_critic.clone(),
        ]
    };
    let [first, second, third] = [0; 3].map(|_| step(&mut algorithm));
    assert!((0..3).all(|part| first[part] != second[part] && second[part] == third[part]));
}

#[test]
fn it_learns_to_guess_and_goes_on_bit_for_bit_from_its_state() {
    let section = Td3Section {
        policy_learning_rate: 3e-3,
        critic_learning_rate: 3e-3,
        ..section()
    };
    for seed in 1..=3 {
        let (mut data, mut noise, mut team) =
            (Noise::new(seed), Noise::new(seed + 1), Team::new(1));
        let mut algorithm = td3(&section, seed);
        let error = |algorithm: &NativeTd3| {
            let asked = Transitions::one_step_task(OBSERVATION, 200, &mut Noise::new(77));
            let mut actions = vec![0.0; 400];
            algorithm.policy.forward_through(
                &mut Team::new(1),
                &algorithm.policy_parameters.values,
                &asked.observations,
                &mut actions,
            );
            let wanted = asked
                .observations
                .chunks(OBSERVATION)
                .flat_map(|row| &row[..2]);
            let squares = actions
                .iter()
                .zip(wanted)
                .map(|(given, wanted)| (given.tanh() - wanted).powi(2));
            squares.sum::<f32>() / 400.0
        };
        let before = error(&algorithm);
        for _ in 0..1500 {
            let transitions = Transitions::one_step_task(OBSERVATION, 64, &mut data);
            algorithm
                .update(&mut team, transitions.columns(), &mut noise)
                .unwrap();
        }
        let after = error(&algorithm);
        assert!(after < 0.15 * before, "seed {seed}: {before} to {after}");

        let mut resumed = td3(&section, seed + 10);
        resumed.load_named(&algorithm.named_tensors()).unwrap();
        let transitions = Transitions::one_step_task(OBSERVATION, 64, &mut data);
        for either in [&mut algorithm, &mut resumed] {
            either
                .update(&mut team, transitions.columns(), &mut Noise::new(5))
                .unwrap();
        }
        assert_eq!(algorithm.named_tensors(), resumed.named_tensors());
    }
}

#[test]
fn neither_threads_nor_instructions_change_a_bit() {
    let run = |isa: Isa, members: usize| {
        let mut algorithm = NativeTd3::new(&section(), Inputs::same(OBSERVATION), 1, isa);
        let (mut data, mut noise, mut team) = (Noise::new(1), Noise::new(2), Team::new(members));
        for _ in 0..4 {
            let transitions = Transitions::random(OBSERVATION, 37, &mut data);
            algorithm
                .update(&mut team, transitions.columns(), &mut noise)
                .unwrap();
        }
        algorithm.named_tensors()
    };
    let expected = run(Isa::Portable, 1);
    for isa in Isa::ALL.into_iter().filter(|isa| isa.is_available()) {
        for members in 1..=3 {
            assert_eq!(run(isa, members), expected, "{isa}, {members} members");
        }
    }
}

#[test]
fn what_is_not_finite_is_named_and_nothing_moves() {
    let mut algorithm = td3(&section(), 1);
    let mut transitions = Transitions::random(OBSERVATION, 20, &mut Noise::new(1));
    transitions.rewards[3] = f32::INFINITY;
    let before = algorithm.named_tensors();
    let refused = algorithm.update(&mut Team::new(1), transitions.columns(), &mut Noise::new(2));
    assert!(
        matches!(
            refused,
            Err(UpdateError::NonFinite {
                tensor: "critic loss",
                update: 1
            })
        ),
        "{refused:?}"
    );
    assert_eq!(algorithm.named_tensors(), before);
}
