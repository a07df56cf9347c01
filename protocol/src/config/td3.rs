//! `[td3]`.

use serde::{Deserialize, Serialize};

use super::{
    Invalid, require, require_batch_size, require_critic_networks, require_discount,
    require_learning_rate, require_width,
};

/// `[td3]`: twin delayed deep deterministic policy gradient (Fujimoto et al. 2018,
/// arXiv:1802.09477), which the paper compares with (its Fig. 11) without saying any of these
/// values. Networks are as wide and minibatches as large as in `[sac]` by default, so that the two
/// are compared on equal terms. Policy and critic are computed by libtorch on any device, the VAE by
/// `run.engine`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Td3Section {
    /// Width of the hidden layers of policy (three) and critic (two). Default 256.
    pub hidden_width: usize,
    /// Networks that give the critic's two estimates of Q: 1, with two outputs (paper), or 2, with
    /// one each, whose errors have less in common, so that the smaller estimate is one of a value
    /// that both overrate less often. Default 1.
    pub critic_networks: usize,
    /// Transitions in a minibatch. Default 256.
    pub batch_size: usize,
    /// Adam's step size for the policy. Default 3e-4.
    pub policy_learning_rate: f64,
    /// Adam's step size for the critic. Default 3e-4.
    pub critic_learning_rate: f64,
    /// Discount per control period, γ. Default 0.99.
    pub discount: f64,
    /// Share of policy and critic that moves into the target networks when the policy is updated,
    /// τ. Default 0.005.
    pub target_rate: f64,
    /// Standard deviation of the noise added to actions in training episodes, each command in [-1,
    /// 1]. Default 0.1, as in arXiv:1802.09477.
    pub exploration_noise: f64,
    /// Standard deviation of the noise that smooths the targets. Default 0.2, as in
    /// arXiv:1802.09477.
    pub target_noise: f64,
    /// Bound of that noise. Default 0.5, as in arXiv:1802.09477.
    pub target_noise_bound: f64,
    /// Updates of the critic for each of the policy. Default 2, as in arXiv:1802.09477.
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
    pub(super) fn validate(&self) -> Result<(), Invalid> {
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
