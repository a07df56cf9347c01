//! The VAE's encoder: depth image to the mean of the latent code (paper, section 3.3).
//!
//! Four 4x4 convolutions of stride 2 without padding, a ReLU after each, and one linear layer:
//! 1x72x128 → 32x35x63 → 64x16x30 → 128x7x14 → 256x2x6 → 32.
//!
//! Images lie channels-last here. A kernel row then covers one contiguous run of memory, so that collecting the pixels under the kernel is four copies, and
//! a convolution is that plus one matrix product. PyTorch's channels-first weights are rearranged once, when a snapshot arrives.

use skein_protocol::snapshot::{ENCODER_CHANNELS as CHANNELS, ENCODER_FEATURES as FEATURES, ENCODER_KERNEL as KERNEL};
use skein_protocol::{IMAGE_HEIGHT, IMAGE_PIXELS, IMAGE_WIDTH, LATENT};

use super::matrix::{add_bias, add_bias_relu, multiply, transposed};

/// Step of every kernel, pixels.
const STRIDE: usize = 2;

/// An image's height and width before and after each convolution.
const SIZES: [[usize; 2]; 5] = {
    let mut sizes = [[IMAGE_HEIGHT, IMAGE_WIDTH]; 5];
    let mut layer = 0;
    while layer < 4 {
        let [height, width] = sizes[layer];
        sizes[layer + 1] = [(height - KERNEL) / STRIDE + 1, (width - KERNEL) / STRIDE + 1];
        layer += 1;
    }
    sizes
};
const _: () = assert!(CHANNELS[4] * SIZES[4][0] * SIZES[4][1] == FEATURES);

/// The encoder's parameters, arranged for [`Encoder::encode`].
#[derive(Debug)]
pub struct Encoder {
    convolutions: [Convolution; 4],
    /// `[FEATURES, LATENT]`, features channels-last.
    mean_weights: Vec<f32>,
    mean_bias: Vec<f32>,
}

/// Working memory of one encoding thread.
#[derive(Debug)]
pub struct EncoderScratch {
    /// Pixels under the kernel, one row for each output pixel: `[height * width, 4 * 4 * channels]`.
    patches: Vec<f32>,
    /// Layers alternate between these two.
    images: [Vec<f32>; 2],
}

impl Encoder {
    /// Takes the parameters by their names in a snapshot (`encoder.conv1.weight`, …), each a slice in PyTorch's order.
    ///
    /// # Panics
    /// When a tensor has not the length its shape asks for.
    pub fn new<'a>(tensor: impl Fn(&str) -> &'a [f32]) -> Self {
        let convolutions = std::array::from_fn(|layer| {
            let name = format!("encoder.conv{}", layer + 1);
            Convolution::new(
                layer,
                tensor(&format!("{name}.weight")),
                tensor(&format!("{name}.bias")),
            )
        });
        let pixels = SIZES[4][0] * SIZES[4][1];
        let mean_weights: Vec<f32> = tensor("encoder.mean.weight")
            .chunks_exact(FEATURES)
            .flat_map(|features| transposed(features, CHANNELS[4], pixels))
            .collect();
        Self {
            convolutions,
            mean_weights: transposed(&mean_weights, LATENT, FEATURES),
            mean_bias: tensor("encoder.mean.bias").to_vec(),
        }
    }

    /// Mean of the latent code of a depth image, `[72, 128]`, top row first, 0 nearest and 255 farthest; the network sees it scaled to [0, 1].
    pub fn encode(&self, image: &[u8; IMAGE_PIXELS], scratch: &mut EncoderScratch) -> [f32; LATENT] {
        let EncoderScratch {
            patches,
            images: [input, output],
        } = scratch;
        let [first, rest @ ..] = &self.convolutions;
        first.apply(
            image.as_slice(),
            |depth| f32::from(depth) * (1.0 / 255.0),
            patches,
            output,
        );
        for convolution in rest {
            std::mem::swap(input, output);
            convolution.apply(input.as_slice(), |value| value, patches, output);
        }
        let mut latent = [0.0; LATENT];
        multiply(&output[..FEATURES], FEATURES, &self.mean_weights, &mut latent, LATENT);
        add_bias(&mut latent, &self.mean_bias);
        latent
    }
}

impl Default for EncoderScratch {
    fn default() -> Self {
        let largest = |values: fn(usize) -> usize| (0..4).map(values).max().unwrap_or(0);
        let image = largest(|layer| SIZES[layer + 1].iter().product::<usize>() * CHANNELS[layer + 1]);
        let patches = largest(|layer| SIZES[layer + 1].iter().product::<usize>() * KERNEL * KERNEL * CHANNELS[layer]);
        Self {
            patches: vec![0.0; patches],
            images: [vec![0.0; image], vec![0.0; image]],
        }
    }
}

/// One convolution with its ReLU.
#[derive(Debug)]
struct Convolution {
    /// `[height, width]`.
    input_size: [usize; 2],
    output_size: [usize; 2],
    input_channels: usize,
    output_channels: usize,
    /// `[4, 4, input channels, output channels]`.
    weights: Vec<f32>,
    bias: Vec<f32>,
}

impl Convolution {
    /// `weights`: `[output channels, input channels, 4, 4]`; `bias`: `[output channels]`.
    fn new(layer: usize, weights: &[f32], bias: &[f32]) -> Self {
        let (input_channels, output_channels) = (CHANNELS[layer], CHANNELS[layer + 1]);
        assert_eq!(bias.len(), output_channels, "a bias for each output channel");
        // [out, in, 16] → [out, 16, in] → [16, in, out].
        let channels_last: Vec<f32> = weights
            .chunks_exact(input_channels * KERNEL * KERNEL)
            .flat_map(|kernel| transposed(kernel, input_channels, KERNEL * KERNEL))
            .collect();
        Self {
            input_size: SIZES[layer],
            output_size: SIZES[layer + 1],
            input_channels,
            output_channels,
            weights: transposed(&channels_last, output_channels, KERNEL * KERNEL * input_channels),
            bias: bias.to_vec(),
        }
    }

    /// `input`: `[height, width, channels]`; `convert` makes a value of it. Writes the start of `output`.
    fn apply<T: Copy>(&self, input: &[T], convert: impl Fn(T) -> f32, patches: &mut [f32], output: &mut [f32]) {
        let pixels = self.output_size[0] * self.output_size[1];
        let patch = KERNEL * KERNEL * self.input_channels;
        let (patches, output) = (
            &mut patches[..pixels * patch],
            &mut output[..pixels * self.output_channels],
        );
        self.collect_patches(input, convert, patches);
        multiply(patches, patch, &self.weights, output, self.output_channels);
        add_bias_relu(output, &self.bias);
    }

    /// Lays the pixels under the kernel side by side, `[4, 4, channels]` for each output pixel.
    fn collect_patches<T: Copy>(&self, input: &[T], convert: impl Fn(T) -> f32, patches: &mut [f32]) {
        let run = KERNEL * self.input_channels;
        let [_, input_width] = self.input_size;
        for (pixel, patch) in patches.chunks_exact_mut(KERNEL * run).enumerate() {
            let (top, left) = (
                pixel / self.output_size[1] * STRIDE,
                pixel % self.output_size[1] * STRIDE,
            );
            for (row, into) in patch.chunks_exact_mut(run).enumerate() {
                let start = ((top + row) * input_width + left) * self.input_channels;
                for (to, from) in into.iter_mut().zip(&input[start..start + run]) {
                    *to = convert(*from);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;
    use skein_protocol::snapshot::SnapshotLayout;

    use crate::testing::random_snapshot;

    fn parameters(seed: u64) -> (SnapshotLayout, Vec<f32>) {
        let layout = SnapshotLayout::new(LATENT, 1);
        let snapshot = random_snapshot(&layout, seed);
        (layout, snapshot.values)
    }

    fn image(seed: u64) -> Box<[u8; IMAGE_PIXELS]> {
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let mut image = Box::new([0; IMAGE_PIXELS]);
        image.fill_with(|| rng.random());
        image
    }

    /// The definition, channels first and in f64, index by index.
    fn naive(tensor: &impl Fn(&str) -> Vec<f32>, image: &[u8; IMAGE_PIXELS]) -> Vec<f64> {
        let mut input: Vec<f64> = image.iter().map(|&depth| f64::from(depth) / 255.0).collect();
        for layer in 0..4 {
            let weights = tensor(&format!("encoder.conv{}.weight", layer + 1));
            let bias = tensor(&format!("encoder.conv{}.bias", layer + 1));
            let ([height, width], [rows, columns]) = (SIZES[layer], SIZES[layer + 1]);
            let mut output = Vec::new();
            for out in 0..CHANNELS[layer + 1] {
                for (row, column) in (0..rows * columns).map(|pixel| (pixel / columns, pixel % columns)) {
                    let mut sum = f64::from(bias[out]);
                    for channel in 0..CHANNELS[layer] {
                        for (y, x) in (0..16).map(|tap| (tap / 4, tap % 4)) {
                            let weight = weights[((out * CHANNELS[layer] + channel) * 4 + y) * 4 + x];
                            let pixel = input[(channel * height + 2 * row + y) * width + 2 * column + x];
                            sum += f64::from(weight) * pixel;
                        }
                    }
                    output.push(sum.max(0.0));
                }
            }
            input = output;
        }
        let weights = tensor("encoder.mean.weight");
        let product = |row: &[f32]| row.iter().zip(&input).map(|(&w, x)| f64::from(w) * x).sum::<f64>();
        tensor("encoder.mean.bias")
            .iter()
            .zip(weights.chunks_exact(FEATURES))
            .map(|(&bias, row)| f64::from(bias) + product(row))
            .collect()
    }

    #[test]
    fn equals_a_direct_convolution() {
        for seed in 0..2 {
            let (layout, values) = parameters(seed);
            let tensor = |name: &str| &values[layout.tensor(name).unwrap().range.clone()];
            let latent = Encoder::new(tensor).encode(&image(seed), &mut EncoderScratch::default());
            let expected = naive(&|name: &str| tensor(name).to_vec(), &image(seed));
            assert!(
                expected.iter().any(|value| value.abs() > 0.02),
                "a comparison of noughts proves nothing"
            );
            for (found, expected) in latent.iter().zip(expected) {
                assert!((f64::from(*found) - expected).abs() < 1e-5, "{found} {expected}");
            }
        }
    }

    #[test]
    fn the_same_image_gives_the_same_bits_whatever_came_before() {
        let (layout, values) = parameters(7);
        let encoder = Encoder::new(|name| &values[layout.tensor(name).unwrap().range.clone()]);
        let mut scratch = EncoderScratch::default();
        let first = encoder.encode(&image(1), &mut scratch);
        assert_ne!(first, encoder.encode(&image(2), &mut scratch));
        assert_eq!(first, encoder.encode(&image(1), &mut scratch));
        assert_eq!(first, encoder.encode(&image(1), &mut EncoderScratch::default()));
    }
}
