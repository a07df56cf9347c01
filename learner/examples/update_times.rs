//! Prints how long a VAE step and a SAC update take on this machine, on both engines, and how near that is to what its cores can do.
//!
//! `cargo run --release -p skein-learner --example update_times -- [THREADS] [sac|vae]`

use std::time::Instant;

use skein_kernels::{Isa, Team, peak_flops};
use skein_learner::device::use_threads;
use skein_learner::noise::Noise;
use skein_learner::sac::{Columns, Sac};
use skein_learner::vae::{LAYERS, NativeVae, TorchVae, images_from_bytes};
use skein_protocol::IMAGE_PIXELS;
use skein_protocol::config::{Engine, Observation, SacSection, VaeSection};
use tch::Device;

fn main() {
    let threads = std::env::args()
        .nth(1)
        .map_or(1, |argument| argument.parse().expect("THREADS is a number"));
    let which = std::env::args().nth(2);
    let wanted = |what: &str| which.as_deref().is_none_or(|which| which == what);
    use_threads(threads);
    let isa = Isa::best();
    let peak = peak_flops(isa) * threads as f64;
    println!("{isa}, peak of {threads} threads: {:.1} GFLOP/s", peak / 1e9);
    if wanted("sac") {
        sac(threads, peak);
    }
    if wanted("vae") {
        for batch in [32, 16] {
            vae(batch, threads, peak);
        }
    }
}

fn sac(threads: usize, peak: f64) {
    let mut noise = Noise::new(1);
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
    let mut team = Team::new(threads);
    for engine in [Engine::Libtorch, Engine::Native] {
        let mut sac = Sac::new(&section, observation, 1, engine, Device::Cpu);
        let mut sac_noise = Noise::new(2);
        let millis = report(&format!("SAC update, {engine}"), rows, 250, || {
            sac.update(&mut team, columns, &mut sac_noise)
                .expect("random rewards are finite");
        });
        let operations = update_operations(rows, observation.len(), section.hidden_width);
        println!(
            "  {:.1} MFLOP, {:.1} GFLOP/s: {:.1} % of {threads} cores",
            operations / 1e6,
            operations / millis / 1e6,
            100.0 * operations / (millis * 1e-3 * peak)
        );
    }
}

fn vae(batch: usize, threads: usize, peak: f64) {
    const STEPS: usize = 10;
    let mut noise = Noise::new(1);
    let section = VaeSection::default();
    let bytes: Vec<u8> = (0..batch * IMAGE_PIXELS)
        .map(|_| (127.0 * noise.uniform(1.0) + 128.0) as u8)
        .collect();
    let (mut native, mut torch) = (
        NativeVae::new(&section, 1, threads),
        TorchVae::new(&section, 1, Device::Cpu),
    );
    let mut spent = None;
    let mut vae_noise = Noise::new(3);
    let native_millis = report("VAE step, native", batch, STEPS, || {
        if spent.is_none() {
            let _ = native.take_spent();
        }
        native.update(&bytes, &mut vae_noise).expect("images are finite");
        spent = Some(native.take_spent());
    });
    let torch_millis = report("VAE step, libtorch", batch, STEPS / 2, || {
        torch
            .update(&images_from_bytes(&bytes), &mut vae_noise)
            .expect("images are finite");
    });
    let operations = native.operations();
    let share_of_peak = |millis: f64| {
        let all: f64 = operations.as_flattened().iter().sum();
        100.0 * all * batch as f64 / (millis * 1e-3 * peak)
    };
    println!(
        "  native {:.1} % of peak, libtorch {:.1} %; {:.2} times as fast",
        share_of_peak(native_millis),
        share_of_peak(torch_millis),
        torch_millis / native_millis
    );
    let spent = spent.expect("steps were done");
    let scale = 1.0 / threads as f64;
    println!("  of the last step, ms by layer (% of peak): forward, backward, gradient");
    for ((name, secs), operations) in LAYERS.iter().zip(spent.layers).zip(operations) {
        let cells = secs.iter().zip(operations).map(|(secs, operations)| {
            let share = 100.0 * operations * batch as f64 / (secs * peak * scale);
            format!("{:8.2} ({share:4.1})", secs * 1e3 * scale)
        });
        println!("    {name:<15}{}", cells.collect::<String>());
    }
    println!(
        "    Adam and packing {:.2}, rest {:.2}, total {:.2}",
        spent.adam_and_packing * 1e3 * scale,
        spent.rest * 1e3 * scale,
        spent.total() * 1e3 * scale
    );
    report("VAE encode, native", batch, 20, || {
        let _ = native.encode(&bytes);
    });
    let images = images_from_bytes(&bytes);
    report("VAE encode, libtorch", batch, 20, || {
        let _ = torch.encode(&images);
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

/// Runs `work` a few times to warm up, then `repetitions` times; prints and returns the median, which a busy machine disturbs least.
fn report(what: &str, batch: usize, repetitions: usize, mut work: impl FnMut()) -> f64 {
    let warm_up = repetitions / 5 + 1;
    let mut millis: Vec<f64> = (0..repetitions + warm_up)
        .map(|_| {
            let start = Instant::now();
            work();
            start.elapsed().as_secs_f64() * 1e3
        })
        .skip(warm_up)
        .collect();
    millis.sort_by(f64::total_cmp);
    println!(
        "{what}, batch {batch}: median {:.2} ms, best {:.2} ms",
        millis[repetitions / 2],
        millis[0]
    );
    millis[repetitions / 2]
}
