//! Buffers of a minibatch, kept between its passes.

use skein_protocol::IMAGE_PIXELS;

use super::buffer::Buffer;
use super::network::VaeNetwork;
use super::parameter_order::LayerRanges;
use super::unfold;

/// Activations, and the gradients of the loss with respect to them, image by image, channels last.
/// Reused from step to step. All shapes are per batch of n images.
#[derive(Debug, Default)]
pub(super) struct BatchBuffers {
    /// Pixels, then the outputs of the encoder's four convolutions after ReLU,
    /// `[n, pixels, channels]` each.
    pub(super) encoder_maps: [Buffer; 5],
    /// Pixels to reproduce where they are not the input's, `[n, 72, 128]`.
    pub(super) clean: Buffer,
    /// Mean and log-variance of the latent code, `[n, 2 latent]`.
    pub(super) heads: Buffer,
    /// Sampled latent codes, `[n, latent]`.
    pub(super) codes: Buffer,
    /// The decoder's first feature map, `[n, 3, 1024]`, after ReLU.
    pub(super) unfolded: Buffer,
    /// Outputs of the decoder's four transposed convolutions, `[n, pixels, channels]` each, after
    /// ReLU. The last one holds the gradient before its sigmoid after the backward pass.
    pub(super) decoder_maps: [Buffer; 4],
    /// Gradients before ReLU of the encoder's outputs, shaped like them; pixels need none.
    pub(super) encoder_maps_grad: [Buffer; 4],
    /// Gradient with respect to `heads`, `[n, 2 latent]`.
    pub(super) heads_grad: Buffer,
    /// Gradient with respect to `codes`, `[n, latent]`.
    pub(super) codes_grad: Buffer,
    /// Gradient before ReLU of `unfolded`, `[n, 3, 1024]`.
    pub(super) unfolded_grad: Buffer,
    /// Gradients before ReLU of the decoder's outputs, except the last one's.
    pub(super) decoder_maps_grad: [Buffer; 3],
    /// Gradient with respect to each bias of the encoder's convolutions, image by image,
    /// `[n, biases]`.
    pub(super) encoder_bias_sums: Buffer,
    /// Gradient with respect to each bias of the decoder's convolutions, image by image,
    /// `[n, biases]`.
    pub(super) decoder_bias_sums: Buffer,
    /// Squared error of each image, `[n]`.
    pub(super) errors: Vec<f64>,
}

impl BatchBuffers {
    /// Makes room for `images` images.
    pub(super) fn resize(&mut self, network: &VaeNetwork, images: usize) {
        let latent = network.latent();
        let (encoder, decoder) = (network.encoder_lens(), network.decoder_lens());
        let resize = |buffers: &mut [Buffer], lens: &[usize]| {
            for (buffer, len) in buffers.iter_mut().zip(lens) {
                buffer.resize(images * len);
            }
        };
        resize(&mut self.encoder_maps, &encoder);
        resize(&mut self.encoder_maps_grad, &encoder[1..]);
        resize(&mut self.decoder_maps, &decoder);
        resize(&mut self.decoder_maps_grad, &decoder[..3]);
        for (buffer, len) in [
            (&mut self.clean, IMAGE_PIXELS),
            (&mut self.heads, 2 * latent),
            (&mut self.heads_grad, 2 * latent),
            (&mut self.codes, latent),
            (&mut self.codes_grad, latent),
            (&mut self.unfolded, unfold::INPUT_LEN),
            (&mut self.unfolded_grad, unfold::INPUT_LEN),
            (
                &mut self.encoder_bias_sums,
                sums_len(network.encoder_places()),
            ),
            (
                &mut self.decoder_bias_sums,
                sums_len(network.decoder_places()),
            ),
        ] {
            buffer.resize(images * len);
        }
        self.errors.resize(images, 0.0);
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
