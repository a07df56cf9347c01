//! The `[distill]` section.

use serde::{Deserialize, Serialize};

use super::{InvalidValue, require, require_batch_size, require_learning_rate, require_width};

/// The `[distill]` section: regression of the policy on the teacher's actions, in the states that
/// the policy itself visits (DAgger, arXiv:1011.0686).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DistillSection {
    /// Width of the policy's three hidden layers, 1 to 4096. Default 256.
    pub hidden_width: usize,
    /// Transitions in a minibatch, 1 to 65,536. Default 256.
    pub batch_size: usize,
    /// Adam's step size at the first update, in (0, 1]. Default 3e-4.
    pub learning_rate: f64,
    /// Standard deviation of the Gaussian before tanh that training episodes are flown with, 1e-8
    /// to 7. It spreads the visited states. Default 0.3.
    pub exploration: f64,
}

impl Default for DistillSection {
    fn default() -> Self {
        Self {
            hidden_width: 256,
            batch_size: 256,
            learning_rate: 3e-4,
            exploration: 0.3,
        }
    }
}

impl DistillSection {
    pub(super) fn validate(&self) -> Result<(), InvalidValue> {
        require_width("distill.hidden_width", self.hidden_width)?;
        require_batch_size("distill.batch_size", self.batch_size)?;
        require_learning_rate("distill.learning_rate", self.learning_rate)?;
        require(
            (1e-8..=7.0).contains(&self.exploration),
            "distill.exploration",
            self.exploration,
            "is outside [1e-8, 7], the bounds of a policy's standard deviation",
        )
    }
}
