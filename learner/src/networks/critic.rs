//! The critic: estimates the value of an action in a state, twice.

use tch::Tensor;

use super::{Layout, LinearLayer, Parameters};
use crate::algorithm::Inputs;

/// Three fully connected layers with ReLU between. Either one network whose last layer gives two
/// estimates of Q (the paper, section 3.4), or two networks with one estimate each
/// (arXiv:1812.05905), whose errors are less correlated. The smaller estimate is the one used.
#[derive(Debug, Clone)]
pub struct CriticNetwork {
    networks: Vec<[LinearLayer; 3]>,
}

impl CriticNetwork {
    /// Describes the layers of `networks`, one or two.
    pub fn describe(
        layout: &mut Layout,
        inputs: Inputs,
        hidden_width: i64,
        networks: usize,
    ) -> Self {
        let mut network = |name: &str| {
            let mut layer = |number: u8, inputs, outputs| {
                LinearLayer::describe(layout, &format!("{name}.layer{number}"), inputs, outputs)
            };
            [
                layer(
                    1,
                    (inputs.critic + inputs.action.numbers()) as i64,
                    hidden_width,
                ),
                layer(2, hidden_width, hidden_width),
                layer(3, hidden_width, 2 / networks as i64),
            ]
        };
        let networks = match networks {
            1 => vec![network("critic")],
            _ => vec![network("critic1"), network("critic2")],
        };
        Self { networks }
    }

    /// Returns both estimates of Q, `[n, 2]`. `observations`: `[n, observation]`, `actions`:
    /// `[n, action]`.
    pub fn forward(
        &self,
        parameters: &Parameters,
        observations: &Tensor,
        actions: &Tensor,
    ) -> Tensor {
        let joined = Tensor::cat(&[observations, actions], 1);
        let estimates = self.networks.iter().map(|[hidden @ .., last]| {
            let features = hidden
                .iter()
                .fold(joined.shallow_clone(), |features, layer| {
                    layer.forward(parameters, &features).relu()
                });
            last.forward(parameters, &features)
        });
        Tensor::cat(&estimates.collect::<Vec<_>>(), 1)
    }

    /// Returns the smaller estimate, `[n]`.
    pub fn smaller(
        &self,
        parameters: &Parameters,
        observations: &Tensor,
        actions: &Tensor,
    ) -> Tensor {
        self.forward(parameters, observations, actions)
            .amin(1, false)
    }
}
