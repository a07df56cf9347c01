//! The `[evaluation]` section.

use serde::{Deserialize, Serialize};

use super::{InvalidValue, require};

/// The `[evaluation]` section: episodes without exploration noise, from the start of level 1.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EvaluationSection {
    /// Episodes per course in the final evaluation, 1 to 1,000,000. Default 100, as in the paper.
    pub episodes: u64,
    /// Episodes that confirm a candidate for the best snapshot, 1 to 1,000,000. Default 20.
    pub confirm_episodes: u64,
    /// Courses of the confirmation episodes: `first-course` flies the first course of the
    /// evaluation; `generated` flies a new generated course in each episode, which no training
    /// episode flies. A policy meant for unseen courses must not be chosen on a fixed one. Default
    /// `first-course`.
    pub confirm_on: ConfirmOn,
    /// Training episodes over which the walls passed are averaged to find candidates, 1 to
    /// 1,000,000. Default 50, as in the paper.
    pub window_episodes: u64,
    /// Fewest training episodes between two candidates, 1 to 1,000,000. Default 50.
    pub every_episodes: u64,
    /// Number of walls by which a candidate's average may lie below that of the best snapshot so
    /// far; at least 0. The average of so few episodes is noisy. Default 0.3.
    pub candidate_margin: f64,
    /// Share R of walls passed in a candidate's confirmation episodes from which on the policy
    /// counts as trained, in [0, 1]. Only the report of training time and episodes uses it;
    /// learning does not. Default 0.9 (paper: R > 0.9).
    pub trained_rate: f64,
}

/// Courses on which candidates for the best snapshot are confirmed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ConfirmOn {
    /// The first evaluation course.
    FirstCourse,
    /// Generated courses, the same ones for each candidate.
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
    /// Number of episodes below which a share of walls passed says little. With 9 episodes of five
    /// walls, a policy that passes nine walls in ten shows R = 1 in one evaluation of a hundred.
    pub const FEW_EPISODES: u64 = 10;

    pub(super) fn validate(&self) -> Result<(), InvalidValue> {
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
