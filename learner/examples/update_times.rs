//! Prints how long a VAE step and a SAC update take on this machine, the latter on both engines and as a share of what the processor can do at most.
//!
//! `cargo run --release -p skein-learner --example update_times -- [THREADS]`

use std::time::Instant;

use skein_kernels::{Isa, Team, peak_flops};
use skein_learner::device::use_threads;
use skein_learner::noise::Noise;
use skein_learner::sac::{Columns, Sac};
use skein_learner::vae::{Vae, images_from_bytes};
use skein_protocol::IMAGE_PIXELS;
use skein_protocol::config::{Engine, Observation, SacSection, VaeSection};
use tch::Device;

fn main() {
    let threads = std::env::args()
        .nth(1)
        .map_or(1, |argument| argument.parse().expect("THREADS is a number"));
    use_threads(threads);
    let mut team = Team::new(threads);
    let mut noise = Noise::new(1);
    let isa = Isa::best();
    let peak = peak_flops(isa);
    println!("{isa}: at most {:.1} GFLOP/s a core; {threads} threads", peak / 1e9);

    let section = SacSection::default();
    let observation = Observation::LatentVelocity;
    let mut draw = |count: usize| -> Vec<f32> { (0..count).map(|_| noise.uniform(1.0)).collect() };
    let rows = section.batch_size;
    let columns = [rows * observation.len(), rows * 2, rows, rows * observation.len()].map(&mut draw);
    let [observations, actions, rewards, next_observations] = &columns;
    let columns = Columns {
        observations,
        actions,
        rewards,
        next_observations,
        terminated: &vec![0.0; rows],
    };
    for engine in [Engine::Libtorch, Engine::Native] {
        let mut sac = Sac::new(&section, observation, 1, engine, Device::Cpu);
        let mut sac_noise = Noise::new(2);
        let secs = report(&format!("SAC update, {engine}"), rows, 250, || {
            sac.update(&mut team, columns, &mut sac_noise)
                .expect("random rewards are finite");
        });
        let operations = update_operations(rows, observation.len(), section.hidden_width);
        println!(
            "  {:.1} MFLOP, {:.1} GFLOP/s: {:.1} % of {threads} cores",
            operations / 1e6,
            operations / secs / 1e9,
            100.0 * operations / secs / peak / threads as f64
        );
    }

    let section = VaeSection::default();
    let bytes: Vec<u8> = draw(section.batch_size * IMAGE_PIXELS)
        .iter()
        .map(|unit| (127.0 * unit + 128.0) as u8)
        .collect();
    let mut vae = Vae::new(&section, 1, Device::Cpu);
    let mut vae_noise = Noise::new(3);
    report("VAE step", section.batch_size, 10, || {
        vae.update(&images_from_bytes(&bytes), &mut vae_noise)
            .expect("images are finite");
    });
    let images = images_from_bytes(&bytes);
    report("VAE encode", section.batch_size, 20, || {
        let _ = vae.encode(&images);
    });
}

/// Floating-point operations that the products of one update cannot do without, a multiplication and an addition counted as two; nothing else is counted.
fn update_operations(rows: usize, observation: usize, width: usize) -> f64 {
    let (action, estimates) = (2, 2);
    // Weights: the layers of the policy, and those of the critic.
    let policy_first = observation * width;
    let policy_rest = 2 * width * width + width * 2 * action;
    let critic_first = (observation + action) * width;
    let critic_rest = width * width + width * estimates;
    let forward = 2 * (policy_first + policy_rest) + 3 * (critic_first + critic_rest);
    // Gradients of all weights; what flows back through all layers but the first ones, and through the critic once more, to the action only.
    let gradients = policy_first + policy_rest + critic_first + critic_rest;
    let back = policy_rest + 2 * critic_rest + width * action;
    (2 * rows * (forward + gradients + back)) as f64
}

/// Runs `work` a few times to warm up, then `repetitions` times; prints and returns the median, in seconds, which a busy machine disturbs least.
fn report(what: &str, batch: usize, repetitions: usize, mut work: impl FnMut()) -> f64 {
    let mut millis: Vec<f64> = (0..repetitions + repetitions / 5)
        .map(|_| {
            let start = Instant::now();
            work();
            start.elapsed().as_secs_f64() * 1e3
        })
        .skip(repetitions / 5)
        .collect();
    millis.sort_by(f64::total_cmp);
    println!(
        "{what}, batch {batch}: median {:.2} ms, best {:.2} ms",
        millis[repetitions / 2],
        millis[0]
    );
    millis[repetitions / 2] / 1e3
}
