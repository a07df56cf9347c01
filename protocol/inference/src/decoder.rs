//! The VAE's decoder: latent code to depth image (paper, section 3.3).
//!
//! One linear layer, then four transposed convolutions of stride 2, a ReLU after each but the last:
//! `vae.latent` → 1024×1×3 → 128×5×11 → 64×14×28 → 32×33×62 → 1×72×128. Only who looks at a run
//! needs it. Images lie channels-last, as in the encoder.

use skein_kernels::{Finish, Isa, Matrix, Panels, Windows, spread};
use skein_protocol::{IMAGE_HEIGHT, IMAGE_PIXELS, IMAGE_WIDTH};

use crate::linear::Linear;

const STRIDE: usize = 2;
/// Pixels of the first feature map, in one row.
const UNFOLDED: usize = 3;
/// Channels of the feature maps; the last one is the depth image.
const CHANNELS: [usize; 5] = [1024, 128, 64, 32, 1];
const KERNELS: [[usize; 2]; 4] = [[5, 7], [6, 8], [7, 8], [8, 6]];

/// Parameters of the decoder, arranged for [`Decoder::decode`].
#[derive(Debug)]
pub struct Decoder {
    unfold: Linear,
    convolutions: [TransposedConvolution; 4],
}

impl Decoder {
    /// Names and lengths of the tensors of a decoder of codes of `latent` numbers, in PyTorch's
    /// order of the parameters.
    pub fn tensors(latent: usize) -> [(&'static str, usize); 10] {
        let weights = |layer: usize| {
            let [height, width] = KERNELS[layer];
            CHANNELS[layer] * CHANNELS[layer + 1] * height * width
        };
        [
            ("decoder.linear.weight", CHANNELS[0] * UNFOLDED * latent),
            ("decoder.linear.bias", CHANNELS[0] * UNFOLDED),
            ("decoder.conv1.weight", weights(0)),
            ("decoder.conv1.bias", CHANNELS[1]),
            ("decoder.conv2.weight", weights(1)),
            ("decoder.conv2.bias", CHANNELS[2]),
            ("decoder.conv3.weight", weights(2)),
            ("decoder.conv3.bias", CHANNELS[3]),
            ("decoder.conv4.weight", weights(3)),
            ("decoder.conv4.bias", CHANNELS[4]),
        ]
    }

    /// `tensor` returns a parameter by its name in [`Decoder::tensors`]. Weights of convolutions
    /// are `[inputs, kernel height, kernel width, outputs]`; the linear layer's outputs are
    /// `[3, 1024]`.
    ///
    /// # Panics
    /// If a tensor does not have the length of its shape.
    pub fn new<'a>(isa: Isa, tensor: impl Fn(&str) -> &'a [f32]) -> Self {
        let mut size = [1, UNFOLDED];
        let convolutions = std::array::from_fn(|layer| {
            let kernel = KERNELS[layer];
            size = [0, 1].map(|axis| STRIDE * (size[axis] - 1) + kernel[axis]);
            let windows = Windows::new(size, CHANNELS[layer + 1], kernel, STRIDE);
            let name = format!("decoder.conv{}", layer + 1);
            let weights = tensor(&format!("{name}.weight"));
            assert_eq!(weights.len(), CHANNELS[layer] * windows.window_len());
            TransposedConvolution {
                weights: Panels::of(isa, Matrix::of_rows(weights, windows.window_len())),
                bias: tensor(&format!("{name}.bias")).to_vec(),
                windows,
            }
        });
        assert_eq!(size, [IMAGE_HEIGHT, IMAGE_WIDTH], "the depth image's size");
        let bias = tensor("decoder.linear.bias");
        assert_eq!(bias.len(), CHANNELS[0] * UNFOLDED);
        Self {
            unfold: Linear::new(isa, tensor("decoder.linear.weight"), bias),
            convolutions,
        }
    }

    /// Returns the depth image that a latent code stands for, as bytes: 0 nearest, 255 farthest.
    ///
    /// # Panics
    /// If the code has another length than the decoder's.
    pub fn decode(&self, latent: &[f32]) -> Vec<u8> {
        let mut image = vec![0.0; CHANNELS[0] * UNFOLDED];
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

    /// Computes a transposed convolution as its definition says.
    fn transposed(
        input: &[f32],
        [height, width]: [usize; 2],
        [inputs, outputs]: [usize; 2],
        kernel: [usize; 2],
        weights: &[f32],
        bias: &[f32],
    ) -> (Vec<f32>, [usize; 2]) {
        let size = [
            STRIDE * (height - 1) + kernel[0],
            STRIDE * (width - 1) + kernel[1],
        ];
        let mut image = bias.repeat(size[0] * size[1]);
        assert_eq!(input.len(), height * width * inputs);
        for (place, value) in input.iter().enumerate() {
            let (pixel, channel) = (place / inputs, place % inputs);
            let (row, column) = (pixel / width * STRIDE, pixel % width * STRIDE);
            for term in 0..kernel[0] * kernel[1] * outputs {
                let (at, output) = (term / outputs, term % outputs);
                let (down, right) = (at / kernel[1], at % kernel[1]);
                let into = ((row + down) * size[1] + column + right) * outputs + output;
                let weight = weights[channel * kernel[0] * kernel[1] * outputs + term];
                image[into] += value * weight;
            }
        }
        (image, size)
    }

    #[test]
    fn an_image_is_what_the_layers_definitions_say() {
        let latent = 8;
        let tensors: Vec<(&str, Vec<f32>)> = (1..)
            .zip(Decoder::tensors(latent))
            .map(|(seed, (name, len))| (name, (0..len).map(|at| number(at + seed)).collect()))
            .collect();
        let tensor = |name: &str| {
            let found = tensors.iter().find(|(known, _)| *known == name);
            found.unwrap().1.as_slice()
        };
        let code: Vec<f32> = (0..latent).map(|at| number(at) * 30.0).collect();
        let decoder = Decoder::new(Isa::best(), tensor);

        let rows = tensor("decoder.linear.weight").chunks(latent);
        let mut image: Vec<f32> = rows
            .zip(tensor("decoder.linear.bias"))
            .map(|(row, bias)| {
                let terms = row.iter().zip(&code).map(|(weight, value)| weight * value);
                (bias + terms.sum::<f32>()).max(0.0)
            })
            .collect();
        let mut size = [1, UNFOLDED];
        for layer in 0..4 {
            let name = |part: &str| format!("decoder.conv{}.{part}", layer + 1);
            let channels = [CHANNELS[layer], CHANNELS[layer + 1]];
            let (weights, bias) = (tensor(&name("weight")), tensor(&name("bias")));
            (image, size) = transposed(&image, size, channels, KERNELS[layer], weights, bias);
            if layer < 3 {
                image.iter_mut().for_each(|value| *value = value.max(0.0));
            }
        }
        let expected = image.iter().map(|value| 255.0 / (1.0 + (-value).exp()));
        let found = decoder.decode(&code);
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
