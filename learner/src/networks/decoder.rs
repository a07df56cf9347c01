//! The VAE's decoder: latent code to depth image.

use tch::Tensor;

use super::{Layout, Linear, Parameters, TransposedConvolution};

/// A linear layer to 1024 × 1 × 3, then four transposed convolutions with stride 2, whose kernels give 72 × 128 exactly (paper, section 3.3; channels
/// as in arXiv:1803.10122). ReLU between, a sigmoid at the end.
#[derive(Debug, Clone, Copy)]
pub struct Decoder {
    unfold: Linear,
    convolutions: [TransposedConvolution; 4],
}

impl Decoder {
    /// Describes the layers, for codes of `latent` numbers.
    pub fn describe(layout: &mut Layout, latent: usize) -> Self {
        let unfold = Linear::describe(layout, "decoder.linear", latent as i64, 1024 * 3);
        let mut convolution = |number: usize, inputs: i64, outputs: i64, kernel: [i64; 2]| {
            TransposedConvolution::describe(layout, &format!("decoder.conv{number}"), inputs, outputs, kernel)
        };
        Self {
            unfold,
            convolutions: [
                convolution(1, 1024, 128, [5, 7]),
                convolution(2, 128, 64, [6, 8]),
                convolution(3, 64, 32, [7, 8]),
                convolution(4, 32, 1, [8, 6]),
            ],
        }
    }

    /// `[n, latent]` to `[n, 1, 72, 128]`, depth in [0, 1].
    pub fn forward(&self, parameters: &Parameters, latents: &Tensor) -> Tensor {
        let mut image = self.unfold.forward(parameters, latents).relu_().view([-1, 1024, 1, 3]);
        let [hidden @ .., last] = &self.convolutions;
        for convolution in hidden {
            image = convolution.forward(parameters, &image).relu_();
        }
        last.forward(parameters, &image).sigmoid_()
    }
}
