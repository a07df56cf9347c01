//! The update against automatic gradients, and that it learns.

use tch::{Device, Tensor, no_grad_guard};

use super::*;
use crate::networks::Parameters;
use crate::optimizer::Adam;
use crate::sac::samples::Transitions;

/// Numbers in an observation.
const OBSERVATION: usize = 34;
/// Where the critic is told something else than the policy sees.
const TOLD: Inputs = Inputs {
    policy: OBSERVATION,
    critic: 19,
};

fn section() -> Td3Section {
    Td3Section {
        hidden_width: 24,
        ..Td3Section::default()
    }
}

fn td3(section: &Td3Section, seed: u64) -> Td3 {
    Td3::new(section, Inputs::same(OBSERVATION), seed, Isa::best())
}

/// The same algorithm on libtorch, in reading order, with [`TOLD`].
struct Reference {
    section: Td3Section,
    policy: Policy,
    critic: Critic,
    learned: [Parameters; 2],
    targets: [Parameters; 2],
    optimizers: [Adam; 2],
    updates: u64,
}

impl Reference {
    fn new(section: &Td3Section, seed: u64) -> Self {
        let width = section.hidden_width as i64;
        let [inputs, state] = [TOLD.policy, TOLD.critic].map(|inputs| inputs as i64);
        let (mut policy_layout, mut critic_layout) = (Layout::default(), Layout::default());
        let policy = Policy::with_outputs(&mut policy_layout, inputs, width, ACTION as i64);
        let critic = Critic::describe(&mut critic_layout, state, width, section.critic_networks);
        let parameters = |layout: Layout, index| {
            Parameters::initialise(layout, derive(seed, Purpose::PolicyParameters, index), Device::Cpu)
        };
        let learned = [parameters(policy_layout, 0), parameters(critic_layout, 1)];
        Self {
            policy,
            critic,
            targets: learned.each_ref().map(Parameters::duplicate),
            optimizers: [
                Adam::new(learned[0].flat(), section.policy_learning_rate),
                Adam::new(learned[1].flat(), section.critic_learning_rate),
            ],
            learned,
            section: section.clone(),
            updates: 0,
        }
    }

    fn update(&mut self, transitions: &Transitions, noise: &mut Noise) -> f64 {
        let rows = transitions.rewards.len() as i64;
        let column = |values: &[f32], width: i64| Tensor::from_slice(values).view([rows, width]);
        let columns = transitions.columns();
        let [inputs, state] = [TOLD.policy, TOLD.critic].map(|inputs| inputs as i64);
        let (observations, actions) = (column(columns.observations, inputs), column(columns.actions, 2));
        let next = column(columns.next_observations, inputs);
        let (states, next_states) = (column(columns.states, state), column(columns.next_states, state));
        let (rewards, terminated) = (column(&transitions.rewards, 1), column(&transitions.terminated, 1));
        let [policy, critic] = &self.learned;
        let [target_policy, target_critic] = &self.targets;
        let targets: Tensor = {
            let _guard = no_grad_guard();
            let bound = self.section.target_noise_bound;
            let noise = noise.normal(&[rows, 2], Device::Cpu) * self.section.target_noise;
            let next_actions =
                (self.policy.output(target_policy, &next).tanh() + noise.clamp(-bound, bound)).clamp(-1.0, 1.0);
            let values = self
                .critic
                .smaller(target_critic, &next_states, &next_actions)
                .unsqueeze(1);
            rewards + (1.0 - terminated) * values * self.section.discount
        };
        let values = self.critic.forward(critic, &states, &actions);
        let loss = (values - targets).square().sum_dim_intlist(1, false, None).mean(None) * 0.5;
        let critic_loss = loss.double_value(&[]);
        let critic_gradient = critic.gradient(&loss);
        self.updates += 1;
        let improves = self.updates.is_multiple_of(self.section.policy_period);
        let policy_gradient = improves.then(|| {
            let actions = self.policy.output(policy, &observations).tanh();
            let first = self.critic.forward(critic, &states, &actions).narrow(1, 0, 1);
            policy.gradient(&-first.mean(None))
        });
        self.optimizers[1].step(self.learned[1].flat_mut(), &critic_gradient);
        if let Some(gradient) = policy_gradient {
            self.optimizers[0].step(self.learned[0].flat_mut(), &gradient);
            for (target, learned) in self.targets.iter_mut().zip(&self.learned) {
                target.follow(learned, self.section.target_rate);
            }
        }
        critic_loss
    }
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
        let mut native = Td3::new(&section, TOLD, seed, Isa::best());
        let mut reference = Reference::new(&section, seed);
        let (mut data, mut noise, mut same_noise) = (Noise::new(seed), Noise::new(9), Noise::new(9));
        let before = native.policy_parameters.values.clone();
        for number in 1..=40 {
            let transitions = Transitions::random(OBSERVATION, 50, &mut data).telling(TOLD.critic, &mut data);
            let found = native
                .update(&mut Team::new(1), transitions.columns(), &mut noise)
                .unwrap();
            let expected = reference.update(&transitions, &mut same_noise);
            let apart = (f64::from(found[0].1) - expected).abs();
            assert!(
                apart < 1e-4 * (1.0 + expected),
                "update {number}: {found:?}, not {expected}"
            );
        }
        let pairs = [
            (&native.policy_parameters.values, &reference.learned[0], 6e-3),
            (&native.critic_parameters.values, &reference.learned[1], 1.2e-2),
            (&native.target_policy, &reference.targets[0], 1e-3),
            (&native.target_critic, &reference.targets[1], 1e-3),
        ];
        for (found, expected, moved) in pairs {
            let expected = numbers(expected);
            let apart = found
                .iter()
                .zip(&expected)
                .map(|(found, expected)| (found - expected).abs());
            // Adam's steps are as large as its rate, however small a gradient; where one is nearly nothing, its sign is chance.
            let far = apart.filter(|apart| *apart > 0.05 * moved).count();
            assert!(far <= 2 + found.len() / 200, "{far} of {} are far off", found.len());
        }
        assert_ne!(before, native.policy_parameters.values, "the policy was never updated");
    }
}

#[test]
fn the_policy_and_the_targets_wait_for_their_turn() {
    let mut algorithm = td3(&section(), 1);
    let (mut data, mut noise) = (Noise::new(1), Noise::new(2));
    let mut step = |algorithm: &mut Td3| {
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
        let (mut data, mut noise, mut team) = (Noise::new(seed), Noise::new(seed + 1), Team::new(1));
        let mut algorithm = td3(&section, seed);
        let error = |algorithm: &Td3| {
            let asked = Transitions::guessing(OBSERVATION, 200, &mut Noise::new(77));
            let mut actions = vec![0.0; 400];
            algorithm.policy.forward_through(
                &mut Team::new(1),
                &algorithm.policy_parameters.values,
                &asked.observations,
                &mut actions,
            );
            let wanted = asked.observations.chunks(OBSERVATION).flat_map(|row| &row[..2]);
            let squares = actions
                .iter()
                .zip(wanted)
                .map(|(given, wanted)| (given.tanh() - wanted).powi(2));
            squares.sum::<f32>() / 400.0
        };
        let before = error(&algorithm);
        for _ in 0..1500 {
            let transitions = Transitions::guessing(OBSERVATION, 64, &mut data);
            algorithm.update(&mut team, transitions.columns(), &mut noise).unwrap();
        }
        let after = error(&algorithm);
        assert!(after < 0.15 * before, "seed {seed}: {before} to {after}");

        let mut resumed = td3(&section, seed + 10);
        resumed.load_named(&algorithm.named_tensors()).unwrap();
        let transitions = Transitions::guessing(OBSERVATION, 64, &mut data);
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
        let mut algorithm = Td3::new(&section(), Inputs::same(OBSERVATION), 1, isa);
        let (mut data, mut noise, mut team) = (Noise::new(1), Noise::new(2), Team::new(members));
        for _ in 0..4 {
            let transitions = Transitions::random(OBSERVATION, 37, &mut data);
            algorithm.update(&mut team, transitions.columns(), &mut noise).unwrap();
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
