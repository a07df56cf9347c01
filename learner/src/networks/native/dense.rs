//! Fully connected networks with ReLU between the layers, forward and backward, on the native
//! kernels.
//!
//! An update's numbers exceed the inner caches, and waiting for memory is what limits it. Therefore
//! some hundred rows at a time go through all layers: the output of one layer is still cached when
//! the next one reads it. Activations that are not needed later are overwritten by the next rows,
//! and weights are packed just before use. Neither the grouping of rows nor the choice of team
//! member changes a bit.

use std::cell::RefCell;
use std::ops::Range;

use skein_kernels::{Finish, Isa, Matrix, Start, Team, Terms, gradient, product_once};

use crate::networks::ParameterSpec;

/// Rows that go through all layers together: one member's share of a minibatch of 256.
const ROWS_AT_ONCE: usize = 264;
/// Row groups are multiples of this, which every instruction set's tile height divides.
const ROW_GRAIN: usize = 12;
/// Columns of a bias's gradient that stay with one member.
const COLUMN_GRAIN: usize = 64;

/// One buffer per layer, `[rows, outputs]` each: its activations, or the gradient with respect to
/// its sums.
pub type Layers = Vec<Vec<f32>>;

thread_local! {
    /// Two buffers for rows under way, used in turns when only the last layer's numbers are kept.
    static PASSING: RefCell<[Vec<f32>; 2]> = RefCell::default();
}

/// A fully connected network: the shapes of its layers and their ranges in the parameter vector.
#[derive(Debug)]
pub struct Dense {
    isa: Isa,
    layers: Vec<DenseLayer>,
}

#[derive(Debug)]
struct DenseLayer {
    inputs: usize,
    outputs: usize,
    /// Ranges in the network's flat vector, of shapes `[outputs, inputs]` and `[outputs]`.
    weight: Range<usize>,
    bias: Range<usize>,
}

impl DenseLayer {
    /// The weight matrix, `[outputs, inputs]`.
    fn weights<'a>(&self, parameters: &'a [f32]) -> Matrix<'a> {
        Matrix::of_rows(&parameters[self.weight.clone()], self.inputs)
    }
}

impl Dense {
    /// Returns the network of these tensors: per layer a weight, `[outputs, inputs]`, and a bias.
    pub fn new(isa: Isa, tensors: &[ParameterSpec]) -> Self {
        let mut start = 0;
        let mut place = |len: usize| {
            start += len;
            start - len..start
        };
        let layers = tensors.chunks_exact(2).map(|tensors| {
            let [weight, bias] = [&tensors[0], &tensors[1]];
            DenseLayer {
                outputs: weight.shape[0] as usize,
                inputs: weight.shape[1] as usize,
                weight: place(weight.len()),
                bias: place(bias.len()),
            }
        });
        let layers = layers.collect();
        Self { isa, layers }
    }

    /// Allocates a buffer per layer, for `rows` rows.
    pub fn allocate(&self, rows: usize) -> Layers {
        let allocate = self
            .layers
            .iter()
            .map(|layer| vec![0.0; rows * layer.outputs]);
        allocate.collect()
    }

    fn inputs(&self) -> usize {
        self.layers[0].inputs
    }

    fn outputs(&self) -> usize {
        self.layers.last().expect("a network has layers").outputs
    }

    /// hᵢ = relu(hᵢ₋₁ Wᵢᵀ + bᵢ), without relu in the last layer.
    fn layer_forward(&self, index: usize, parameters: &[f32], input: &[f32], output: &mut [f32]) {
        let layer = &self.layers[index];
        let last = index + 1 == self.layers.len();
        let finish = if last {
            Finish::Plain
        } else {
            Finish::Rectified
        };
        let bias = Start::Bias(&parameters[layer.bias.clone()]);
        product_once(
            self.isa,
            input,
            layer.weights(parameters).transposed(),
            bias,
            finish,
            output,
        );
    }

    /// ∂zᵢ₋₁ = ∂zᵢ Wᵢ where hᵢ₋₁ > 0, else 0.
    fn layer_backward(
        &self,
        index: usize,
        parameters: &[f32],
        grad: &[f32],
        before: &[f32],
        into: &mut [f32],
    ) {
        let weights = self.layers[index].weights(parameters);
        product_once(
            self.isa,
            grad,
            weights,
            Start::Zero,
            Finish::Gated(before),
            into,
        );
    }

    /// Computes all hᵢ into `activations`, from h₀ = `input`, `[rows, inputs]`.
    pub fn forward(
        &self,
        team: &mut Team,
        parameters: &[f32],
        input: &[f32],
        activations: &mut Layers,
    ) {
        let mut parts = self.parts(input.len() / self.inputs(), team.size(), activations);
        team.split_rows(&mut parts, 1, 1, |_, parts| {
            for RowGroup { first, layers } in parts {
                let rows = layers[0].len() / self.layers[0].outputs;
                let mut input = &input[*first * self.inputs()..][..rows * self.inputs()];
                for (index, activations) in layers.iter_mut().enumerate() {
                    self.layer_forward(index, parameters, input, activations);
                    input = activations;
                }
            }
        });
    }

    /// Computes [`Dense::forward`], but keeps only the last layer's `output`, `[rows, outputs]`.
    pub fn forward_through(
        &self,
        team: &mut Team,
        parameters: &[f32],
        input: &[f32],
        output: &mut [f32],
    ) {
        let rows_each = rows_each(output.len() / self.outputs(), team.size());
        let mut parts: Vec<_> = output.chunks_mut(rows_each * self.outputs()).collect();
        team.split_rows(&mut parts, 1, 1, |first, parts| {
            let inputs =
                input[first * rows_each * self.inputs()..].chunks(rows_each * self.inputs());
            for (output, input) in parts.iter_mut().zip(inputs) {
                let rows = output.len() / self.outputs();
                PASSING.with_borrow_mut(|[before, after]| {
                    let [hidden @ .., _] = &self.layers[..] else {
                        return;
                    };
                    for (index, layer) in hidden.iter().enumerate() {
                        let from: &[f32] = if index == 0 { input } else { &*before };
                        after.resize(rows * layer.outputs, 0.0);
                        self.layer_forward(index, parameters, from, after);
                        std::mem::swap(before, after);
                    }
                    let from: &[f32] = if hidden.is_empty() { input } else { &*before };
                    self.layer_forward(hidden.len(), parameters, from, output);
                });
            }
        });
    }

    /// Computes the gradient with respect to each layer's sums zᵢ = hᵢ₋₁ Wᵢᵀ + bᵢ. The caller fills
    /// the last buffer of `grad`; this fills the others. `activations`: those of the same rows.
    pub fn backward(
        &self,
        team: &mut Team,
        parameters: &[f32],
        activations: &Layers,
        grad: &mut Layers,
    ) {
        let rows = grad[0].len() / self.layers[0].outputs;
        let mut parts = self.parts(rows, team.size(), grad);
        team.split_rows(&mut parts, 1, 1, |_, parts| {
            for RowGroup { first, layers } in parts {
                for index in (1..layers.len()).rev() {
                    let [into, from] = &mut layers[index - 1..=index] else {
                        unreachable!("two layers side by side")
                    };
                    let before = &activations[index - 1][*first * self.layers[index - 1].outputs..]
                        [..into.len()];
                    self.layer_backward(index, parameters, from, before, into);
                }
            }
        });
    }

    /// Computes the gradient with respect to some columns of the input, `[rows, columns]`, from the
    /// gradient with respect to the last layer's sums, `[rows, outputs]`. `activations`: as for
    /// [`Dense::backward`].
    pub fn backward_through(
        &self,
        team: &mut Team,
        parameters: &[f32],
        activations: &Layers,
        grad: &[f32],
        columns: Range<usize>,
        into: &mut [f32],
    ) {
        let rows_each = rows_each(into.len() / columns.len(), team.size());
        let mut parts: Vec<_> = into.chunks_mut(rows_each * columns.len()).collect();
        team.split_rows(&mut parts, 1, 1, |first, parts| {
            for (part, into) in parts.iter_mut().enumerate() {
                let (start, rows) = ((first + part) * rows_each, into.len() / columns.len());
                PASSING.with_borrow_mut(|[from, to]| {
                    from.clear();
                    from.extend_from_slice(
                        &grad[start * self.outputs()..][..rows * self.outputs()],
                    );
                    for index in (1..self.layers.len()).rev() {
                        let width = self.layers[index - 1].outputs;
                        to.resize(rows * width, 0.0);
                        let before = &activations[index - 1][start * width..][..rows * width];
                        self.layer_backward(index, parameters, from, before, to);
                        std::mem::swap(from, to);
                    }
                    let weights = self.layers[0]
                        .weights(parameters)
                        .columns_of(columns.clone());
                    product_once(self.isa, from, weights, Start::Zero, Finish::Plain, into);
                });
            }
        });
    }

    /// Computes the gradient with respect to all parameters, summed over rows:
    /// ∂Wᵢ = ∂zᵢᵀ hᵢ₋₁, ∂bᵢ = Σ ∂zᵢ. `activations` and `grad` have as many rows as `input`.
    pub fn gradient(
        &self,
        team: &mut Team,
        input: &[f32],
        activations: &Layers,
        grad: &Layers,
        into: &mut [f32],
    ) {
        for (index, layer) in self.layers.iter().enumerate() {
            let (grad, inputs) = (&grad[index], layer.inputs);
            let input = if index == 0 {
                input
            } else {
                &activations[index - 1]
            };
            let left = Matrix::of_rows(grad, layer.outputs);
            let right = Terms::Matrix(input, inputs);
            gradient(team, self.isa, left, right, &mut into[layer.weight.clone()]);
            let bias = &mut into[layer.bias.clone()];
            team.split_rows(bias, 1, COLUMN_GRAIN, |first, sums| {
                self.isa.vectorised(
                    #[inline(always)]
                    || {
                        sums.fill(0.0);
                        for row in grad.chunks_exact(layer.outputs) {
                            for (sum, term) in sums.iter_mut().zip(&row[first..]) {
                                *sum += term;
                            }
                        }
                    },
                );
            });
        }
    }

    /// Splits the rows into groups that go through all layers, equally many per member.
    fn parts<'a>(&self, rows: usize, members: usize, layers: &'a mut Layers) -> Vec<RowGroup<'a>> {
        let rows_each = rows_each(rows, members);
        let part = |first| RowGroup {
            first,
            layers: Vec::with_capacity(layers.len()),
        };
        let mut parts: Vec<_> = (0..rows).step_by(rows_each).map(part).collect();
        for (layer, numbers) in self.layers.iter().zip(layers) {
            let numbers = numbers.chunks_mut(rows_each * layer.outputs);
            for (part, numbers) in parts.iter_mut().zip(numbers) {
                part.layers.push(numbers);
            }
        }
        parts
    }
}

/// Rows per group, so that each member has equally many groups.
fn rows_each(rows: usize, members: usize) -> usize {
    let parts = members * rows.div_ceil(members * ROWS_AT_ONCE);
    rows.div_ceil(parts).next_multiple_of(ROW_GRAIN)
}

/// A group of rows, in the buffers of all layers.
struct RowGroup<'a> {
    first: usize,
    layers: Vec<&'a mut [f32]>,
}

/// Buffer of the last layer.
pub fn output(layers: &Layers) -> &[f32] {
    layers.last().expect("a network has layers")
}

/// Buffer of the last layer, mutable.
pub fn output_mut(layers: &mut Layers) -> &mut [f32] {
    layers.last_mut().expect("a network has layers")
}
