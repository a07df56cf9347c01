//! Encoder and decoder, applied to one image at a time.

use skein_kernels::{Finish, Isa, Matrix, Panels, Rows, Start, Team, Windows, product};
use skein_protocol::snapshot::{ENCODER_CHANNELS, ENCODER_FEATURES, ENCODER_KERNEL};
use skein_protocol::{IMAGE_HEIGHT, IMAGE_PIXELS, IMAGE_WIDTH};

use super::elementwise::{LANES, fill, rectify, scale};
use super::layer::{ConvLayer, LinearLayer, STRIDE};
use super::parameter_order::{LayerRanges, ParameterOrder};
use super::stopwatch::{Pass, Stopwatch};
use super::unfold::{self, Unfold};

/// Channels of the decoder's feature maps, from the first one with `[1, 3]` pixels to the depth
/// image.
const DECODER_CHANNELS: [usize; 5] = [1024, 128, 64, 32, 1];
const DECODER_KERNELS: [[usize; 2]; 4] = [[5, 7], [6, 8], [7, 8], [8, 6]];

/// Indices of the layers in [`super::stopwatch::LAYERS`].
pub(super) const HEADS: usize = 4;
pub(super) const LINEAR: usize = 5;
pub(super) const UNFOLD: usize = 6;
pub(super) const DECODER: usize = 7;

/// All layers of the VAE.
#[derive(Debug)]
pub(super) struct VaeNetwork {
    isa: Isa,
    pub(super) encoder: [ConvLayer; 4],
    /// Both heads as one layer: mean, then log-variance.
    pub(super) heads: LinearLayer,
    /// Weights of the mean head alone, `[3072, latent]`, for encoding.
    mean: Panels,
    pub(super) linear: LinearLayer,
    pub(super) unfold: Unfold,
    /// Transposed convolutions after the first one.
    pub(super) decoder: [ConvLayer; 3],
}

impl VaeNetwork {
    /// Describes the network for codes of `latent` numbers.
    pub(super) fn new(isa: Isa, latent: usize, order: &ParameterOrder) -> Self {
        let mut size = [IMAGE_HEIGHT, IMAGE_WIDTH];
        let encoder = std::array::from_fn(|index| {
            let windows = Windows::new(size, ENCODER_CHANNELS[index], [ENCODER_KERNEL; 2], STRIDE);
            size = windows.positions();
            let place = order.layer(&format!("encoder.conv{}", index + 1));
            ConvLayer::new(isa, windows, ENCODER_CHANNELS[index + 1], place)
        });
        assert!(
            (2 * latent).is_multiple_of(LANES),
            "bias gradients of the heads are summed in whole lanes"
        );
        let mut heads = order.layer("encoder.mean");
        let log_variance = order.layer("encoder.log_variance");
        heads.weight.end = log_variance.weight.end;
        heads.bias.end = log_variance.bias.end;
        let mut size = [1, 3];
        let grown = |size: [usize; 2], kernel: [usize; 2]| {
            [0, 1].map(|axis| STRIDE * (size[axis] - 1) + kernel[axis])
        };
        size = grown(size, DECODER_KERNELS[0]);
        let decoder = std::array::from_fn(|index| {
            let (layer, kernel) = (index + 1, DECODER_KERNELS[index + 1]);
            size = grown(size, kernel);
            let windows = Windows::new(size, DECODER_CHANNELS[layer + 1], kernel, STRIDE);
            let place = order.layer(&format!("decoder.conv{}", layer + 1));
            ConvLayer::new(isa, windows, DECODER_CHANNELS[layer], place)
        });
        assert_eq!(
            size,
            [IMAGE_HEIGHT, IMAGE_WIDTH],
            "the decoder's output has the size of the encoder's input"
        );
        Self {
            isa,
            encoder,
            heads: LinearLayer::new(isa, ENCODER_FEATURES, 2 * latent, heads),
            mean: Panels::new(isa),
            linear: LinearLayer::new(
                isa,
                latent,
                unfold::INPUT_LEN,
                order.layer("decoder.linear"),
            ),
            unfold: Unfold::new(isa, order.layer("decoder.conv1")),
            decoder,
        }
    }

    /// Packs all weights except those of the decoder's first convolution.
    pub(super) fn pack(&mut self, team: &mut Team, parameters: &[f32]) {
        let mean = &parameters[self.heads.place.weight.clone()][..self.latent() * ENCODER_FEATURES];
        self.mean
            .pack(Matrix::of_rows(mean, ENCODER_FEATURES).transposed());
        self.heads.pack(parameters);
        self.linear.pack(parameters);
        let mut layers: Vec<&mut ConvLayer> =
            self.encoder.iter_mut().chain(&mut self.decoder).collect();
        team.split_rows(&mut layers, 1, 1, |_, layers| {
            layers.iter_mut().for_each(|layer| layer.pack(parameters));
        });
    }

    /// Runs the encoder's convolutions: depth, `[72, 128]`, to pixels in [0, 1] and four feature
    /// maps, the last of which are the features.
    pub(super) fn encoder_forward(
        &self,
        parameters: &[f32],
        depth: &[u8],
        images: [&mut [f32]; 5],
        watch: &mut Stopwatch,
    ) {
        let [pixels, rest @ ..] = images;
        scale(self.isa, depth, pixels);
        watch.rest();
        let mut input = &*pixels;
        for (index, (layer, output)) in self.encoder.iter().zip(rest).enumerate() {
            let bias = &parameters[layer.place.bias.clone()];
            layer.look(input, Start::Bias(bias), Finish::Rectified, output);
            watch.layer(index, Pass::Forward);
            input = output;
        }
    }

    /// Computes the latent mean from the features, into `code`, `[latent]`.
    pub(super) fn mean(&self, parameters: &[f32], features: &[f32], code: &mut [f32]) {
        let bias = &parameters[self.heads.place.bias.clone()][..self.latent()];
        let (rows, start) = (Rows::Matrix(features), Start::Bias(bias));
        product(rows, &self.mean, start, Finish::Plain, code);
    }

    /// Length of a latent code.
    pub(super) fn latent(&self) -> usize {
        self.linear.inputs
    }

    /// Runs the decoder's convolutions for image `index` of a batch whose codes have gone through
    /// [`Unfold::multiply`]. Fills four feature maps, the last one before its sigmoid.
    pub(super) fn decoder_forward(
        &self,
        parameters: &[f32],
        index: usize,
        images: [&mut [f32]; 4],
        columns: &mut Vec<f32>,
        watch: &mut Stopwatch,
    ) {
        let [first, rest @ ..] = images;
        let bias = |place: &LayerRanges| &parameters[place.bias.clone()];
        self.unfold
            .add_up(self.isa, bias(&self.unfold.place), index, first);
        rectify(self.isa, first);
        watch.layer(UNFOLD, Pass::Forward);
        let mut input = &*first;
        for (index, (layer, output)) in self.decoder.iter().zip(rest).enumerate() {
            fill(output, bias(&layer.place));
            layer.spread(input, columns, output);
            if index + 1 < self.decoder.len() {
                rectify(self.isa, output);
            }
            watch.layer(DECODER + index, Pass::Forward);
            input = output;
        }
    }

    /// Lengths of the pixels and of each of the encoder's feature maps.
    pub(super) fn encoder_lens(&self) -> [usize; 5] {
        let [a, b, c, d] = [0, 1, 2, 3].map(|layer| self.encoder[layer].rows_len());
        [IMAGE_PIXELS, a, b, c, d]
    }

    /// Lengths of the decoder's feature maps.
    pub(super) fn decoder_lens(&self) -> [usize; 4] {
        let [a, b, c] = [0, 1, 2].map(|layer| self.decoder[layer].windows.image_len());
        [unfold::IMAGE_LEN, a, b, c]
    }

    /// Parameter ranges of the encoder's convolutions, in order. Each image has its own sums for
    /// their biases.
    pub(super) fn encoder_places(&self) -> [&LayerRanges; 4] {
        [0, 1, 2, 3].map(|layer| &self.encoder[layer].place)
    }

    /// Parameter ranges of the decoder's convolutions, in order.
    pub(super) fn decoder_places(&self) -> [&LayerRanges; 4] {
        let [a, b, c] = [0, 1, 2].map(|layer| &self.decoder[layer].place);
        [&self.unfold.place, a, b, c]
    }

    /// Floating-point operations per image of one pass of each layer, in the order of
    /// [`super::stopwatch::LAYERS`].
    pub(super) fn operations(&self) -> [f64; 10] {
        let encoder = [0, 1, 2, 3].map(|layer| self.encoder[layer].operations());
        let decoder = [0, 1, 2].map(|layer| self.decoder[layer].operations());
        let between = [
            self.heads.operations(),
            self.linear.operations(),
            Unfold::operations(),
        ];
        let all = encoder.into_iter().chain(between).chain(decoder);
        let mut operations = [0.0; 10];
        operations
            .iter_mut()
            .zip(all)
            .for_each(|(into, from)| *into = from);
        operations
    }
}
