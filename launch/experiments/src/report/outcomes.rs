//! Outcomes of evaluation episodes: walls passed, and causes of failure, per wall.

use skein_protocol::evaluation::{CourseEvaluation, WallFailures};

use super::Findings;
use super::tables::{NOTHING, TitledTable, course_of, grid};
use crate::results::RunResult;

const HEADER: [&str; 10] = [
    "arm",
    "course",
    "seeds",
    "episodes",
    "R",
    "passed wall 1, 2, …",
    "completed",
    "hit wall 1, 2, …",
    "hit the corridor before 1, …, end",
    "timed out before 1, …, end",
];

impl Findings<'_> {
    /// Returns the tables for the evaluation courses and, if there is one, the suite.
    pub(super) fn outcomes(&self) -> Vec<TitledTable> {
        let courses = TitledTable {
            title: "How the evaluation episodes ended, all seeds together".to_owned(),
            table: self.outcomes_of(&self.courses(), course_of),
        };
        let suite = self.experiment.suite.as_ref().map(|flown| TitledTable {
            title: format!(
                "How the episodes of the suite `{}` ended, all seeds together",
                flown.file_name()
            ),
            table: self.outcomes_of(&self.entries(), entry_of),
        });
        [courses].into_iter().chain(suite).collect()
    }

    /// Returns a table with a row per arm and course.
    fn outcomes_of(
        &self,
        courses: &[String],
        find: for<'a> fn(&'a RunResult, &str) -> Option<&'a CourseEvaluation>,
    ) -> String {
        let mut rows = Vec::new();
        for (number, arm) in self.experiment.arms.iter().enumerate() {
            for course in courses {
                let of_seeds: Vec<_> = self
                    .of_arm(number)
                    .filter_map(|run| find(run, course))
                    .collect();
                let mut row = vec![arm.label.clone(), course.clone()];
                row.extend(cells(&of_seeds));
                rows.push(row);
            }
        }
        grid(HEADER.map(str::to_owned).to_vec(), rows, 2)
    }
}

/// Returns a run's evaluation on an entry of the suite.
pub(super) fn entry_of<'a>(result: &'a RunResult, name: &str) -> Option<&'a CourseEvaluation> {
    let courses = &result.suite.as_ref()?.courses;
    courses.iter().find(|course| course.course == name)
}

/// Returns the cells after arm and course, over the episodes of all seeds.
fn cells(of_seeds: &[&CourseEvaluation]) -> [String; HEADER.len() - 2] {
    let sum = |count: fn(&CourseEvaluation) -> u64| {
        of_seeds.iter().map(|course| count(course)).sum::<u64>()
    };
    let failed = |by: fn(&WallFailures) -> u64| {
        summed(of_seeds, |course| course.failures.iter().map(by).collect())
    };
    let passed = summed(of_seeds, |course| course.walls_passed.clone());
    let episodes = sum(|course| course.episodes);
    // Not from the counts: courses of one suite entry differ in their number of walls.
    let weighted = |course: &&CourseEvaluation| course.r * course.episodes as f64;
    let r = of_seeds.iter().map(weighted).sum::<f64>() / episodes as f64;
    let mut hit_wall = failed(|failures| failures.hit_wall);
    // No wall follows the last one.
    hit_wall.truncate(passed.len());
    [
        of_seeds.len().to_string(),
        episodes.to_string(),
        match episodes {
            0 => NOTHING.to_owned(),
            _ => format!("{r:.3}"),
        },
        joined(&passed),
        sum(|course| course.reached_end).to_string(),
        joined(&hit_wall),
        joined(&failed(|failures| failures.hit_corridor)),
        joined(&failed(|failures| failures.timed_out)),
    ]
}

/// Returns the sums over the seeds of counts per wall.
fn summed(
    of_seeds: &[&CourseEvaluation],
    counts: impl Fn(&CourseEvaluation) -> Vec<u64>,
) -> Vec<u64> {
    let mut sums = Vec::new();
    for counts in of_seeds.iter().map(|course| counts(course)) {
        sums.resize(sums.len().max(counts.len()), 0);
        for (sum, count) in sums.iter_mut().zip(counts) {
            *sum += count;
        }
    }
    sums
}

/// Joins counts by blanks; zeros only become a single 0.
fn joined(counts: &[u64]) -> String {
    if counts.iter().all(|&count| count == 0) {
        return "0".to_owned();
    }
    counts
        .iter()
        .map(u64::to_string)
        .collect::<Vec<_>>()
        .join(" ")
}

#[cfg(test)]
mod tests {
    use skein_protocol::evaluation::EpisodeScore;
    use skein_protocol::transition::Outcome;

    use super::*;

    #[test]
    fn episodes_of_all_seeds_are_counted_where_they_ended() {
        let score_of = |walls, walls_passed, outcome, hit_wall| EpisodeScore {
            walls_passed,
            walls,
            episode_return: 0.0,
            outcome,
            hit_wall,
        };
        let score = |walls_passed, outcome, hit_wall| score_of(2, walls_passed, outcome, hit_wall);
        let seeds = [
            CourseEvaluation::of(
                "c",
                &[
                    score(2, Outcome::ReachedEnd, None),
                    score(1, Outcome::Collided, Some(2)),
                ],
            ),
            CourseEvaluation::of(
                "c",
                &[
                    score(2, Outcome::Collided, None),
                    score(0, Outcome::TimedOut, None),
                ],
            ),
        ];
        let cells = cells(&seeds.each_ref());
        assert_eq!(
            cells,
            ["2", "4", "0.625", "3 2", "1", "0 1", "0 0 1", "1 0 0"]
        );
        assert_eq!(super::cells(&[])[2], NOTHING);
        // Every wall of two courses is passed, one of them and then two.
        let all = [1, 2].map(|walls| score_of(walls, walls, Outcome::ReachedEnd, None));
        let course = CourseEvaluation::of("c", &all);
        assert_eq!(super::cells(&[&course])[2..4], ["1.000", "2 1"]);
    }
}
