//! Time to encode an image as images grow: the encoder's four convolutions, one image at a time.
//!
//! The system's images have a fixed size. The kernels accept any, so the same layers can be
//! measured with others.

use std::hint::black_box;

use criterion::{BenchmarkId, Criterion, Throughput};
use skein_kernels::{Finish, Isa, Matrix, Panels, Rows, Start, Windows, product};

/// Channels before and after each convolution, as in the encoder.
const CHANNELS: [usize; 5] = [1, 32, 64, 128, 256];
const KERNEL: [usize; 2] = [4, 4];
const STRIDE: usize = 2;

struct Layer {
    windows: Windows,
    panels: Panels,
    bias: Vec<f32>,
    output: Vec<f32>,
}

fn main() {
    let mut criterion = Criterion::default().configure_from_args();
    let mut group = criterion.benchmark_group("image_size");
    for [height, width] in [
        [54, 96],
        [72, 128],
        [108, 192],
        [144, 256],
        [216, 384],
        [288, 512],
    ] {
        let (mut layers, operations) = encoder([height, width]);
        let image = vec![0.5; height * width];
        group.throughput(Throughput::Elements(operations));
        group.bench_function(BenchmarkId::new("encoder", height * width), |bencher| {
            bencher.iter(|| {
                let mut input = black_box(&image);
                for layer in &mut layers {
                    product(
                        Rows::Windows(&layer.windows, input),
                        &layer.panels,
                        Start::Bias(&layer.bias),
                        Finish::Rectified,
                        &mut layer.output,
                    );
                    input = &layer.output;
                }
                black_box(input);
            });
        });
    }
    group.finish();
    criterion.final_summary();
}

/// Returns the layers for images of `size` (height, width), and their floating-point operations.
fn encoder(mut size: [usize; 2]) -> (Vec<Layer>, u64) {
    let mut operations = 0;
    let layers = CHANNELS.windows(2).map(|channels| {
        let windows = Windows::new(size, channels[0], KERNEL, STRIDE);
        size = windows.positions();
        let terms = windows.window_len();
        operations += 2 * (windows.count() * terms * channels[1]) as u64;
        let weights = vec![1.0 / terms as f32; terms * channels[1]];
        Layer {
            panels: Panels::of(Isa::best(), Matrix::of_rows(&weights, terms).transposed()),
            bias: vec![0.0; channels[1]],
            output: vec![0.0; windows.count() * channels[1]],
            windows,
        }
    });
    let layers: Vec<_> = layers.collect();
    (layers, operations)
}
