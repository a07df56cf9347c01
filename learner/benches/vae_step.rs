//! A VAE step, batch 16, on one thread: native, and on libtorch with automatic gradients.

use criterion::{Criterion, Throughput};
use skein_learner::device::use_threads;
use skein_learner::noise::Noise;
use skein_learner::vae::{NativeVae, TorchVae, images_from_bytes};
use skein_protocol::IMAGE_PIXELS;
use skein_protocol::config::VaeSection;
use tch::Device;

/// Images per batch, as in `one-course.toml`.
const BATCH: usize = 16;

fn main() {
    let mut criterion = Criterion::default().configure_from_args();
    use_threads(1);
    let section = VaeSection::default();
    let mut noise = Noise::new(1);
    let images: Vec<u8> = (0..BATCH * IMAGE_PIXELS)
        .map(|_| (127.0 * noise.uniform(1.0) + 128.0) as u8)
        .collect();
    let mut native = NativeVae::new(&section, 1, 1);
    let mut torch = TorchVae::new(&section, 1, Device::Cpu);
    let of_an_image: f64 = native.operations().as_flattened().iter().sum();

    let mut group = criterion.benchmark_group("vae_step");
    group.throughput(Throughput::Elements(of_an_image as u64 * BATCH as u64));
    group.bench_function("native", |bencher| {
        bencher.iter(|| {
            native
                .update(&images, &mut noise)
                .expect("images are finite")
        });
    });
    group.bench_function("libtorch", |bencher| {
        bencher.iter(|| {
            torch
                .update(&images_from_bytes(&images), &mut noise)
                .expect("images are finite")
        });
    });
    group.finish();
    criterion.final_summary();
}
