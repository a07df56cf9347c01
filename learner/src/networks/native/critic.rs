//! A critic's two estimates of Q on the kernels, from one network with two outputs or from two
//! networks with one.

use std::ops::Range;

use skein_kernels::{Isa, Team};

use super::dense::{Dense, Layers, output, output_mut};
use super::rows::ESTIMATES;
use crate::networks::Layout;

/// The networks, which are alike; their parameters lie one behind the other.
#[derive(Debug)]
pub struct NativeCritic {
    network: Dense,
    networks: usize,
    /// Parameters of one.
    len: usize,
}

/// What the networks gave for some rows, or what flows back.
#[derive(Debug, Default)]
pub struct CriticLayers {
    networks: Vec<Layers>,
    /// Both estimates, `[rows, 2]`.
    pub values: Vec<f32>,
}

impl NativeCritic {
    /// The critic that `layout` describes, of one network or of two.
    pub fn new(isa: Isa, layout: &Layout, networks: usize) -> Self {
        let tensors = &layout.tensors()[..layout.tensors().len() / networks];
        Self {
            network: Dense::new(isa, tensors),
            networks,
            len: layout.len() / networks,
        }
    }

    /// Places for what is computed of so many rows.
    pub fn places(&self, rows: usize) -> CriticLayers {
        CriticLayers {
            networks: (0..self.networks)
                .map(|_| self.network.places(rows))
                .collect(),
            values: vec![0.0; rows * ESTIMATES],
        }
    }

    /// Both estimates for `joined`, `[rows, observation + 2]`, and what the layers gave on the way.
    pub fn forward(
        &self,
        team: &mut Team,
        parameters: &[f32],
        joined: &[f32],
        given: &mut CriticLayers,
    ) {
        for (number, layers) in given.networks.iter_mut().enumerate() {
            self.network
                .forward(team, self.of(number, parameters), joined, layers);
            scatter(output(layers), number, &mut given.values);
        }
    }

    /// Both estimates alone, `[rows, 2]`.
    pub fn forward_through(
        &self,
        team: &mut Team,
        parameters: &[f32],
        joined: &[f32],
        values: &mut [f32],
    ) {
        let mut own = vec![0.0; values.len() / self.networks];
        for number in 0..self.networks {
            let parameters = self.of(number, parameters);
            self.network
                .forward_through(team, parameters, joined, &mut own);
            scatter(&own, number, values);
        }
    }

    /// The gradient of all parameters, from what flows back to the estimates, `grad.values`.
    pub fn gradient(
        &self,
        team: &mut Team,
        parameters: &[f32],
        joined: &[f32],
        given: &CriticLayers,
        grad: &mut CriticLayers,
        into: &mut [f32],
    ) {
        for (number, layers) in grad.networks.iter_mut().enumerate() {
            gather(&grad.values, number, output_mut(layers));
            let (parameters, given) = (self.of(number, parameters), &given.networks[number]);
            self.network.backward(team, parameters, given, layers);
            let into = &mut into[number * self.len..][..self.len];
            self.network.gradient(team, joined, given, layers, into);
        }
    }

    /// What flows back to some columns of the input, `[rows, columns]`, from what flows to the
    /// estimates, `[rows, 2]`.
    pub fn backward_through(
        &self,
        team: &mut Team,
        parameters: &[f32],
        given: &CriticLayers,
        grad: &[f32],
        columns: Range<usize>,
        into: &mut [f32],
    ) {
        let mut own_grad = vec![0.0; grad.len() / self.networks];
        let mut own = vec![0.0; into.len()];
        into.fill(0.0);
        for (number, given) in given.networks.iter().enumerate() {
            gather(grad, number, &mut own_grad);
            let parameters = self.of(number, parameters);
            let columns = columns.clone();
            self.network
                .backward_through(team, parameters, given, &own_grad, columns, &mut own);
            into.iter_mut().zip(&own).for_each(|(sum, own)| *sum += own);
        }
    }

    /// The parameters of one network.
    fn of<'a>(&self, number: usize, parameters: &'a [f32]) -> &'a [f32] {
        &parameters[number * self.len..][..self.len]
    }
}

/// Writes what network `number` gave, `[rows, estimates of it]`, to its place among the estimates.
fn scatter(own: &[f32], number: usize, values: &mut [f32]) {
    let each = ESTIMATES * own.len() / values.len();
    for (own, values) in own
        .chunks_exact(each)
        .zip(values.chunks_exact_mut(ESTIMATES))
    {
        values[number * each..][..each].copy_from_slice(own);
    }
}

/// Reads what network `number` gave from among the estimates: the other way round.
fn gather(values: &[f32], number: usize, own: &mut [f32]) {
    let each = ESTIMATES * own.len() / values.len();
    for (own, values) in own
        .chunks_exact_mut(each)
        .zip(values.chunks_exact(ESTIMATES))
    {
        own.copy_from_slice(&values[number * each..][..each]);
    }
}
