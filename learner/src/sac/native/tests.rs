//! Native against libtorch, number by number; neither threads nor instructions change a bit.

use skein_protocol::ActionSpace;
use skein_protocol::config::TeacherName;
use tch::Device;

use super::super::TorchSac;
use super::super::samples::Transitions;
use super::*;
use crate::state::{NamedTensor, TensorValues};

/// Widths of observation to test.
const OBSERVATIONS: [usize; 3] = [32, 34, 36];

fn section(hidden_width: usize) -> SacSection {
    SacSection {
        hidden_width,
        ..SacSection::default()
    }
}

/// Returns both engines before their first update.
fn both(section: &SacSection, inputs: Inputs, seed: u64) -> (NativeSac, TorchSac) {
    crate::device::use_threads(1);
    (
        NativeSac::new(section, inputs, seed, Isa::best()),
        TorchSac::new(section, inputs, seed, Device::Cpu),
    )
}

fn numbers(state: &mut impl Stateful) -> Vec<(String, Vec<f64>)> {
    let mut state = state.named_tensors();
    state.sort_by(|left, right| left.name.cmp(&right.name));
    let wide = |tensor: NamedTensor| {
        let values = match tensor.values {
            TensorValues::F32(values) => values.into_iter().map(f64::from).collect(),
            TensorValues::F64(values) => values,
            TensorValues::I64(values) => values.into_iter().map(|value| value as f64).collect(),
        };
        (tensor.name, values)
    };
    state.into_iter().map(wide).collect()
}

/// Largest difference between two vectors, relative to the largest number in `expected`.
fn distance(found: &[f64], expected: &[f64]) -> f64 {
    assert_eq!(found.len(), expected.len());
    let largest = |numbers: &mut dyn Iterator<Item = f64>| numbers.fold(0.0, f64::max);
    let apart = largest(
        &mut found
            .iter()
            .zip(expected)
            .map(|(left, right)| (left - right).abs()),
    );
    let size = largest(&mut expected.iter().map(|value| value.abs()));
    if apart == 0.0 { 0.0 } else { apart / size }
}

fn assert_metrics_are_close(
    found: &[(Scalar, f32)],
    expected: &[(Scalar, f32)],
    tolerance: f32,
    context: &str,
) {
    for ((scalar, found), (same, expected)) in found.iter().zip(expected) {
        assert_eq!(scalar, same);
        let apart = (found - expected).abs();
        assert!(
            apart <= tolerance * (1.0 + expected.abs()),
            "{context}: {scalar:?} {found} is not {expected}"
        );
    }
}

/// Updates both engines once from the same state. Adam's first moment is then a tenth of the
/// gradient.
fn assert_one_update_is_equal(
    native: &mut NativeSac,
    torch: &mut TorchSac,
    transitions: &Transitions,
    context: &str,
) {
    let noise = || Noise::new(9);
    let columns = transitions.columns();
    let found = native
        .update(&mut Team::new(1), columns, &mut noise())
        .unwrap();
    let expected = torch
        .update(&mut Team::new(1), columns, &mut noise())
        .unwrap();
    assert_metrics_are_close(&found, &expected, 2e-5, context);
    for ((name, found), (_, expected)) in numbers(native).iter().zip(&numbers(torch)) {
        let context = format!("{context}: {name}");
        if name.ends_with("parameters") || name.ends_with("log_temperature") {
            // A gradient near zero may differ in sign between the engines, and Adam's first step
            // depends on the sign alone.
            let apart = found
                .iter()
                .zip(expected)
                .map(|(found, expected)| (found - expected).abs());
            let largest = apart.clone().fold(0.0, f64::max);
            let far = apart.filter(|apart| *apart > 1e-6).count();
            assert!(
                largest < 6.1e-4 && far <= 2 + found.len() / 500,
                "{context}: {largest}, {far} of {}",
                found.len()
            );
        } else {
            let apart = distance(found, expected);
            assert!(apart < 2e-5, "{context}: off by {apart} of the largest");
        }
    }
}

#[test]
fn gradients_and_one_update_are_the_references() {
    // `critic_width`: width of the critic's own input, if it has one.
    for (number, ((observation, critic_width), action)) in OBSERVATIONS
        .into_iter()
        .zip([None, Some(5), Some(50)])
        .zip(ActionSpace::ALL)
        .enumerate()
    {
        let inputs = Inputs {
            critic: critic_width.unwrap_or(observation),
            action,
            ..Inputs::same(observation)
        };
        for (width, rows) in [
            (8, 1),
            (8, 33),
            (31, 7),
            (31, 8),
            (64, 50),
            (256, 256),
            (100, 201),
        ] {
            let seed = (number + rows) as u64;
            let section = SacSection {
                critic_networks: 1 + rows % 2,
                ..section(width)
            };
            let (mut native, mut torch) = both(&section, inputs, seed);
            let mut noise = Noise::new(seed);
            let mut transitions = Transitions::random_for(inputs, rows, &mut noise);
            if let Some(critic_width) = critic_width {
                transitions = transitions.with_critic_states(critic_width, &mut noise);
            }
            let context = format!(
                "{observation} seen, {action:?}, width {width}, {rows} rows, {} networks",
                section.critic_networks
            );
            assert_one_update_is_equal(&mut native, &mut torch, &transitions, &context);
        }
    }
}

#[test]
fn gradients_are_the_references_where_tanh_saturates_and_deviations_are_bounded() {
    let observation = 32;
    let (mut native, mut torch) = both(&section(16), Inputs::same(observation), 1);
    let mut stored = native.named_tensors();
    let policy = stored
        .iter_mut()
        .find(|tensor| tensor.name == "sac.policy.parameters")
        .unwrap();
    let TensorValues::F32(values) = &mut policy.values else {
        unreachable!("parameters are f32")
    };
    // The biases of the last layer, which end the vector: one mean far out, one log deviation above
    // its bound and one below.
    let len = values.len();
    values[len - 4..].copy_from_slice(&[12.0, -0.5, 2.5, -21.0]);
    native.load_named(&stored).unwrap();
    torch.load_named(&stored).unwrap();
    let transitions = Transitions::random(observation, 64, &mut Noise::new(1));
    assert_one_update_is_equal(&mut native, &mut torch, &transitions, "at the bounds");
}

#[test]
fn the_teachers_gradient_is_the_references_and_fades() {
    let teacher = TeacherSection {
        policy: TeacherName::Oracle,
        loss_weight: 5.0,
        loss_updates: 2,
        ..TeacherSection::default()
    };
    let inputs = Inputs::same(32);
    let (native, torch) = both(&section(64), inputs, 3);
    let (mut native, mut torch) = (native.with_teacher(&teacher), torch.with_teacher(&teacher));
    let mut noise = Noise::new(3);
    let taught = Transitions::random(32, 50, &mut noise).with_teacher();
    assert_one_update_is_equal(&mut native, &mut torch, &taught, "with a teacher");
    let metrics = native.update(&mut Team::new(1), taught.columns(), &mut Noise::new(9));
    assert_eq!(metrics.unwrap().last().unwrap().0, Scalar::TeacherDistance);
    // After the last of its updates, the teacher has no influence.
    let mut untaught = NativeSac::new(&section(64), inputs, 3, Isa::best());
    untaught.load_named(&native.named_tensors()).unwrap();
    for sac in [&mut native, &mut untaught] {
        sac.update(&mut Team::new(1), taught.columns(), &mut Noise::new(9))
            .unwrap();
    }
    assert_eq!(native.named_tensors(), untaught.named_tensors());
}

#[test]
fn a_hundred_updates_stay_close_to_the_references() {
    let observation = 34;
    for seed in 1..=3 {
        let (mut native, mut torch) = both(&section(64), Inputs::same(observation), seed);
        let (mut data, mut team) = (Noise::new(seed), Team::new(1));
        let (mut noise, mut same_noise) = (Noise::new(seed + 1), Noise::new(seed + 1));
        let before = numbers(&mut native);
        for number in 1..=100 {
            let transitions = Transitions::random(observation, 64, &mut data);
            let found = native
                .update(&mut team, transitions.columns(), &mut noise)
                .unwrap();
            let expected = torch
                .update(&mut team, transitions.columns(), &mut same_noise)
                .unwrap();
            assert_metrics_are_close(
                &found,
                &expected,
                1e-3,
                &format!("seed {seed}, update {number}"),
            );
        }
        let after = numbers(&mut native);
        for (((name, found), (_, expected)), (_, before)) in
            after.iter().zip(&numbers(&mut torch)).zip(&before)
        {
            if !name.ends_with("parameters") {
                continue;
            }
            let apart = |left: &[f64], right: &[f64]| {
                let squares = left
                    .iter()
                    .zip(right)
                    .map(|(left, right)| (left - right).powi(2));
                squares.sum::<f64>().sqrt()
            };
            let (off, moved) = (apart(found, expected), apart(found, before));
            assert!(
                off < 0.01 * moved,
                "seed {seed}: {name} moved by {moved}, and is off by {off}"
            );
        }
    }
}

#[test]
fn neither_threads_nor_instructions_change_a_bit() {
    let observation = 36;
    for (width, rows) in [(40, 131), (16, 5)] {
        let run = |isa: Isa, members: usize| {
            let mut sac = NativeSac::new(&section(width), Inputs::same(observation), 1, isa);
            let (mut data, mut noise, mut team) =
                (Noise::new(1), Noise::new(2), Team::new(members));
            let metrics: Vec<_> = (0..5)
                .map(|_| {
                    let transitions = Transitions::random(observation, rows, &mut data);
                    sac.update(&mut team, transitions.columns(), &mut noise)
                        .unwrap()
                })
                .collect();
            let mode = sac.mode(&Transitions::random(observation, 3, &mut data).observations);
            (metrics, mode, sac.named_tensors())
        };
        let expected = run(Isa::Portable, 1);
        for isa in Isa::ALL.into_iter().filter(|isa| isa.is_available()) {
            for members in 1..=4 {
                assert_eq!(
                    run(isa, members),
                    expected,
                    "{isa}, {members} members, {rows} rows"
                );
            }
        }
    }
}

#[test]
fn batches_of_changing_size_are_what_they_are_alone() {
    let observation = 32;
    let (mut team, section) = (Team::new(1), section(16));
    let large = Transitions::random(observation, 50, &mut Noise::new(1));
    let little = Transitions::random(observation, 3, &mut Noise::new(2));
    let mut sac = NativeSac::new(&section, Inputs::same(observation), 1, Isa::best());
    sac.update(&mut team, large.columns(), &mut Noise::new(3))
        .unwrap();
    let mut fresh = NativeSac::new(&section, Inputs::same(observation), 2, Isa::best());
    fresh.load_named(&sac.named_tensors()).unwrap();
    let run = |sac: &mut NativeSac, team: &mut Team| {
        sac.update(team, little.columns(), &mut Noise::new(4))
            .unwrap()
    };
    assert_eq!(run(&mut sac, &mut team), run(&mut fresh, &mut team));
    assert_eq!(sac.named_tensors(), fresh.named_tensors());
}

#[test]
#[should_panic(expected = "one row for each transition")]
fn columns_that_do_not_belong_together_are_refused() {
    let observation = 32;
    let mut transitions = Transitions::random(observation, 5, &mut Noise::new(1));
    transitions.next_observations.truncate(4 * observation);
    let mut sac = NativeSac::new(&section(8), Inputs::same(observation), 1, Isa::best());
    let _ = sac.update(&mut Team::new(1), transitions.columns(), &mut Noise::new(1));
}
