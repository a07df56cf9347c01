//! Buffers of a minibatch, kept between its passes.

use super::buffer::Buffer;
use super::network::Network;
use super::order::Affine;
use super::unfold;

/// Activations, and the gradients of the loss in them, image by image, channels last. Reused from
/// step to step. All shapes are per batch of n images.
#[derive(Debug, Default)]
pub(super) struct Batch {
    /// Pixels, then the outputs of the encoder's four convolutions after ReLU, `[n, pixels,
    /// channels]` each.
    pub(super) seen: [Buffer; 5],
    /// Mean and log-variance of the latent code, `[n, 2 latent]`.
    pub(super) heads: Buffer,
    /// Sampled latent codes, `[n, latent]`.
    pub(super) codes: Buffer,
    /// The decoder's first feature map, `[n, 3, 1024]`, after ReLU.
    pub(super) unfolded: Buffer,
    /// Outputs of the decoder's four transposed convolutions, `[n, pixels, channels]` each, after
    /// ReLU. The last one holds the gradient before its sigmoid after the backward pass.
    pub(super) drawn: [Buffer; 4],
    /// Gradients before ReLU of the encoder's outputs, shaped like them; pixels need none.
    pub(super) seen_flow: [Buffer; 4],
    /// Gradient in `heads`, `[n, 2 latent]`.
    pub(super) heads_flow: Buffer,
    /// Gradient in `codes`, `[n, latent]`.
    pub(super) codes_flow: Buffer,
    /// Gradient before ReLU of `unfolded`, `[n, 3, 1024]`.
    pub(super) unfolded_flow: Buffer,
    /// Gradients before ReLU of the decoder's outputs, except the last one's.
    pub(super) drawn_flow: [Buffer; 3],
    /// Gradient in each bias of the encoder's convolutions, image by image, `[n, biases]`.
    pub(super) seen_sums: Buffer,
    /// Gradient in each bias of the decoder's convolutions, image by image, `[n, biases]`.
    pub(super) drawn_sums: Buffer,
    /// Squared error of each image, `[n]`.
    pub(super) errors: Vec<f64>,
}

impl Batch {
    /// Makes room for `images` images.
    pub(super) fn resize(&mut self, network: &Network, images: usize) {
        let latent = network.latent();
        let (seen, drawn) = (network.seen_lens(), network.drawn_lens());
        let resize = |buffers: &mut [Buffer], lens: &[usize]| {
            for (buffer, len) in buffers.iter_mut().zip(lens) {
                buffer.resize(images * len);
            }
        };
        resize(&mut self.seen, &seen);
        resize(&mut self.seen_flow, &seen[1..]);
        resize(&mut self.drawn, &drawn);
        resize(&mut self.drawn_flow, &drawn[..3]);
        for (buffer, len) in [
            (&mut self.heads, 2 * latent),
            (&mut self.heads_flow, 2 * latent),
            (&mut self.codes, latent),
            (&mut self.codes_flow, latent),
            (&mut self.unfolded, unfold::INPUT_LEN),
            (&mut self.unfolded_flow, unfold::INPUT_LEN),
            (&mut self.seen_sums, sums_len(network.encoder_places())),
            (&mut self.drawn_sums, sums_len(network.decoder_places())),
        ] {
            buffer.resize(images * len);
        }
        self.errors.resize(images, 0.0);
    }
}

/// Length of an image's bias sums for these layers, in whole cache lines.
fn sums_len(places: [&Affine; 4]) -> usize {
    places
        .iter()
        .map(|place| place.bias.len())
        .sum::<usize>()
        .next_multiple_of(16)
}
