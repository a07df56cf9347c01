//! The critic: the value of an action in a state, twice.

use skein_protocol::ACTION;
use tch::Tensor;

use super::{Layout, Linear, Parameters};

/// Three fully connected layers with ReLU between; the last gives two estimates of Q, of which the smaller one is used (paper, section 3.4).
#[derive(Debug, Clone, Copy)]
pub struct Critic {
    layers: [Linear; 3],
}

impl Critic {
    /// Describes the layers.
    pub fn describe(layout: &mut Layout, observation: i64, hidden_width: i64) -> Self {
        Self {
            layers: [
                Linear::describe(layout, "critic.layer1", observation + ACTION as i64, hidden_width),
                Linear::describe(layout, "critic.layer2", hidden_width, hidden_width),
                Linear::describe(layout, "critic.layer3", hidden_width, 2),
            ],
        }
    }

    /// Both estimates of Q, `[n, 2]`. `observations`: `[n, observation]`, `actions`: `[n, 2]`.
    pub fn forward(&self, parameters: &Parameters, observations: &Tensor, actions: &Tensor) -> Tensor {
        let [hidden @ .., last] = &self.layers;
        let mut features = Tensor::cat(&[observations, actions], 1);
        for layer in hidden {
            features = layer.forward(parameters, &features).relu_();
        }
        last.forward(parameters, &features)
    }

    /// The smaller estimate, `[n]`.
    pub fn smaller(&self, parameters: &Parameters, observations: &Tensor, actions: &Tensor) -> Tensor {
        self.forward(parameters, observations, actions).amin(1, false)
    }
}
