//! The best snapshot: training episodes propose candidates, confirmation episodes decide.
//!
//! Training episodes have exploration noise and start at all levels, so their average only shows
//! when a closer look pays. Confirmation episodes are flown like the final evaluation: without
//! noise, from the start of level 1. They are the same for all candidates, so the best one's
//! results tell early that a candidate will not replace it.

use skein_protocol::config::EvaluationSection;

use crate::checkpoint::{BestSnapshot, EpisodeWalls};
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

/// `true` if a confirmed candidate replaces the best: at least as many walls passed in confirmation
/// episodes. Of equals the newest counts, because it has learned from most.
pub(crate) fn is_better(candidate: &BestSnapshot, best: Option<&BestSnapshot>) -> bool {
    best.is_none_or(|best| candidate.confirmed_walls_passed() >= best.confirmed_walls_passed())
}

/// Returns the number of confirmation episodes flown before the next look at them, after `flown`:
/// looks follow at 10, 20, 40, 80 episodes, and so on.
pub(crate) fn next_look(flown: usize) -> usize {
    /// A bad candidate costs no more than this.
    const FIRST: usize = 10;
    FIRST.max(2 * flown) - flown
}

/// `false` if a candidate with these first confirmation episodes will hardly replace the best: even
/// by passing all further walls it would not, or it passed significantly fewer walls than the best
/// in the same episodes.
///
/// The second test compares the sum of differences with the root of their sum of squares. If that
/// ratio is about normal, each look stops one in 200 of the candidates that equal the best.
pub(crate) fn may_replace(candidate: &BestSnapshot, best: Option<&BestSnapshot>) -> bool {
    /// Standard errors between candidate and best.
    const SIGNIFICANT: f64 = 2.6;
    let Some(best) = best else {
        return true;
    };
    let flown = &candidate.confirmed;
    let further = best.confirmed.iter().skip(flown.len());
    let mut most = candidate.clone();
    most.confirmed
        .extend(further.map(|&EpisodeWalls { of, .. }| EpisodeWalls { passed: of, of }));
    let differences = flown
        .iter()
        .zip(&best.confirmed)
        .map(|(own, best)| f64::from(own.passed) - f64::from(best.passed));
    let (sum, squares) = differences.fold((0.0, 0.0), |(sum, squares), difference| {
        (sum + difference, squares + difference * difference)
    });
    is_better(&most, Some(best)) && sum >= -SIGNIFICANT * squares.sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn best(window: f64, confirmed: f64) -> BestSnapshot {
        BestSnapshot {
            policy_version: 1,
            episodes: 50,
            window_walls_passed: window,
            confirmed: walls(&[(2.0 * confirmed) as u8, 0]),
        }
    }

    fn walls(passed: &[u8]) -> Vec<EpisodeWalls> {
        let of = 7;
        passed
            .iter()
            .map(|&passed| EpisodeWalls { passed, of })
            .collect()
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
    fn looks_follow_at_ten_episodes_and_whenever_their_number_has_doubled() {
        let mut looks = vec![0];
        while looks.len() < 6 {
            let flown = looks[looks.len() - 1];
            looks.push(flown + next_look(flown));
        }
        assert_eq!(looks, [0, 10, 20, 40, 80, 160]);
    }

    #[test]
    fn a_candidate_is_given_up_once_it_cannot_or_will_hardly_replace_the_best() {
        let of = |window, passed: &[u8]| BestSnapshot {
            confirmed: walls(passed),
            ..best(window, 0.0)
        };
        let may = |flown: &[u8], best: &[u8]| may_replace(&of(2.0, flown), Some(&of(1.0, best)));
        // The best passed all seven walls: one wall missed decides.
        assert!(may(&[7, 7], &[7, 7, 7, 7]));
        assert!(!may(&[7, 6], &[7, 7, 7, 7]));
        // Two walls fewer, and four to be won.
        assert!(may(&[4, 4], &[5, 5, 5, 5]));
        assert!(!may(&[2, 2], &[7, 7, 3, 6]));
        // One wall fewer in each of ten episodes is no accident; in five of them it may be.
        let best_so_far = [&[3; 10][..], &[0; 90]].concat();
        assert!(!may(&[2; 10], &best_so_far));
        assert!(may(&[2, 2, 2, 2, 2, 3, 3, 3, 3, 3], &best_so_far));
        assert!(may_replace(&of(1.0, &[0]), None));
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
    fn evaluation_episodes_decide_and_of_equals_the_newest_is_best() {
        assert!(is_better(&best(1.0, 3.0), None));
        assert!(is_better(&best(1.0, 3.5), Some(&best(2.0, 3.0))));
        assert!(!is_better(&best(2.0, 3.0), Some(&best(1.0, 3.5))));
        assert!(is_better(&best(1.0, 3.0), Some(&best(2.0, 3.0))));
    }
}
