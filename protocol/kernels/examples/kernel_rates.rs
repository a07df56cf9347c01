//! Prints the rate of each kernel as a share of the core's peak.
//!
//! `cargo run --release -p skein-kernels --example kernel_rates`

use skein_kernels::*;
use std::time::Instant;

fn best(mut work: impl FnMut()) -> f64 {
    let mut best = f64::INFINITY;
    let begun = Instant::now();
    while begun.elapsed().as_secs_f64() < 0.4 {
        let start = Instant::now();
        work();
        best = best.min(start.elapsed().as_secs_f64());
    }
    best
}

/// Pseudo-random numbers in [-1, 1). A processor that multiplies the same number again and again
/// draws less power, and may run faster than with real data.
fn noise(len: usize) -> Vec<f32> {
    let mut state = 0x9e37_79b9_7f4a_7c15_u64;
    let next = || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 40) as f32 / (1 << 23) as f32 - 1.0
    };
    std::iter::repeat_with(next).take(len).collect()
}

fn main() {
    let isa = Isa::best();
    let peak = peak_flops(isa);
    println!("{isa}, peak {:.1} GFLOP/s", peak / 1e9);
    let report = |what: &str, flops: f64, secs: f64| {
        println!(
            "{what:<40} {:>9.1} us {:>6.1} GFLOP/s {:>5.1} %",
            secs * 1e6,
            flops / secs / 1e9,
            100.0 * flops / secs / peak
        );
    };
    for (m, k, n) in [
        (256, 256, 256),
        (512, 256, 256),
        (512, 34, 256),
        (512, 256, 4),
        (1, 256, 256),
        (1, 3072, 32),
        (12, 2048, 256),
        (96, 1024, 4480),
        (2046, 32, 48),
        (392, 64, 1792),
    ] {
        let (a, b) = (noise(m * k), noise(k * n));
        let mut c = vec![0.0; m * n];
        let panels = Panels::of(isa, Matrix::of_rows(&b, n));
        let bias = vec![0.1; n];
        report(
            &format!("product {m}x{k}x{n}"),
            (2 * m * k * n) as f64,
            best(|| {
                product(
                    Rows::Matrix(&a),
                    &panels,
                    Start::Bias(&bias),
                    Finish::Rectified,
                    &mut c,
                )
            }),
        );
        let mut panels = Panels::new(isa);
        report(
            "  pack",
            (2 * m * k * n) as f64,
            best(|| panels.pack(Matrix::of_rows(&b, n))),
        );
        report(
            "  pack transposed",
            (2 * m * k * n) as f64,
            best(|| panels.pack(Matrix::of_rows(&b, k).transposed())),
        );
        let mut team = Team::new(1);
        let d = noise(m * n);
        let mut g = vec![0.0; n * k];
        report(
            "  gradient",
            (2 * m * k * n) as f64,
            best(|| {
                gradient(
                    &mut team,
                    isa,
                    Matrix::of_rows(&d, n),
                    Terms::Matrix(&a, k),
                    &mut g,
                )
            }),
        );
    }
    for (size, ch, kernel, out) in [
        ([72, 128], 1, [4, 4], 32),
        ([35, 63], 32, [4, 4], 64),
        ([16, 30], 64, [4, 4], 128),
        ([7, 14], 128, [4, 4], 256),
        ([14, 28], 64, [6, 8], 128),
        ([33, 62], 32, [7, 8], 64),
        ([72, 128], 1, [8, 6], 32),
    ] {
        let w = Windows::new(size, ch, kernel, 2);
        let img = noise(w.image_len());
        let b = noise(w.window_len() * out);
        let panels = Panels::of(isa, Matrix::of_rows(&b, w.window_len()).transposed());
        let mut c = noise(w.count() * out);
        let flops = (2 * w.count() * w.window_len() * out) as f64;
        report(
            &format!("convolution {size:?}x{ch} {kernel:?} to {out}"),
            flops,
            best(|| {
                product(
                    Rows::Windows(&w, &img),
                    &panels,
                    Start::Zero,
                    Finish::Rectified,
                    &mut c,
                )
            }),
        );
        let mut team = Team::new(1);
        let mut g = vec![0.0; b.len()];
        let imgs = noise(8 * img.len());
        let d = noise(8 * c.len());
        report(
            "  gradient of 8",
            8.0 * flops,
            best(|| {
                gradient(
                    &mut team,
                    isa,
                    Matrix::of_rows(&d, out),
                    Terms::Windows(&w, &imgs),
                    &mut g,
                )
            }),
        );
        let mut into = vec![0.0; w.image_len()];
        let panels = Panels::of(isa, Matrix::of_rows(&b, w.window_len()));
        let mut scratch = Vec::new();
        report(
            "  spread",
            flops,
            best(|| spread(&c, &panels, &w, &mut scratch, &mut into)),
        );
    }
}
