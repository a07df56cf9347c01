//! `[evaluation]`.

use serde::{Deserialize, Serialize};

use super::{Invalid, require};

/// `[evaluation]`: flights without exploration noise, from the start of level 1.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EvaluationSection {
    /// Flights per course in the final evaluation (paper: 100). Default 100.
    pub flights: u64,
    /// Flights that confirm a candidate for the best snapshot. Default 20.
    pub confirm_flights: u64,
    /// Where they are flown: on the `first-course` of the evaluation, or each on a `generated` course of its own that no training flight flies. A policy that shall fly courses it
    /// has never seen must not be chosen on one of them. Default `first-course`.
    pub confirm_on: ConfirmOn,
    /// Training flights over which walls passed are averaged to find candidates (paper: 50). Default 50.
    pub window_flights: u64,
    /// Training flights between two candidates at least. Default 50.
    pub every_flights: u64,
    /// How far below that of the best snapshot so far a candidate's average may lie, in walls: the average of so few flights is noisy. Default 0.3.
    pub candidate_margin: f64,
    /// Share R of walls passed in a candidate's evaluation flights from which on the policy counts as trained. Only told, as time and flights that it took
    /// (paper: R > 0.9); nothing that is learned depends on it. Default 0.9.
    pub trained_rate: f64,
}

/// Where candidates for the best snapshot are confirmed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ConfirmOn {
    /// On the first evaluation course.
    FirstCourse,
    /// On generated courses, the same ones for each candidate.
    Generated,
}

impl Default for EvaluationSection {
    fn default() -> Self {
        Self {
            flights: 100,
            confirm_flights: 20,
            confirm_on: ConfirmOn::FirstCourse,
            window_flights: 50,
            every_flights: 50,
            candidate_margin: 0.3,
            trained_rate: 0.9,
        }
    }
}

impl EvaluationSection {
    pub(super) fn validate(&self) -> Result<(), Invalid> {
        for (key, value) in [
            ("evaluation.flights", self.flights),
            ("evaluation.confirm_flights", self.confirm_flights),
            ("evaluation.window_flights", self.window_flights),
            ("evaluation.every_flights", self.every_flights),
        ] {
            require((1..=1_000_000).contains(&value), key, value, "is outside 1..=1000000")?;
        }
        require(
            self.candidate_margin >= 0.0 && self.candidate_margin.is_finite(),
            "evaluation.candidate_margin",
            self.candidate_margin,
            "is negative or not finite",
        )?;
        require(
            (0.0..=1.0).contains(&self.trained_rate),
            "evaluation.trained_rate",
            self.trained_rate,
            "is outside [0, 1]: it is a share of walls passed",
        )
    }
}
