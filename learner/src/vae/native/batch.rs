//! What is remembered of a minibatch between its passes.

use super::buffer::Buffer;
use super::network::Network;
use super::order::Affine;
use super::unfold;

/// Activations, and the loss's gradients with respect to them, image by image, channels last. Kept
/// from step to step.
#[derive(Debug, Default)]
pub(super) struct Batch {
    /// Pixels and the encoder's images, after ReLU.
    pub(super) seen: [Buffer; 5],
    /// Mean and log-variance, `[n, 2 latent]`.
    pub(super) heads: Buffer,
    /// `[n, latent]`.
    pub(super) codes: Buffer,
    /// The decoder's first image, `[n, 3, 1024]`, after ReLU.
    pub(super) unfolded: Buffer,
    /// The decoder's other images, after ReLU; of the last one, the gradient before its sigmoid.
    pub(super) drawn: [Buffer; 4],
    /// Gradients before the ReLU of the encoder's images, as `seen`; of pixels none is needed.
    pub(super) seen_flow: [Buffer; 4],
    pub(super) heads_flow: Buffer,
    pub(super) codes_flow: Buffer,
    pub(super) unfolded_flow: Buffer,
    /// Gradients before the ReLU of the decoder's images but the last.
    pub(super) drawn_flow: [Buffer; 3],
    /// Of each image, what flows back to each bias of the encoder's layers,
    pub(super) seen_sums: Buffer,
    /// and of the decoder's.
    pub(super) drawn_sums: Buffer,
    /// Of each image, the squared error.
    pub(super) errors: Vec<f64>,
}

impl Batch {
    /// Makes room for so many images.
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

/// Numbers of an image's sums for these layers' biases, in whole cache lines.
fn sums_len(places: [&Affine; 4]) -> usize {
    places
        .iter()
        .map(|place| place.bias.len())
        .sum::<usize>()
        .next_multiple_of(16)
}
