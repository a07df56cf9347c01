//! The points of an epoch's curves, gathered over its segments and written at its end.

use std::time::Duration;

use skein_protocol::config::{AlgorithmName, Config};

use crate::faults::Faults;
use crate::metrics::{Scalar, fault_points};
use crate::replay::Replay;
use crate::trainer::MetricMeans;
use crate::vae::VaeMetrics;

/// Results of an epoch so far.
#[derive(Debug, Default)]
pub(super) struct EpochCurves {
    /// Steps learned from.
    pub(super) steps: usize,
    /// Metrics of the last VAE step, if there was one.
    pub(super) vae: Option<VaeMetrics>,
    /// MetricMeans of the policy updates' metrics.
    pub(super) policy: MetricMeans,
    pub(super) updates: u64,
    /// Time spent on the updates.
    pub(super) updating: Duration,
}

impl EpochCurves {
    /// Returns the points of an epoch of a run of `config`, which took `duration`.
    pub(super) fn points(
        self,
        config: &Config,
        duration: Duration,
        replay: &Replay,
        faults: &Faults,
    ) -> Vec<(Scalar, f64)> {
        let mut points = vec![
            (Scalar::ReplayTransitions, replay.len() as f64),
            (Scalar::ReplaySuccess, replay.success_len() as f64),
            (
                Scalar::StepsPerSec,
                self.steps as f64 / duration.as_secs_f64(),
            ),
        ];
        points.extend(fault_points(faults));
        if let Some(vae) = self.vae {
            points.extend([
                (Scalar::VaeLoss, vae.loss.into()),
                (Scalar::VaePixelError, vae.pixel_error.into()),
                (Scalar::VaeDivergence, vae.divergence.into()),
                (Scalar::VaeLearningRate, config.vae.learning_rate),
            ]);
        }
        if self.updates > 0 {
            points.extend(self.policy.finish());
            points.extend(learning_rates(config));
            points.push((
                Scalar::UpdatesPerSec,
                self.updates as f64 / self.updating.as_secs_f64(),
            ));
        }
        points
    }
}

/// Returns the learning rates of the configured algorithm.
fn learning_rates(config: &Config) -> Vec<(Scalar, f64)> {
    let (sac, td3) = (&config.sac, &config.td3);
    match config.learning.algorithm {
        AlgorithmName::Sac => vec![
            (Scalar::PolicyLearningRate, sac.policy_learning_rate),
            (Scalar::CriticLearningRate, sac.critic_learning_rate),
            (
                Scalar::TemperatureLearningRate,
                sac.temperature_learning_rate,
            ),
        ],
        AlgorithmName::Td3 => vec![
            (Scalar::PolicyLearningRate, td3.policy_learning_rate),
            (Scalar::CriticLearningRate, td3.critic_learning_rate),
        ],
        AlgorithmName::Distill => {
            vec![(Scalar::PolicyLearningRate, config.distill.learning_rate)]
        }
    }
}
