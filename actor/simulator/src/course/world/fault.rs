//! Reasons why a world cannot be flown, and what to change.

use std::path::PathBuf;

use rapier3d::parry::shape::TriMeshBuilderError;

use super::{MAX_OBSTACLES, MAX_TRIANGLES, Region, STAGES};
use crate::course::{Corridor, CourseFault};

/// Reason why a world is refused: the obstacle, the key and the remedy.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum WorldFault {
    /// A name or a value that a corridor course would be refused for, too.
    #[error(transparent)]
    Value(CourseFault),
    /// A region that is not inside the world.
    #[error(
        "course: [{name}] centre_m = {:?}, size_m = {:?} is not inside the world, which reaches \
         from {least:?} to {most:?}: move it or make it smaller",
        region.centre_m,
        region.size_m
    )]
    Region {
        /// `start` or `goal`.
        name: &'static str,
        /// The region.
        region: Region,
        /// Least corner of the world, metres.
        least: [f32; 3],
        /// Largest corner of the world, metres.
        most: [f32; 3],
    },
    /// A section that a world by hand needs is missing.
    #[error(
        "course: section [{section}] is missing: a world needs [bounds], [start] and [goal], or \
         [generated] alone"
    )]
    MissingSection {
        /// The section.
        section: &'static str,
    },
    /// A section beside `[generated]`.
    #[error("course: {key} and [generated] exclude each other: remove one of them")]
    GeneratedBeside {
        /// The section.
        key: &'static str,
    },
    /// A key that the shape needs is missing.
    #[error("obstacle {obstacle}: key {key} is missing: a {shape} needs {needed}")]
    MissingKey {
        /// The obstacle, from 1.
        obstacle: usize,
        /// The missing key.
        key: &'static str,
        /// The obstacle's shape or motion.
        shape: &'static str,
        /// All keys of that shape.
        needed: &'static str,
    },
    /// A key that belongs to another shape.
    #[error(
        "obstacle {obstacle}: key {key} does not belong to a {shape}, which takes {needed}: remove \
         it"
    )]
    ForeignKey {
        /// The obstacle, from 1.
        obstacle: usize,
        /// The key found.
        key: &'static str,
        /// The obstacle's shape or motion.
        shape: &'static str,
        /// All keys of that shape.
        needed: &'static str,
    },
    /// An opening that is no simple polygon, or not inside its wall.
    #[error(
        "obstacle {obstacle}: opening {opening} {problem}: move it, make it smaller or list its \
         corners in order"
    )]
    Opening {
        /// The wall, from 1.
        obstacle: usize,
        /// Its opening, from 1.
        opening: usize,
        /// The problem.
        problem: &'static str,
    },
    /// Too many obstacles.
    #[error("course: {count} obstacles: give at most {MAX_OBSTACLES}")]
    ObstacleCount {
        /// Obstacles found.
        count: usize,
    },
    /// Too many triangles.
    #[error(
        "course: the meshes have {count} triangles: simplify them to at most {MAX_TRIANGLES} in all"
    )]
    TriangleCount {
        /// Triangles found.
        count: usize,
    },
    /// A mesh file that cannot be used.
    #[error("obstacle {obstacle}: file = {path:?}: {problem}")]
    MeshFile {
        /// The obstacle, from 1.
        obstacle: usize,
        /// The file.
        path: PathBuf,
        /// The problem and its remedy.
        problem: String,
    },
    /// Too large for the search of ways.
    #[error(
        "course: [bounds] of {} x {} x {} m are too large to search for a way: make them smaller",
        bounds.length_m,
        bounds.width_m,
        bounds.height_m
    )]
    TooLarge {
        /// The bounds.
        bounds: Corridor,
    },
    /// The drone does not fit into the goal or at the middle of the start.
    #[error(
        "course: the drone does not fit into [{name}]: it needs 1.2 x 1.2 x 0.6 m free \
         of obstacles: move the region or the obstacle"
    )]
    Blocked {
        /// `start` or `goal`.
        name: &'static str,
    },
    /// A moving obstacle meets the start region.
    #[error(
        "obstacle {obstacle}: its motion leads through [start], where an episode could begin in a \
         collision: move one of them"
    )]
    MovesThroughStart {
        /// The obstacle, from 1.
        obstacle: usize,
    },
    /// No way for the drone.
    #[error(
        "course: no way of 1.2 m width and 0.6 m height leads from the middle of [start] to \
         [goal]: move or remove an obstacle"
    )]
    NoWay,
    /// The goal is too near to the start.
    #[error(
        "course: the way from [start] to [goal] is {length_m:.1} m long: move them at least \
         {STAGES} m apart"
    )]
    TooNear {
        /// Length of the way, metres.
        length_m: f32,
    },
    /// The generator found no world that can be flown.
    #[error("generator: no world drawn from {kind} could be flown, for example: {last}")]
    NothingFits {
        /// The generator's section.
        kind: &'static str,
        /// Reason why the last attempt was refused.
        last: Box<WorldFault>,
    },
    /// An obstacle's surfaces form no mesh.
    #[error("course: an obstacle's surfaces form no collision mesh: {0}")]
    Mesh(TriMeshBuilderError),
}
