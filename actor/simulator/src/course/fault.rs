//! Reasons why a course cannot be flown, and what to change.

use std::fmt;

use super::{BODY_CLEARANCE_M, DRONE_WIDTH_M, FRAME_M, MAX_CORNERS, MAX_WALLS, WallLabel};

/// Part of a course description that holds a fault.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FaultLocation {
    /// Anything outside a wall's definition.
    Course,
    /// The definition of this wall.
    Wall(WallLabel),
    /// The definition of this obstacle of a world, from 1 in the file's order.
    Obstacle(usize),
}

impl fmt::Display for FaultLocation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Course => f.write_str("course"),
            Self::Wall(label) => write!(f, "wall {label}"),
            Self::Obstacle(number) => write!(f, "obstacle {number}"),
        }
    }
}

/// Reason why a course is refused: the wall, the key and the remedy.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CourseFault {
    /// A name that breaks a table.
    #[error("course: key name = {name:?} cannot be shown in a table: give one line without |")]
    Name {
        /// The name found.
        name: String,
    },
    /// A number out of bounds, or NaN.
    #[error("{location}: key {key} = {value} must lie between {least} and {most}")]
    OutOfRange {
        /// The part of the description.
        location: FaultLocation,
        /// The key that sets it.
        key: &'static str,
        /// The value found.
        value: f32,
        /// Smallest value accepted.
        least: f32,
        /// Largest value accepted.
        most: f32,
    },
    /// A key that the shape needs is missing.
    #[error("wall {wall}: key {key} is missing: a {shape} needs {needed}")]
    MissingKey {
        /// The wall.
        wall: WallLabel,
        /// The missing key.
        key: &'static str,
        /// The wall's shape.
        shape: &'static str,
        /// All keys of that shape.
        needed: &'static str,
    },
    /// A key that belongs to another shape.
    #[error("wall {wall}: key {key} does not belong to a {shape}, which takes {needed}: remove it")]
    ForeignKey {
        /// The wall.
        wall: WallLabel,
        /// The key found.
        key: &'static str,
        /// The wall's shape.
        shape: &'static str,
        /// All keys of that shape.
        needed: &'static str,
    },
    /// A length smaller than the drone.
    #[error(
        "wall {wall}: key {key} = {value_m} m is narrower than the drone ({DRONE_WIDTH_M} m): \
         enlarge the opening"
    )]
    NarrowerThanDrone {
        /// The wall.
        wall: WallLabel,
        /// The key that sets the length.
        key: &'static str,
        /// The length.
        value_m: f32,
    },
    /// The widest circle inside the opening is too small for the drone.
    #[error(
        "wall {wall}: the widest circle inside the {shape} has a radius of {clearance_m:.2} m, \
         but the drone needs {BODY_CLEARANCE_M} m in any attitude: enlarge the opening"
    )]
    TooSmall {
        /// The wall.
        wall: WallLabel,
        /// The opening's shape.
        shape: &'static str,
        /// Radius of the widest circle inside, metres.
        clearance_m: f32,
    },
    /// A polygon with too few or too many corners.
    #[error("wall {wall}: key points_m has {count} corners: give 3 to {MAX_CORNERS}")]
    CornerCount {
        /// The wall.
        wall: WallLabel,
        /// Corners found.
        count: usize,
    },
    /// A polygon with a corner that follows itself.
    #[error("wall {wall}: key points_m has corner {corner} twice in a row: remove one")]
    RepeatedCorner {
        /// The wall.
        wall: WallLabel,
        /// The first of the two corners, from 1.
        corner: usize,
    },
    /// A polygon that crosses or touches itself, or has no area.
    #[error(
        "wall {wall}: the opening's outline crosses or touches itself (edges {} and {}): \
         list the corners in order around it",
        edges.0 + 1,
        edges.1 + 1
    )]
    SelfIntersecting {
        /// The wall.
        wall: WallLabel,
        /// The two edges, numbered from 0.
        edges: (usize, usize),
    },
    /// The opening extends beyond the wall's frame.
    #[error(
        "wall {wall}: the opening reaches y = {y_m:.2} m, z = {z_m:.2} m, but it must stay within \
         |y| <= {limit_y_m:.2} m and {FRAME_M} m <= z <= {limit_z_m:.2} m: \
         move centre_m or make it smaller"
    )]
    OutsideWall {
        /// The wall.
        wall: WallLabel,
        /// The offending corner's y, metres.
        y_m: f32,
        /// The offending corner's z, metres.
        z_m: f32,
        /// Largest |y| accepted, metres.
        limit_y_m: f32,
        /// Largest z accepted, metres.
        limit_z_m: f32,
    },
    /// The wall is outside the corridor, or leaves the drone no room at the corridor's end.
    #[error(
        "wall {wall}: key wall_x_m = {x_m} m: the wall must stand between {least_m:.2} m and \
         {most_m:.2} m of the corridor"
    )]
    OutsideCorridor {
        /// The wall.
        wall: WallLabel,
        /// Its front face, metres.
        x_m: f32,
        /// Least position accepted, metres.
        least_m: f32,
        /// Largest position accepted, metres.
        most_m: f32,
    },
    /// The wall stands before the one that it follows.
    #[error(
        "wall {wall}: key wall_x_m = {x_m} m is not behind wall {previous} at {previous_x_m} m: \
         list the places in ascending order"
    )]
    NotBehind {
        /// The wall.
        wall: WallLabel,
        /// Its front face, metres.
        x_m: f32,
        /// The wall that it follows.
        previous: WallLabel,
        /// Front face of the previous wall, metres.
        previous_x_m: f32,
    },
    /// The wall is too close behind the previous one for the sidestep between the openings.
    #[error(
        "wall {wall}: key wall_x_m leaves {gap_m:.2} m before it, but the drone must move \
         {shift_m:.2} m sideways, up or down to its opening, which takes {needed_m:.2} m at 1 m/s: \
         move the wall back or the openings closer together"
    )]
    TooClose {
        /// The wall that is too close.
        wall: WallLabel,
        /// Free distance before it, metres.
        gap_m: f32,
        /// Distance to move sideways, up or down, metres.
        shift_m: f32,
        /// Free distance needed, metres.
        needed_m: f32,
    },
    /// `order` names a wall that is not defined.
    #[error(
        "course: key order names wall {wall}, which no [[wall]] defines: correct the order or add \
         the wall"
    )]
    UnknownWall {
        /// The label.
        wall: WallLabel,
    },
    /// A label that is defined twice, or that `order` holds twice.
    #[error("wall {wall}: {key} holds it twice: give each wall its own label and one place")]
    RepeatedWall {
        /// The label.
        wall: WallLabel,
        /// `label` or `order`.
        key: &'static str,
    },
    /// The lengths of `order` and `wall_x_m` differ.
    #[error(
        "course: key order has {order} walls and wall_x_m {places} places: give the same number \
         of both"
    )]
    OrderLength {
        /// Length of `order`.
        order: usize,
        /// Length of `wall_x_m`.
        places: usize,
    },
    /// No walls, or too many.
    #[error("course: {count} walls: give 1 to {MAX_WALLS}")]
    WallCount {
        /// Walls found.
        count: usize,
    },
}

/// A start level that the course does not have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("start level {level}: this course has levels 1 to {levels}")]
pub struct NoSuchLevel {
    /// The level asked for.
    pub level: u8,
    /// Levels of the course.
    pub levels: u8,
}
