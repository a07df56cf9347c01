//! The policy: observation to action, by a squashed Gaussian (arXiv:1812.05905, appendix C) or with
//! added noise (arXiv:1802.09477).
//!
//! Three hidden layers with ReLU, then a [`PolicyHead`].

use rand::Rng;
use rand_distr::{Distribution, StandardNormal};
use skein_kernels::{Finish, Isa};
use skein_protocol::snapshot::{POLICY_LAYERS, PolicyHead};
use skein_protocol::{Action, LOG_STD, MAX_ACTION};

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

/// Distribution of a policy's action. Its arrays end with as many zeros as an action does.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ActionDistribution {
    /// Gaussian that tanh squashes into an action; the parameters are those before tanh.
    SquashedGaussian {
        /// Numbers of an action.
        numbers: usize,
        /// Mean of each number.
        mean: Action,
        /// Natural logarithm of each standard deviation, within [-20, 2].
        log_std: Action,
    },
    /// Action with added noise.
    Noisy {
        /// Numbers of an action.
        numbers: usize,
        /// Action without noise, inside (-1, 1).
        action: Action,
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
        let mut outputs = [0.0; 2 * MAX_ACTION];
        let outputs = &mut outputs[..last.outputs()];
        last.apply(input, Finish::Plain, outputs);
        match self.head {
            PolicyHead::SquashedGaussian => {
                let numbers = outputs.len() / 2;
                let (means, log_stds) = outputs.split_at(numbers);
                ActionDistribution::SquashedGaussian {
                    numbers,
                    mean: action_of(means, |mean| mean),
                    log_std: action_of(log_stds, |log_std| log_std.clamp(LOG_STD.0, LOG_STD.1)),
                }
            }
            PolicyHead::Noisy(std) => ActionDistribution::Noisy {
                numbers: outputs.len(),
                action: action_of(outputs, f32::tanh),
                std,
            },
        }
    }
}

impl ActionDistribution {
    /// Returns the action without noise, each number in [-1, 1].
    pub fn mode(&self) -> Action {
        match self {
            Self::SquashedGaussian { mean, .. } => mean.map(f32::tanh),
            Self::Noisy { action, .. } => *action,
        }
    }

    /// Draws an action, each number in [-1, 1].
    pub fn sample(&self, rng: &mut impl Rng) -> Action {
        let (Self::SquashedGaussian { numbers, .. } | Self::Noisy { numbers, .. }) = self;
        let mut drawn = [0.0; MAX_ACTION];
        for (axis, number) in drawn.iter_mut().take(*numbers).enumerate() {
            let noise: f32 = StandardNormal.sample(rng);
            *number = match self {
                Self::SquashedGaussian { mean, log_std, .. } => {
                    (mean[axis] + log_std[axis].exp() * noise).tanh()
                }
                Self::Noisy { action, std, .. } => (action[axis] + std * noise).clamp(-1.0, 1.0),
            };
        }
        drawn
    }
}

/// Returns `numbers`, changed by `change`, with zeros behind them.
fn action_of(numbers: &[f32], change: impl Fn(f32) -> f32) -> Action {
    let mut action = [0.0; MAX_ACTION];
    for (into, number) in action.iter_mut().zip(numbers) {
        *into = change(*number);
    }
    action
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_pcg::Pcg64Mcg;

    const OBSERVATION: usize = 34;
    const WIDTH: usize = 5;
    const ACTION: usize = 2;

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

    fn gaussian(policy: &Policy, observation: &[f32]) -> (Action, Action) {
        match policy.distribution(observation, &mut PolicyScratch::default()) {
            ActionDistribution::SquashedGaussian { mean, log_std, .. } => (mean, log_std),
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
            numbers: 3,
            mean: [0.5, -3.0, 0.0, 0.0],
            log_std: [-1.0, 2.0, 0.0, 0.0],
        };
        let mut rng = Pcg64Mcg::seed_from_u64(1);
        let draws: Vec<_> = (0..20_000).map(|_| distribution.sample(&mut rng)).collect();
        assert!(draws.iter().flatten().all(|command| command.abs() <= 1.0));
        assert!(
            draws
                .iter()
                .all(|action| action[2] != 0.0 && action[3] == 0.0)
        );
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
            numbers: 2,
            mean: [0.5, -40.0, 0.0, 0.0],
            log_std: [0.0; MAX_ACTION],
        };
        assert_eq!(distribution.mode(), [0.5f32.tanh(), -1.0, 0.0, 0.0]);
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
        assert_eq!(log_std, [2.0, -20.0, 0.0, 0.0]);
    }

    #[test]
    fn noise_is_added_to_an_action_and_the_sum_stays_within_bounds() {
        let distribution = ActionDistribution::Noisy {
            numbers: 2,
            action: [0.2, 0.95, 0.0, 0.0],
            std: 0.1,
        };
        assert_eq!(distribution.mode(), [0.2, 0.95, 0.0, 0.0]);
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
