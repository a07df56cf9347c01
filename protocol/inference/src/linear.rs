//! A fully connected layer for one observation at a time.

use skein_kernels::{Finish, Isa, Matrix, Panels, Rows, Start, product};

/// Weights and bias, arranged for [`Linear::apply`].
#[derive(Debug)]
pub(super) struct Linear {
    /// `[inputs, outputs]`.
    weights: Panels,
    bias: Vec<f32>,
}

impl Linear {
    /// `weights`: `[outputs, inputs]`, PyTorch's order; `bias`: `[outputs]`.
    ///
    /// # Panics
    /// When the weights are not as many for each output.
    pub(super) fn new(isa: Isa, weights: &[f32], bias: &[f32]) -> Self {
        assert!(
            weights.len().is_multiple_of(bias.len()),
            "as many weights for each output"
        );
        Self {
            weights: Panels::of(
                isa,
                Matrix::of_rows(weights, weights.len() / bias.len()).transposed(),
            ),
            bias: bias.to_vec(),
        }
    }

    /// Outputs.
    pub(super) fn outputs(&self) -> usize {
        self.bias.len()
    }

    /// `finish(bias + weights · input)` into `output`, `[outputs]`.
    ///
    /// # Panics
    /// When `input` or `output` has another length.
    pub(super) fn apply(&self, input: &[f32], finish: Finish<'_>, output: &mut [f32]) {
        assert_eq!(
            input.len(),
            self.weights.terms(),
            "as many inputs as the layer has weights for"
        );
        product(
            Rows::Matrix(input),
            &self.weights,
            Start::Bias(&self.bias),
            finish,
            output,
        );
    }
}
