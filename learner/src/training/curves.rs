//! The points of an epoch's curves, gathered over its segments and written at its end.

use std::time::Duration;

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
    /// Returns the points of an epoch that took `duration`.
    pub(super) fn points(
        self,
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
            ]);
        }
        if self.updates > 0 {
            points.extend(self.policy.finish());
            points.push((
                Scalar::UpdatesPerSec,
                self.updates as f64 / self.updating.as_secs_f64(),
            ));
        }
        points
    }
}
