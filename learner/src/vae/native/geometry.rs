//! A second head on the code: regresses geometry that the caller knows, such as where openings are.
//!
//! The squared error of all pixels hardly depends on an opening's edges, which flying depends on.
//! This head's loss does. It sees the sampled code, so what it needs must exceed the code's noise.

use skein_kernels::{Isa, Team};

use super::elementwise::squares;
use crate::networks::native::{Dense, Layers, Learned, output, output_mut};
use crate::networks::{Layout, LinearLayer};
use crate::state::StatePart;

/// Width of the hidden layer.
const WIDTH: i64 = 128;

/// Two layers from the code to `outputs` numbers, with Adam's state.
#[derive(Debug)]
pub(super) struct GeometryHead {
    isa: Isa,
    outputs: usize,
    weight: f64,
    dense: Dense,
    learned: Learned,
    activations: Layers,
    grad: Layers,
    codes_grad: Vec<f32>,
}

impl GeometryHead {
    /// Returns an untrained head for codes of `latent` numbers. `weight`: factor of its loss. Each
    /// step is given its learning rate.
    pub(super) fn new(isa: Isa, latent: usize, outputs: usize, weight: f64, seed: u64) -> Self {
        let mut layout = Layout::default();
        let _ = [
            LinearLayer::describe(&mut layout, "geometry.layer1", latent as i64, WIDTH),
            LinearLayer::describe(&mut layout, "geometry.layer2", WIDTH, outputs as i64),
        ];
        Self {
            isa,
            outputs,
            weight,
            dense: Dense::new(isa, layout.tensors()),
            learned: Learned::new(layout.initial_values(seed), 0.0),
            activations: Layers::new(),
            grad: Layers::new(),
            codes_grad: Vec::new(),
        }
    }

    /// Computes the head's gradient, and adds the gradient with respect to the codes, `[n,
    /// latent]`, to `codes_grad`. `known`: `[n, outputs]`, NaN where a number is unknown. Returns
    /// the weighted squared error, summed over the outputs, mean over the batch.
    pub(super) fn add_gradient(
        &mut self,
        team: &mut Team,
        codes: &[f32],
        known: &[f32],
        codes_grad: &mut [f32],
    ) -> f64 {
        let rows = known.len() / self.outputs;
        let latent = codes.len() / rows;
        if output_len(&self.grad) != known.len() {
            self.activations = self.dense.allocate(rows);
            self.grad = self.dense.allocate(rows);
        }
        let values = &self.learned.values;
        self.dense
            .forward(team, values, codes, &mut self.activations);
        let factor = self.weight / rows as f64;
        let mut loss = 0.0;
        let errors = output(&self.activations).iter().zip(known);
        for (grad, (found, known)) in output_mut(&mut self.grad).iter_mut().zip(errors) {
            let error = if known.is_nan() { 0.0 } else { found - known };
            *grad = (2.0 * factor) as f32 * error;
            loss += factor * f64::from(error) * f64::from(error);
        }
        self.dense
            .backward(team, values, &self.activations, &mut self.grad);
        let gradient = &mut self.learned.gradient;
        self.dense
            .gradient(team, codes, &self.activations, &self.grad, gradient);
        self.codes_grad.resize(codes.len(), 0.0);
        self.dense.backward_through(
            team,
            values,
            &self.activations,
            output(&self.grad),
            0..latent,
            &mut self.codes_grad,
        );
        for (into, grad) in codes_grad.iter_mut().zip(&self.codes_grad) {
            *into += grad;
        }
        loss
    }

    /// Squared norm of the head's gradient.
    pub(super) fn squares(&self) -> f64 {
        squares(self.isa, &self.learned.gradient)
    }

    /// Makes one step of Adam.
    pub(super) fn step(&mut self, team: &mut Team, learning_rate: f64) {
        self.learned.set_learning_rate(learning_rate);
        self.learned.step(team, self.isa);
    }

    /// The parameters and Adam's state.
    pub(super) fn parts(&mut self) -> Vec<(String, StatePart<'_>)> {
        self.learned
            .parts("vae.native.geometry", "vae.native.geometry.adam")
    }
}

fn output_len(layers: &Layers) -> usize {
    layers.last().map_or(0, Vec::len)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gradients_are_the_slopes_of_the_loss_and_unknown_numbers_have_none() {
        const ROWS: usize = 3;
        const LATENT: usize = 8;
        let mut team = Team::new(1);
        let mut head = GeometryHead::new(Isa::best(), LATENT, 2, 5.0, 1);
        let codes: Vec<f32> = (0..ROWS * LATENT)
            .map(|at| (at as f32 * 0.7).sin())
            .collect();
        let known = [0.3, f32::NAN, -0.4, 1.0, f32::NAN, f32::NAN];
        let mut loss = |head: &mut GeometryHead, codes: &[f32], codes_grad: &mut [f32]| {
            head.add_gradient(&mut team, codes, &known, codes_grad)
        };
        let mut codes_grad = vec![0.25; codes.len()];
        let before = loss(&mut head, &codes, &mut codes_grad);
        assert!(before > 0.0);
        let scratch = &mut vec![0.0; codes.len()];
        for place in 0..codes.len() {
            let mut at = |moved: f32| {
                let mut codes = codes.clone();
                codes[place] += moved;
                loss(&mut head, &codes, scratch)
            };
            let slope = (at(0.01) - at(-0.01)) / 0.02;
            let found = f64::from(codes_grad[place]) - 0.25;
            assert!(
                (found - slope).abs() < 1e-3,
                "{place}: {found} is not {slope}"
            );
        }
        assert!(
            codes_grad[2 * LATENT..].iter().all(|grad| *grad == 0.25),
            "nothing is known"
        );

        loss(&mut head, &codes, scratch);
        let gradient = head.learned.gradient.clone();
        let places = (0..gradient.len()).step_by(97).chain([gradient.len() - 1]);
        for place in places {
            let mut at = |moved: f32| {
                let value = head.learned.values[place];
                head.learned.values[place] += moved;
                let loss = loss(&mut head, &codes, scratch);
                head.learned.values[place] = value;
                loss
            };
            let slope = (at(0.01) - at(-0.01)) / 0.02;
            let found = f64::from(gradient[place]);
            assert!(
                (found - slope).abs() < 1e-3,
                "{place}: {found} is not {slope}"
            );
        }
    }
}
