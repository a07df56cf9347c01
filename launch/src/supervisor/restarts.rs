//! When an actor that died is started again.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// Deaths within [`WINDOW`] after which an actor is given up: what kills it will kill it again.
pub(super) const MAX_DEATHS: usize = 5;
/// Deaths longer ago than this are forgiven.
pub(super) const WINDOW: Duration = Duration::from_secs(60);
/// Pause before the first restart; it doubles with each further death.
const FIRST_PAUSE: Duration = Duration::from_millis(250);

/// What follows an actor's death.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Verdict {
    /// Start it again after this pause.
    RestartAfter(Duration),
    /// Leave it dead.
    GiveUp,
}

/// The recent deaths of one actor.
#[derive(Debug, Default)]
pub(super) struct Restarts {
    deaths: VecDeque<Instant>,
}

impl Restarts {
    /// Notes a death at `now` and decides what follows.
    pub(super) fn died(&mut self, now: Instant) -> Verdict {
        self.deaths.retain(|&death| now.duration_since(death) < WINDOW);
        self.deaths.push_back(now);
        if self.deaths.len() >= MAX_DEATHS {
            Verdict::GiveUp
        } else {
            Verdict::RestartAfter(FIRST_PAUSE * (1 << (self.deaths.len() - 1)))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pauses_double_until_the_actor_is_given_up() {
        let (mut restarts, start) = (Restarts::default(), Instant::now());
        let verdicts: Vec<_> = (0..5)
            .map(|second| restarts.died(start + Duration::from_secs(second)))
            .collect();
        let pause = |factor| Verdict::RestartAfter(FIRST_PAUSE * factor);
        assert_eq!(verdicts, [pause(1), pause(2), pause(4), pause(8), Verdict::GiveUp]);
    }

    #[test]
    fn an_actor_that_dies_rarely_is_always_restarted() {
        let (mut restarts, start) = (Restarts::default(), Instant::now());
        for minute in 0..100 {
            let verdict = restarts.died(start + Duration::from_secs(61 * minute));
            assert_eq!(verdict, Verdict::RestartAfter(FIRST_PAUSE));
        }
    }
}
