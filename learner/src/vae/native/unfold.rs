//! The decoder's first transposed convolution: three pixels of 1024 channels to 5 × 11 of 128.
//!
//! It has three quarters of all weights but only three windows per image, so reading the weights,
//! not multiplying, would take the time. Therefore it is computed for the whole batch at once, in
//! independent blocks of weights. An input pixel contributes five runs of seven pixels to the
//! image, one in each image row; a block is one run, for all input channels. A block stays in the
//! caches from its gradient through Adam to packing, and the whole gradient is never stored.

use skein_kernels::{
    AdamStep, Finish, Isa, Matrix, Panels, Rows, Start, Team, Terms, Windows, gradient, product,
};

use super::buffer::Buffer;
use super::elementwise::{fill, squares};
use super::layer::STRIDE;
use super::parameter_order::LayerRanges;

/// Rows of the image and of the kernel: the input has one row, so kernel row k makes image row k
/// and nothing else.
const ROWS: usize = 5;
/// Pixels of the input.
const INPUTS: usize = 3;
/// Channels of the input.
const INPUT_CHANNELS: usize = 1024;
const KERNEL_WIDTH: usize = 7;
const CHANNELS: usize = 128;
/// Length of an input pixel's contribution to an image row: seven pixels side by side.
const RUN: usize = KERNEL_WIDTH * CHANNELS;
/// Length of an image row, 11 pixels.
const ROW: usize = (STRIDE * (INPUTS - 1) + KERNEL_WIDTH) * CHANNELS;
/// Lengths of the input and of the image.
pub(super) const INPUT_LEN: usize = INPUTS * INPUT_CHANNELS;
pub(super) const IMAGE_LEN: usize = ROWS * ROW;
/// Weights in a block, `[1024, RUN]`. Each image row has a block.
const BLOCK: usize = INPUT_CHANNELS * RUN;

/// The layer's packed weights and the batch's columns.
#[derive(Debug)]
pub(super) struct Unfold {
    pub(super) place: LayerRanges,
    /// Packed weights of each block, `[1024, RUN]`.
    panels: [Panels; ROWS],
    /// The block weights seen as an image, so that a window holds all weights of one input channel.
    weights: Windows,
    /// Contribution of each input pixel to each run, or the gradient with respect to it:
    /// `[ROWS, 3 n, RUN]`.
    columns: Buffer,
}

/// Working memory of one team member.
#[derive(Debug)]
pub(super) struct UnfoldScratch {
    team: Team,
    seen: Buffer,
    panels: Panels,
    transposed: Buffer,
    gradient: Buffer,
}

impl UnfoldScratch {
    pub(super) fn new(isa: Isa) -> Self {
        Self {
            team: Team::new(1),
            seen: Buffer::default(),
            panels: Panels::new(isa),
            transposed: Buffer::default(),
            gradient: Buffer::default(),
        }
    }
}

/// One block of weights, with all that its update needs.
#[derive(Debug)]
pub(super) struct WeightBlock<'a> {
    panels: &'a mut Panels,
    /// Gradient with respect to the block's output, `[3 n, RUN]`.
    columns: &'a [f32],
    weights: &'a mut [f32],
    moments: [&'a mut [f32]; 2],
}

impl Unfold {
    pub(super) fn new(isa: Isa, place: LayerRanges) -> Self {
        assert_eq!(place.weight.len(), ROWS * BLOCK, "the layer's weights");
        Self {
            place,
            panels: std::array::from_fn(|_| Panels::new(isa)),
            weights: Windows::new([ROWS, INPUT_CHANNELS], RUN, [ROWS, 1], 1),
            columns: Buffer::default(),
        }
    }

    /// Packs the present weights.
    pub(super) fn pack(&mut self, parameters: &[f32]) {
        let weights = parameters[self.place.weight.clone()].chunks_exact(BLOCK);
        for (panels, weights) in self.panels.iter_mut().zip(weights) {
            panels.pack(Matrix::of_rows(weights, RUN));
        }
    }

    /// First half of the forward pass: multiplies each input pixel, `[3 n, 1024]`, with all blocks.
    pub(super) fn multiply(&mut self, team: &mut Team, input: &[f32]) {
        let pixels = input.len() / INPUT_CHANNELS;
        self.columns.resize(ROWS * pixels * RUN);
        for (panels, columns) in self
            .panels
            .iter()
            .zip(self.columns.chunks_exact_mut(pixels * RUN))
        {
            team.split_rows(columns, RUN, 1, |first, columns| {
                let rows = &input[first * INPUT_CHANNELS..][..columns.len() / RUN * INPUT_CHANNELS];
                product(
                    Rows::Matrix(rows),
                    panels,
                    Start::Zero,
                    Finish::Plain,
                    columns,
                );
            });
        }
    }

    /// Second half: adds up image `index` of the batch, `[5, 11, 128]`, before its ReLU.
    pub(super) fn add_up(&self, isa: Isa, bias: &[f32], index: usize, image: &mut [f32]) {
        fill(image, bias);
        for (row, image) in image.chunks_exact_mut(ROW).enumerate() {
            for pixel in 0..INPUTS {
                let into = &mut image[pixel * STRIDE * CHANNELS..][..RUN];
                let from = self.column(row, INPUTS * index + pixel);
                isa.vectorised(
                    #[inline(always)]
                    || {
                        for (into, from) in into.iter_mut().zip(from) {
                            *into += from;
                        }
                    },
                );
            }
        }
    }

    fn column(&self, block: usize, pixel: usize) -> &[f32] {
        let pixels = self.columns.len() / (ROWS * RUN);
        &self.columns[(block * pixels + pixel) * RUN..][..RUN]
    }

    /// First half of the backward pass: gathers the columns of each input pixel from the gradient
    /// with respect to the images, `[n, 5, 11, 128]`.
    pub(super) fn gather(&mut self, grad: &[f32]) {
        let images = grad.len() / (ROWS * ROW);
        self.columns.resize(ROWS * INPUTS * images * RUN);
        for (index, image) in grad.chunks_exact(ROWS * ROW).enumerate() {
            for (row, image) in image.chunks_exact(ROW).enumerate() {
                for pixel in 0..INPUTS {
                    let from = &image[pixel * STRIDE * CHANNELS..][..RUN];
                    let place = (row * images + index) * INPUTS + pixel;
                    self.columns[place * RUN..][..RUN].copy_from_slice(from);
                }
            }
        }
    }

    /// Second half: computes the gradient with respect to the inputs of some images,
    /// `[3 · images, 1024]`, starting with image `first` of the batch. It is zero where `gate` is
    /// not positive.
    ///
    /// The weights are the left operand and are read in place, not packed: pixels are few, weights
    /// are many.
    pub(super) fn backward(
        &self,
        parameters: &[f32],
        scratch: &mut UnfoldScratch,
        first: usize,
        gate: &[f32],
        input: &mut [f32],
    ) {
        let pixels = input.len() / INPUT_CHANNELS;
        let UnfoldScratch {
            seen,
            panels,
            transposed,
            ..
        } = scratch;
        seen.resize(pixels * ROWS * RUN);
        for (pixel, seen) in seen.chunks_exact_mut(ROWS * RUN).enumerate() {
            for (block, seen) in seen.chunks_exact_mut(RUN).enumerate() {
                seen.copy_from_slice(self.column(block, INPUTS * first + pixel));
            }
        }
        panels.pack(Matrix::of_rows(seen, ROWS * RUN).transposed());
        transposed.resize(input.len());
        let weights = Rows::Windows(&self.weights, &parameters[self.place.weight.clone()]);
        product(weights, panels, Start::Zero, Finish::Plain, transposed);
        let (inputs, gates) = (
            input.chunks_exact_mut(INPUT_CHANNELS),
            gate.chunks_exact(INPUT_CHANNELS),
        );
        for (pixel, (input, gate)) in inputs.zip(gates).enumerate() {
            for (channel, (input, gate)) in input.iter_mut().zip(gate).enumerate() {
                *input = if *gate > 0.0 {
                    transposed[channel * pixels + pixel]
                } else {
                    0.0
                };
            }
        }
    }

    /// Upper bound of the squared norm of the weights' gradient (Cauchy and Schwarz): if it is
    /// finite, the gradient is.
    pub(super) fn gradient_bound(&self, isa: Isa, input: &[f32]) -> f64 {
        squares(isa, input) * squares(isa, &self.columns)
    }

    /// Splits the weights, their moments and columns into blocks.
    pub(super) fn blocks<'a>(
        &'a mut self,
        parameters: &'a mut [f32],
        moments: [&'a mut [f32]; 2],
    ) -> Vec<WeightBlock<'a>> {
        let range = self.place.weight.clone();
        let [first, second] = moments.map(|moment| moment[range.clone()].chunks_exact_mut(BLOCK));
        let columns = self.columns.chunks_exact(self.columns.len() / ROWS);
        let weights = parameters[range].chunks_exact_mut(BLOCK);
        let blocks = self
            .panels
            .iter_mut()
            .zip(columns)
            .zip(weights)
            .zip(first.zip(second));
        blocks
            .map(
                |(((panels, columns), weights), (first, second))| WeightBlock {
                    panels,
                    columns,
                    weights,
                    moments: [first, second],
                },
            )
            .collect()
    }

    /// Operations of one pass per image.
    pub(super) fn operations() -> f64 {
        2.0 * (INPUTS * ROWS * BLOCK) as f64
    }
}

impl WeightBlock<'_> {
    /// The gradient of this block's weights, `[1024, RUN]`. `input`: `[3 n, 1024]`.
    pub(super) fn gradient<'a>(
        &self,
        isa: Isa,
        input: &[f32],
        scratch: &'a mut UnfoldScratch,
    ) -> &'a [f32] {
        let UnfoldScratch {
            team,
            gradient: found,
            ..
        } = scratch;
        found.resize(BLOCK);
        let left = Matrix::of_rows(input, INPUT_CHANNELS);
        gradient(team, isa, left, Terms::Matrix(self.columns, RUN), found);
        found
    }

    /// Applies Adam with the gradient left by [`WeightBlock::gradient`], and packs the weights.
    pub(super) fn step(&mut self, isa: Isa, adam: AdamStep, scratch: &mut UnfoldScratch) {
        let [first, second] = &mut self.moments;
        adam.apply(
            &mut scratch.team,
            isa,
            self.weights,
            &scratch.gradient,
            [first, second],
        );
        self.panels.pack(Matrix::of_rows(self.weights, RUN));
    }
}
