//! Soft actor-critic with learned temperature (Haarnoja et al. 2018, arXiv:1812.05905).
//!
//! Two engines do the same update: one on kernels of our own, one on libtorch. Parameters, noise, metrics and what a checkpoint holds are the same of both; sums round
//! differently.

pub mod losses;
mod native;
mod torch;

use skein_kernels::{Isa, Team};
use skein_protocol::config::{Engine, SacSection};
use tch::Device;

use crate::algorithm::{Algorithm, Columns, Inputs};
use crate::error::UpdateError;
use crate::metrics::Scalar;
use crate::networks::Layout;
use crate::noise::Noise;
use crate::state::{Part, Stateful};

pub use native::NativeSac;
pub use torch::TorchSac;

/// Policy, critic, target critic and temperature, each with its optimizer, on the engine of the run.
#[derive(Debug)]
pub enum Sac {
    /// On the processor.
    Native(Box<NativeSac>),
    /// On any device of libtorch's.
    Torch(Box<TorchSac>),
}

/// What one SAC update reports.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SacMetrics {
    /// Half the squared distance of the two Q estimates from their targets: rises when the policy meets something new, should not grow for long.
    pub critic_loss: f32,
    /// What the policy minimises, α log π - Q: falls as the value of its actions rises.
    pub policy_loss: f32,
    /// α before this update: the price of certainty, in units of reward for each nat of entropy.
    pub temperature: f32,
    /// Estimate of the policy's entropy in nats, -log π of drawn actions: held near the target entropy by the temperature.
    pub entropy: f32,
    /// The smaller Q estimate of the replayed actions: the return the critic expects, entropy bonus included.
    pub mean_value: f32,
}

impl Sac {
    /// Untrained networks whose parameters depend on the run's seed alone. `device`: libtorch's; the native engine is on the processor.
    pub fn new(section: &SacSection, inputs: Inputs, run_seed: u64, engine: Engine, device: Device) -> Self {
        match engine {
            Engine::Native => {
                let sac = NativeSac::new(section, inputs, run_seed, Isa::best());
                Self::Native(Box::new(sac))
            }
            Engine::Libtorch => Self::Torch(Box::new(TorchSac::new(section, inputs, run_seed, device))),
        }
    }

    /// One step of critic, policy and temperature, and of the target behind them. libtorch has threads of its own and leaves `team` alone.
    ///
    /// # Errors
    /// [`UpdateError::NonFinite`] names what was not finite and the update's number; nothing was changed then.
    ///
    /// # Panics
    /// When the columns have different numbers of rows, or none.
    pub fn update(
        &mut self,
        team: &mut Team,
        columns: Columns<'_>,
        noise: &mut Noise,
    ) -> Result<SacMetrics, UpdateError> {
        match self {
            Self::Native(sac) => sac.update(team, columns, noise),
            Self::Torch(sac) => sac.update(columns, noise),
        }
    }

    /// The policy's action without noise, `[n, 2]`. `observations`: `[n, observation]`.
    pub fn mode(&self, observations: &[f32]) -> Vec<f32> {
        match self {
            Self::Native(sac) => sac.mode(observations),
            Self::Torch(sac) => sac.mode(observations),
        }
    }

    /// Names and shapes of what [`Sac::publish`] copies.
    pub fn policy_layout(&self) -> &Layout {
        match self {
            Self::Native(sac) => sac.policy_layout(),
            Self::Torch(sac) => sac.policy_layout(),
        }
    }

    /// Length of the policy's parameters.
    pub fn published_len(&self) -> usize {
        self.policy_layout().len()
    }

    /// Copies the policy's part of a snapshot, in the snapshot layout's order.
    ///
    /// # Panics
    /// When `into` is not [`Sac::published_len`] long.
    pub fn publish(&self, into: &mut [f32]) {
        match self {
            Self::Native(sac) => sac.publish(into),
            Self::Torch(sac) => sac.publish(into),
        }
    }

    /// Updates done so far.
    pub fn updates(&self) -> u64 {
        match self {
            Self::Native(sac) => sac.updates(),
            Self::Torch(sac) => sac.updates(),
        }
    }
}

impl Algorithm for Sac {
    fn update(
        &mut self,
        team: &mut Team,
        columns: Columns<'_>,
        noise: &mut Noise,
    ) -> Result<Vec<(Scalar, f32)>, UpdateError> {
        let metrics = Sac::update(self, team, columns, noise)?;
        Ok(vec![
            (Scalar::CriticLoss, metrics.critic_loss),
            (Scalar::PolicyLoss, metrics.policy_loss),
            (Scalar::Temperature, metrics.temperature),
            (Scalar::Entropy, metrics.entropy),
            (Scalar::MeanValue, metrics.mean_value),
        ])
    }

    fn updates(&self) -> u64 {
        Sac::updates(self)
    }

    fn policy_layout(&self) -> &Layout {
        Sac::policy_layout(self)
    }

    fn publish(&self, into: &mut [f32]) {
        Sac::publish(self, into);
    }

    fn publish_encoder(&self, into: &mut [f32]) {
        match self {
            Self::Native(_) => {}
            Self::Torch(sac) => sac.publish_encoder(into),
        }
    }
}

impl Stateful for Sac {
    fn parts(&mut self) -> Vec<(String, Part<'_>)> {
        match self {
            Self::Native(sac) => sac.parts(),
            Self::Torch(sac) => sac.parts(),
        }
    }
}

#[cfg(test)]
pub(crate) mod samples;
#[cfg(test)]
mod tests;
