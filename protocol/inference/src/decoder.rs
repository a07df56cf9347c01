//! The VAE's decoder: latent code to depth image (paper, section 3.3).
//!
//! One linear layer, then four transposed convolutions of stride 2, a ReLU after each but the last:
//! `vae.latent` → 1024×1×3 → 128×5×11 → 64×14×28 → 32×33×62 → 1×72×128. Only who looks at a run
//! needs it. Images lie channels-last, as in the encoder.

use skein_kernels::{Finish, Isa, Matrix, Panels, Windows, spread};
use skein_protocol::IMAGE_PIXELS;
use skein_protocol::decoder_file::{DECODER_KERNELS, DECODER_MAPS, TrainedDecoder};

use crate::linear::Linear;

const STRIDE: usize = 2;

/// Parameters of the decoder, arranged for [`Decoder::decode`].
#[derive(Debug)]
pub struct Decoder {
    unfold: Linear,
    convolutions: [TransposedConvolution; 4],
}

impl Decoder {
    /// Arranges the parameters of a trained decoder.
    ///
    /// # Panics
    /// If it has not the number of values that its tensors hold.
    pub fn new(isa: Isa, trained: &TrainedDecoder) -> Self {
        let tensors = TrainedDecoder::tensors(trained.latent);
        let values = |tensor: usize| &trained.values[tensors[tensor].range.clone()];
        let convolutions = std::array::from_fn(|layer| {
            let [inputs, height, width] = DECODER_MAPS[layer];
            let [outputs, ..] = DECODER_MAPS[layer + 1];
            let kernel = DECODER_KERNELS[layer];
            let size = [height, width].map(|pixels| STRIDE * (pixels - 1));
            let size = [size[0] + kernel[0], size[1] + kernel[1]];
            let windows = Windows::new(size, outputs, kernel, STRIDE);
            let shape = [inputs, outputs, kernel[0] * kernel[1], 1];
            let weights = channels_last(values(2 * layer + 2), shape);
            TransposedConvolution {
                weights: Panels::of(isa, Matrix::of_rows(&weights, windows.window_len())),
                bias: values(2 * layer + 3).to_vec(),
                windows,
            }
        });
        let [channels, height, width] = DECODER_MAPS[0];
        let pixels = height * width;
        let weights = channels_last(values(0), [1, channels, pixels, trained.latent]);
        let bias = channels_last(values(1), [1, channels, pixels, 1]);
        Self {
            unfold: Linear::new(isa, &weights, &bias),
            convolutions,
        }
    }

    /// Returns the depth image that a latent code stands for, as bytes: 0 nearest, 255 farthest.
    ///
    /// # Panics
    /// If the code has another length than the decoder's.
    pub fn decode(&self, latent: &[f32]) -> Vec<u8> {
        let mut image = vec![0.0; DECODER_MAPS[0].iter().product()];
        self.unfold.apply(latent, Finish::Rectified, &mut image);
        let mut scratch = Vec::new();
        for (number, convolution) in (1..).zip(&self.convolutions) {
            image = convolution.apply(&image, &mut scratch);
            if number < self.convolutions.len() {
                image.iter_mut().for_each(|value| *value = value.max(0.0));
            }
        }
        debug_assert_eq!(image.len(), IMAGE_PIXELS);
        let byte = |logit: &f32| (255.0 / (1.0 + (-logit).exp())).round() as u8;
        image.iter().map(byte).collect()
    }
}

/// Brings `[rows, channels, pixels, len]` to `[rows, pixels, channels, len]`.
fn channels_last(values: &[f32], [rows, channels, pixels, len]: [usize; 4]) -> Vec<f32> {
    assert_eq!(values.len(), rows * channels * pixels * len);
    let mut arranged = Vec::with_capacity(values.len());
    for row in 0..rows {
        for pixel in 0..pixels {
            for channel in 0..channels {
                let first = ((row * channels + channel) * pixels + pixel) * len;
                arranged.extend_from_slice(&values[first..first + len]);
            }
        }
    }
    arranged
}

/// A transposed convolution.
#[derive(Debug)]
struct TransposedConvolution {
    windows: Windows,
    /// `[input channels, window]`.
    weights: Panels,
    bias: Vec<f32>,
}

impl TransposedConvolution {
    fn apply(&self, input: &[f32], scratch: &mut Vec<f32>) -> Vec<f32> {
        let pixels = self.windows.image_len() / self.bias.len();
        let mut image = self.bias.repeat(pixels);
        spread(input, &self.weights, &self.windows, scratch, &mut image);
        image
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a small number that differs from place to place.
    fn number(place: usize) -> f32 {
        ((place * 7919 % 1013) as f32 / 1013.0 - 0.5) * 0.1
    }

    /// Computes a transposed convolution as PyTorch defines it. Images are `[channels, height,
    /// width]`, `weights` `[inputs, outputs, kernel height, kernel width]`.
    fn transposed(
        input: &[f32],
        [from, to]: [[usize; 3]; 2],
        kernel: [usize; 2],
        weights: &[f32],
        bias: &[f32],
    ) -> Vec<f32> {
        let pixels = to[1] * to[2];
        let mut image: Vec<f32> = bias.iter().flat_map(|bias| vec![*bias; pixels]).collect();
        for (place, value) in input.iter().enumerate() {
            let (channel, pixel) = (place / (from[1] * from[2]), place % (from[1] * from[2]));
            let (row, column) = (pixel / from[2] * STRIDE, pixel % from[2] * STRIDE);
            let window = kernel[0] * kernel[1];
            for term in 0..to[0] * window {
                let (output, at) = (term / window, term % window);
                let (down, right) = (at / kernel[1], at % kernel[1]);
                image[output * pixels + (row + down) * to[2] + column + right] +=
                    value * weights[channel * to[0] * window + term];
            }
        }
        image
    }

    #[test]
    fn an_image_is_what_pytorchs_definitions_say() {
        let latent = 8;
        let tensors = TrainedDecoder::tensors(latent);
        let seeded = (1..).zip(&tensors);
        let values =
            seeded.flat_map(|(seed, tensor)| tensor.range.clone().map(move |at| at + seed));
        let trained = TrainedDecoder {
            values: values.map(number).collect(),
            latent,
            encoder_sha256: String::new(),
        };
        let tensor = |place: usize| &trained.values[tensors[place].range.clone()];
        let code: Vec<f32> = (0..latent).map(|at| number(at) * 30.0).collect();

        let mut image: Vec<f32> = tensor(0)
            .chunks(latent)
            .zip(tensor(1))
            .map(|(row, bias)| {
                let terms = row.iter().zip(&code).map(|(weight, value)| weight * value);
                (bias + terms.sum::<f32>()).max(0.0)
            })
            .collect();
        for (layer, kernel) in DECODER_KERNELS.into_iter().enumerate() {
            let maps = [DECODER_MAPS[layer], DECODER_MAPS[layer + 1]];
            let (weights, bias) = (tensor(2 * layer + 2), tensor(2 * layer + 3));
            image = transposed(&image, maps, kernel, weights, bias);
            if layer < 3 {
                image.iter_mut().for_each(|value| *value = value.max(0.0));
            }
        }
        let expected = image.iter().map(|value| 255.0 / (1.0 + (-value).exp()));
        let found = Decoder::new(Isa::best(), &trained).decode(&code);
        assert_eq!(found.len(), IMAGE_PIXELS);
        for (found, expected) in found.iter().zip(expected) {
            assert!(
                (f32::from(*found) - expected).abs() < 1.0,
                "{found} {expected}"
            );
        }
        assert!(
            found.iter().max() > found.iter().min(),
            "no picture of one grey"
        );
    }
}
