//! The best snapshot: training episodes propose candidates, confirmation episodes decide.
//!
//! Training episodes have exploration noise and start at all levels, so their average only shows
//! when a closer look pays. Confirmation episodes are flown like the final evaluation: without
//! noise, from the start of level 1.

use skein_protocol::config::EvaluationSection;

use crate::checkpoint::BestSnapshot;
use crate::metrics::MovingAverage;

/// `true` if the snapshot after `episodes` training episodes is worth confirming. It must be late
/// enough after the last candidate at `latest`, have a full window, and an average not far below
/// the best snapshot's.
pub(crate) fn is_candidate(
    section: &EvaluationSection,
    episodes: u64,
    latest: Option<u64>,
    walls_passed: &MovingAverage,
    best: Option<&BestSnapshot>,
) -> bool {
    let due = latest.is_none_or(|latest| episodes >= latest + section.every_episodes);
    let threshold = best.map_or(0.0, |best| {
        best.window_walls_passed - section.candidate_margin
    });
    due && walls_passed.is_full()
        && walls_passed
            .mean()
            .is_some_and(|mean| mean > 0.0 && mean >= threshold)
}

/// `true` if a confirmed candidate replaces the best: more walls passed in confirmation episodes,
/// or equally many and a better training average.
pub(crate) fn is_better(candidate: &BestSnapshot, best: Option<&BestSnapshot>) -> bool {
    best.is_none_or(|best| {
        let rank = |snapshot: &BestSnapshot| {
            (
                snapshot.confirmed_walls_passed,
                snapshot.window_walls_passed,
            )
        };
        rank(candidate) > rank(best)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn best(window: f64, confirmed: f64) -> BestSnapshot {
        BestSnapshot {
            policy_version: 1,
            episodes: 50,
            window_walls_passed: window,
            confirmed_walls_passed: confirmed,
        }
    }

    fn window(value: f32, count: usize) -> MovingAverage {
        let mut window = MovingAverage::new(50);
        (0..count).for_each(|_| window.push(value));
        window
    }

    #[test]
    fn a_candidate_needs_a_full_window_and_an_average_near_the_best() {
        let section = EvaluationSection::default();
        let is = |episodes, latest, window: &MovingAverage, best: Option<BestSnapshot>| {
            is_candidate(&section, episodes, latest, window, best.as_ref())
        };
        assert!(is(50, None, &window(1.0, 50), None));
        assert!(!is(49, None, &window(1.0, 49), None));
        assert!(!is(50, None, &window(0.0, 50), None));
        assert!(!is(90, Some(50), &window(1.0, 50), None));
        assert!(is(100, Some(50), &window(1.0, 50), Some(best(1.0, 3.0))));
        assert!(!is(100, Some(50), &window(1.0, 50), Some(best(2.0, 3.0))));
    }

    #[test]
    fn an_average_below_the_bests_is_near_enough_up_to_the_margin() {
        let section = EvaluationSection {
            candidate_margin: 0.25,
            ..EvaluationSection::default()
        };
        let is = |mean| {
            let best = best(2.0, 3.0);
            is_candidate(&section, 200, Some(50), &window(mean, 50), Some(&best))
        };
        assert_eq!([1.5, 1.75, 1.875, 2.5].map(is), [false, true, true, true]);
    }

    #[test]
    fn a_candidate_is_due_every_so_many_episodes_after_the_last() {
        let section = EvaluationSection {
            every_episodes: 30,
            ..EvaluationSection::default()
        };
        let is = |episodes| is_candidate(&section, episodes, Some(50), &window(1.0, 50), None);
        assert_eq!([79, 80, 81].map(is), [false, true, true]);
    }

    #[test]
    fn evaluation_episodes_decide_and_training_episodes_break_ties() {
        assert!(is_better(&best(1.0, 3.0), None));
        assert!(is_better(&best(1.0, 3.5), Some(&best(2.0, 3.0))));
        assert!(!is_better(&best(2.0, 3.0), Some(&best(1.0, 3.5))));
        assert!(is_better(&best(2.0, 3.0), Some(&best(1.0, 3.0))));
        assert!(!is_better(&best(1.0, 3.0), Some(&best(1.0, 3.0))));
    }
}
