//! `[evaluation]`.

use serde::{Deserialize, Serialize};

use super::{Invalid, require};

/// `[evaluation]`: episodes without exploration noise, from the start of level 1.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EvaluationSection {
    /// Episodes per course in the final evaluation (paper: 100). Default 100.
    pub episodes: u64,
    /// Episodes that confirm a candidate for the best snapshot. Default 20.
    pub confirm_episodes: u64,
    /// Where they are flown: on the `first-course` of the evaluation, or each on a `generated`
    /// course of its own that no training episode flies. A policy that shall fly courses it has
    /// never seen must not be chosen on one of them. Default `first-course`.
    pub confirm_on: ConfirmOn,
    /// Training episodes over which walls passed are averaged to find candidates (paper: 50).
    /// Default 50.
    pub window_episodes: u64,
    /// Training episodes between two candidates at least. Default 50.
    pub every_episodes: u64,
    /// How far below that of the best snapshot so far a candidate's average may lie, in walls: the
    /// average of so few episodes is noisy. Default 0.3.
    pub candidate_margin: f64,
    /// Share R of walls passed in a candidate's evaluation episodes from which on the policy counts
    /// as trained. Only told, as time and episodes that it took (paper: R > 0.9); nothing that is
    /// learned depends on it. Default 0.9.
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
            episodes: 100,
            confirm_episodes: 20,
            confirm_on: ConfirmOn::FirstCourse,
            window_episodes: 50,
            every_episodes: 50,
            candidate_margin: 0.3,
            trained_rate: 0.9,
        }
    }
}

impl EvaluationSection {
    pub(super) fn validate(&self) -> Result<(), Invalid> {
        for (key, value) in [
            ("evaluation.episodes", self.episodes),
            ("evaluation.confirm_episodes", self.confirm_episodes),
            ("evaluation.window_episodes", self.window_episodes),
            ("evaluation.every_episodes", self.every_episodes),
        ] {
            require(
                (1..=1_000_000).contains(&value),
                key,
                value,
                "is outside 1..=1000000",
            )?;
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
