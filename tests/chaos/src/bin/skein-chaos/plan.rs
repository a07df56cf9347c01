//! Plan of disturbances, drawn from a seed before the run starts, so that a seed always disturbs in
//! the same way.
//!
//! Moments are given in training episodes, not in seconds, so that a plan fits a run on any
//! machine. Some disturbances follow another closely, to hit a run that is just recovering.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use serde::Serialize;

/// A disturbance.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(tag = "what", rename_all = "snake_case")]
pub(crate) enum Disturbance {
    /// SIGKILL to an actor; `choice` selects among the live ones.
    KillActor { choice: u32 },
    /// SIGSTOP to an actor, and SIGCONT after `secs`.
    FreezeActor { choice: u32, secs: f64 },
    /// SIGKILL to the learner.
    KillLearner,
    /// SIGSTOP to the learner, and SIGCONT after `secs`.
    FreezeLearner { secs: f64 },
    /// SIGKILL to the supervisor and to the processes within `reach`. The run is resumed after
    /// `pause_secs` with `actors` actors.
    KillSupervisor {
        reach: Reach,
        pause_secs: f64,
        actors: u32,
    },
    /// `skein attach` with this many actors.
    Attach { count: u32 },
    /// Ends one of the `skein attach` processes, with all its actors.
    Detach { choice: u32, manner: DetachSignal },
}

/// Processes that die with the supervisor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Reach {
    /// None: the others are orphaned.
    Alone,
    /// All processes of the run at once, as in a power cut.
    Everybody,
}

/// Signal that ends attached actors.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum DetachSignal {
    /// SIGINT, as Ctrl-C.
    Interrupt,
    /// SIGKILL.
    Kill,
}

/// Moment of a disturbance.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Moment {
    /// When this many training episodes were first learned from, plus this share of an epoch's
    /// duration.
    Episode { episode: u64, share: f64 },
    /// This long after the previous disturbance.
    After { secs: f64 },
}

/// A disturbance and its moment.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub(crate) struct PlannedDisturbance {
    pub(crate) when: Moment,
    #[serde(flatten)]
    pub(crate) what: Disturbance,
}

/// Number of disturbances of each kind.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct DisturbanceCounts {
    pub(crate) actor_kills: u32,
    pub(crate) learner_kills: u32,
    pub(crate) supervisor_kills: u32,
    pub(crate) freezes: u32,
    pub(crate) attachments: u32,
}

/// Run to be disturbed.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Subject {
    pub(crate) episodes: u64,
    pub(crate) episodes_per_epoch: u64,
    pub(crate) actors: u32,
    pub(crate) actor_silence_secs: f64,
    pub(crate) learner_silence_secs: f64,
}

/// Latest moment of a disturbance, as a share of the run: delayed disturbances must still find it
/// running.
const LAST: f64 = 0.9;
/// Share of the kills that closely follow the kill of a learner or supervisor.
const AFTERSHOCKS: f64 = 0.3;
/// Longest time between a kill and its aftershock, about the time of a start.
const AFTERSHOCK_SECS: f64 = 2.0;
/// Interval of freezes that hit the learner.
const LEARNER_FREEZES: u32 = 6;

impl DisturbanceCounts {
    /// Plans all wanted disturbances for `subject`, in chronological order.
    pub(crate) fn plan(self, subject: &Subject, seed: u64) -> Vec<PlannedDisturbance> {
        let mut draw = DisturbanceDraws {
            subject: *subject,
            generator: Pcg64Mcg::seed_from_u64(seed),
        };
        let mut shocks = Vec::new();
        shocks.extend((0..self.learner_kills).map(|_| Disturbance::KillLearner));
        shocks.extend((0..self.supervisor_kills).map(|number| draw.supervisor_kill(number)));
        shocks.extend((0..self.freezes).map(|number| draw.freeze(number)));
        let mut kills: Vec<_> = (0..self.actor_kills).map(|_| draw.actor_kill()).collect();

        let mut moments: Vec<(u64, f64, Disturbance, Vec<PlannedDisturbance>)> = Vec::new();
        for what in shocks {
            let mut after = Vec::new();
            let gets_up_again = matches!(
                what,
                Disturbance::KillLearner | Disturbance::KillSupervisor { .. }
            );
            if gets_up_again
                && draw.generator.random_bool(AFTERSHOCKS)
                && let Some(what) = kills.pop()
            {
                let secs = draw.generator.random_range(0.0..AFTERSHOCK_SECS);
                after.push(PlannedDisturbance {
                    when: Moment::After { secs },
                    what,
                });
            }
            let (episode, share) = draw.moment();
            moments.push((episode, share, what, after));
        }
        for what in kills {
            let (episode, share) = draw.moment();
            moments.push((episode, share, what, Vec::new()));
        }
        for _ in 0..self.attachments {
            let [(one, one_share), (other, other_share)] = [draw.moment(), draw.moment()];
            let (first, last) = if (one, one_share) < (other, other_share) {
                ((one, one_share), (other, other_share))
            } else {
                ((other, other_share), (one, one_share))
            };
            let count = draw.generator.random_range(1..=2);
            moments.push((first.0, first.1, Disturbance::Attach { count }, Vec::new()));
            moments.push((last.0, last.1, draw.detachment(), Vec::new()));
        }
        moments.sort_by(|one, other| {
            (one.0, one.1)
                .partial_cmp(&(other.0, other.1))
                .expect("shares are numbers")
        });
        let in_order = moments
            .into_iter()
            .flat_map(|(episode, share, what, after)| {
                let when = Moment::Episode { episode, share };
                std::iter::once(PlannedDisturbance { when, what }).chain(after)
            });
        in_order.collect()
    }
}

/// Random draws of disturbances.
struct DisturbanceDraws {
    subject: Subject,
    generator: Pcg64Mcg,
}

impl DisturbanceDraws {
    fn moment(&mut self) -> (u64, f64) {
        let Subject {
            episodes,
            episodes_per_epoch,
            ..
        } = self.subject;
        let last = (episodes as f64 * LAST) as u64 / episodes_per_epoch;
        let epoch = self.generator.random_range(0..=last);
        (
            epoch * episodes_per_epoch,
            self.generator.random_range(0.0..1.0),
        )
    }

    fn actor_kill(&mut self) -> Disturbance {
        Disturbance::KillActor {
            choice: self.generator.random(),
        }
    }

    fn supervisor_kill(&mut self, number: u32) -> Disturbance {
        Disturbance::KillSupervisor {
            reach: if number.is_multiple_of(2) {
                Reach::Alone
            } else {
                Reach::Everybody
            },
            pause_secs: self.generator.random_range(0.0..3.0),
            actors: self.generator.random_range(1..=self.subject.actors + 2),
        }
    }

    /// Freezes half of them for less than the peer's tolerated silence, and half for longer.
    fn freeze(&mut self, number: u32) -> Disturbance {
        let learner = number % LEARNER_FREEZES == LEARNER_FREEZES - 1;
        let silence_secs = if learner {
            self.subject.learner_silence_secs
        } else {
            self.subject.actor_silence_secs
        };
        let factor = if number.is_multiple_of(2) {
            self.generator.random_range(0.02..0.8)
        } else {
            self.generator.random_range(1.1..1.6)
        };
        let secs = silence_secs * factor;
        if learner {
            Disturbance::FreezeLearner { secs }
        } else {
            let choice = self.generator.random();
            Disturbance::FreezeActor { choice, secs }
        }
    }

    fn detachment(&mut self) -> Disturbance {
        Disturbance::Detach {
            choice: self.generator.random(),
            manner: if self.generator.random_bool(0.5) {
                DetachSignal::Interrupt
            } else {
                DetachSignal::Kill
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SUBJECT: Subject = Subject {
        episodes: 300,
        episodes_per_epoch: 10,
        actors: 4,
        actor_silence_secs: 5.0,
        learner_silence_secs: 30.0,
    };
    const WANTED: DisturbanceCounts = DisturbanceCounts {
        actor_kills: 50,
        learner_kills: 5,
        supervisor_kills: 2,
        freezes: 6,
        attachments: 3,
    };

    #[test]
    fn a_plan_holds_all_wanted_disturbances_and_depends_only_on_the_seed() {
        let plan = WANTED.plan(&SUBJECT, 7);
        let count =
            |is: fn(&Disturbance) -> bool| plan.iter().filter(|planned| is(&planned.what)).count();
        assert_eq!(
            count(|what| matches!(what, Disturbance::KillActor { .. })),
            50
        );
        assert_eq!(count(|what| matches!(what, Disturbance::KillLearner)), 5);
        assert_eq!(
            count(|what| matches!(what, Disturbance::KillSupervisor { .. })),
            2
        );
        assert_eq!(
            count(|what| matches!(what, Disturbance::FreezeActor { .. })),
            5
        );
        assert_eq!(
            count(|what| matches!(what, Disturbance::FreezeLearner { .. })),
            1
        );
        assert_eq!(count(|what| matches!(what, Disturbance::Attach { .. })), 3);
        assert_eq!(plan, WANTED.plan(&SUBJECT, 7));
        assert_ne!(plan, WANTED.plan(&SUBJECT, 8));
    }

    #[test]
    fn moments_are_in_order_and_before_the_end() {
        let episodes: Vec<_> = (0..20)
            .flat_map(|seed| WANTED.plan(&SUBJECT, seed))
            .filter_map(|planned| match planned.when {
                Moment::Episode { episode, .. } => Some(episode),
                Moment::After { .. } => None,
            })
            .collect();
        assert!(
            episodes
                .iter()
                .all(|&episode| episode <= 270 && episode % 10 == 0)
        );
        let one = WANTED.plan(&SUBJECT, 1);
        assert!(
            matches!(one[0].when, Moment::Episode { .. }),
            "an aftershock without a preceding kill"
        );
        let mut last = (0, 0.0);
        for planned in &one {
            if let Moment::Episode { episode, share } = planned.when {
                assert!((episode, share) >= last);
                last = (episode, share);
            }
        }
    }

    #[test]
    fn actors_are_frozen_for_less_and_for_more_than_the_tolerated_silence() {
        let frozen: Vec<_> = WANTED
            .plan(&SUBJECT, 3)
            .into_iter()
            .filter_map(|planned| match planned.what {
                Disturbance::FreezeActor { secs, .. } => Some(secs),
                _ => None,
            })
            .collect();
        assert!(frozen.iter().any(|&secs| secs < 5.0) && frozen.iter().any(|&secs| secs > 5.0));
    }
}
