//! How long a learner that was told to stop still goes on.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use super::TrainingError;
use crate::episodes::receiver::Shared;

/// Time for the rest of an epoch's updates once the run is told to stop, and of an episode in
/// segments that is learned from already. Longer than those of any configuration here take, so that
/// everything learned is saved as a rule; and shorter than the 90 seconds after which the
/// supervisor ends a learner that does not.
const GRACE: Duration = Duration::from_secs(60);

/// Looks at the stop between updates.
pub(super) struct StopWatch<'a> {
    stop: &'a AtomicBool,
    grace: Duration,
    /// When it was first seen.
    seen: Option<Instant>,
}

impl<'a> StopWatch<'a> {
    pub(super) fn of(stop: &'a AtomicBool) -> Self {
        Self {
            stop,
            grace: GRACE,
            seen: None,
        }
    }

    /// To be asked while the next segment of an episode is waited for: the episode is flown to its
    /// end, so that what was learned from it can be saved.
    ///
    /// # Errors
    /// [`TrainingError::Abandoned`] when that takes too long, or nobody is there to fly it.
    pub(super) fn amid_episode(&mut self, receiver: &Shared) -> Result<(), TrainingError> {
        if self.stop.load(Ordering::Relaxed) && receiver.live_actors().is_empty() {
            return Err(TrainingError::Abandoned);
        }
        self.after_update()
    }

    /// # Errors
    /// [`TrainingError::Abandoned`] when the epoch's updates have taken too long since the stop:
    /// they are given up half done, and nothing of them is kept. The run goes on from the
    /// checkpoint before, and will do the same updates.
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
    fn updates_go_on_after_the_stop_but_not_for_long() {
        let stop = AtomicBool::new(false);
        let mut watch = StopWatch {
            grace: Duration::from_millis(20),
            ..StopWatch::of(&stop)
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
