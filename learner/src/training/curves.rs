//! What the curves of an epoch are drawn from, gathered over its segments and told at its end.

use std::time::Duration;

use crate::episodes::receiver::Shared;
use crate::metrics::Scalar;
use crate::replay::Replay;
use crate::trainer::Means;
use crate::vae::VaeMetrics;

/// What an epoch brought so far.
#[derive(Debug, Default)]
pub(super) struct EpochCurves {
    /// Steps taken in.
    pub(super) steps: usize,
    /// Of the last step of the VAE, if there was one.
    pub(super) vae: Option<VaeMetrics>,
    /// Of the policy's updates.
    pub(super) policy: Means,
    pub(super) updates: u64,
    /// Time for the updates.
    pub(super) updating: Duration,
}

impl EpochCurves {
    /// The points of an epoch that took so `long`.
    pub(super) fn points(
        self,
        long: Duration,
        replay: &Replay,
        receiver: &Shared,
    ) -> Vec<(Scalar, f64)> {
        let mut points = vec![
            (Scalar::ReplayTransitions, replay.len() as f64),
            (Scalar::ReplaySuccess, replay.success_len() as f64),
            (Scalar::StepsPerSec, self.steps as f64 / long.as_secs_f64()),
        ];
        points.extend(receiver.faults().scalars());
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
