//! Why episodes of an evaluation failed: rates by kind of opening and approach, and a picture of
//! the failed episodes.

mod approaches;
mod gallery;

use std::sync::Arc;

use skein_protocol::transition::Outcome;
use skein_simulator::course::{Course, Wall};

pub use approaches::approaches_table;
pub use gallery::draw_failures;

/// Episode of an evaluation, from the start of level 1.
#[derive(Debug, Clone)]
pub struct FlownEpisode<'a> {
    /// Name of the course or entry.
    pub course_name: &'a str,
    /// Number in that course or entry, from 0.
    pub number: usize,
    /// The course.
    pub course: Arc<Course>,
    /// Shape of all its openings, if the course was generated with one shape; the course itself
    /// knows a generated shape only as a polygon.
    pub generated_shape: Option<&'static str>,
    /// Position of the vehicle's centre at each step and at the end, world frame, metres.
    pub points_m: &'a [[f32; 3]],
    /// End of the episode.
    pub outcome: Outcome,
    /// Walls passed.
    pub walls_passed: usize,
    /// The wall that it hit, from 1 in course order; `None` without a collision or for the
    /// corridor.
    pub hit_wall: Option<u8>,
    /// Depth image a second before the end; `None` for an episode that did not fail.
    pub seen_before_end: Option<&'a [u8]>,
}

impl FlownEpisode<'_> {
    /// Returns how the episode failed, or `None` if it reached the end wall.
    fn failure(&self) -> Option<Failure> {
        match (self.outcome, self.hit_wall) {
            (Outcome::ReachedEnd, _) => None,
            (Outcome::Collided, Some(_)) if self.course.is_world() => Some(Failure::HitObstacle),
            (Outcome::Collided, Some(_)) => Some(Failure::HitWall),
            (Outcome::Collided, None) => Some(Failure::HitCorridor),
            (Outcome::TimedOut, _) => Some(Failure::TimedOut),
        }
    }

    /// Returns the wall at or before which the episode ended; `None` behind the last one.
    fn last_wall(&self) -> Option<&Wall> {
        self.course.walls().get(self.walls_passed)
    }

    /// Returns the name of the shape of a wall's opening.
    fn shape(&self, wall: &Wall) -> &'static str {
        self.generated_shape
            .unwrap_or_else(|| wall.opening().shape.name())
    }
}

/// The way an episode failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Failure {
    /// It hit a wall or the edge of its opening.
    HitWall,
    /// It hit an obstacle of a world.
    HitObstacle,
    /// It hit a side, the floor or the ceiling of the corridor.
    HitCorridor,
    /// It reached the step limit.
    TimedOut,
}

impl Failure {
    fn name(self) -> &'static str {
        match self {
            Self::HitWall => "hit the wall",
            Self::HitObstacle => "hit an obstacle",
            Self::HitCorridor => "hit the corridor",
            Self::TimedOut => "timed out",
        }
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Returns a course of two walls, a circle's and a triangle's, 10 m apart.
    pub(crate) fn course() -> Arc<Course> {
        let text = "name = \"c\"\norder = [1, 2]\nwall_x_m = [10.0, 20.0]\n\
                    wall_thickness_m = 0.3\n\
                    corridor = { length_m = 30.0, width_m = 6.0, height_m = 7.0 }\n\
                    start = { offset_m = 1.5, jitter_y_m = 0.0, jitter_z_m = 0.0 }\n\
                    [[wall]]\nlabel = 1\nshape = \"circle\"\ncentre_m = [1.0, 3.5]\n\
                    diameter_m = 1.6\n\
                    [[wall]]\nlabel = 2\nshape = \"triangle\"\ncentre_m = [-0.6, 3.5]\n\
                    width_m = 3.6\nheight_m = 3.2\n";
        Arc::new(Course::parse(text, "c.toml").unwrap())
    }

    /// Returns an episode along `points_m` that hit `hit_wall`, or the corridor.
    pub(super) fn collided<'a>(
        points_m: &'a [[f32; 3]],
        walls_passed: usize,
        hit_wall: Option<u8>,
    ) -> FlownEpisode<'a> {
        FlownEpisode {
            course_name: "two walls",
            number: 0,
            course: course(),
            generated_shape: None,
            points_m,
            outcome: Outcome::Collided,
            walls_passed,
            hit_wall,
            seen_before_end: None,
        }
    }
}
