//! Inference of an actor, one image and one action at a time: native, and by libtorch, which only
//! the learner has. This benchmark is the only one that needs both.

use std::hint::black_box;

use criterion::{Criterion, Throughput};
use skein_inference::{Network, Scratch};
use skein_learner::algorithm::{Algorithm, Inputs};
use skein_learner::device::use_threads;
use skein_learner::sac::TorchSac;
use skein_learner::vae::{TorchVae, images_from_bytes};
use skein_protocol::config::{Config, Observation, ObservationLayout, SeenStep};
use skein_protocol::ids::PolicyVersion;
use skein_protocol::snapshot::{
    ENCODER_CHANNELS, ENCODER_FEATURES, ENCODER_KERNEL, Snapshot, SnapshotLayout,
};
use skein_protocol::{IMAGE_HEIGHT, IMAGE_PIXELS, IMAGE_WIDTH, LatentCode, MAX_ACTION, MAX_LATENT};
use tch::Device;

/// Settings of `one-course.toml`.
const OBSERVATION: Observation = Observation::LatentVelocity;
const STRIDE: usize = 2;

fn main() {
    let mut criterion = Criterion::default().configure_from_args();
    use_threads(1);
    let mut config = Config::default();
    config.learning.observation = OBSERVATION;
    let view = config.observation_layout();
    let vae = TorchVae::new(&config.vae, 1, Device::Cpu);
    let sac = TorchSac::new(&config.sac, Inputs::of(&config), 1, Device::Cpu);
    let layout = SnapshotLayout::of(&config);
    let mut values = vec![0.0; layout.values()];
    vae.publish(&mut values[layout.encoder()]);
    sac.publish(&mut values[layout.policy()]);
    let version = PolicyVersion(0);
    let snapshot = Snapshot { version, values };

    let image: [u8; IMAGE_PIXELS] = std::array::from_fn(|pixel| (pixel * 7) as u8);
    let mut observation = vec![0.0; view.len()];
    let mut observe = |latent: LatentCode| {
        let step = SeenStep {
            latent: &latent,
            velocity_mps: &[1.0, 0.1, 0.1],
            orientation: &[0.0, 0.0, 0.0, 1.0],
            goal_m: &[30.0, 0.0, 0.0],
            previous_action: &[0.0; MAX_ACTION],
        };
        view.write_step(&step, &mut observation);
        observation.clone()
    };
    let mut group = criterion.benchmark_group("encoder_policy");
    group.throughput(Throughput::Elements(operations(
        &view,
        config.sac.hidden_width,
    )));
    let network = Network::new(&snapshot, &layout);
    group.bench_function("native", |bencher| {
        let mut scratch = Scratch::default();
        bencher.iter(|| {
            let latent = network.encode(black_box(&image), &mut scratch);
            black_box(network.distribution(&observe(latent), &mut scratch).mode())
        });
    });
    group.bench_function("libtorch", |bencher| {
        bencher.iter(|| {
            let mut latent = [0.0; MAX_LATENT];
            vae.encode(&images_from_bytes(black_box(&image)))
                .copy_data(&mut latent, view.latent);
            black_box(sac.mode(&observe(latent)))
        });
    });
    group.finish();
    criterion.final_summary();
}

/// Returns the floating-point operations of the matrix products of both networks. A multiplication
/// and an addition count as two; nothing else counts.
fn operations(layout: &ObservationLayout, width: usize) -> u64 {
    let mut size = [IMAGE_HEIGHT, IMAGE_WIDTH];
    let mut products = 0;
    for channels in ENCODER_CHANNELS.windows(2) {
        size = size.map(|length| (length - ENCODER_KERNEL) / STRIDE + 1);
        products += size[0] * size[1] * ENCODER_KERNEL * ENCODER_KERNEL * channels[0] * channels[1];
    }
    products += ENCODER_FEATURES * layout.latent;
    products += layout.len() * width + 2 * width * width + width * 2 * layout.action.numbers();
    2 * products as u64
}
