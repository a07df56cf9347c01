//! Which loss moves the encoder, and that images are learned from.

use skein_kernels::Team;
use skein_protocol::IMAGE_PIXELS;
use skein_protocol::config::{AlgorithmName, Config, EncoderTraining, Observation};
use skein_protocol::snapshot::SnapshotLayout;
use tch::Device;

use super::*;
use crate::algorithm::{Algorithm, Inputs};
use crate::error::UpdateError;
use crate::metrics::Scalar;
use crate::noise::Noise;
use crate::sac::samples::{Transitions, shade};
use crate::state::TensorValues;
use crate::trainer::new_algorithm;

const ALGORITHMS: [AlgorithmName; 2] = [AlgorithmName::Sac, AlgorithmName::Td3];
/// Length of the latent code.
const LATENT: usize = 16;
/// Width of an observation: velocity beside the code.
const OBSERVATION: usize = LATENT + 2;

fn config(algorithm: AlgorithmName) -> Config {
    let mut config = Config::default();
    config.learning.algorithm = algorithm;
    config.learning.encoder = EncoderTraining::EndToEnd;
    config.learning.observation = Observation::LatentVelocity;
    config.vae.latent = LATENT;
    config.sac.hidden_width = 32;
    config.td3.hidden_width = 32;
    config.td3.policy_period = 1;
    config
}

fn new(config: &Config) -> Box<dyn Algorithm> {
    crate::device::use_threads(1);
    new_algorithm(config, Device::Cpu)
}

fn update(
    algorithm: &mut dyn Algorithm,
    seen: &Transitions,
    noise: &mut Noise,
) -> Result<(), UpdateError> {
    algorithm
        .update(&mut Team::new(1), seen.columns(), noise)
        .map(|_| ())
}

/// Transitions of which most are not terminal, so that the next state matters.
fn random(rows: usize, seed: u64) -> Transitions {
    let mut noise = Noise::new(seed);
    let mut draw = || {
        (0..rows * IMAGE_PIXELS)
            .map(|_| shade(noise.uniform(1.0)))
            .collect()
    };
    let images = Some([draw(), draw()]);
    Transitions {
        images,
        ..Transitions::random(OBSERVATION, rows, &mut noise)
    }
}

/// The parameters under this name.
fn part(algorithm: &mut dyn Algorithm, name: &str) -> Vec<f32> {
    let parts = algorithm.named_tensors();
    let part = parts.into_iter().find(|part| part.name.ends_with(name));
    match part.unwrap().values {
        TensorValues::F32(values) => values,
        other => panic!("{other:?}"),
    }
}

fn encoder_of(algorithm: &dyn Algorithm, config: &Config) -> Vec<f32> {
    let mut values = vec![f32::NAN; SnapshotLayout::of(config).encoder().len()];
    algorithm.publish_encoder(&mut values);
    values
}

#[test]
fn the_critics_loss_moves_every_tensor_of_the_encoder_and_its_target_follows() {
    let targets = ["sac.target.parameters", "td3.target_critic.parameters"];
    for (name, target) in ALGORITHMS.into_iter().zip(targets) {
        let config = config(name);
        let (layout, mut algorithm) = (SnapshotLayout::of(&config), new(&config));
        let encoder = layout.encoder();
        let (before, target_before) = (
            encoder_of(&*algorithm, &config),
            part(&mut *algorithm, target)[encoder.clone()].to_vec(),
        );
        assert_eq!(
            before, target_before,
            "the target begins where the critic does"
        );
        update(&mut *algorithm, &random(6, 1), &mut Noise::new(2)).unwrap();
        let after = encoder_of(&*algorithm, &config);
        let target_after = &part(&mut *algorithm, target)[encoder.clone()];
        for tensor in layout
            .tensors()
            .iter()
            .filter(|tensor| tensor.range.end <= encoder.end)
        {
            let moved = |before: &[f32], after: &[f32]| {
                let pairs = before[tensor.range.clone()]
                    .iter()
                    .zip(&after[tensor.range.clone()]);
                pairs
                    .map(|(before, after)| (after - before).abs())
                    .fold(0.0, f32::max)
            };
            let (learned, followed) = (moved(&before, &after), moved(&target_before, target_after));
            // Adam's first step is as long as its rate; the target moves by a small fraction of
            // that.
            assert!(learned > 1e-4, "{name}: {} stood still", tensor.name);
            assert!(
                followed > 0.0 && followed < 0.02 * learned,
                "{name}: the target of {} moved by {followed}",
                tensor.name
            );
        }
    }
}

#[test]
fn the_policys_loss_moves_the_policy_and_leaves_the_encoder_alone() {
    for name in ALGORITHMS {
        // A step this small is lost in rounding: it switches a loss off.
        let none = 1e-30;
        let after = |set: fn(&mut Config, f64), rate: f64| {
            let mut config = config(name);
            set(&mut config, rate);
            let mut algorithm = new(&config);
            let before = (
                encoder_of(&*algorithm, &config),
                part(&mut *algorithm, "policy.parameters"),
            );
            for number in 0..2 {
                update(&mut *algorithm, &random(6, number), &mut Noise::new(2)).unwrap();
            }
            let after = (
                encoder_of(&*algorithm, &config),
                part(&mut *algorithm, "policy.parameters"),
            );
            [before.0 != after.0, before.1 != after.1]
        };
        let without_critic = |config: &mut Config, rate| {
            (
                config.sac.critic_learning_rate,
                config.td3.critic_learning_rate,
            ) = (rate, rate);
        };
        let without_policy = |config: &mut Config, rate| {
            (
                config.sac.policy_learning_rate,
                config.td3.policy_learning_rate,
            ) = (rate, rate);
        };
        assert_eq!(
            after(without_critic, none),
            [false, true],
            "{name}: the policy's loss"
        );
        assert_eq!(
            after(without_policy, none),
            [true, false],
            "{name}: the critic's loss"
        );
    }
}

#[test]
fn policy_inputs_carry_no_gradient_and_critic_inputs_do() {
    crate::device::use_threads(1);
    let mut layout = Layout::default();
    let perception = Perception::describe(&mut layout, LATENT);
    let critic = Parameters::initialise(layout.clone(), 1, Device::Cpu);
    let target = Parameters::initialise(layout, 2, Device::Cpu);
    let seen = random(3, 1);
    let inputs = Inputs {
        from_image: Some(LATENT),
        ..Inputs::same(OBSERVATION)
    };
    for ahead in [NextStateEncoder::Learned, NextStateEncoder::Target] {
        let mut batch = TensorBatch::new(seen.columns(), inputs, Device::Cpu);
        let (now, next) = (batch.observations.copy(), batch.next_observations.copy());
        perception.encode(&mut batch, &critic, &target, ahead);
        let carry = [
            &batch.states,
            &batch.observations,
            &batch.next_states,
            &batch.next_observations,
        ];
        assert_eq!(
            carry.map(Tensor::requires_grad),
            [true, false, false, false]
        );
        assert_eq!(
            batch.observations,
            batch.states.detach(),
            "both see the same"
        );
        assert_eq!(
            batch.next_observations == batch.next_states,
            ahead == NextStateEncoder::Target,
            "two encoders see two things"
        );
        for (seen, flown) in [
            (&batch.observations, &now),
            (&batch.next_observations, &next),
        ] {
            let beside = |all: &Tensor| all.narrow(1, LATENT as i64, 2);
            assert_eq!(beside(seen), beside(flown), "the velocity is as it was");
            assert_ne!(
                seen.narrow(1, 0, 1),
                flown.narrow(1, 0, 1),
                "the code is not the actor's"
            );
        }
    }
}

#[test]
fn latent_codes_from_the_flight_change_nothing() {
    for name in ALGORITHMS {
        let learned = |code: f32| {
            let mut seen = random(4, 1);
            for observations in [&mut seen.observations, &mut seen.next_observations] {
                for row in observations.chunks_exact_mut(OBSERVATION) {
                    row[..LATENT].fill(code);
                }
            }
            let mut algorithm = new(&config(name));
            update(&mut *algorithm, &seen, &mut Noise::new(2)).unwrap();
            algorithm.named_tensors()
        };
        assert!(learned(0.0) == learned(9.0), "{name}");
    }
}

#[test]
fn a_restored_algorithm_continues_bit_for_bit() {
    for name in ALGORITHMS {
        let config = config(name);
        let mut algorithm = new(&config);
        update(&mut *algorithm, &random(4, 1), &mut Noise::new(1)).unwrap();
        let mut other = config.clone();
        other.run.seed += 1;
        let mut resumed = new(&other);
        resumed.load_named(&algorithm.named_tensors()).unwrap();
        for algorithm in [&mut algorithm, &mut resumed] {
            update(&mut **algorithm, &random(4, 2), &mut Noise::new(2)).unwrap();
        }
        assert!(
            algorithm.named_tensors() == resumed.named_tensors(),
            "{name}"
        );
        assert_eq!(
            encoder_of(&*algorithm, &config),
            encoder_of(&*resumed, &config)
        );
        let mut fresh = new(&other);
        update(&mut *fresh, &random(4, 2), &mut Noise::new(2)).unwrap();
        assert!(
            fresh.named_tensors() != algorithm.named_tensors(),
            "{name}: nothing was compared"
        );
    }
}

#[test]
fn an_update_that_is_not_finite_changes_nothing() {
    for name in ALGORITHMS {
        let mut algorithm = new(&config(name));
        let mut seen = random(4, 1);
        seen.rewards[2] = f32::NAN;
        let before = algorithm.named_tensors();
        let UpdateError::NonFinite { tensor, update } =
            update(&mut *algorithm, &seen, &mut Noise::new(1)).unwrap_err();
        assert_eq!((tensor, update), ("critic loss", 1), "{name}");
        assert!(algorithm.named_tensors() == before, "{name}");
    }
}

#[test]
#[should_panic(expected = "two images for each transition")]
fn a_minibatch_without_images_is_a_mistake() {
    let seen = Transitions::random(OBSERVATION, 3, &mut Noise::new(1));
    let _ = update(
        &mut *new(&config(AlgorithmName::Sac)),
        &seen,
        &mut Noise::new(1),
    );
}

#[test]
fn a_reward_that_only_the_image_shows_is_learned() {
    for name in ALGORITHMS {
        let mut config = config(name);
        (
            config.sac.critic_learning_rate,
            config.td3.critic_learning_rate,
        ) = (1e-3, 1e-3);
        let mut algorithm = new(&config);
        let (mut data, mut noise) = (Noise::new(1), Noise::new(2));
        let losses: Vec<f32> = (0..120)
            .map(|_| {
                let seen = Transitions::one_step_task_in_images(OBSERVATION, 8, &mut data);
                let metrics = algorithm
                    .update(&mut Team::new(1), seen.columns(), &mut noise)
                    .unwrap();
                let loss = metrics
                    .iter()
                    .find(|(scalar, _)| *scalar == Scalar::CriticLoss);
                loss.unwrap().1
            })
            .collect();
        let mean = |losses: &[f32]| losses.iter().sum::<f32>() / losses.len() as f32;
        let (before, after) = (mean(&losses[..5]), mean(&losses[110..]));
        assert!(
            after < 0.2 * before,
            "{name}: the critic's loss went from {before} to {after}"
        );
    }
}

/// Prints the processor time of an update: `cargo test --release -p skein-learner -- --ignored
/// --nocapture update_from_64_images`.
#[test]
#[ignore = "a measurement, not a claim"]
fn time_of_an_update_from_64_images() {
    const UPDATES: usize = 20;
    for name in ALGORITHMS {
        let mut config = config(name);
        (
            config.sac.hidden_width,
            config.td3.hidden_width,
            config.td3.policy_period,
        ) = (256, 256, 2);
        let (mut algorithm, seen, mut noise) = (new(&config), random(64, 1), Noise::new(2));
        let spent = || crate::threads::cpu_secs().values().sum::<f64>();
        let before = spent();
        for _ in 0..UPDATES {
            update(&mut *algorithm, &seen, &mut noise).unwrap();
        }
        println!(
            "{name}: {:.0} ms",
            (spent() - before) / UPDATES as f64 * 1e3
        );
    }
}
