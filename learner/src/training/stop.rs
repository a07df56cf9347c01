//! Time limit for a learner that was asked to stop.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use super::TrainingError;
use crate::episodes::ReceiverState;

/// Time for the rest of an epoch's updates after a stop, and for the rest of an episode in
/// segments. It exceeds what any shipped configuration takes, so everything learned is usually
/// saved. It is shorter than the 90 seconds after which the supervisor kills the learner.
const GRACE: Duration = Duration::from_secs(60);

/// Checks the stop flag between updates.
pub(super) struct StopMonitor<'a> {
    stop: &'a AtomicBool,
    grace: Duration,
    /// Time at which the flag was first seen set.
    seen: Option<Instant>,
}

impl<'a> StopMonitor<'a> {
    pub(super) fn of(stop: &'a AtomicBool) -> Self {
        Self {
            stop,
            grace: GRACE,
            seen: None,
        }
    }

    /// Called while waiting for the next segment of an episode. The episode is flown to its end, so
    /// that what was learned from it can be saved.
    ///
    /// # Errors
    /// [`TrainingError::Abandoned`] when that takes too long, or no actor is there to fly it.
    pub(super) fn during_episode(&mut self, receiver: &ReceiverState) -> Result<(), TrainingError> {
        if self.stop.load(Ordering::Relaxed) && receiver.live_actors().is_empty() {
            return Err(TrainingError::Abandoned);
        }
        self.after_update()
    }

    /// Called after each update.
    ///
    /// # Errors
    /// [`TrainingError::Abandoned`] when the epoch's updates have taken too long since the stop.
    /// None of them is kept: the run resumes from the checkpoint before, and repeats them.
    pub(super) fn after_update(&mut self) -> Result<(), TrainingError> {
        if !self.stop.load(Ordering::Relaxed) {
            return Ok(());
        }
        let seen = *self.seen.get_or_insert_with(Instant::now);
        if seen.elapsed() < self.grace {
            Ok(())
        } else {
            Err(TrainingError::Abandoned)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn updates_continue_after_the_stop_but_not_for_long() {
        let stop = AtomicBool::new(false);
        let mut watch = StopMonitor {
            grace: Duration::from_millis(20),
            ..StopMonitor::of(&stop)
        };
        std::thread::sleep(Duration::from_millis(30));
        watch.after_update().unwrap();
        stop.store(true, Ordering::Relaxed);
        watch.after_update().unwrap();
        std::thread::sleep(Duration::from_millis(30));
        assert!(matches!(
            watch.after_update(),
            Err(TrainingError::Abandoned)
        ));
    }
}
