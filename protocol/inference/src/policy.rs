//! The policy: observation to action, by a squashed Gaussian (arXiv:1812.05905, appendix C) or with
//! added noise (arXiv:1802.09477).
//!
//! Three hidden layers with ReLU, then a [`PolicyHead`].

use rand::Rng;
use rand_distr::{Distribution, StandardNormal};
use skein_kernels::{Finish, Isa};
use skein_protocol::snapshot::{POLICY_LAYERS, PolicyHead};
use skein_protocol::{ACTION, LOG_STD};

use crate::linear::Linear;

/// Parameters of the policy, arranged for [`Policy::distribution`].
#[derive(Debug)]
pub struct Policy {
    layers: [Linear; POLICY_LAYERS],
    head: PolicyHead,
}

/// Working memory of one thread.
#[derive(Debug, Default)]
pub struct PolicyScratch {
    /// Inputs and outputs; layers alternate between the two.
    values: [Vec<f32>; 2],
}

/// Distribution of a policy's action.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ActionDistribution {
    /// Gaussian that tanh squashes into an action; the parameters are those before tanh.
    SquashedGaussian {
        /// Mean, `[2]`.
        mean: [f32; ACTION],
        /// Natural logarithm of the standard deviation, `[2]`, within [-20, 2].
        log_std: [f32; ACTION],
    },
    /// Action with added noise.
    Noisy {
        /// Action without noise, `[2]`, inside (-1, 1).
        action: [f32; ACTION],
        /// Standard deviation of the noise.
        std: f32,
    },
}

impl Policy {
    /// `tensor` returns a parameter by its name in a snapshot (`policy.layer1.weight`, …), as a
    /// slice in PyTorch's order.
    ///
    /// # Panics
    /// If a tensor does not have the length of its shape.
    pub fn new<'a>(isa: Isa, head: PolicyHead, tensor: impl Fn(&str) -> &'a [f32]) -> Self {
        let layers = std::array::from_fn(|index| {
            let name = format!("policy.layer{}", index + 1);
            Linear::new(
                isa,
                tensor(&format!("{name}.weight")),
                tensor(&format!("{name}.bias")),
            )
        });
        Self { layers, head }
    }

    /// Returns the distribution of the action for an observation, `[ObservationLayout::len]`.
    ///
    /// # Panics
    /// If `observation` does not have the length that the policy was trained on.
    pub fn distribution(
        &self,
        observation: &[f32],
        scratch: &mut PolicyScratch,
    ) -> ActionDistribution {
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
        last.apply(input, Finish::Plain, &mut outputs[..self.head.outputs()]);
        match self.head {
            PolicyHead::SquashedGaussian => ActionDistribution::SquashedGaussian {
                mean: std::array::from_fn(|axis| outputs[axis]),
                log_std: std::array::from_fn(|axis| {
                    outputs[ACTION + axis].clamp(LOG_STD.0, LOG_STD.1)
                }),
            },
            PolicyHead::Noisy(std) => ActionDistribution::Noisy {
                action: std::array::from_fn(|axis| outputs[axis].tanh()),
                std,
            },
        }
    }
}

impl ActionDistribution {
    /// Returns the action without noise, each command in [-1, 1].
    pub fn mode(&self) -> [f32; ACTION] {
        match self {
            Self::SquashedGaussian { mean, .. } => mean.map(f32::tanh),
            Self::Noisy { action, .. } => *action,
        }
    }

    /// Draws an action, each command in [-1, 1].
    pub fn sample(&self, rng: &mut impl Rng) -> [f32; ACTION] {
        std::array::from_fn(|axis| {
            let noise: f32 = StandardNormal.sample(rng);
            match self {
                Self::SquashedGaussian { mean, log_std } => {
                    (mean[axis] + log_std[axis].exp() * noise).tanh()
                }
                Self::Noisy { action, std } => (action[axis] + std * noise).clamp(-1.0, 1.0),
            }
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

    /// Returns parameters by a fixed rule; small, so that no unit is always off.
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
        Policy::new(Isa::best(), PolicyHead::SquashedGaussian, |name| {
            parameters(name).leak()
        })
    }

    fn gaussian(policy: &Policy, observation: &[f32]) -> ([f32; ACTION], [f32; ACTION]) {
        match policy.distribution(observation, &mut PolicyScratch::default()) {
            ActionDistribution::SquashedGaussian { mean, log_std } => (mean, log_std),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn layers_match_a_calculation_by_hand() {
        let observation: Vec<f32> = (0..OBSERVATION).map(|index| (index as f32).cos()).collect();
        let mut values = observation.clone();
        for layer in 1..=POLICY_LAYERS {
            let weights = parameters(&format!("policy.layer{layer}.weight"));
            let bias = parameters(&format!("policy.layer{layer}.bias"));
            values = (0..bias.len())
                .map(|out| {
                    let row = &weights[out * values.len()..][..values.len()];
                    let sum = bias[out] + row.iter().zip(&values).map(|(w, x)| w * x).sum::<f32>();
                    if layer < POLICY_LAYERS {
                        sum.max(0.0)
                    } else {
                        sum
                    }
                })
                .collect();
        }
        let (mean, log_std) = gaussian(&policy(), &observation);
        for axis in 0..ACTION {
            assert!(
                (mean[axis] - values[axis]).abs() < 1e-6,
                "{mean:?} {values:?}"
            );
            assert!(
                (log_std[axis] - values[ACTION + axis]).abs() < 1e-6,
                "{log_std:?} {values:?}"
            );
        }
    }

    #[test]
    fn samples_have_the_stated_mean_and_deviation_and_stay_within_bounds() {
        let distribution = ActionDistribution::SquashedGaussian {
            mean: [0.5, -3.0],
            log_std: [-1.0, 2.0],
        };
        let mut rng = Pcg64Mcg::seed_from_u64(1);
        let draws: Vec<_> = (0..20_000).map(|_| distribution.sample(&mut rng)).collect();
        assert!(draws.iter().flatten().all(|command| command.abs() <= 1.0));
        let before_squashing: Vec<f32> = draws.iter().map(|action| action[0].atanh()).collect();
        let mean = before_squashing.iter().sum::<f32>() / draws.len() as f32;
        let variance = before_squashing
            .iter()
            .map(|x| (x - mean).powi(2))
            .sum::<f32>()
            / draws.len() as f32;
        assert!((mean - 0.5).abs() < 0.01, "{mean}");
        assert!(
            (variance.sqrt() - (-1f32).exp()).abs() < 0.01,
            "{}",
            variance.sqrt()
        );
    }

    #[test]
    fn the_mode_is_the_squashed_mean() {
        let distribution = ActionDistribution::SquashedGaussian {
            mean: [0.5, -40.0],
            log_std: [0.0, 0.0],
        };
        assert_eq!(distribution.mode(), [0.5f32.tanh(), -1.0]);
    }

    #[test]
    fn an_extreme_standard_deviation_is_bounded() {
        let wild = Policy::new(Isa::best(), PolicyHead::SquashedGaussian, |name| {
            let mut values = parameters(name);
            if name == "policy.layer4.bias" {
                values[ACTION..].copy_from_slice(&[1e3, -1e3]);
            }
            values.leak()
        });
        let (_, log_std) = gaussian(&wild, &[0.0; OBSERVATION]);
        assert_eq!(log_std, [2.0, -20.0]);
    }

    #[test]
    fn noise_is_added_to_an_action_and_the_sum_stays_within_bounds() {
        let distribution = ActionDistribution::Noisy {
            action: [0.2, 0.95],
            std: 0.1,
        };
        assert_eq!(distribution.mode(), [0.2, 0.95]);
        let mut rng = Pcg64Mcg::seed_from_u64(1);
        let draws: Vec<_> = (0..20_000).map(|_| distribution.sample(&mut rng)).collect();
        let (mean, count) = (
            draws.iter().map(|draw| draw[0]).sum::<f32>() / 2e4,
            draws.len() as f32,
        );
        let variance = draws
            .iter()
            .map(|draw| (draw[0] - mean).powi(2))
            .sum::<f32>()
            / count;
        assert!(
            (mean - 0.2).abs() < 3e-3 && (variance.sqrt() - 0.1).abs() < 3e-3,
            "{mean} {variance}"
        );
        let at_the_bound = draws.iter().filter(|draw| draw[1] == 1.0).count() as f32 / count;
        // The bound is half a standard deviation away; 31 % of a Gaussian lie beyond it.
        assert!(
            draws.iter().all(|draw| draw[1] <= 1.0) && (at_the_bound - 0.309).abs() < 0.02,
            "{at_the_bound}"
        );
    }
}
