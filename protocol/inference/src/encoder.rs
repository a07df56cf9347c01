//! The VAE's encoder: depth image to the mean of the latent code (paper, section 3.3).
//!
//! Four 4×4 convolutions of stride 2 without padding, a ReLU after each, and one linear layer:
//! 1×72×128 → 32×35×63 → 64×16×30 → 128×7×14 → 256×2×6 → `vae.latent`.
//!
//! Images lie channels-last here. A kernel row then covers one contiguous span of memory, and a
//! convolution is one product that reads its windows where they lie. PyTorch's channels-first
//! weights are rearranged once, when a snapshot arrives.

use skein_kernels::{Finish, Isa, Matrix, Panels, Rows, Start, Team, Windows, product};
use skein_protocol::snapshot::{
    ENCODER_CHANNELS as CHANNELS, ENCODER_FEATURES as FEATURES, ENCODER_KERNEL as KERNEL,
};
use skein_protocol::{IMAGE_HEIGHT, IMAGE_PIXELS, IMAGE_WIDTH, LatentCode, MAX_LATENT};

use crate::linear::Linear;

/// Stride of every kernel, pixels.
const STRIDE: usize = 2;

/// Parameters of the encoder, arranged for [`Encoder::encode`].
#[derive(Debug)]
pub struct Encoder {
    convolutions: [Convolution; 4],
    /// Linear layer to the code's mean; its weights are ordered for channels-last features.
    mean: Linear,
}

/// Working memory of one thread.
#[derive(Debug, Default)]
pub struct EncoderScratch {
    /// Inputs and outputs; layers alternate between the two.
    images: [Vec<f32>; 2],
}

impl Encoder {
    /// `tensor` returns a parameter by its name in a snapshot (`encoder.conv1.weight`, …), as a
    /// slice in PyTorch's order.
    ///
    /// # Panics
    /// If a tensor does not have the length of its shape.
    pub fn new<'a>(isa: Isa, tensor: impl Fn(&str) -> &'a [f32]) -> Self {
        let mut size = [IMAGE_HEIGHT, IMAGE_WIDTH];
        let convolutions = std::array::from_fn(|layer| {
            let name = format!("encoder.conv{}", layer + 1);
            let (weights, bias) = (
                tensor(&format!("{name}.weight")),
                tensor(&format!("{name}.bias")),
            );
            let convolution = Convolution::new(isa, size, CHANNELS[layer], weights, bias);
            size = convolution.windows.positions();
            convolution
        });
        let pixels = size[0] * size[1];
        assert_eq!(
            pixels * CHANNELS[4],
            FEATURES,
            "the last image consists of all features"
        );
        let weights: Vec<f32> = tensor("encoder.mean.weight")
            .chunks_exact(FEATURES)
            .flat_map(|features| transposed(features, CHANNELS[4], pixels))
            .collect();
        Self {
            convolutions,
            mean: Linear::new(isa, &weights, tensor("encoder.mean.bias")),
        }
    }

    /// Returns the latent code's mean for a depth image, `[72, 128]`, top row first, 0 nearest and
    /// 255 farthest. The network receives depth scaled to [0, 1]. Zeros follow the code's numbers.
    pub fn encode(&self, image: &[u8; IMAGE_PIXELS], scratch: &mut EncoderScratch) -> LatentCode {
        let [input, output] = &mut scratch.images;
        input.clear();
        input.extend(image.iter().map(|&depth| f32::from(depth) * (1.0 / 255.0)));
        for convolution in &self.convolutions {
            convolution.apply(input, output);
            std::mem::swap(input, output);
        }
        let mut latent = [0.0; MAX_LATENT];
        self.mean
            .apply(input, Finish::Plain, &mut latent[..self.mean.outputs()]);
        latent
    }

    /// [`Encoder::encode`] of many images, `[n, 72, 128]`, shared by the members of a team.
    ///
    /// # Panics
    /// If the last image is incomplete.
    pub fn encode_all(&self, team: &mut Team, images: &[u8]) -> Vec<LatentCode> {
        let (images, rest) = images.as_chunks::<IMAGE_PIXELS>();
        assert!(rest.is_empty(), "{} pixels are no whole image", rest.len());
        let mut latents = vec![[0.0; MAX_LATENT]; images.len()];
        team.split_rows(&mut latents, 1, 1, |first, latents| {
            let mut scratch = EncoderScratch::default();
            for (latent, image) in latents.iter_mut().zip(&images[first..]) {
                *latent = self.encode(image, &mut scratch);
            }
        });
        latents
    }
}

/// One convolution with its ReLU.
#[derive(Debug)]
struct Convolution {
    windows: Windows,
    /// `[4 · 4 · input channels, output channels]`.
    weights: Panels,
    bias: Vec<f32>,
}

impl Convolution {
    /// A convolution on images of `size`, height and width. `weights`: `[output channels, input
    /// channels, 4, 4]`; `bias`: `[output channels]`.
    fn new(isa: Isa, size: [usize; 2], channels: usize, weights: &[f32], bias: &[f32]) -> Self {
        let len = KERNEL * KERNEL * channels;
        assert_eq!(
            weights.len(),
            bias.len() * len,
            "a weight for each number of a window and output channel"
        );
        let channels_last: Vec<f32> = weights
            .chunks_exact(len)
            .flat_map(|kernel| transposed(kernel, channels, KERNEL * KERNEL))
            .collect();
        Self {
            windows: Windows::new(size, channels, [KERNEL; 2], STRIDE),
            weights: Panels::of(isa, Matrix::of_rows(&channels_last, len).transposed()),
            bias: bias.to_vec(),
        }
    }

    /// Writes the layer's output for `input`, both `[height, width, channels]`.
    fn apply(&self, input: &[f32], output: &mut Vec<f32>) {
        output.resize(self.windows.count() * self.bias.len(), 0.0);
        product(
            Rows::Windows(&self.windows, input),
            &self.weights,
            Start::Bias(&self.bias),
            Finish::Rectified,
            output,
        );
    }
}

/// Returns the transposed matrix; `matrix`: `[rows, columns]`, row-major.
fn transposed(matrix: &[f32], rows: usize, columns: usize) -> Vec<f32> {
    assert_eq!(matrix.len(), rows * columns, "the matrix has this shape");
    (0..columns)
        .flat_map(|column| (0..rows).map(move |row| matrix[row * columns + column]))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;
    use skein_protocol::config::{Observation, ObservationLayout};
    use skein_protocol::snapshot::SnapshotLayout;

    fn parameters(latent: usize, seed: u64) -> (SnapshotLayout, Vec<f32>) {
        let layout =
            SnapshotLayout::new(&ObservationLayout::present(Observation::Latent, latent), 1);
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let mut values = vec![0.0; layout.values()];
        for tensor in layout.tensors() {
            let bound = (tensor.shape[0] as f32 / tensor.range.len() as f32)
                .sqrt()
                .min(0.5);
            values[tensor.range.clone()].fill_with(|| rng.random_range(-bound..bound));
        }
        (layout, values)
    }

    fn image(seed: u64) -> Box<[u8; IMAGE_PIXELS]> {
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let mut image = Box::new([0; IMAGE_PIXELS]);
        image.fill_with(|| rng.random());
        image
    }

    /// Height and width of the image before and after each convolution.
    const SIZES: [[usize; 2]; 5] = [[72, 128], [35, 63], [16, 30], [7, 14], [2, 6]];

    fn encoder(layout: &SnapshotLayout, values: &[f32], isa: Isa) -> Encoder {
        Encoder::new(isa, |name| {
            &values[layout.tensor(name).unwrap().range.clone()]
        })
    }

    /// The definition, channels first and in f64, index by index.
    fn naive(tensor: &impl Fn(&str) -> Vec<f32>, image: &[u8; IMAGE_PIXELS]) -> Vec<f64> {
        let mut input: Vec<f64> = image
            .iter()
            .map(|&depth| f64::from(depth) / 255.0)
            .collect();
        for layer in 0..4 {
            let weights = tensor(&format!("encoder.conv{}.weight", layer + 1));
            let bias = tensor(&format!("encoder.conv{}.bias", layer + 1));
            let ([height, width], [rows, columns]) = (SIZES[layer], SIZES[layer + 1]);
            let mut output = Vec::new();
            for out in 0..CHANNELS[layer + 1] {
                for (row, column) in
                    (0..rows * columns).map(|pixel| (pixel / columns, pixel % columns))
                {
                    let mut sum = f64::from(bias[out]);
                    for channel in 0..CHANNELS[layer] {
                        for (y, x) in (0..16).map(|tap| (tap / 4, tap % 4)) {
                            let weight =
                                weights[((out * CHANNELS[layer] + channel) * 4 + y) * 4 + x];
                            let pixel =
                                input[(channel * height + 2 * row + y) * width + 2 * column + x];
                            sum += f64::from(weight) * pixel;
                        }
                    }
                    output.push(sum.max(0.0));
                }
            }
            input = output;
        }
        let weights = tensor("encoder.mean.weight");
        let product = |row: &[f32]| {
            row.iter()
                .zip(&input)
                .map(|(&w, x)| f64::from(w) * x)
                .sum::<f64>()
        };
        tensor("encoder.mean.bias")
            .iter()
            .zip(weights.chunks_exact(FEATURES))
            .map(|(&bias, row)| f64::from(bias) + product(row))
            .collect()
    }

    #[test]
    fn equals_a_direct_convolution() {
        for (seed, latent_len) in [(0, 32), (1, 8), (2, 64)] {
            let (layout, values) = parameters(latent_len, seed);
            let tensor = |name: &str| &values[layout.tensor(name).unwrap().range.clone()];
            let code = encoder(&layout, &values, Isa::best())
                .encode(&image(seed), &mut EncoderScratch::default());
            let expected = naive(&|name: &str| tensor(name).to_vec(), &image(seed));
            assert_eq!(expected.len(), latent_len);
            assert!(
                expected.iter().any(|value| value.abs() > 0.02),
                "a comparison of zeros proves nothing"
            );
            assert!(
                code[latent_len..].iter().all(|&value| value == 0.0),
                "behind the code"
            );
            for (found, expected) in code.iter().zip(&expected) {
                let error = (f64::from(*found) - expected).abs();
                assert!(error < 1e-5, "{found} {expected}");
            }
        }
    }

    #[test]
    fn an_images_code_does_not_depend_on_the_images_before() {
        let (layout, values) = parameters(32, 7);
        let encoder = encoder(&layout, &values, Isa::best());
        let mut scratch = EncoderScratch::default();
        let first = encoder.encode(&image(1), &mut scratch);
        assert_ne!(first, encoder.encode(&image(2), &mut scratch));
        assert_eq!(first, encoder.encode(&image(1), &mut scratch));
        assert_eq!(
            first,
            encoder.encode(&image(1), &mut EncoderScratch::default())
        );
    }

    #[test]
    fn every_instruction_set_gives_the_same_bits() {
        let (layout, values) = parameters(16, 3);
        let latent =
            |isa| encoder(&layout, &values, isa).encode(&image(1), &mut EncoderScratch::default());
        for isa in Isa::ALL.into_iter().filter(|isa| isa.is_available()) {
            assert_eq!(latent(isa), latent(Isa::Portable), "{isa}");
        }
    }
}
