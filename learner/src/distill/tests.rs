//! Tests: the update learns the teacher's actions, keeps the exploration, and is exact.

use skein_protocol::LOG_STD;

use super::*;
use crate::sac::samples::Transitions;

const OBSERVATION: usize = 32;

fn distill(seed: u64) -> Distill {
    let section = DistillSection {
        hidden_width: 32,
        exploration: 0.25,
        learning_rate: 3e-3,
        ..DistillSection::default()
    };
    Distill::new(&section, Inputs::same(OBSERVATION), seed, Isa::best())
}

fn train(distill: &mut Distill, team: &mut Team, updates: usize) -> Vec<f32> {
    let (mut data, mut unused) = (Noise::new(5), Noise::new(6));
    let mut update = || {
        let taught = Transitions::one_step_task(OBSERVATION, 32, &mut data).with_teacher();
        let metrics = distill.update(team, taught.columns(), &mut unused).unwrap();
        assert_eq!(metrics[0].0, Scalar::TeacherDistance);
        metrics[0].1
    };
    (0..updates).map(|_| update()).collect()
}

#[test]
fn the_policy_learns_the_teachers_actions_and_keeps_its_exploration() {
    for seed in [1, 2, 3] {
        let mut distill = distill(seed);
        let distances = train(&mut distill, &mut Team::new(1), 600);
        let (first, last) = (distances[0], distances[distances.len() - 1]);
        assert!(last < 0.05 * first, "seed {seed}: {first} to {last}");
        let seen = Transitions::one_step_task(OBSERVATION, 32, &mut Noise::new(9));
        let mut outputs = vec![0.0; 32 * 4];
        let parameters = &distill.parameters.values;
        let team = &mut Team::new(1);
        distill
            .policy
            .forward_through(team, parameters, &seen.observations, &mut outputs);
        for output in outputs.chunks_exact(4) {
            for log_std in &output[2..] {
                assert!((LOG_STD.0..=LOG_STD.1).contains(log_std));
                assert!((log_std.exp() - 0.25).abs() < 0.05, "{log_std}");
            }
        }
    }
}

#[test]
fn threads_do_not_change_a_bit_and_a_restored_policy_continues() {
    let (mut one, mut other) = (distill(1), distill(1));
    train(&mut one, &mut Team::new(1), 10);
    train(&mut other, &mut Team::new(2), 10);
    assert_eq!(one.named_tensors(), other.named_tensors());
    let mut restored = distill(77);
    restored.load_named(&one.named_tensors()).unwrap();
    assert_eq!(restored.updates(), 10);
    train(&mut one, &mut Team::new(1), 10);
    train(&mut restored, &mut Team::new(1), 10);
    assert_eq!(one.named_tensors(), restored.named_tensors());
}

#[test]
fn an_update_that_is_not_finite_changes_nothing() {
    let mut distill = distill(1);
    let before = distill.named_tensors();
    let mut taught = Transitions::one_step_task(OBSERVATION, 32, &mut Noise::new(1)).with_teacher();
    taught.teacher_actions.as_mut().unwrap()[3] = f32::NAN;
    let error = distill.update(&mut Team::new(1), taught.columns(), &mut Noise::new(1));
    let expected = UpdateError::NonFinite {
        tensor: "distance to the teacher",
        update: 1,
    };
    assert_eq!(error.unwrap_err(), expected);
    assert_eq!(before, distill.named_tensors());
}
