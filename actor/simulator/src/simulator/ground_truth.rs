//! Ground truth: facts about a moment that the camera does not show.

use crate::course::{BODY_CLEARANCE_M, Course, Wall};
use crate::vehicle::VehicleState;

/// Facts about a moment that the camera does not show: for the critic in training, never for the
/// policy.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GroundTruth {
    /// Openings of the next two walls that the drone's tail has not left; in a world, two points of
    /// the way, up to 3 and 6 m ahead.
    pub ahead: [OpeningAhead; 2],
    /// Position left and up from the middle of the corridor, m.
    pub from_middle_m: [f32; 2],
    /// Distance to the end wall, or along the way to the goal of a world, m.
    pub to_end_m: f32,
    /// The drone's mass relative to its nominal mass.
    pub mass_factor: f32,
    /// Control periods until a command takes effect.
    pub latency_periods: f32,
    /// The gust's force in the world frame: forward, left, up, N.
    pub gust_n: [f32; 3],
    /// Half the corridor's width and height, m.
    pub half_section_m: [f32; 2],
}

/// An opening relative to the drone. Behind the last wall, the end wall stands for an opening as
/// wide as the corridor, because the drone may touch it anywhere.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OpeningAhead {
    /// Distance forward to the wall's front face, m; negative inside the wall and behind it.
    pub distance_m: f32,
    /// Offset left and up to the opening's safe point, m.
    pub offset_m: [f32; 2],
    /// Radius of the free space around the safe point, m.
    pub clearance_m: f32,
}

impl GroundTruth {
    /// Length of [`Self::numbers`].
    pub const NUMBERS: usize = 18;

    /// Returns all fields as numbers, in their order.
    #[must_use]
    pub fn numbers(&self) -> [f32; Self::NUMBERS] {
        let [next, after] = self.ahead.map(|ahead| {
            let [left, up] = ahead.offset_m;
            [ahead.distance_m, left, up, ahead.clearance_m]
        });
        let [left, up] = self.from_middle_m;
        let [half_width, half_height] = self.half_section_m;
        let [gust_x, gust_y, gust_z] = self.gust_n;
        let rest = [
            left,
            up,
            self.to_end_m,
            self.mass_factor,
            self.latency_periods,
            gust_x,
            gust_y,
            gust_z,
            half_width,
            half_height,
        ];
        let mut numbers = [0.0; Self::NUMBERS];
        numbers[..4].copy_from_slice(&next);
        numbers[4..8].copy_from_slice(&after);
        numbers[8..].copy_from_slice(&rest);
        numbers
    }
}

impl OpeningAhead {
    /// Returns the next two openings behind `walls_behind` walls, seen from the drone.
    pub(super) fn next_two(
        course: &Course,
        walls_behind: usize,
        state: &VehicleState,
    ) -> [Self; 2] {
        if let Some(next) = Self::on_the_way(course, 3.0, state)
            && let Some(after) = Self::on_the_way(course, 6.0, state)
        {
            return [next, after];
        }
        let walls = &course.walls()[walls_behind..];
        let mut walls = walls.iter().map(|wall| Self::of_wall(wall, state));
        let mut next = || walls.next().unwrap_or_else(|| Self::of_end(course, state));
        [next(), next()]
    }

    /// Returns the point to fly to in a world, at most `ahead_m` away: what an opening is to a
    /// corridor.
    fn on_the_way(course: &Course, ahead_m: f32, state: &VehicleState) -> Option<Self> {
        let aim = course.aim_m(&state.position_m, ahead_m)?;
        Some(Self::seen(aim.x, [aim.y, aim.z], BODY_CLEARANCE_M, state))
    }

    pub(crate) fn of_wall(wall: &Wall, state: &VehicleState) -> Self {
        Self::seen(wall.x_m(), wall.safe_point(), wall.clearance_m(), state)
    }

    fn of_end(course: &Course, state: &VehicleState) -> Self {
        let corridor = course.corridor();
        let middle = [0.0, corridor.height_m / 2.0];
        let clearance_m = corridor.height_m.min(corridor.width_m) / 2.0;
        Self::seen(corridor.length_m, middle, clearance_m, state)
    }

    fn seen(x_m: f32, [y_m, z_m]: [f32; 2], clearance_m: f32, state: &VehicleState) -> Self {
        let at = state.position_m;
        Self {
            distance_m: x_m - at.x,
            offset_m: [y_m - at.y, z_m - at.z],
            clearance_m,
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;

    use super::*;
    use crate::course::test_course;

    #[test]
    fn the_next_two_openings_are_seen_from_the_drone_and_behind_the_last_there_is_the_end() {
        let course = test_course();
        let walls = course.walls();
        let [y_m, z_m] = walls[0].safe_point();
        let before = VehicleState::at_rest(Point3::new(walls[0].x_m() - 4.0, y_m - 1.0, z_m + 0.5));
        let [next, after] = OpeningAhead::next_two(&course, 0, &before);
        assert_eq!(
            (next.distance_m, next.clearance_m),
            (4.0, walls[0].clearance_m())
        );
        assert!((next.offset_m[0] - 1.0).abs() < 1e-5 && (next.offset_m[1] + 0.5).abs() < 1e-5);
        let behind_first = after.distance_m - next.distance_m;
        let expected = walls.get(1).map_or(course.corridor().length_m, Wall::x_m) - walls[0].x_m();
        assert!((behind_first - expected).abs() < 1e-5);

        let last = walls.last().unwrap();
        let behind_all = last.x_m() + course.wall_thickness_m() + 0.5;
        let behind = VehicleState::at_rest(Point3::new(behind_all, 1.0, 2.0));
        let [next, after] = OpeningAhead::next_two(&course, walls.len(), &behind);
        assert_eq!(next, after);
        assert_eq!(next.distance_m, course.corridor().length_m - behind_all);
        assert_eq!(
            next.offset_m,
            [-1.0, course.corridor().height_m / 2.0 - 2.0]
        );
    }
}
