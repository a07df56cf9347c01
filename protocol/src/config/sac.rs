//! `[sac]`.

use serde::{Deserialize, Serialize};

use super::{
    Invalid, require, require_batch_size, require_critic_networks, require_discount,
    require_learning_rate, require_width,
};
use crate::ACTION;

/// `[sac]`: soft actor-critic with learned temperature (arXiv:1812.05905). The paper leaves every
/// value here open.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SacSection {
    /// Width of the hidden layers of policy (three) and critic (two). Default 256, as in
    /// arXiv:1812.05905.
    pub hidden_width: usize,
    /// Networks that give the critic's two estimates of Q: 1, with two outputs (paper), or 2, with
    /// one each, whose errors have less in common, so that the smaller estimate is one of a value
    /// that both overrate less often. Default 1.
    pub critic_networks: usize,
    /// Transitions in a minibatch. Default 256, as in arXiv:1812.05905.
    pub batch_size: usize,
    /// Adam's step size for the policy. Default 3e-4, as in arXiv:1812.05905.
    pub policy_learning_rate: f64,
    /// Adam's step size for the critic. Default 3e-4.
    pub critic_learning_rate: f64,
    /// Adam's step size for the temperature's logarithm. Default 3e-4.
    pub temperature_learning_rate: f64,
    /// Discount per control period, γ. Default 0.99.
    pub discount: f64,
    /// Share of the critic that moves into the target network at each update, τ. Default 0.005.
    pub target_rate: f64,
    /// Temperature before the first update, α. Default 0.2.
    pub initial_temperature: f64,
    /// Entropy the temperature is steered towards. Default `auto`: minus the action's dimensions.
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
    pub(super) fn validate(&self) -> Result<(), Invalid> {
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
        require(
            self.target_entropy.value().is_finite(),
            "sac.target_entropy",
            self.target_entropy.value(),
            "is not a finite number",
        )
    }
}

/// The entropy a policy is held at by its temperature.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum TargetEntropy {
    /// A value in nats.
    Nats(f64),
    /// Minus the number of the action's dimensions (arXiv:1812.05905, appendix D).
    #[serde(with = "auto")]
    Auto,
}

impl TargetEntropy {
    /// The entropy in nats.
    pub fn value(self) -> f64 {
        match self {
            Self::Auto => -(ACTION as f64),
            Self::Nats(value) => value,
        }
    }
}

/// The word `auto` for [`TargetEntropy::Auto`].
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
