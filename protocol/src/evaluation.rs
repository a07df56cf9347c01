//! `evaluation.json`: how a snapshot flies, course by course.

use std::fmt;

use comfy_table::presets::UTF8_FULL_CONDENSED;
use comfy_table::{CellAlignment, Table};
use serde::{Deserialize, Serialize};

use crate::ids::PolicyVersion;
use crate::transition::Outcome;

/// How a snapshot flies: flights in mode action from the start of level 1.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EvaluationReport {
    /// The snapshot.
    pub policy_version: PolicyVersion,
    /// Its SHA-256.
    pub policy_sha256: String,
    /// One entry per course.
    pub courses: Vec<CourseEvaluation>,
}

/// How a snapshot flies one course.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CourseEvaluation {
    /// The course's name.
    pub course: String,
    /// Flights flown.
    pub flights: u64,
    /// R = (t_1 + … + t_n) / (n · flights): the average rate of obstacles avoided (paper, section 4.4).
    pub r: f64,
    /// Share of flights that reached the end wall.
    pub completed: f64,
    /// t_n: flights that passed wall n, in flight order.
    pub walls_passed: Vec<u64>,
    /// Mean sum of rewards.
    pub mean_return: f64,
    /// Flights that collided.
    pub collided: u64,
    /// Flights cut off by the step limit.
    pub timed_out: u64,
}

/// What an evaluation counts of one flight.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FlightScore {
    /// Walls passed, from the start of level 1.
    pub walls_passed: u32,
    /// Sum of rewards.
    pub flight_return: f64,
    /// How it ended.
    pub outcome: Outcome,
}

impl CourseEvaluation {
    /// Counts `flights` of a course of `walls` walls.
    pub fn of(course: &str, walls: usize, flights: &[FlightScore]) -> Self {
        let count = |holds: &dyn Fn(&FlightScore) -> bool| flights.iter().filter(|flight| holds(flight)).count() as u64;
        let share = |part: u64, whole: usize| if whole == 0 { 0.0 } else { part as f64 / whole as f64 };
        let walls_passed: Vec<u64> = (1..=walls)
            .map(|wall| count(&|flight| flight.walls_passed as usize >= wall))
            .collect();
        let returns: f64 = flights.iter().map(|flight| flight.flight_return).sum();
        Self {
            course: course.to_owned(),
            flights: flights.len() as u64,
            r: share(walls_passed.iter().sum(), walls * flights.len()),
            completed: share(count(&|flight| flight.outcome == Outcome::ReachedEnd), flights.len()),
            walls_passed,
            mean_return: if flights.is_empty() {
                0.0
            } else {
                returns / flights.len() as f64
            },
            collided: count(&|flight| flight.outcome == Outcome::Collided),
            timed_out: count(&|flight| flight.outcome == Outcome::TimedOut),
        }
    }
}

impl fmt::Display for EvaluationReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut table = Table::new();
        table.load_preset(UTF8_FULL_CONDENSED);
        table.set_header([
            "course",
            "flights",
            "R",
            "completed",
            "passed wall 1, 2, …",
            "return",
            "timed out",
        ]);
        for course in &self.courses {
            let walls: Vec<String> = course.walls_passed.iter().map(u64::to_string).collect();
            table.add_row([
                course.course.clone(),
                course.flights.to_string(),
                format!("{:.3}", course.r),
                format!("{:.1} %", 100.0 * course.completed),
                walls.join(" "),
                format!("{:.2}", course.mean_return),
                course.timed_out.to_string(),
            ]);
        }
        for column in table.column_iter_mut().skip(1) {
            column.set_cell_alignment(CellAlignment::Right);
        }
        write!(f, "{table}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn r_counts_walls_and_completed_counts_courses() {
        let score = |walls_passed, outcome| FlightScore {
            walls_passed,
            flight_return: 2.0,
            outcome,
        };
        let flights = [
            score(5, Outcome::ReachedEnd),
            score(5, Outcome::Collided),
            score(2, Outcome::Collided),
            score(0, Outcome::TimedOut),
        ];
        let evaluation = CourseEvaluation::of("training", 5, &flights);
        assert_eq!(evaluation.walls_passed, [3, 3, 2, 2, 2]);
        assert_eq!(evaluation.r, 12.0 / 20.0);
        assert_eq!(evaluation.completed, 0.25);
        assert_eq!((evaluation.collided, evaluation.timed_out), (2, 1));
        assert_eq!(evaluation.mean_return, 2.0);
    }

    #[test]
    fn no_flights_are_no_rate() {
        assert_eq!(CourseEvaluation::of("training", 5, &[]).r, 0.0);
    }
}
