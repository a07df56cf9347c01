//! When a process that died is started again, and when it is given up.
//!
//! Being killed gives nobody up: processes may be killed as often as anybody likes, and are only
//! started again after longer pauses. What counts is whether those that fail by themselves get
//! anywhere in between.

use std::collections::VecDeque;
use std::time::Duration;

use tokio::time::Instant;

use super::work::Work;

/// What follows a death.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Verdict {
    /// Start it again after this pause.
    RestartAfter(Duration),
    /// Leave it dead.
    GiveUp,
}

/// The deaths of an actor.
#[derive(Debug, Default)]
pub(super) struct ActorDeaths {
    recent: VecDeque<Instant>,
    in_vain: usize,
}

impl ActorDeaths {
    /// Lives in vain, one after the other, after which an actor is given up: what kills it will
    /// kill it again.
    pub(super) const MAX_IN_VAIN: usize = 5;
    /// Deaths longer ago than this no longer lengthen the pause.
    const WINDOW: Duration = Duration::from_secs(60);
    /// Pause before the first restart; it doubles with each further death within the window, up to
    /// the longest.
    const FIRST_PAUSE: Duration = Duration::from_millis(250);
    const LONGEST_PAUSE: Duration = Duration::from_secs(8);

    /// Notes a death at `now` and decides what follows.
    pub(super) fn died(&mut self, now: Instant, incarnation: LearnerIncarnation) -> Verdict {
        self.recent
            .retain(|&death| now.duration_since(death) < Self::WINDOW);
        self.recent.push_back(now);
        self.in_vain = match incarnation {
            LearnerIncarnation::Served => 0,
            LearnerIncarnation::Interrupted => self.in_vain,
            LearnerIncarnation::InVain => self.in_vain + 1,
        };
        if self.in_vain >= Self::MAX_IN_VAIN {
            return Verdict::GiveUp;
        }
        let doublings = u32::try_from(self.recent.len() - 1).unwrap_or(u32::MAX);
        let pause = Self::FIRST_PAUSE.saturating_mul(2_u32.saturating_pow(doublings));
        Verdict::RestartAfter(pause.min(Self::LONGEST_PAUSE))
    }
}

/// What an actor's incarnation was good for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum LearnerIncarnation {
    /// The learner heard of it, and the run got on meanwhile.
    Served,
    /// There was no learner to serve, or somebody killed it: that says nothing about the actor.
    Interrupted,
    /// Neither.
    InVain,
}

/// Whose doing a death of the learner was.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Cause {
    /// Somebody else's: it says nothing about the learner.
    Outside,
    /// Its own.
    Failure,
}

/// The deaths of the learner.
#[derive(Debug)]
pub(super) struct LearnerDeaths {
    first_pause: Duration,
    furthest: Option<Work>,
    since_progress: u32,
    failures_since_progress: u32,
}

impl LearnerDeaths {
    /// Failures after which the run fails, if none of these incarnations got further than one
    /// before it. Not fewer, because a learner that dies before it has written a checkpoint may get
    /// no further by no fault of its own.
    pub(super) const MAX_WITHOUT_PROGRESS: u32 = 10;
    /// The longest pause, in first pauses.
    const LONGEST_PAUSE: u32 = 8;

    /// No deaths so far. There is no pause after the first, `first_pause` after the second, then
    /// they double.
    pub(super) fn new(first_pause: Duration) -> Self {
        Self {
            first_pause,
            furthest: None,
            since_progress: 0,
            failures_since_progress: 0,
        }
    }

    /// Notes how far the run has come. Only what no incarnation before has reached is progress: the
    /// rest is done over.
    pub(super) fn reached(&mut self, work: Work) {
        if self.furthest.is_none_or(|furthest| work > furthest) {
            // The first report of all shows where the run began, not that it gets on.
            if self.furthest.is_some() {
                self.since_progress = 0;
                self.failures_since_progress = 0;
            }
            self.furthest = Some(work);
        }
    }

    /// Notes a death and decides what follows.
    pub(super) fn died(&mut self, cause: Cause) -> Verdict {
        self.since_progress = self.since_progress.saturating_add(1);
        if cause == Cause::Failure {
            self.failures_since_progress += 1;
        }
        if self.failures_since_progress >= Self::MAX_WITHOUT_PROGRESS {
            return Verdict::GiveUp;
        }
        match self.since_progress {
            1 => Verdict::RestartAfter(Duration::ZERO),
            deaths => {
                let pauses = 2_u32.saturating_pow(deaths - 2).min(Self::LONGEST_PAUSE);
                Verdict::RestartAfter(self.first_pause * pauses)
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
            .map(|second| {
                deaths.died(
                    start + Duration::from_secs(second),
                    LearnerIncarnation::InVain,
                )
            })
            .collect();
        let pause = |factor| Verdict::RestartAfter(ActorDeaths::FIRST_PAUSE * factor);
        assert_eq!(
            verdicts,
            [pause(1), pause(2), pause(4), pause(8), Verdict::GiveUp]
        );
    }

    #[test]
    fn an_actor_that_serves_between_its_deaths_is_started_again_for_ever() {
        let (mut deaths, start) = (ActorDeaths::default(), Instant::now());
        for second in 0..1000 {
            let incarnation = if second % 4 == 0 {
                LearnerIncarnation::Served
            } else {
                LearnerIncarnation::InVain
            };
            let verdict = deaths.died(start + Duration::from_secs(second), incarnation);
            assert_ne!(verdict, Verdict::GiveUp);
        }
        let verdict = deaths.died(
            start + Duration::from_secs(1000),
            LearnerIncarnation::Served,
        );
        assert_eq!(verdict, Verdict::RestartAfter(ActorDeaths::LONGEST_PAUSE));
        let verdict = deaths.died(
            start + Duration::from_secs(1061),
            LearnerIncarnation::Served,
        );
        assert_eq!(verdict, Verdict::RestartAfter(ActorDeaths::FIRST_PAUSE));
    }

    #[test]
    fn an_actor_is_not_blamed_for_a_learner_that_is_not_there() {
        let (mut deaths, now) = (ActorDeaths::default(), Instant::now());
        for _ in 0..100 {
            assert_ne!(
                deaths.died(now, LearnerIncarnation::Interrupted),
                Verdict::GiveUp
            );
        }
    }

    #[test]
    fn a_learner_is_started_again_at_once_and_then_after_pauses() {
        let mut deaths = LearnerDeaths::new(Duration::from_secs(1));
        let secs: Vec<_> = std::iter::from_fn(|| match deaths.died(Cause::Failure) {
            Verdict::RestartAfter(pause) => Some(pause.as_secs()),
            Verdict::GiveUp => None,
        })
        .collect();
        assert_eq!(secs, [0, 1, 2, 4, 8, 8, 8, 8, 8]);
    }

    #[test]
    fn a_learner_that_is_killed_is_started_again_for_ever() {
        let mut deaths = LearnerDeaths::new(Duration::from_secs(1));
        for _ in 0..1000 {
            assert_ne!(deaths.died(Cause::Outside), Verdict::GiveUp);
        }
        assert_eq!(
            deaths.died(Cause::Outside),
            Verdict::RestartAfter(Duration::from_secs(8))
        );
    }

    #[test]
    fn only_what_no_incarnation_before_reached_is_progress() {
        let mut deaths = LearnerDeaths::new(Duration::from_secs(1));
        deaths.reached(Work::test(0));
        for incarnation in 0..1000 {
            deaths.reached(Work::test(incarnation));
            deaths.reached(Work::test(incarnation + 1));
            assert_eq!(
                deaths.died(Cause::Failure),
                Verdict::RestartAfter(Duration::ZERO)
            );
        }
        // It dies at the same place again and again, having done the same work each time.
        let again: Vec<_> = (0..LearnerDeaths::MAX_WITHOUT_PROGRESS - 1)
            .map(|_| {
                (990..=1000).for_each(|updates| deaths.reached(Work::test(updates)));
                deaths.died(Cause::Failure)
            })
            .collect();
        assert_eq!(again.last(), Some(&Verdict::GiveUp));
    }
}
