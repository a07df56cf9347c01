//! The actor's networks equal the learner's: the same parameters give the same numbers, to 1e-5
//! with libtorch and to the last bit with the native engine's encoder.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use skein_inference::{ActionDistribution, Network, Scratch};
use skein_kernels::Isa;
use skein_learner::algorithm::{Algorithm, Inputs};
use skein_learner::networks::{Layout, Parameters, PolicyNetwork};
use skein_learner::sac::{NativeSac, TorchSac};
use skein_learner::vae::{NativeVae, TorchVae as Vae, images_from_bytes};
use skein_protocol::IMAGE_PIXELS;
use skein_protocol::config::{Config, Observation};
use skein_protocol::ids::PolicyVersion;
use skein_protocol::snapshot::{Snapshot, SnapshotLayout};
use tch::{Device, Tensor};

const TOLERANCE: f32 = 1e-5;
const SEEDS: std::ops::Range<u64> = 0..3;
const OBSERVATIONS: [Observation; 3] = [
    Observation::Latent,
    Observation::LatentVelocity,
    Observation::LatentVelocityActionGoal,
];

fn config(observation: Observation) -> Config {
    let mut config = Config::default();
    config.learning.observation = observation;
    config
}

fn with_latent(latent: usize) -> Config {
    let mut config = config(Observation::Latent);
    config.vae.latent = latent;
    config
}

/// Returns the network that the learner would publish, with the policy's parameters written by
/// `policy`.
fn network(config: &Config, vae: &Vae, policy: impl Fn(&mut [f32])) -> Network {
    let layout = SnapshotLayout::of(config);
    let mut values = vec![0.0; layout.values()];
    vae.publish(&mut values[layout.encoder()]);
    policy(&mut values[layout.policy()]);
    Network::new(
        &Snapshot {
            version: PolicyVersion(0),
            values,
        },
        &layout,
    )
}

fn vae(config: &Config, seed: u64) -> Vae {
    Vae::new(&config.vae, seed, Device::Cpu)
}

fn rows(tensor: &Tensor) -> Vec<Vec<f32>> {
    tensor.try_into().unwrap()
}

fn assert_close(what: &str, native: &[f32], learner: &[f32]) {
    assert_eq!(native.len(), learner.len());
    for (index, (native, learner)) in native.iter().zip(learner).enumerate() {
        assert!(
            (native - learner).abs() <= TOLERANCE,
            "{what}[{index}]: native {native}, learner {learner}"
        );
    }
}

fn assert_alive(what: &str, values: &[f32]) {
    assert!(
        values.iter().any(|value| value.abs() > 1e-3),
        "{what} is all zeros, so the comparison shows nothing"
    );
}

fn gaussian(network: &Network, observed: &[f32]) -> [Vec<f32>; 2] {
    match network.distribution(observed, &mut Scratch::default()) {
        ActionDistribution::SquashedGaussian {
            numbers,
            mean,
            log_std,
        } => [mean, log_std].map(|values| values[..numbers].to_vec()),
        other => panic!("{other:?}"),
    }
}

#[test]
fn the_native_encoder_equals_the_learners() {
    for (seed, latent) in SEEDS.zip([32, 8, 64]) {
        let config = with_latent(latent);
        let vae = vae(&config, seed);
        let network = network(&config, &vae, |_| {});
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let mut images = vec![[0u8; IMAGE_PIXELS], [255; IMAGE_PIXELS]];
        images.extend((0..4).map(|_| std::array::from_fn(|_| rng.random())));
        let learner = rows(&vae.encode(&images_from_bytes(&images.concat())));
        let mut scratch = Scratch::default();
        for (image, learner) in images.iter().zip(&learner) {
            let native = &network.encode(image, &mut scratch)[..latent];
            assert_alive("latent", native);
            assert_close("latent", native, learner);
        }
    }
}

#[test]
fn the_native_policy_equals_the_learners() {
    for (seed, observation) in SEEDS.zip(OBSERVATIONS) {
        let config = config(observation);
        let mut layout = Layout::default();
        let policy = PolicyNetwork::describe(
            &mut layout,
            Inputs::of(&config),
            config.sac.hidden_width as i64,
        );
        let parameters = Parameters::initialise(layout, seed, Device::Cpu);
        let network = network(&config, &vae(&config, seed), |into| {
            parameters.copy_range(0..into.len(), into)
        });
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let observed: Vec<f32> = (0..config.observation_layout().len())
            .map(|_| rng.random_range(-3.0..3.0))
            .collect();
        let (mean, log_std) =
            policy.distribution(&parameters, &Tensor::from_slice(&observed).unsqueeze(0));
        let [native_mean, native_log_std] = gaussian(&network, &observed);
        assert_alive("mean", &native_mean);
        assert_alive("log_std", &native_log_std);
        assert_close("mean", &native_mean, &rows(&mean)[0]);
        assert_close("log_std", &native_log_std, &rows(&log_std)[0]);
    }
}

#[test]
fn both_bound_an_extreme_standard_deviation_alike() {
    let config = config(Observation::Latent);
    let mut layout = Layout::default();
    let policy = PolicyNetwork::describe(
        &mut layout,
        Inputs::of(&config),
        config.sac.hidden_width as i64,
    );
    let mut parameters = Parameters::initialise(layout, 0, Device::Cpu);
    // The last two values are the biases of the logarithms of the standard deviations.
    let count = parameters.layout().len();
    {
        let _guard = tch::no_grad_guard();
        let extremes = Tensor::from_slice(&[500.0f32, -500.0]);
        parameters
            .flat_mut()
            .narrow(0, count as i64 - 2, 2)
            .copy_(&extremes);
    }
    let network = network(&config, &vae(&config, 0), |into| {
        parameters.copy_range(0..into.len(), into)
    });
    let observed = vec![0.5; config.observation_layout().len()];
    let (_, log_std) =
        policy.distribution(&parameters, &Tensor::from_slice(&observed).unsqueeze(0));
    let [_, native_log_std] = gaussian(&network, &observed);
    assert_eq!(native_log_std, rows(&log_std)[0]);
}

#[test]
fn a_published_policy_acts_as_in_the_learner() {
    for observation in OBSERVATIONS {
        let config = config(observation);
        let (inputs, observed) = (
            Inputs::of(&config),
            vec![0.3; config.observation_layout().len()],
        );
        let flies_as = |sac: &dyn Algorithm, learner: &[f32]| {
            let network = network(&config, &vae(&config, 9), |into| sac.publish(into));
            let actor = network
                .distribution(&observed, &mut Scratch::default())
                .mode();
            let actor = &actor[..learner.len()];
            assert_alive("action", actor);
            assert_close("action", actor, learner);
        };
        let native = NativeSac::new(&config.sac, inputs, 9, Isa::best());
        flies_as(&native, &native.mode(&observed));
        let torch = TorchSac::new(&config.sac, inputs, 9, Device::Cpu);
        flies_as(&torch, &torch.mode(&observed));
    }
}

#[test]
fn the_native_engine_encodes_as_the_actor_does_bit_for_bit() {
    for latent in [32, 16, 64] {
        let config = with_latent(latent);
        let mut native = NativeVae::new(&config.vae, 3, 2);
        let torch = vae(&config, 3);
        let mut rng = Pcg64Mcg::seed_from_u64(3);
        let images: Vec<[u8; IMAGE_PIXELS]> = (0..3)
            .map(|_| std::array::from_fn(|_| rng.random()))
            .collect();
        let learner = native.encode(&images.concat());
        // Both engines start with the same parameters.
        let network = network(&config, &torch, |_| {});
        let mut scratch = Scratch::default();
        for (image, learner) in images.iter().zip(learner.chunks_exact(latent)) {
            let actor = network.encode(image, &mut scratch);
            assert_alive("latent", &actor);
            assert_eq!(actor[..latent], *learner);
        }
    }
}
