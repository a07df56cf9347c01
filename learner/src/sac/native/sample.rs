//! Actions drawn from the policy, their log-probability, and the gradients through both.
//!
//! Element by element, these are the functions of [`crate::networks::PolicyNetwork`] and their
//! derivatives.

use std::f32::consts::LN_2;

use skein_kernels::{Isa, exp};
use skein_protocol::LOG_STD;

use crate::networks::native::squash;

/// ½ ln 2π.
const HALF_LN_TAU: f32 = 0.918_938_5;

/// Actions drawn for rows of observations. All fields but `action` and `log_prob` are
/// `[rows, action]`.
#[derive(Debug, Default)]
pub(super) struct Sample {
    /// Numbers of an action.
    action: usize,
    /// Standard normal noise; the caller fills it before [`Sample::draw`].
    pub(super) noise: Vec<f32>,
    /// Mean of the normal distribution before tanh.
    mean: Vec<f32>,
    /// Logarithm of its standard deviation as the network gave it, before bounding.
    log_std: Vec<f32>,
    /// std · noise.
    deviation: Vec<f32>,
    /// Actions, tanh(mean + std · noise), inside (-1, 1).
    pub(super) actions: Vec<f32>,
    /// Derivative of tanh there.
    slope: Vec<f32>,
    /// Summand of log π that belongs to this element.
    element_log_prob: Vec<f32>,
    /// log π(action | observation) in nats, `[rows]`.
    pub(super) log_prob: Vec<f32>,
}

impl Sample {
    /// Allocates buffers for `rows` actions of `action` numbers.
    pub(super) fn allocate(rows: usize, action: usize) -> Self {
        let element = || vec![0.0; rows * action];
        Self {
            action,
            noise: element(),
            mean: element(),
            log_std: element(),
            deviation: element(),
            actions: element(),
            slope: element(),
            element_log_prob: element(),
            log_prob: vec![0.0; rows],
        }
    }

    /// Draws a = tanh(x), x = mean + std · noise, and computes log π(a) (arXiv:1812.05905, eq. 26).
    /// `output`: the policy network's, `[rows, 2 · action]`: in each row the means, then the
    /// logarithms of the standard deviations.
    pub(super) fn draw(&mut self, isa: Isa, output: &[f32]) {
        let action = self.action;
        let rows = output.chunks_exact(2 * action);
        let own = self
            .mean
            .chunks_exact_mut(action)
            .zip(self.log_std.chunks_exact_mut(action));
        for (row, (mean, log_std)) in rows.zip(own) {
            mean.copy_from_slice(&row[..action]);
            log_std.copy_from_slice(&row[action..]);
        }
        let Self {
            noise,
            mean,
            log_std,
            deviation,
            actions,
            slope,
            element_log_prob,
            ..
        } = self;
        let given = noise.iter().zip(mean).zip(log_std);
        let made = deviation
            .iter_mut()
            .zip(actions)
            .zip(slope)
            .zip(element_log_prob);
        isa.vectorised(
            #[inline(always)]
            || {
                for (((noise, mean), log_std), (((deviation, action), slope), log_prob)) in
                    given.zip(made)
                {
                    let log_std = log_std.clamp(LOG_STD.0, LOG_STD.1);
                    *deviation = exp(log_std) * noise;
                    let x = *mean + *deviation;
                    let e;
                    [*action, *slope, e] = squash(x);
                    // log(1 - tanh²x) = 2 (ln 2 - x - softplus(-2x)) = 2 (ln 2 - |x| - ln(1 + e)).
                    let correction = 2.0 * (LN_2 - x.abs() - ln_1p(e));
                    *log_prob = -0.5 * noise * noise - log_std - HALF_LN_TAU - correction;
                }
            },
        );
        let elements = self.element_log_prob.chunks_exact(action);
        for (log_prob, elements) in self.log_prob.iter_mut().zip(elements) {
            *log_prob = elements.iter().sum();
        }
    }

    /// Computes the gradient with respect to the policy network's output, `[rows, 2 · action]`, for
    /// the rows after the first `skipped`. Incoming gradients: `log_prob_gradient`, with respect to
    /// each log π, and `action_grad`, `[rows, action]`, with respect to the actions.
    ///
    /// ∂log π/∂x = 2 tanh x; ∂a/∂x = 1 - tanh²x; ∂x/∂mean = 1; ∂x/∂log_std = std · noise; log_std
    /// also enters log π directly, ∂log π/∂log_std = -1. No gradient passes a bound of log_std.
    pub(super) fn backward(
        &self,
        skipped: usize,
        log_prob_gradient: f32,
        action_grad: &[f32],
        into: &mut [f32],
    ) {
        let action = self.action;
        for (row, into) in into.chunks_exact_mut(2 * action).enumerate() {
            for dimension in 0..action {
                let at = (skipped + row) * action + dimension;
                let by_action = action_grad[row * action + dimension];
                let by_x = log_prob_gradient * 2.0 * self.actions[at] + by_action * self.slope[at];
                into[dimension] = by_x;
                let free = (LOG_STD.0..=LOG_STD.1).contains(&self.log_std[at]);
                into[action + dimension] = if free {
                    by_x * self.deviation[at] - log_prob_gradient
                } else {
                    0.0
                };
            }
        }
    }
}

/// ln(1 + e) for e in [0, 1], within 1e-7. It is 2 artanh s with s = e / (2 + e) ≤ ⅓, by the series
/// up to s¹⁵ (remainder below 1e-9).
#[inline(always)]
fn ln_1p(e: f32) -> f32 {
    let s = e / (2.0 + e);
    let square = s * s;
    let mut sum = 1.0 / 15.0;
    for factor in [
        1.0 / 13.0,
        1.0 / 11.0,
        1.0 / 9.0,
        1.0 / 7.0,
        1.0 / 5.0,
        1.0 / 3.0,
        1.0,
    ] {
        sum = square.mul_add(sum, factor);
    }
    2.0 * s * sum
}
