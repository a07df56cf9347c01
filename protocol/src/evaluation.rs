//! Evaluation results, `evaluation.json`: how a snapshot flies, course by course.

use serde::{Deserialize, Serialize};

use crate::ids::PolicyVersion;
use crate::transition::Outcome;

/// Evaluation of a snapshot: episodes with mode actions from the start of level 1.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EvaluationReport {
    /// The snapshot.
    pub policy_version: PolicyVersion,
    /// Its SHA-256.
    pub policy_sha256: String,
    /// One entry per course.
    pub courses: Vec<CourseEvaluation>,
}

/// Evaluation of a snapshot on one course.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CourseEvaluation {
    /// The course's name.
    pub course: String,
    /// Episodes flown.
    pub episodes: u64,
    /// Walls passed of all walls. With n walls, it is the paper's mean rate of walls passed,
    /// R = (t_1 + … + t_n) / (n · episodes) (section 4.4).
    pub r: f64,
    /// Share of episodes that reached the end wall.
    pub completed: f64,
    /// Episodes that reached the end wall.
    pub reached_end: u64,
    /// t_n: episodes that passed wall n, in course order.
    pub walls_passed: Vec<u64>,
    /// Mean sum of rewards.
    pub mean_return: f64,
    /// Episodes that collided.
    pub collided: u64,
    /// Episodes cut off by the step limit.
    pub timed_out: u64,
    /// Failures by place and cause: an entry for each wall in course order, and one for the section
    /// from a course's last wall to its end wall. They sum to `collided` plus `timed_out`.
    pub failures: Vec<WallFailures>,
}

/// Failed episodes at a wall or on the way to it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct WallFailures {
    /// Episodes that hit this wall or the edge of its opening, from either side.
    pub hit_wall: u64,
    /// Episodes that hit a side, the floor or the ceiling of the corridor between the previous wall
    /// and this one.
    pub hit_corridor: u64,
    /// Episodes that reached the step limit there.
    pub timed_out: u64,
}

/// Score of one episode.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EpisodeScore {
    /// Walls passed, from the start of level 1.
    pub walls_passed: u32,
    /// Walls of the course.
    pub walls: u32,
    /// Sum of rewards.
    pub episode_return: f64,
    /// Outcome.
    pub outcome: Outcome,
    /// The wall that the episode hit, from 1 in course order; `None` without a collision or for the
    /// corridor.
    pub hit_wall: Option<u8>,
}

impl CourseEvaluation {
    /// Evaluates `episodes` of a course, or of courses that differ in their number of walls.
    pub fn of(course: &str, episodes: &[EpisodeScore]) -> Self {
        let walls = episodes.iter().map(|episode| episode.walls as usize);
        let (walls, all) = (walls.clone().max().unwrap_or(0), walls.sum());
        let count = |holds: &dyn Fn(&EpisodeScore) -> bool| {
            episodes.iter().filter(|episode| holds(episode)).count() as u64
        };
        let share = |part: u64, whole: usize| {
            if whole == 0 {
                0.0
            } else {
                part as f64 / whole as f64
            }
        };
        let walls_passed: Vec<u64> = (1..=walls)
            .map(|wall| count(&|episode| episode.walls_passed as usize >= wall))
            .collect();
        let reached_end = count(&|episode| episode.outcome == Outcome::ReachedEnd);
        let returns: f64 = episodes.iter().map(|episode| episode.episode_return).sum();
        Self {
            course: course.to_owned(),
            episodes: episodes.len() as u64,
            r: share(walls_passed.iter().sum(), all),
            completed: share(reached_end, episodes.len()),
            reached_end,
            walls_passed,
            mean_return: if episodes.is_empty() {
                0.0
            } else {
                returns / episodes.len() as f64
            },
            collided: count(&|episode| episode.outcome == Outcome::Collided),
            timed_out: count(&|episode| episode.outcome == Outcome::TimedOut),
            failures: WallFailures::of(walls, episodes),
        }
    }
}

impl WallFailures {
    /// Counts the failures of `episodes` from the start of level 1, `[walls + 1]`.
    fn of(walls: usize, episodes: &[EpisodeScore]) -> Vec<Self> {
        let mut failures = vec![Self::default(); walls + 1];
        for episode in episodes {
            let next = match episode.walls_passed < episode.walls {
                true => episode.walls_passed as usize,
                false => walls,
            };
            match (episode.outcome, episode.hit_wall) {
                (Outcome::ReachedEnd, _) => {}
                (Outcome::TimedOut, _) => failures[next].timed_out += 1,
                (Outcome::Collided, None) => failures[next].hit_corridor += 1,
                (Outcome::Collided, Some(wall)) => {
                    failures[usize::from(wall).saturating_sub(1).min(walls)].hit_wall += 1;
                }
            }
        }
        failures
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn r_counts_walls_and_completed_counts_courses() {
        let score = |walls_passed, outcome| EpisodeScore {
            walls_passed,
            walls: 5,
            episode_return: 2.0,
            outcome,
            hit_wall: None,
        };
        let episodes = [
            score(5, Outcome::ReachedEnd),
            score(5, Outcome::Collided),
            score(2, Outcome::Collided),
            score(0, Outcome::TimedOut),
        ];
        let evaluation = CourseEvaluation::of("training", &episodes);
        assert_eq!(evaluation.walls_passed, [3, 3, 2, 2, 2]);
        assert_eq!(evaluation.r, 12.0 / 20.0);
        assert_eq!((evaluation.completed, evaluation.reached_end), (0.25, 1));
        assert_eq!((evaluation.collided, evaluation.timed_out), (2, 1));
        assert_eq!(evaluation.mean_return, 2.0);
    }

    #[test]
    fn every_failure_is_counted_once_where_it_happened() {
        let score = |walls_passed, outcome, hit_wall| EpisodeScore {
            walls_passed,
            walls: 3,
            episode_return: 0.0,
            outcome,
            hit_wall,
        };
        let episodes = [
            score(3, Outcome::ReachedEnd, None),
            score(1, Outcome::Collided, Some(2)),
            // As older versions counted: the tail hit a wall that the centre had passed.
            score(2, Outcome::Collided, Some(2)),
            score(2, Outcome::Collided, None),
            score(0, Outcome::TimedOut, None),
            score(3, Outcome::Collided, None),
        ];
        let evaluation = CourseEvaluation::of("training", &episodes);
        let failures = |hit_wall, hit_corridor, timed_out| WallFailures {
            hit_wall,
            hit_corridor,
            timed_out,
        };
        assert_eq!(
            evaluation.failures,
            [
                failures(0, 0, 1),
                failures(2, 0, 0),
                failures(0, 1, 0),
                failures(0, 1, 0)
            ]
        );
    }

    #[test]
    fn courses_of_different_length_count_by_their_own_walls() {
        let score = |walls_passed, walls, outcome| EpisodeScore {
            walls_passed,
            walls,
            episode_return: 0.0,
            outcome,
            hit_wall: None,
        };
        let evaluation = CourseEvaluation::of(
            "mixed",
            &[
                score(1, 1, Outcome::ReachedEnd),
                score(2, 4, Outcome::Collided),
                score(1, 1, Outcome::TimedOut),
            ],
        );
        assert_eq!(evaluation.r, 4.0 / 6.0);
        assert_eq!(evaluation.walls_passed, [3, 1, 0, 0]);
        let hit: Vec<_> = evaluation.failures.iter().map(|f| f.hit_corridor).collect();
        assert_eq!(hit, [0, 0, 1, 0, 0]);
        assert_eq!(evaluation.failures[4].timed_out, 1);
    }

    #[test]
    fn the_rate_of_zero_episodes_is_zero() {
        assert_eq!(CourseEvaluation::of("training", &[]).r, 0.0);
    }
}
