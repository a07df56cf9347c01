//! Prints the time of a VAE step on this machine, on both engines, by layer, and relative to the
//! peak of its cores.
//!
//! `cargo run --release -p skein-learner --example vae_step_times -- [THREADS]`

use std::time::Instant;

use skein_kernels::{Isa, peak_flops};
use skein_learner::device::use_threads;
use skein_learner::noise::Noise;
use skein_learner::vae::{LAYERS, NativeVae, TorchVae, images_from_bytes};
use skein_protocol::IMAGE_PIXELS;
use skein_protocol::config::VaeSection;
use tch::Device;

fn main() {
    let threads = std::env::args()
        .nth(1)
        .map_or(1, |argument| argument.parse().expect("THREADS is a number"));
    use_threads(threads);
    let isa = Isa::best();
    let peak = peak_flops(isa) * threads as f64;
    println!(
        "{isa}, peak of {threads} threads: {:.1} GFLOP/s",
        peak / 1e9
    );
    for batch in [32, 16] {
        vae(batch, threads, peak);
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
    let mut times = None;
    let mut vae_noise = Noise::new(3);
    let native_millis = report("VAE step, native", batch, STEPS, || {
        if times.is_none() {
            let _ = native.take_times();
        }
        native
            .update(&bytes, &mut vae_noise)
            .expect("images are finite");
        times = Some(native.take_times());
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
    let times = times.expect("steps were done");
    let scale = 1.0 / threads as f64;
    println!("  of the last step, ms by layer (% of peak): forward, backward, gradient");
    for ((name, secs), operations) in LAYERS.iter().zip(times.layers).zip(operations) {
        let cells = secs.iter().zip(operations).map(|(secs, operations)| {
            let share = 100.0 * operations * batch as f64 / (secs * peak * scale);
            format!("{:8.2} ({share:4.1})", secs * 1e3 * scale)
        });
        println!("    {name:<15}{}", cells.collect::<String>());
    }
    println!(
        "    Adam and packing {:.2}, rest {:.2}, total {:.2}",
        times.adam_and_packing * 1e3 * scale,
        times.rest * 1e3 * scale,
        times.total() * 1e3 * scale
    );
    report("VAE encode, native", batch, 20, || {
        let _ = native.encode(&bytes);
    });
    let images = images_from_bytes(&bytes);
    report("VAE encode, libtorch", batch, 20, || {
        let _ = torch.encode(&images);
    });
}

/// Runs `work` a few times to warm up, then `repetitions` times. Prints and returns the median,
/// which a busy machine disturbs least.
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
