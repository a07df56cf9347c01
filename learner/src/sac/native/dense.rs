//! Fully connected networks with ReLU between their layers, forward and backward, on the kernels.
//!
//! Rows go through all layers a hundred or two at a time: what a layer gives is still in the cache when the next one takes it. Which rows go together, and which
//! member of the team takes them, changes no bit.

use std::ops::Range;

use skein_kernels::{Finish, Isa, Matrix, Panels, Rows, Start, Team, Terms, gradient, product};

use crate::networks::Layout;

/// Rows that go through all layers together: their numbers in a layer of 256 are 192 KB.
const ROWS_AT_ONCE: usize = 192;
/// What parts of rows are multiples of: the height of every instruction set's tiles divides it.
const ROW_GRAIN: usize = 12;
/// Columns of a bias's gradient that stay with one member.
const COLUMN_GRAIN: usize = 64;

/// What there is of each layer for so many rows, `[rows, outputs]` each: what it gave, or what flows back to its sums.
pub(super) type Layers = Vec<Vec<f32>>;

/// A network's layers, with its weights packed for products.
#[derive(Debug)]
pub(super) struct Dense {
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
    /// Wᵀ: from inputs to outputs.
    forward: Panels,
    /// W: back from outputs to inputs.
    backward: Panels,
}

/// Weights to be packed.
pub(super) struct Packing<'a> {
    panels: &'a mut Panels,
    weights: Matrix<'a>,
}

/// Packs all of them, each member of the team some.
pub(super) fn pack(team: &mut Team, mut packings: Vec<Packing<'_>>) {
    team.split_rows(&mut packings, 1, 1, |_, packings| {
        for Packing { panels, weights } in packings {
            panels.pack(*weights);
        }
    });
}

impl Dense {
    /// The layers of a layout: a weight, `[outputs, inputs]`, and a bias for each.
    pub(super) fn new(isa: Isa, layout: &Layout) -> Self {
        let mut start = 0;
        let mut place = |len: usize| {
            start += len;
            start - len..start
        };
        let layers = layout.tensors().chunks_exact(2).map(|tensors| {
            let [weight, bias] = [&tensors[0], &tensors[1]];
            Layer {
                outputs: weight.shape[0] as usize,
                inputs: weight.shape[1] as usize,
                weight: place(weight.len()),
                bias: place(bias.len()),
                forward: Panels::new(isa),
                backward: Panels::new(isa),
            }
        });
        let layers = layers.collect();
        Self { isa, layers }
    }

    /// Places for what each layer gives for so many rows.
    pub(super) fn places(&self, rows: usize) -> Layers {
        let places = self.layers.iter().map(|layer| vec![0.0; rows * layer.outputs]);
        places.collect()
    }

    /// What [`Dense::forward`] needs packed.
    pub(super) fn forward_packings<'a>(&'a mut self, parameters: &'a [f32]) -> impl Iterator<Item = Packing<'a>> {
        self.layers.iter_mut().map(|layer| Packing {
            panels: &mut layer.forward,
            weights: Matrix::of_rows(&parameters[layer.weight.clone()], layer.inputs).transposed(),
        })
    }

    /// What [`Dense::forward`] and [`Dense::backward`] need packed.
    pub(super) fn packings<'a>(&'a mut self, parameters: &'a [f32]) -> impl Iterator<Item = Packing<'a>> {
        self.layers.iter_mut().enumerate().flat_map(|(index, layer)| {
            let weights = Matrix::of_rows(&parameters[layer.weight.clone()], layer.inputs);
            let forward = Packing {
                panels: &mut layer.forward,
                weights: weights.transposed(),
            };
            let backward = Packing {
                panels: &mut layer.backward,
                weights,
            };
            // Nothing flows back to the input but through `Input`.
            std::iter::once(forward).chain((index > 0).then_some(backward))
        })
    }

    /// h₀ = `input`, hᵢ = relu(hᵢ₋₁ Wᵢᵀ + bᵢ), the last layer's without relu; fills `given` with all hᵢ. `input`: `[rows, inputs]`.
    pub(super) fn forward(&self, team: &mut Team, parameters: &[f32], input: &[f32], given: &mut Layers) {
        let last = self.layers.len() - 1;
        let rows = input.len() / self.layers[0].inputs;
        let mut parts = self.parts(rows, team.size(), given);
        team.split_rows(&mut parts, 1, 1, |_, parts| {
            for Part { first, layers } in parts {
                let inputs = self.layers[0].inputs;
                let rows = layers[0].len() / self.layers[0].outputs;
                let mut input = &input[*first * inputs..][..rows * inputs];
                for (index, (layer, given)) in self.layers.iter().zip(layers).enumerate() {
                    let finish = if index < last { Finish::Rectified } else { Finish::Plain };
                    let bias = Start::Bias(&parameters[layer.bias.clone()]);
                    product(Rows::Matrix(input), &layer.forward, bias, finish, given);
                    input = given;
                }
            }
        });
    }

    /// What flows back to each layer's sums zᵢ = hᵢ₋₁ Wᵢᵀ + bᵢ: ∂zᵢ₋₁ = (∂zᵢ Wᵢ) where hᵢ₋₁ > 0. The last of `flowing` is given, the others are filled.
    /// `given`: what the layers gave for the same rows.
    pub(super) fn backward(&self, team: &mut Team, given: &[&[f32]], flowing: &mut Layers) {
        let rows = flowing[0].len() / self.layers[0].outputs;
        let mut parts = self.parts(rows, team.size(), flowing);
        team.split_rows(&mut parts, 1, 1, |_, parts| {
            for Part { first, layers } in parts {
                for index in (1..layers.len()).rev() {
                    let [into, from] = &mut layers[index - 1..=index] else {
                        unreachable!("two layers side by side")
                    };
                    let gate = &given[index - 1][*first * self.layers[index - 1].outputs..][..into.len()];
                    let panels = &self.layers[index].backward;
                    product(Rows::Matrix(from), panels, Start::Zero, Finish::Gated(gate), into);
                }
            }
        });
    }

    /// The gradient of all parameters, summed over rows: ∂Wᵢ = ∂zᵢᵀ hᵢ₋₁, ∂bᵢ = Σ ∂zᵢ. `given` and `flowing`: of as many rows as `input`.
    pub(super) fn gradient(
        &self,
        team: &mut Team,
        input: &[f32],
        given: &[&[f32]],
        flowing: &[&[f32]],
        into: &mut [f32],
    ) {
        for (index, layer) in self.layers.iter().enumerate() {
            let (flowing, inputs) = (flowing[index], layer.inputs);
            let input = if index == 0 { input } else { given[index - 1] };
            let left = Matrix::of_rows(flowing, layer.outputs);
            let right = Terms::Matrix(input, inputs);
            gradient(team, self.isa, left, right, &mut into[layer.weight.clone()]);
            let bias = &mut into[layer.bias.clone()];
            team.split_rows(bias, 1, COLUMN_GRAIN, |first, sums| {
                self.isa.vectorised(
                    #[inline(always)]
                    || {
                        sums.fill(0.0);
                        for row in flowing.chunks_exact(layer.outputs) {
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
        let count = members * rows.div_ceil(members * ROWS_AT_ONCE);
        let rows_each = rows.div_ceil(count).next_multiple_of(ROW_GRAIN);
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

/// Some rows of all layers.
struct Part<'a> {
    first: usize,
    layers: Vec<&'a mut [f32]>,
}

/// Some columns of a first layer's weights: the way back to a part of the input.
#[derive(Debug)]
pub(super) struct Input {
    columns: Range<usize>,
    inputs: usize,
    outputs: usize,
    /// `[outputs, columns]`.
    weights: Vec<f32>,
    panels: Panels,
}

impl Input {
    /// These columns of the network's input.
    pub(super) fn new(network: &Dense, columns: Range<usize>) -> Self {
        let Layer { inputs, outputs, .. } = network.layers[0];
        Self {
            columns,
            inputs,
            outputs,
            weights: Vec::new(),
            panels: Panels::new(network.isa),
        }
    }

    /// What [`Input::backward`] needs packed.
    pub(super) fn packing<'a>(&'a mut self, parameters: &[f32]) -> Packing<'a> {
        self.weights.clear();
        for row in parameters[..self.outputs * self.inputs].chunks_exact(self.inputs) {
            self.weights.extend_from_slice(&row[self.columns.clone()]);
        }
        Packing {
            panels: &mut self.panels,
            weights: Matrix::of_rows(&self.weights, self.columns.len()),
        }
    }

    /// What flows back from the first layer's sums to these columns, `[rows, columns]`.
    pub(super) fn backward(&self, team: &mut Team, flowing: &[f32], into: &mut [f32]) {
        team.split_rows(into, self.columns.len(), ROW_GRAIN, |first, into| {
            let rows = into.len() / self.columns.len();
            let flowing = &flowing[first * self.outputs..][..rows * self.outputs];
            product(Rows::Matrix(flowing), &self.panels, Start::Zero, Finish::Plain, into);
        });
    }
}

/// These rows of each layer.
pub(super) fn rows_of<'a>(layers: &'a Layers, rows: Range<usize>, of: usize) -> Vec<&'a [f32]> {
    let part = |numbers: &'a Vec<f32>| {
        let len = numbers.len() / of;
        &numbers[rows.start * len..rows.end * len]
    };
    layers.iter().map(part).collect()
}

/// What the last layer gave.
pub(super) fn output(layers: &Layers) -> &[f32] {
    layers.last().expect("a network has layers")
}

/// As [`output`].
pub(super) fn output_mut(layers: &mut Layers) -> &mut [f32] {
    layers.last_mut().expect("a network has layers")
}
