//! The VAE's decoder: latent code to depth image, optionally with skip connections from the
//! encoder.

use skein_protocol::config::DecoderName;

use tch::Tensor;

use super::{Layout, LinearLayer, Parameters, TransposedConvolutionLayer};

/// A linear layer to 1024 × 1 × 3, then four transposed convolutions with stride 2, whose kernels
/// give 72 × 128 exactly (the paper, section 3.3; channels as in arXiv:1803.10122). ReLU between, a
/// sigmoid at the end.
///
/// As a U-Net (arXiv:1505.04597), its last three convolutions also see the encoder's feature maps,
/// cropped at the centre to the size of the features they are concatenated with. Expected effect:
/// nearly the whole image passes through those maps, so the reconstruction is far better than a
/// plain decoder's, and the latent code is hardly needed for it. The divergence still pulls the
/// code towards the prior, at its usual weight, so the code may end up empty. The policy sees only
/// the code. The comparison of both decoders measures what that costs.
#[derive(Debug, Clone, Copy)]
pub struct DecoderNetwork {
    unfold: LinearLayer,
    convolutions: [TransposedConvolutionLayer; 4],
    name: DecoderName,
}

impl DecoderNetwork {
    /// Describes the layers, for latent codes of `latent` numbers.
    pub fn describe(layout: &mut Layout, latent: usize, name: DecoderName) -> Self {
        let unfold = LinearLayer::describe(layout, "decoder.linear", latent as i64, 1024 * 3);
        let mut convolution = |number: usize, inputs: i64, outputs: i64, kernel: [i64; 2]| {
            TransposedConvolutionLayer::describe(
                layout,
                &format!("decoder.conv{number}"),
                inputs,
                outputs,
                kernel,
            )
        };
        // An encoder map has as many channels as the features it is concatenated with.
        let sources = match name {
            DecoderName::Plain => 1,
            DecoderName::UNet => 2,
        };
        Self {
            unfold,
            convolutions: [
                convolution(1, 1024, 128, [5, 7]),
                convolution(2, sources * 128, 64, [6, 8]),
                convolution(3, sources * 64, 32, [7, 8]),
                convolution(4, sources * 32, 1, [8, 6]),
            ],
            name,
        }
    }

    /// Maps `[n, latent]` to `[n, 1, 72, 128]`, depth in [0, 1]. `maps`: outputs of the encoder's
    /// first three convolutions, [`Encoded::maps`](super::Encoded::maps).
    pub fn forward(&self, parameters: &Parameters, latents: &Tensor, maps: &[Tensor; 3]) -> Tensor {
        let mut image = self
            .unfold
            .forward(parameters, latents)
            .relu_()
            .view([-1, 1024, 1, 3]);
        let [hidden @ .., last] = &self.convolutions;
        for (convolution, map) in hidden.iter().zip(maps.iter().rev()) {
            image = convolution.forward(parameters, &image).relu_();
            if self.name == DecoderName::UNet {
                image = Tensor::cat(&[&image, &middle(map, &image)], 1);
            }
        }
        last.forward(parameters, &image).sigmoid_()
    }
}

/// Centre crop of `map` to the height and width of `beside`; both `[n, channels, h, w]`.
fn middle(map: &Tensor, beside: &Tensor) -> Tensor {
    [2, 3]
        .into_iter()
        .fold(map.shallow_clone(), |map, dimension| {
            let wanted = beside.size()[dimension as usize];
            let spare = map.size()[dimension as usize] - wanted;
            map.narrow(dimension, spare / 2, wanted)
        })
}
