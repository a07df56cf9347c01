//! Prints how long a VAE step and a SAC update take on this machine.
//!
//! `cargo run --release -p skein-learner --example update_times -- [THREADS]`

use std::time::Instant;

use skein_learner::device::use_threads;
use skein_learner::noise::Noise;
use skein_learner::sac::{Batch, Columns, Sac};
use skein_learner::vae::{TorchVae as Vae, images_from_bytes};
use skein_protocol::IMAGE_PIXELS;
use skein_protocol::config::{Observation, SacSection, VaeSection};
use tch::Device;

fn main() {
    let threads = std::env::args()
        .nth(1)
        .map_or(1, |argument| argument.parse().expect("THREADS is a number"));
    use_threads(threads);
    let mut noise = Noise::new(1);

    let section = SacSection::default();
    let observation = Observation::LatentVelocity;
    let mut draw = |count: usize| -> Vec<f32> { (0..count).map(|_| noise.uniform(1.0)).collect() };
    let rows = section.batch_size;
    let columns = [rows * observation.len(), rows * 2, rows, rows * observation.len()].map(&mut draw);
    let batch = || {
        let [observations, actions, rewards, next_observations] = &columns;
        Batch::new(
            Columns {
                observations,
                actions,
                rewards,
                next_observations,
                terminated: &vec![0.0; rows],
            },
            Device::Cpu,
        )
    };
    let mut sac = Sac::new(&section, observation, 1, Device::Cpu);
    let mut sac_noise = Noise::new(2);
    report("SAC update", section.batch_size, 300, || {
        sac.update(&batch(), &mut sac_noise).expect("random rewards are finite");
    });

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

/// Runs `work` a few times to warm up, then `repetitions` times; prints the median, which a busy machine disturbs least.
fn report(what: &str, batch: usize, repetitions: usize, mut work: impl FnMut()) {
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
}
