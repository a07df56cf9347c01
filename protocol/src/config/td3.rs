//! The `[td3]` section.

use serde::{Deserialize, Serialize};

use super::{
    InvalidValue, require, require_batch_size, require_critic_networks, require_discount,
    require_learning_rate, require_width,
};

/// The `[td3]` section: twin delayed deep deterministic policy gradient (Fujimoto et al. 2018,
/// arXiv:1802.09477).
///
/// The paper compares with it (its Fig. 11) but specifies none of these values. Networks and
/// minibatches default to the sizes in `[sac]`, so that the two are compared on equal terms. Policy
/// and critic run on libtorch on any device, the VAE on `run.engine`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Td3Section {
    /// Width of the hidden layers of policy (three) and critic (two), 1 to 4096. Default 256.
    pub hidden_width: usize,
    /// Networks that estimate Q twice: 1, with two outputs (paper), or 2, with one output each.
    /// Errors of two networks are less correlated, so the smaller estimate overrates Q less often.
    /// Default 1.
    pub critic_networks: usize,
    /// Transitions in a minibatch, 1 to 65,536. Default 256.
    pub batch_size: usize,
    /// Adam's step size for the policy, in (0, 1]. Default 3e-4.
    pub policy_learning_rate: f64,
    /// Adam's step size for the critic, in (0, 1]. Default 3e-4.
    pub critic_learning_rate: f64,
    /// Discount γ per control period, in [0, 1). Default 0.99.
    pub discount: f64,
    /// Share τ of policy and critic that moves into the target networks at each policy update, in
    /// (0, 1]. Default 0.005.
    pub target_rate: f64,
    /// Standard deviation of the exploration noise in training episodes, on commands in [-1, 1]; 0
    /// to 2. Default 0.1, as in arXiv:1802.09477.
    pub exploration_noise: f64,
    /// Standard deviation of the noise that smooths the targets, 0 to 2. Default 0.2, as in
    /// arXiv:1802.09477.
    pub target_noise: f64,
    /// Bound of the target noise, 0 to 2. Default 0.5, as in arXiv:1802.09477.
    pub target_noise_bound: f64,
    /// Critic updates per policy update, at least 1. Default 2, as in arXiv:1802.09477.
    pub policy_period: u64,
}

impl Default for Td3Section {
    fn default() -> Self {
        Self {
            hidden_width: 256,
            critic_networks: 1,
            batch_size: 256,
            policy_learning_rate: 3e-4,
            critic_learning_rate: 3e-4,
            discount: 0.99,
            target_rate: 0.005,
            exploration_noise: 0.1,
            target_noise: 0.2,
            target_noise_bound: 0.5,
            policy_period: 2,
        }
    }
}

impl Td3Section {
    pub(super) fn validate(&self) -> Result<(), InvalidValue> {
        require_width("td3.hidden_width", self.hidden_width)?;
        require_critic_networks("td3.critic_networks", self.critic_networks)?;
        require_batch_size("td3.batch_size", self.batch_size)?;
        for (key, rate) in [
            ("td3.policy_learning_rate", self.policy_learning_rate),
            ("td3.critic_learning_rate", self.critic_learning_rate),
        ] {
            require_learning_rate(key, rate)?;
        }
        require_discount("td3.discount", self.discount)?;
        require(
            self.target_rate > 0.0 && self.target_rate <= 1.0,
            "td3.target_rate",
            self.target_rate,
            "is outside (0, 1]: the target networks would never follow",
        )?;
        for (key, noise) in [
            ("td3.exploration_noise", self.exploration_noise),
            ("td3.target_noise", self.target_noise),
            ("td3.target_noise_bound", self.target_noise_bound),
        ] {
            require(
                (0.0..=2.0).contains(&noise),
                key,
                noise,
                "is outside [0, 2]: commands are in [-1, 1]",
            )?;
        }
        require(
            self.policy_period >= 1,
            "td3.policy_period",
            self.policy_period,
            "is below 1: the policy would never be updated",
        )
    }
}
