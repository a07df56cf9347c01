//! A fully connected layer for one observation at a time.

use skein_kernels::{Finish, Isa, Matrix, Panels, Rows, Start, product};

/// Weights and bias of a layer, arranged for [`Linear::apply`].
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
    /// If the number of weights is not a multiple of the number of outputs.
    pub(super) fn new(isa: Isa, weights: &[f32], bias: &[f32]) -> Self {
        assert!(
            weights.len().is_multiple_of(bias.len()),
            "the same number of weights for each output"
        );
        Self {
            weights: Panels::of(
                isa,
                Matrix::of_rows(weights, weights.len() / bias.len()).transposed(),
            ),
            bias: bias.to_vec(),
        }
    }

    /// Number of outputs.
    pub(super) fn outputs(&self) -> usize {
        self.bias.len()
    }

    /// Writes `finish(bias + weights · input)` to `output`, `[outputs]`.
    ///
    /// # Panics
    /// If `input` or `output` has another length.
    pub(super) fn apply(&self, input: &[f32], finish: Finish<'_>, output: &mut [f32]) {
        assert_eq!(
            input.len(),
            self.weights.terms(),
            "the input has the length of a row of weights"
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
