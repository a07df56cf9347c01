//! The policy: observation to action by a squashed Gaussian (arXiv:1812.05905, appendix C).
//!
//! Three hidden layers with ReLU, then mean and logarithm of the standard deviation of each of the two commands.

use rand::Rng;
use rand_distr::{Distribution, StandardNormal};
use skein_kernels::{Finish, Isa};
use skein_protocol::snapshot::POLICY_LAYERS;
use skein_protocol::{ACTION, LOG_STD};

use crate::linear::Linear;

/// The policy's parameters, arranged for [`Policy::distribution`].
#[derive(Debug)]
pub struct Policy {
    layers: [Linear; POLICY_LAYERS],
}

/// Working memory of one thread.
#[derive(Debug, Default)]
pub struct PolicyScratch {
    /// Layers alternate between these two.
    values: [Vec<f32>; 2],
}

/// The Gaussian that is squashed into an action, by its parameters before the squashing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ActionDistribution {
    /// `[2]`.
    pub mean: [f32; ACTION],
    /// Natural logarithm of the standard deviation, `[2]`, within [-20, 2].
    pub log_std: [f32; ACTION],
}

impl Policy {
    /// Takes the parameters by their names in a snapshot (`policy.layer1.weight`, …), each a slice in PyTorch's order.
    ///
    /// # Panics
    /// When a tensor has not the length its shape asks for.
    pub fn new<'a>(isa: Isa, tensor: impl Fn(&str) -> &'a [f32]) -> Self {
        let layers = std::array::from_fn(|index| {
            let name = format!("policy.layer{}", index + 1);
            Linear::new(isa, tensor(&format!("{name}.weight")), tensor(&format!("{name}.bias")))
        });
        Self { layers }
    }

    /// The distribution of actions for an observation, `[Observation::len]`.
    ///
    /// # Panics
    /// When `observation` has not the length the policy was trained on.
    pub fn distribution(&self, observation: &[f32], scratch: &mut PolicyScratch) -> ActionDistribution {
        let [input, output] = &mut scratch.values;
        input.clear();
        input.extend_from_slice(observation);
        let [hidden @ .., last] = &self.layers;
        for layer in hidden {
            output.resize(layer.outputs(), 0.0);
            layer.apply(input, Finish::Rectified, output);
            std::mem::swap(input, output);
        }
        let mut outputs = [0.0; 2 * ACTION];
        last.apply(input, Finish::Plain, &mut outputs);
        ActionDistribution {
            mean: std::array::from_fn(|axis| outputs[axis]),
            log_std: std::array::from_fn(|axis| outputs[ACTION + axis].clamp(LOG_STD.0, LOG_STD.1)),
        }
    }
}

impl ActionDistribution {
    /// The action without noise, each command in [-1, 1].
    pub fn mode(&self) -> [f32; ACTION] {
        self.mean.map(f32::tanh)
    }

    /// An action drawn at random, each command in [-1, 1].
    pub fn sample(&self, rng: &mut impl Rng) -> [f32; ACTION] {
        std::array::from_fn(|axis| {
            let noise: f32 = StandardNormal.sample(rng);
            (self.mean[axis] + self.log_std[axis].exp() * noise).tanh()
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_pcg::Pcg64Mcg;

    const OBSERVATION: usize = 34;
    const WIDTH: usize = 5;

    /// Parameters by a fixed rule; small, so that no unit is always off.
    fn parameters(name: &str) -> Vec<f32> {
        let sizes = [OBSERVATION, WIDTH, WIDTH, WIDTH, 2 * ACTION];
        let layer = usize::from(name.as_bytes()["policy.layer".len()] - b'0');
        let values = if name.ends_with("bias") {
            sizes[layer]
        } else {
            sizes[layer] * sizes[layer - 1]
        };
        (0..values)
            .map(|index| ((index * 7 + layer * 13) as f32).sin() * 0.4)
            .collect()
    }

    fn policy() -> Policy {
        Policy::new(Isa::best(), |name| parameters(name).leak())
    }

    #[test]
    fn layers_are_those_written_out_by_hand() {
        let observation: Vec<f32> = (0..OBSERVATION).map(|index| (index as f32).cos()).collect();
        let mut values = observation.clone();
        for layer in 1..=POLICY_LAYERS {
            let weights = parameters(&format!("policy.layer{layer}.weight"));
            let bias = parameters(&format!("policy.layer{layer}.bias"));
            values = (0..bias.len())
                .map(|out| {
                    let row = &weights[out * values.len()..][..values.len()];
                    let sum = bias[out] + row.iter().zip(&values).map(|(w, x)| w * x).sum::<f32>();
                    if layer < POLICY_LAYERS { sum.max(0.0) } else { sum }
                })
                .collect();
        }
        let found = policy().distribution(&observation, &mut PolicyScratch::default());
        for axis in 0..ACTION {
            assert!((found.mean[axis] - values[axis]).abs() < 1e-6, "{found:?} {values:?}");
            assert!(
                (found.log_std[axis] - values[ACTION + axis]).abs() < 1e-6,
                "{found:?} {values:?}"
            );
        }
    }

    #[test]
    fn samples_have_the_stated_mean_and_spread_and_stay_within_bounds() {
        let distribution = ActionDistribution {
            mean: [0.5, -3.0],
            log_std: [-1.0, 2.0],
        };
        let mut rng = Pcg64Mcg::seed_from_u64(1);
        let draws: Vec<_> = (0..20_000).map(|_| distribution.sample(&mut rng)).collect();
        assert!(draws.iter().flatten().all(|command| command.abs() <= 1.0));
        let before_squashing: Vec<f32> = draws.iter().map(|action| action[0].atanh()).collect();
        let mean = before_squashing.iter().sum::<f32>() / draws.len() as f32;
        let variance = before_squashing.iter().map(|x| (x - mean).powi(2)).sum::<f32>() / draws.len() as f32;
        assert!((mean - 0.5).abs() < 0.01, "{mean}");
        assert!((variance.sqrt() - (-1f32).exp()).abs() < 0.01, "{}", variance.sqrt());
    }

    #[test]
    fn the_mode_is_the_squashed_mean() {
        let distribution = ActionDistribution {
            mean: [0.5, -40.0],
            log_std: [0.0, 0.0],
        };
        assert_eq!(distribution.mode(), [0.5f32.tanh(), -1.0]);
    }

    #[test]
    fn an_extreme_spread_is_bounded() {
        let wild = Policy::new(Isa::best(), |name| {
            let mut values = parameters(name);
            if name == "policy.layer4.bias" {
                values[ACTION..].copy_from_slice(&[1e3, -1e3]);
            }
            values.leak()
        });
        let found = wild.distribution(&[0.0; OBSERVATION], &mut PolicyScratch::default());
        assert_eq!(found.log_std, [2.0, -20.0]);
    }
}
