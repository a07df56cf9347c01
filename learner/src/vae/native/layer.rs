//! A convolution or a transposed convolution: the same weights applied in either direction.
//!
//! Both connect an image with rows of channels, one row for each position of the kernel on the
//! image. A convolution *looks* through these windows: image to rows. A transposed one *spreads*
//! rows through them: rows to image. The gradient goes in the opposite direction, and the weights'
//! gradient is the same product for both.

use skein_kernels::{
    Finish, Isa, Matrix, Panels, Rows, Start, Team, Terms, Windows, gradient, product, spread,
};

use super::parameter_order::LayerRanges;

/// Stride of every kernel.
pub(super) const STRIDE: usize = 2;

/// A layer with weights `[channels, window]`.
#[derive(Debug)]
pub(super) struct ConvLayer {
    pub(super) windows: Windows,
    /// Number of channels per row.
    pub(super) channels: usize,
    pub(super) place: LayerRanges,
    /// Weights packed for looking, `[window, channels]`.
    looking: Panels,
    /// Weights packed for spreading, `[channels, window]`.
    spreading: Panels,
}

impl ConvLayer {
    pub(super) fn new(isa: Isa, windows: Windows, channels: usize, place: LayerRanges) -> Self {
        assert_eq!(
            place.weight.len(),
            channels * windows.window_len(),
            "a layer's weights"
        );
        let [looking, spreading] = [0; 2].map(|_| Panels::new(isa));
        Self {
            windows,
            channels,
            place,
            looking,
            spreading,
        }
    }

    /// Packs the present weights.
    pub(super) fn pack(&mut self, parameters: &[f32]) {
        let weights = Matrix::of_rows(
            &parameters[self.place.weight.clone()],
            self.windows.window_len(),
        );
        self.looking.pack(weights.transposed());
        self.spreading.pack(weights);
    }

    /// Computes `rows`, `[windows, channels]`, from an image.
    pub(super) fn look(
        &self,
        image: &[f32],
        start: Start<'_>,
        finish: Finish<'_>,
        rows: &mut [f32],
    ) {
        product(
            Rows::Windows(&self.windows, image),
            &self.looking,
            start,
            finish,
            rows,
        );
    }

    /// Adds the image that `rows` produce to `image`.
    pub(super) fn spread(&self, rows: &[f32], scratch: &mut Vec<f32>, image: &mut [f32]) {
        spread(rows, &self.spreading, &self.windows, scratch, image);
    }

    /// Computes the weights' gradient from rows and images of the whole batch: one holds the input,
    /// the other the gradient with respect to the output.
    pub(super) fn gradient(
        &self,
        team: &mut Team,
        isa: Isa,
        rows: &[f32],
        images: &[f32],
        all: &mut [f32],
    ) {
        let rows = Matrix::of_rows(rows, self.channels);
        let terms = Terms::Windows(&self.windows, images);
        gradient(team, isa, rows, terms, &mut all[self.place.weight.clone()]);
    }

    /// Length of all rows of an image.
    pub(super) fn rows_len(&self) -> usize {
        self.windows.count() * self.channels
    }

    /// Operations of one pass per image.
    pub(super) fn operations(&self) -> f64 {
        2.0 * (self.rows_len() * self.windows.window_len()) as f64
    }
}

/// A fully connected layer with weights `[outputs, inputs]`.
#[derive(Debug)]
pub(super) struct LinearLayer {
    pub(super) inputs: usize,
    pub(super) outputs: usize,
    pub(super) place: LayerRanges,
    /// Weights packed for the forward pass, `[inputs, outputs]`.
    forward: Panels,
    /// Weights packed for the backward pass, `[outputs, inputs]`.
    backward: Panels,
}

impl LinearLayer {
    pub(super) fn new(isa: Isa, inputs: usize, outputs: usize, place: LayerRanges) -> Self {
        assert_eq!(
            (place.weight.len(), place.bias.len()),
            (inputs * outputs, outputs),
            "a layer's weights"
        );
        let [forward, backward] = [0; 2].map(|_| Panels::new(isa));
        Self {
            inputs,
            outputs,
            place,
            forward,
            backward,
        }
    }

    /// Packs the present weights.
    pub(super) fn pack(&mut self, parameters: &[f32]) {
        let weights = Matrix::of_rows(&parameters[self.place.weight.clone()], self.inputs);
        self.forward.pack(weights.transposed());
        self.backward.pack(weights);
    }

    /// Maps `[n, inputs]` to `[n, outputs]`; the members share the rows.
    pub(super) fn forward(
        &self,
        team: &mut Team,
        parameters: &[f32],
        input: &[f32],
        finish: Finish<'_>,
        output: &mut [f32],
    ) {
        let bias = &parameters[self.place.bias.clone()];
        rows_times(
            team,
            input,
            &self.forward,
            Start::Bias(bias),
            finish,
            output,
        );
    }

    /// Computes the gradient with respect to the input, `[n, inputs]`, from the gradient with
    /// respect to the output, `[n, outputs]`.
    pub(super) fn backward(
        &self,
        team: &mut Team,
        grad: &[f32],
        finish: Finish<'_>,
        input: &mut [f32],
    ) {
        rows_times(team, grad, &self.backward, Start::Zero, finish, input);
    }

    /// Computes the gradient with respect to weights and biases.
    pub(super) fn gradient(
        &self,
        team: &mut Team,
        isa: Isa,
        grad: &[f32],
        input: &[f32],
        all: &mut [f32],
    ) {
        let left = Matrix::of_rows(grad, self.outputs);
        let terms = Terms::Matrix(input, self.inputs);
        gradient(team, isa, left, terms, &mut all[self.place.weight.clone()]);
        super::elementwise::column_sums(isa, grad, &mut all[self.place.bias.clone()]);
    }

    /// Operations of one pass per image.
    pub(super) fn operations(&self) -> f64 {
        2.0 * (self.inputs * self.outputs) as f64
    }
}

/// Multiplies few rows by packed weights; the members share the rows.
fn rows_times(
    team: &mut Team,
    rows: &[f32],
    panels: &Panels,
    start: Start<'_>,
    finish: Finish<'_>,
    output: &mut [f32],
) {
    let (terms, columns) = (panels.terms(), panels.columns());
    team.split_rows(output, columns, 1, |first, output| {
        let count = output.len() / columns;
        let rows = &rows[first * terms..][..count * terms];
        let finish = match finish {
            Finish::Gated(by) => Finish::Gated(&by[first * columns..][..count * columns]),
            finish => finish,
        };
        product(Rows::Matrix(rows), panels, start, finish, output);
    });
}
