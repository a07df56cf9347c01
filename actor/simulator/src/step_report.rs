//! Result of one step: walls passed, and how the episode ended.
//!
//! A module of its own, so that the reward can be computed from it without the simulator.

/// End of an episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum EpisodeOutcome {
    /// The body touched the corridor, a wall or an opening's edge: a terminal state.
    Collided,
    /// The body touched the corridor's end wall, the destination: a terminal state.
    ReachedEnd,
    /// The episode reached its step limit, `[simulator] max_steps`. Not a terminal state: the drone
    /// still flies.
    TimedOut,
}

/// `Yes` if the drone passed a wall in a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum LevelUp {
    /// It passed none.
    #[default]
    No,
    /// Its tail left a wall behind: the whole body is clear of it.
    Yes,
}

/// Obstacle that the body hit in a collision.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Obstacle {
    /// A wall or the edge of its opening, by its place in course order from 1. A body that touches
    /// a wall and the corridor has hit the wall.
    Wall(u8),
    /// A side of the corridor, its floor or its ceiling.
    Corridor,
}

/// Result of one step.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct StepReport {
    /// Walls passed in this episode so far.
    pub walls_passed: u8,
    /// `Yes` if the drone passed one of them in this step.
    pub level_up: LevelUp,
    /// End of the episode, if it ended in this step.
    pub outcome: Option<EpisodeOutcome>,
    /// Obstacle that the body hit, if `outcome` is [`EpisodeOutcome::Collided`].
    pub hit: Option<Obstacle>,
    /// Metres by which the drone came nearer to the goal, the middle of the end wall.
    pub progress_m: f32,
    /// Distance from the body's middle to the nearest surface, m.
    pub clearance_m: f32,
    /// Mean square of the action's numbers.
    pub effort: f32,
    /// Mean square of their change since the step before. Before the first step they were zero.
    pub effort_change: f32,
}
