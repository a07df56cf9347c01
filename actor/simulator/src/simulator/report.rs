//! What a step tells, and why it fails.

use serde::{Deserialize, Serialize};

/// How an episode ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// The body touched the corridor, a wall or an opening's edge: a terminal state.
    Collided,
    /// The body touched the corridor's end wall, the destination: a terminal state.
    ReachedEnd,
    /// The episode was broken off after
    /// [`SimulatorSettings::max_steps`](super::SimulatorSettings::max_steps): not a terminal state,
    /// the drone still flies.
    TimedOut,
}

/// Whether a wall was passed in a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum LevelUp {
    /// No wall was passed.
    No,
    /// The drone's centre left a wall behind.
    Yes,
}

/// What a body that collided has hit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Obstacle {
    /// A wall or the edge of its opening, by its place in course order from 1. What touches a wall
    /// and the corridor has hit the wall.
    Wall(u8),
    /// A side of the corridor, its floor or its ceiling.
    Corridor,
}

/// What one step brought.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StepReport {
    /// Walls passed in this episode so far.
    pub walls_passed: u8,
    /// Whether one of them was passed in this step.
    pub level_up: LevelUp,
    /// How the episode ended, if it did.
    pub outcome: Option<Outcome>,
    /// What was hit, if it ended as [`Outcome::Collided`].
    pub hit: Option<Obstacle>,
}

/// Why a step failed. The episode is over then; [`Simulator::reset`](super::Simulator::reset)
/// starts another.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum SimulationError {
    /// A number became NaN or infinite.
    #[error("{what} is not finite in step {step}: the episode is broken off")]
    NonFinite {
        /// Which number.
        what: &'static str,
        /// The step's number within the episode, from 1.
        step: u32,
    },
    /// No episode is under way.
    #[error("no episode is under way: reset starts one")]
    NotFlying,
}
