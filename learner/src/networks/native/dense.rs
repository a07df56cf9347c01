//! Fully connected networks with ReLU between their layers, forward and backward, on the kernels.
//!
//! An update's numbers are more than the nearer caches hold, and what has to be fetched from memory
//! is what it waits for. So rows go through all layers some hundred at a time: what a layer gives
//! is still there when the next one takes it; what nobody needs later is written over by the next
//! rows; and weights are packed when their turn comes, not beforehand. Which rows go together, and
//! which member of the team takes them, changes no bit.

use std::cell::RefCell;
use std::ops::Range;

use skein_kernels::{Finish, Isa, Matrix, Start, Team, Terms, gradient, product_once};

use crate::networks::ParameterSpec;

/// Rows that go through all layers together: all that one member has of a minibatch of 256.
const ROWS_AT_ONCE: usize = 264;
/// What parts of rows are multiples of: the height of every instruction set's tiles divides it.
const ROW_GRAIN: usize = 12;
/// Columns of a bias's gradient that stay with one member.
const COLUMN_GRAIN: usize = 64;

/// What there is of each layer for so many rows, `[rows, outputs]` each: what it gave, or what
/// flows back to its sums.
pub type Layers = Vec<Vec<f32>>;

thread_local! {
    /// Two layers' numbers for rows that are under way, when nobody needs them later.
    static PASSING: RefCell<[Vec<f32>; 2]> = RefCell::default();
}

/// A network's layers.
#[derive(Debug)]
pub struct Dense {
    isa: Isa,
    layers: Vec<Layer>,
}

#[derive(Debug)]
struct Layer {
    inputs: usize,
    outputs: usize,
    /// Places in the network's flat vector: `[outputs, inputs]` and `[outputs]`.
    weight: Range<usize>,
    bias: Range<usize>,
}

impl Layer {
    /// `[outputs, inputs]`.
    fn weights<'a>(&self, parameters: &'a [f32]) -> Matrix<'a> {
        Matrix::of_rows(&parameters[self.weight.clone()], self.inputs)
    }
}

impl Dense {
    /// The layers of these tensors: a weight, `[outputs, inputs]`, and a bias for each.
    pub fn new(isa: Isa, tensors: &[ParameterSpec]) -> Self {
        let mut start = 0;
        let mut place = |len: usize| {
            start += len;
            start - len..start
        };
        let layers = tensors.chunks_exact(2).map(|tensors| {
            let [weight, bias] = [&tensors[0], &tensors[1]];
            Layer {
                outputs: weight.shape[0] as usize,
                inputs: weight.shape[1] as usize,
                weight: place(weight.len()),
                bias: place(bias.len()),
            }
        });
        let layers = layers.collect();
        Self { isa, layers }
    }

    /// Places for what each layer gives for so many rows.
    pub fn places(&self, rows: usize) -> Layers {
        let places = self
            .layers
            .iter()
            .map(|layer| vec![0.0; rows * layer.outputs]);
        places.collect()
    }

    fn inputs(&self) -> usize {
        self.layers[0].inputs
    }

    fn outputs(&self) -> usize {
        self.layers.last().expect("a network has layers").outputs
    }

    /// hᵢ = relu(hᵢ₋₁ Wᵢᵀ + bᵢ), the last layer's without relu.
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

    /// ∂zᵢ₋₁ = ∂zᵢ Wᵢ where hᵢ₋₁ > 0.
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

    /// h₀ = `input`, `[rows, inputs]`; fills `given` with all hᵢ.
    pub fn forward(&self, team: &mut Team, parameters: &[f32], input: &[f32], given: &mut Layers) {
        let mut parts = self.parts(input.len() / self.inputs(), team.size(), given);
        team.split_rows(&mut parts, 1, 1, |_, parts| {
            for Part { first, layers } in parts {
                let rows = layers[0].len() / self.layers[0].outputs;
                let mut input = &input[*first * self.inputs()..][..rows * self.inputs()];
                for (index, given) in layers.iter_mut().enumerate() {
                    self.layer_forward(index, parameters, input, given);
                    input = given;
                }
            }
        });
    }

    /// [`Dense::forward`] of which only the last layer's is kept, in `output`.
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

    /// What flows back to each layer's sums zᵢ = hᵢ₋₁ Wᵢᵀ + bᵢ. The last of `grad` is given, the
    /// others are filled. `given`: what the layers gave for the same rows.
    pub fn backward(&self, team: &mut Team, parameters: &[f32], given: &Layers, grad: &mut Layers) {
        let rows = grad[0].len() / self.layers[0].outputs;
        let mut parts = self.parts(rows, team.size(), grad);
        team.split_rows(&mut parts, 1, 1, |_, parts| {
            for Part { first, layers } in parts {
                for index in (1..layers.len()).rev() {
                    let [into, from] = &mut layers[index - 1..=index] else {
                        unreachable!("two layers side by side")
                    };
                    let before =
                        &given[index - 1][*first * self.layers[index - 1].outputs..][..into.len()];
                    self.layer_backward(index, parameters, from, before, into);
                }
            }
        });
    }

    /// What flows back to some columns of the input, `[rows, columns]`, from what flows to the last
    /// layer's sums, `[rows, outputs]`. `given`: as for [`Dense::backward`].
    pub fn backward_through(
        &self,
        team: &mut Team,
        parameters: &[f32],
        given: &Layers,
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
                        let before = &given[index - 1][start * width..][..rows * width];
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

    /// The gradient of all parameters, summed over rows: ∂Wᵢ = ∂zᵢᵀ hᵢ₋₁, ∂bᵢ = Σ ∂zᵢ. `given` and
    /// `grad`: of as many rows as `input`.
    pub fn gradient(
        &self,
        team: &mut Team,
        input: &[f32],
        given: &Layers,
        grad: &Layers,
        into: &mut [f32],
    ) {
        for (index, layer) in self.layers.iter().enumerate() {
            let (grad, inputs) = (&grad[index], layer.inputs);
            let input = if index == 0 { input } else { &given[index - 1] };
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

    /// Cuts rows into parts that go through all layers, as many for each member.
    fn parts<'a>(&self, rows: usize, members: usize, layers: &'a mut Layers) -> Vec<Part<'a>> {
        let rows_each = rows_each(rows, members);
        let part = |first| Part {
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

/// Rows of a part, so that each member has as many parts.
fn rows_each(rows: usize, members: usize) -> usize {
    let parts = members * rows.div_ceil(members * ROWS_AT_ONCE);
    rows.div_ceil(parts).next_multiple_of(ROW_GRAIN)
}

/// Some rows of all layers.
struct Part<'a> {
    first: usize,
    layers: Vec<&'a mut [f32]>,
}

/// What the last layer gave.
pub fn output(layers: &Layers) -> &[f32] {
    layers.last().expect("a network has layers")
}

/// As [`output`].
pub fn output_mut(layers: &mut Layers) -> &mut [f32] {
    layers.last_mut().expect("a network has layers")
}
