//! The policy: observation to a squashed Gaussian over actions.

use std::f64::consts::{LN_2, PI};

use skein_protocol::LOG_STD;
use tch::Tensor;

use super::{Layout, LinearLayer, Parameters};
use crate::algorithm::Inputs;

/// Four fully connected layers with ReLU between (the paper, section 3.4). The last one gives mean
/// and log standard deviation of a Gaussian, which tanh squashes into the action (arXiv:1812.05905,
/// appendix C).
#[derive(Debug, Clone, Copy)]
pub struct PolicyNetwork {
    layers: [LinearLayer; 4],
}

/// Actions drawn from the policy.
#[derive(Debug)]
pub struct PolicySample {
    /// Actions, `[n, action]`, inside (-1, 1).
    pub actions: Tensor,
    /// log π(action | observation) in nats, `[n]`.
    pub log_prob: Tensor,
}

impl PolicyNetwork {
    /// Describes the layers of a stochastic policy: its outputs are means and log standard
    /// deviations.
    pub fn describe(layout: &mut Layout, inputs: Inputs, hidden_width: i64) -> Self {
        Self::with_outputs(layout, inputs, hidden_width, 2 * inputs.action.numbers())
    }

    /// Describes the layers of a policy with `outputs` outputs, such as the action alone.
    pub fn with_outputs(
        layout: &mut Layout,
        inputs: Inputs,
        hidden_width: i64,
        outputs: usize,
    ) -> Self {
        let mut layer = |number: usize, inputs: i64, outputs: i64| {
            LinearLayer::describe(layout, &format!("policy.layer{number}"), inputs, outputs)
        };
        Self {
            layers: [
                layer(1, inputs.policy as i64, hidden_width),
                layer(2, hidden_width, hidden_width),
                layer(3, hidden_width, hidden_width),
                layer(4, hidden_width, outputs as i64),
            ],
        }
    }

    /// Returns the last layer's output, `[n, outputs]`.
    pub fn output(&self, parameters: &Parameters, observations: &Tensor) -> Tensor {
        let [hidden @ .., last] = &self.layers;
        let mut features = observations.shallow_clone();
        for layer in hidden {
            features = layer.forward(parameters, &features).relu_();
        }
        last.forward(parameters, &features)
    }

    /// Returns mean and log standard deviation before tanh, `[n, action]` each.
    pub fn distribution(&self, parameters: &Parameters, observations: &Tensor) -> (Tensor, Tensor) {
        let output = self.output(parameters, observations);
        let action = output.size()[1] / 2;
        let (mean, log_std) = (
            output.narrow(1, 0, action),
            output.narrow(1, action, action),
        );
        (
            mean,
            log_std.clamp(f64::from(LOG_STD.0), f64::from(LOG_STD.1)),
        )
    }

    /// Returns the action without noise, tanh of the mean, `[n, action]`.
    pub fn mode(&self, parameters: &Parameters, observations: &Tensor) -> Tensor {
        self.distribution(parameters, observations).0.tanh()
    }

    /// Draws actions, differentiably in the parameters. `noise`: standard normal,
    /// `[n, action]`.
    pub fn sample(
        &self,
        parameters: &Parameters,
        observations: &Tensor,
        noise: &Tensor,
    ) -> PolicySample {
        let (mean, log_std) = self.distribution(parameters, observations);
        let before_tanh = mean + log_std.exp() * noise;
        PolicySample {
            log_prob: squashed_log_prob(&before_tanh, &log_std, noise),
            actions: before_tanh.tanh(),
        }
    }
}

/// log π of tanh(x) with x = mean + std · noise, summed over the action's dimensions, `[n]`
/// (arXiv:1812.05905, eq. 26).
///
/// log(1 - tanh²x) is computed as 2 (ln 2 - x - softplus(-2x)): exact even where 1 - tanh²x rounds
/// to zero.
fn squashed_log_prob(before_tanh: &Tensor, log_std: &Tensor, noise: &Tensor) -> Tensor {
    let gaussian = noise.square() * -0.5 - log_std - 0.5 * (2.0 * PI).ln();
    let correction = (LN_2 - before_tanh - (before_tanh * -2.0).softplus()) * 2.0;
    (gaussian - correction).sum_dim_intlist(1, false, None)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// log π of tanh(mean + exp(log_std) noise), from its definition and in f64.
    fn by_definition(mean: f64, log_std: f64, noise: f64) -> f64 {
        let x = mean + log_std.exp() * noise;
        let density = (-0.5 * noise * noise).exp() / (log_std.exp() * (2.0 * PI).sqrt());
        density.ln() - (1.0 - x.tanh() * x.tanh()).ln()
    }

    fn row(values: [f64; 2]) -> Tensor {
        Tensor::from_slice(&values.map(|value| value as f32)).view([1, 2])
    }

    #[test]
    fn log_prob_is_the_density_of_the_squashed_gaussian() {
        let (mean, log_std, noise) = ([0.3, -1.2], [-0.5, 0.4], [1.1, -0.7]);
        let before_tanh = row(mean) + row(log_std).exp() * row(noise);
        let computed =
            squashed_log_prob(&before_tanh, &row(log_std), &row(noise)).double_value(&[0]);
        let expected: f64 = (0..2)
            .map(|i| by_definition(mean[i], log_std[i], noise[i]))
            .sum();
        assert!(
            (computed - expected).abs() < 1e-5,
            "{computed} is not {expected}"
        );
    }

    #[test]
    fn log_prob_stays_exact_where_tanh_saturates() {
        // At x = 20 the action is 1.0 to the last bit of f32. log(1 - tanh²x) is 2 ln 2 - 2x up to
        // e^-40.
        let (x, log_std, noise) = (row([20.0, -20.0]), row([0.0, 0.0]), row([0.0, 0.0]));
        let computed = squashed_log_prob(&x, &log_std, &noise).double_value(&[0]);
        let expected = 2.0 * (-0.5 * (2.0 * PI).ln() - (2.0 * LN_2 - 40.0));
        assert!(
            (computed - expected).abs() < 1e-4,
            "{computed} is not {expected}"
        );
    }
}
