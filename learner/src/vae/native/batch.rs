//! Buffers of a minibatch, kept between its passes.

use skein_protocol::IMAGE_PIXELS;

use super::buffer::Buffer;
use super::network::VaeNetwork;
use super::parameter_order::LayerRanges;
use super::unfold;

/// Activations, and the gradients of the loss with respect to them, image by image, channels last.
/// Reused from step to step. All shapes are per batch of n images, of which the first m are decoded
/// again.
#[derive(Debug, Default)]
pub(super) struct BatchBuffers {
    /// Pixels, then the outputs of the encoder's four convolutions after ReLU,
    /// `[n, pixels, channels]` each.
    pub(super) encoder_maps: [Buffer; 5],
    /// Pixels to reproduce where they are not the input's, `[m, 72, 128]`.
    pub(super) clean: Buffer,
    /// Mean and log-variance of the latent code, `[n, 2 latent]`.
    pub(super) heads: Buffer,
    /// Sampled latent codes, `[n, latent]`.
    pub(super) codes: Buffer,
    /// The decoder's first feature map, `[m, 3, 1024]`, after ReLU.
    pub(super) unfolded: Buffer,
    /// Outputs of the decoder's four transposed convolutions, `[m, pixels, channels]` each, after
    /// ReLU. The last one holds the gradient before its sigmoid after the backward pass.
    pub(super) decoder_maps: [Buffer; 4],
    /// Gradients before ReLU of the encoder's outputs, shaped like them; pixels need none.
    pub(super) encoder_maps_grad: [Buffer; 4],
    /// Gradient with respect to `heads`, `[n, 2 latent]`.
    pub(super) heads_grad: Buffer,
    /// Gradient with respect to `codes`, `[n, latent]`.
    pub(super) codes_grad: Buffer,
    /// Gradient before ReLU of `unfolded`, `[m, 3, 1024]`.
    pub(super) unfolded_grad: Buffer,
    /// Gradients before ReLU of the decoder's outputs, except the last one's.
    pub(super) decoder_maps_grad: [Buffer; 3],
    /// Gradient with respect to each bias of the encoder's convolutions, image by image,
    /// `[n, biases]`.
    pub(super) encoder_bias_sums: Buffer,
    /// Gradient with respect to each bias of the decoder's convolutions, image by image,
    /// `[m, biases]`.
    pub(super) decoder_bias_sums: Buffer,
    /// Squared error of each decoded image, `[m]`.
    pub(super) errors: Vec<f64>,
}

impl BatchBuffers {
    /// Makes room for `images` images, the first `decoded` of which are decoded again.
    pub(super) fn resize(&mut self, network: &VaeNetwork, images: usize, decoded: usize) {
        let latent = network.latent();
        let encoder_lens = network.encoder_lens();
        let encoder = [
            (&mut self.heads, 2 * latent),
            (&mut self.heads_grad, 2 * latent),
            (&mut self.codes, latent),
            (&mut self.codes_grad, latent),
            (
                &mut self.encoder_bias_sums,
                sums_len(network.encoder_places()),
            ),
        ]
        .into_iter()
        .chain(self.encoder_maps.iter_mut().zip(encoder_lens))
        .chain(
            self.encoder_maps_grad
                .iter_mut()
                .zip(encoder_lens.into_iter().skip(1)),
        );
        for (buffer, len) in encoder {
            buffer.resize(images * len);
        }
        let decoder_lens = network.decoder_lens();
        let decoder = [
            (&mut self.clean, IMAGE_PIXELS),
            (&mut self.unfolded, unfold::INPUT_LEN),
            (&mut self.unfolded_grad, unfold::INPUT_LEN),
            (
                &mut self.decoder_bias_sums,
                sums_len(network.decoder_places()),
            ),
        ]
        .into_iter()
        .chain(self.decoder_maps.iter_mut().zip(decoder_lens))
        .chain(self.decoder_maps_grad.iter_mut().zip(decoder_lens));
        for (buffer, len) in decoder {
            buffer.resize(decoded * len);
        }
        self.errors.resize(decoded, 0.0);
    }

    /// Returns the length of the codes that are decoded, `[m, latent]`.
    pub(super) fn decoded_len(&self, latent: usize) -> usize {
        self.errors.len() * latent
    }
}

/// Length of an image's bias sums for these layers, in whole cache lines.
fn sums_len(places: [&LayerRanges; 4]) -> usize {
    places
        .iter()
        .map(|place| place.bias.len())
        .sum::<usize>()
        .next_multiple_of(16)
}
