//! Decides when a process that died is restarted, and when it is given up.
//!
//! Kills from outside never lead to giving up: a process may be killed any number of times, and
//! only the pauses grow. What counts is whether processes that fail by themselves make progress in
//! between.

use std::collections::VecDeque;
use std::time::Duration;

use tokio::time::Instant;

use super::work::WorkDone;

/// Decision after a death.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum RestartDecision {
    /// Restart it after this pause.
    RestartAfter(Duration),
    /// Leave it dead.
    GiveUp,
}

/// Deaths of an actor.
#[derive(Debug, Default)]
pub(super) struct ActorDeaths {
    recent: VecDeque<Instant>,
    useless: usize,
}

impl ActorDeaths {
    /// Number of consecutive useless incarnations after which an actor is given up: the same cause
    /// would kill it again.
    pub(super) const MAX_USELESS: usize = 5;
    /// Deaths longer ago than this no longer lengthen the pause.
    const WINDOW: Duration = Duration::from_secs(60);
    /// Pause before the first restart. It doubles with each further death within the window, up to
    /// the longest.
    const FIRST_PAUSE: Duration = Duration::from_millis(250);
    const LONGEST_PAUSE: Duration = Duration::from_secs(8);

    /// Records a death at `now` and returns the decision.
    pub(super) fn died(&mut self, now: Instant, incarnation: IncarnationUse) -> RestartDecision {
        self.recent
            .retain(|&death| now.duration_since(death) < Self::WINDOW);
        self.recent.push_back(now);
        self.useless = match incarnation {
            IncarnationUse::Served => 0,
            IncarnationUse::Interrupted => self.useless,
            IncarnationUse::Useless => self.useless + 1,
        };
        if self.useless >= Self::MAX_USELESS {
            return RestartDecision::GiveUp;
        }
        let doublings = u32::try_from(self.recent.len() - 1).unwrap_or(u32::MAX);
        let pause = Self::FIRST_PAUSE.saturating_mul(2_u32.saturating_pow(doublings));
        RestartDecision::RestartAfter(pause.min(Self::LONGEST_PAUSE))
    }
}

/// Usefulness of an actor's incarnation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum IncarnationUse {
    /// The learner heard of it, and the run progressed meanwhile.
    Served,
    /// No learner was there to serve, or it was killed from outside: inconclusive.
    Interrupted,
    /// Neither of these.
    Useless,
}

/// Origin of the learner's death.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum DeathCause {
    /// An outside cause, which proves nothing about the learner.
    Outside,
    /// The learner's own failure.
    Failure,
}

/// Deaths of the learner.
#[derive(Debug)]
pub(super) struct LearnerDeaths {
    first_pause: Duration,
    furthest: Option<WorkDone>,
    since_progress: u32,
    failures_since_progress: u32,
}

impl LearnerDeaths {
    /// Number of failures after which the run fails, if none of these incarnations made progress.
    /// The number is large because a learner that dies before it writes a checkpoint may make no
    /// progress through no fault of its own.
    pub(super) const MAX_WITHOUT_PROGRESS: u32 = 10;
    /// Longest pause, in multiples of the first.
    const LONGEST_PAUSE: u32 = 8;

    /// Creates the state before any death. The first death has no pause, the second `first_pause`;
    /// then pauses double.
    pub(super) fn new(first_pause: Duration) -> Self {
        Self {
            first_pause,
            furthest: None,
            since_progress: 0,
            failures_since_progress: 0,
        }
    }

    /// Records the work done. Only work beyond that of all earlier incarnations is progress; the
    /// rest is repeated.
    pub(super) fn reached(&mut self, work: WorkDone) {
        if self.furthest.is_none_or(|furthest| work > furthest) {
            // The very first report shows where the run began, not progress.
            if self.furthest.is_some() {
                self.since_progress = 0;
                self.failures_since_progress = 0;
            }
            self.furthest = Some(work);
        }
    }

    /// Records a death and returns the decision.
    pub(super) fn died(&mut self, cause: DeathCause) -> RestartDecision {
        self.since_progress = self.since_progress.saturating_add(1);
        if cause == DeathCause::Failure {
            self.failures_since_progress += 1;
        }
        if self.failures_since_progress >= Self::MAX_WITHOUT_PROGRESS {
            return RestartDecision::GiveUp;
        }
        match self.since_progress {
            1 => RestartDecision::RestartAfter(Duration::ZERO),
            deaths => {
                let pauses = 2_u32.saturating_pow(deaths - 2).min(Self::LONGEST_PAUSE);
                RestartDecision::RestartAfter(self.first_pause * pauses)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pauses_double_until_the_actor_is_given_up() {
        let (mut deaths, start) = (ActorDeaths::default(), Instant::now());
        let verdicts: Vec<_> = (0..5)
            .map(|second| deaths.died(start + Duration::from_secs(second), IncarnationUse::Useless))
            .collect();
        let pause = |factor| RestartDecision::RestartAfter(ActorDeaths::FIRST_PAUSE * factor);
        assert_eq!(
            verdicts,
            [
                pause(1),
                pause(2),
                pause(4),
                pause(8),
                RestartDecision::GiveUp
            ]
        );
    }

    #[test]
    fn an_actor_that_is_useful_between_deaths_is_always_restarted() {
        let (mut deaths, start) = (ActorDeaths::default(), Instant::now());
        for second in 0..1000 {
            let incarnation = if second % 4 == 0 {
                IncarnationUse::Served
            } else {
                IncarnationUse::Useless
            };
            let verdict = deaths.died(start + Duration::from_secs(second), incarnation);
            assert_ne!(verdict, RestartDecision::GiveUp);
        }
        let verdict = deaths.died(start + Duration::from_secs(1000), IncarnationUse::Served);
        assert_eq!(
            verdict,
            RestartDecision::RestartAfter(ActorDeaths::LONGEST_PAUSE)
        );
        let verdict = deaths.died(start + Duration::from_secs(1061), IncarnationUse::Served);
        assert_eq!(
            verdict,
            RestartDecision::RestartAfter(ActorDeaths::FIRST_PAUSE)
        );
    }

    #[test]
    fn an_actor_is_not_blamed_for_an_absent_learner() {
        let (mut deaths, now) = (ActorDeaths::default(), Instant::now());
        for _ in 0..100 {
            assert_ne!(
                deaths.died(now, IncarnationUse::Interrupted),
                RestartDecision::GiveUp
            );
        }
    }

    #[test]
    fn a_learner_restarts_at_once_and_later_after_pauses() {
        let mut deaths = LearnerDeaths::new(Duration::from_secs(1));
        let secs: Vec<_> = std::iter::from_fn(|| match deaths.died(DeathCause::Failure) {
            RestartDecision::RestartAfter(pause) => Some(pause.as_secs()),
            RestartDecision::GiveUp => None,
        })
        .collect();
        assert_eq!(secs, [0, 1, 2, 4, 8, 8, 8, 8, 8]);
    }

    #[test]
    fn a_learner_killed_from_outside_is_always_restarted() {
        let mut deaths = LearnerDeaths::new(Duration::from_secs(1));
        for _ in 0..1000 {
            assert_ne!(deaths.died(DeathCause::Outside), RestartDecision::GiveUp);
        }
        assert_eq!(
            deaths.died(DeathCause::Outside),
            RestartDecision::RestartAfter(Duration::from_secs(8))
        );
    }

    #[test]
    fn only_work_beyond_all_earlier_incarnations_is_progress() {
        let mut deaths = LearnerDeaths::new(Duration::from_secs(1));
        deaths.reached(WorkDone::test(0));
        for incarnation in 0..1000 {
            deaths.reached(WorkDone::test(incarnation));
            deaths.reached(WorkDone::test(incarnation + 1));
            assert_eq!(
                deaths.died(DeathCause::Failure),
                RestartDecision::RestartAfter(Duration::ZERO)
            );
        }
        // Dies at the same place repeatedly, after the same work each time.
        let again: Vec<_> = (0..LearnerDeaths::MAX_WITHOUT_PROGRESS - 1)
            .map(|_| {
                (990..=1000).for_each(|updates| deaths.reached(WorkDone::test(updates)));
                deaths.died(DeathCause::Failure)
            })
            .collect();
        assert_eq!(again.last(), Some(&RestartDecision::GiveUp));
    }
}
