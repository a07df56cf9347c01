//! The delayed update, learning, and refusal of numbers that are not finite.

use super::*;
use crate::sac::samples::Transitions;

/// Numbers in an observation.
const OBSERVATION: usize = 34;

fn section() -> Td3Section {
    Td3Section {
        hidden_width: 24,
        ..Td3Section::default()
    }
}

fn td3(section: &Td3Section, seed: u64) -> Td3 {
    crate::device::use_threads(1);
    Td3::new(section, Inputs::same(OBSERVATION), seed, Device::Cpu)
}

fn update(algorithm: &mut Td3, transitions: &Transitions, noise: &mut Noise) {
    algorithm
        .update(&mut Team::new(1), transitions.columns(), noise)
        .unwrap();
}

fn numbers(parameters: &Parameters) -> Vec<f32> {
    let mut numbers = vec![0.0; parameters.layout().len()];
    parameters.copy_range(0..numbers.len(), &mut numbers);
    numbers
}

#[test]
fn policy_and_targets_move_every_second_update() {
    let mut algorithm = td3(&section(), 1);
    let (mut data, mut noise) = (Noise::new(1), Noise::new(2));
    let mut step = |algorithm: &mut Td3| {
        let transitions = Transitions::random(OBSERVATION, 20, &mut data);
        update(algorithm, &transitions, &mut noise);
        [
            &algorithm.policy_parameters,
            &algorithm.target_policy,
            &algorithm.target_critic,
        ]
        .map(numbers)
    };
    let [first, second, third] = [0; 3].map(|_| step(&mut algorithm));
    assert!((0..3).all(|part| first[part] != second[part] && second[part] == third[part]));
}

#[test]
fn it_learns_to_guess_and_a_restored_one_continues_bit_for_bit() {
    let section = Td3Section {
        policy_learning_rate: 3e-3,
        critic_learning_rate: 3e-3,
        ..section()
    };
    for seed in 1..=3 {
        let (mut data, mut noise) = (Noise::new(seed), Noise::new(seed + 1));
        let mut algorithm = td3(&section, seed);
        let before = error(&algorithm);
        for _ in 0..1500 {
            let transitions = Transitions::one_step_task(OBSERVATION, 64, &mut data);
            update(&mut algorithm, &transitions, &mut noise);
        }
        let after = error(&algorithm);
        assert!(after < 0.15 * before, "seed {seed}: {before} to {after}");

        let mut resumed = td3(&section, seed + 10);
        resumed.load_named(&algorithm.named_tensors()).unwrap();
        let transitions = Transitions::one_step_task(OBSERVATION, 64, &mut data);
        for either in [&mut algorithm, &mut resumed] {
            update(either, &transitions, &mut Noise::new(5));
        }
        assert_eq!(algorithm.named_tensors(), resumed.named_tensors());
    }
}

/// Mean squared error of the policy's guesses.
fn error(algorithm: &Td3) -> f64 {
    let asked = Transitions::one_step_task(OBSERVATION, 200, &mut Noise::new(77));
    let observations = Tensor::from_slice(&asked.observations).view([-1, OBSERVATION as i64]);
    let _guard = no_grad_guard();
    let actions = algorithm
        .policy
        .output(&algorithm.policy_parameters, &observations)
        .tanh();
    let wanted = observations.narrow(1, 0, 2);
    (actions - wanted).square().mean(None).double_value(&[])
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
