//! The `[sac]` section.

use serde::{Deserialize, Serialize};

use super::{
    InvalidValue, require, require_batch_size, require_critic_networks, require_discount,
    require_learning_rate, require_width,
};
use crate::ActionSpace;

/// The `[sac]` section: soft actor-critic with learned temperature (arXiv:1812.05905). The paper
/// specifies none of these values.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SacSection {
    /// Width of the hidden layers of policy (three) and critic (two), 1 to 4096. Default 256, as in
    /// arXiv:1812.05905.
    pub hidden_width: usize,
    /// Networks that estimate Q twice: 1, with two outputs (paper), or 2, with one output each.
    /// Errors of two networks are less correlated, so the smaller estimate overrates Q less often.
    /// Default 1.
    pub critic_networks: usize,
    /// Transitions in a minibatch, 1 to 65,536. Default 256, as in arXiv:1812.05905.
    pub batch_size: usize,
    /// Adam's step size for the policy, in (0, 1]. Default 3e-4, as in arXiv:1812.05905.
    pub policy_learning_rate: f64,
    /// Adam's step size for the critic, in (0, 1]. Default 3e-4.
    pub critic_learning_rate: f64,
    /// Adam's step size for the logarithm of the temperature, in (0, 1]. Default 3e-4.
    pub temperature_learning_rate: f64,
    /// Discount γ per control period, in [0, 1). Default 0.99.
    pub discount: f64,
    /// Share τ of the critic that moves into the target network at each update, in (0, 1]. Default
    /// 0.005.
    pub target_rate: f64,
    /// Temperature α before the first update, above 0. Default 0.2.
    pub initial_temperature: f64,
    /// Entropy in nats that the temperature steers towards, or `auto`: minus the number of action
    /// dimensions. Default `auto`.
    pub target_entropy: TargetEntropy,
}

impl Default for SacSection {
    fn default() -> Self {
        Self {
            hidden_width: 256,
            critic_networks: 1,
            batch_size: 256,
            policy_learning_rate: 3e-4,
            critic_learning_rate: 3e-4,
            temperature_learning_rate: 3e-4,
            discount: 0.99,
            target_rate: 0.005,
            initial_temperature: 0.2,
            target_entropy: TargetEntropy::Auto,
        }
    }
}

impl SacSection {
    pub(super) fn validate(&self) -> Result<(), InvalidValue> {
        require_width("sac.hidden_width", self.hidden_width)?;
        require_critic_networks("sac.critic_networks", self.critic_networks)?;
        require_batch_size("sac.batch_size", self.batch_size)?;
        for (key, rate) in [
            ("sac.policy_learning_rate", self.policy_learning_rate),
            ("sac.critic_learning_rate", self.critic_learning_rate),
            (
                "sac.temperature_learning_rate",
                self.temperature_learning_rate,
            ),
        ] {
            require_learning_rate(key, rate)?;
        }
        require_discount("sac.discount", self.discount)?;
        require(
            self.target_rate > 0.0 && self.target_rate <= 1.0,
            "sac.target_rate",
            self.target_rate,
            "is outside (0, 1]: the target network would never follow",
        )?;
        require(
            self.initial_temperature > 0.0 && self.initial_temperature.is_finite(),
            "sac.initial_temperature",
            self.initial_temperature,
            "is not a positive number: its logarithm is what is learned",
        )?;
        let TargetEntropy::Nats(entropy) = self.target_entropy else {
            return Ok(());
        };
        require(
            entropy.is_finite(),
            "sac.target_entropy",
            entropy,
            "is not a finite number",
        )
    }
}

/// Target entropy of the policy.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum TargetEntropy {
    /// A value in nats.
    Nats(f64),
    /// Minus the number of action dimensions (arXiv:1812.05905, appendix D).
    #[serde(with = "auto")]
    Auto,
}

impl TargetEntropy {
    /// Returns the entropy in nats for a policy with these actions.
    pub fn value(self, action: ActionSpace) -> f64 {
        match self {
            Self::Auto => -(action.numbers() as f64),
            Self::Nats(value) => value,
        }
    }
}

/// Serialization of [`TargetEntropy::Auto`] as the word `auto`.
mod auto {
    use serde::{Deserialize, Deserializer, Serializer, de::Error};

    pub(super) fn serialize<S: Serializer>(serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str("auto")
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<(), D::Error> {
        let word = String::deserialize(deserializer)?;
        if word == "auto" {
            Ok(())
        } else {
            Err(D::Error::custom("expected a number or \"auto\""))
        }
    }
}
