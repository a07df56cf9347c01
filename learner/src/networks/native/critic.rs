//! The critic's two estimates of Q on the native kernels, from one network with two outputs or from
//! two networks with one output each.

use std::ops::Range;

use skein_kernels::{Isa, Team};

use super::dense::{Dense, Layers, output, output_mut};
use super::rows::ESTIMATES;
use crate::networks::Layout;

/// One or two networks of equal shape; their parameters lie one after the other.
#[derive(Debug)]
pub struct NativeCritic {
    network: Dense,
    networks: usize,
    /// Number of parameters of one network.
    len: usize,
}

/// Activations of the critic's networks for some rows, or the loss's gradients with respect
/// to them.
#[derive(Debug, Default)]
pub struct CriticLayers {
    networks: Vec<Layers>,
    /// Both estimates, `[rows, 2]`, or the gradient with respect to them.
    pub values: Vec<f32>,
}

impl NativeCritic {
    /// Returns the critic that `layout` describes, made of `networks` networks.
    pub fn new(isa: Isa, layout: &Layout, networks: usize) -> Self {
        let tensors = &layout.tensors()[..layout.tensors().len() / networks];
        Self {
            network: Dense::new(isa, tensors),
            networks,
            len: layout.len() / networks,
        }
    }

    /// Allocates buffers for the activations of `rows` rows.
    pub fn allocate(&self, rows: usize) -> CriticLayers {
        CriticLayers {
            networks: (0..self.networks)
                .map(|_| self.network.allocate(rows))
                .collect(),
            values: vec![0.0; rows * ESTIMATES],
        }
    }

    /// Computes both estimates for `joined`, `[rows, critic input + 2]`; keeps all activations in
    /// `activations`.
    pub fn forward(
        &self,
        team: &mut Team,
        parameters: &[f32],
        joined: &[f32],
        activations: &mut CriticLayers,
    ) {
        for (number, layers) in activations.networks.iter_mut().enumerate() {
            self.network
                .forward(team, self.of(number, parameters), joined, layers);
            scatter(output(layers), number, &mut activations.values);
        }
    }

    /// Computes only both estimates, `[rows, 2]`.
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

    /// Computes the gradient with respect to all parameters, from the gradient with respect to the
    /// estimates, `grad.values`.
    pub fn gradient(
        &self,
        team: &mut Team,
        parameters: &[f32],
        joined: &[f32],
        activations: &CriticLayers,
        grad: &mut CriticLayers,
        into: &mut [f32],
    ) {
        for (number, layers) in grad.networks.iter_mut().enumerate() {
            gather(&grad.values, number, output_mut(layers));
            let (parameters, activations) =
                (self.of(number, parameters), &activations.networks[number]);
            self.network.backward(team, parameters, activations, layers);
            let into = &mut into[number * self.len..][..self.len];
            self.network
                .gradient(team, joined, activations, layers, into);
        }
    }

    /// Computes the gradient with respect to some columns of the input, `[rows, columns]`, from the
    /// gradient with respect to the estimates, `[rows, 2]`.
    pub fn backward_through(
        &self,
        team: &mut Team,
        parameters: &[f32],
        activations: &CriticLayers,
        grad: &[f32],
        columns: Range<usize>,
        into: &mut [f32],
    ) {
        let mut own_grad = vec![0.0; grad.len() / self.networks];
        let mut own = vec![0.0; into.len()];
        into.fill(0.0);
        for (number, activations) in activations.networks.iter().enumerate() {
            gather(grad, number, &mut own_grad);
            let parameters = self.of(number, parameters);
            let columns = columns.clone();
            self.network.backward_through(
                team,
                parameters,
                activations,
                &own_grad,
                columns,
                &mut own,
            );
            into.iter_mut().zip(&own).for_each(|(sum, own)| *sum += own);
        }
    }

    /// Slice of the parameters that belongs to network `number`.
    fn of<'a>(&self, number: usize, parameters: &'a [f32]) -> &'a [f32] {
        &parameters[number * self.len..][..self.len]
    }
}

/// Copies the output of network `number`, `[rows, outputs]`, to its columns of `values`,
/// `[rows, 2]`.
fn scatter(own: &[f32], number: usize, values: &mut [f32]) {
    let each = ESTIMATES * own.len() / values.len();
    for (own, values) in own
        .chunks_exact(each)
        .zip(values.chunks_exact_mut(ESTIMATES))
    {
        values[number * each..][..each].copy_from_slice(own);
    }
}

/// Copies the columns of network `number` out of `values`; the inverse of [`scatter`].
fn gather(values: &[f32], number: usize, own: &mut [f32]) {
    let each = ESTIMATES * own.len() / values.len();
    for (own, values) in own
        .chunks_exact_mut(each)
        .zip(values.chunks_exact(ESTIMATES))
    {
        own.copy_from_slice(&values[number * each..][..each]);
    }
}
