//! The drone among the surfaces, and on its way to the goal.

use nalgebra::{Point3, Vector3};

use crate::course::{Course, polygon};

/// Returns the goal: the middle of the end wall, or of a world's goal.
pub(super) fn goal(course: &Course) -> Point3<f32> {
    let corridor = course.corridor();
    let end_wall = Point3::new(corridor.length_m, 0.0, corridor.height_m / 2.0);
    let region = course.goal();
    region.map_or(end_wall, |region| Point3::from(region.centre_m))
}

/// Returns the distance from `point`, inside the corridor, to the nearest surface of corridor and
/// walls, m. The end wall is the destination, no obstacle.
pub(super) fn clearance_m(course: &Course, point: &Point3<f32>) -> f32 {
    let corridor = course.corridor();
    let half_width_m = corridor.width_m / 2.0;
    let sides_m = (half_width_m - point.y.abs()).min(point.z.min(corridor.height_m - point.z));
    let walls = course.walls().iter().map(|wall| {
        let back_m = wall.x_m() + course.wall_thickness_m();
        let along_m = (wall.x_m() - point.x).max(point.x - back_m).max(0.0);
        // Within the opening's outline, its edge is the nearest part of the wall.
        let inside_m = polygon::signed_distance(wall.outline(), [point.y, point.z]).max(0.0);
        Vector3::new(along_m, inside_m, 0.0).norm()
    });
    walls.fold(sides_m.min(point.x), f32::min).max(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::course::test_course;

    #[test]
    fn the_nearest_surface_is_a_side_a_wall_or_an_openings_edge() {
        let course = test_course();
        let wall = &course.walls()[0];
        let [y, z] = wall.safe_point();
        let at = |x: f32, y: f32, z: f32| clearance_m(&course, &Point3::new(x, y, z));
        // Half way between two walls, 0.5 m above the floor.
        assert!((at(15.0, 0.0, 0.5) - 0.5).abs() < 1e-6);
        // Before the closed part of the wall.
        assert!((at(wall.x_m() - 0.75, -1.5, 4.0) - 0.75).abs() < 1e-5);
        // In the opening, the edge is as far as the widest circle's radius.
        assert!((at(wall.x_m() + 0.1, y, z) - wall.clearance_m()).abs() < 1e-3);
        let before = at(wall.x_m() - 0.5, y, z);
        assert!(
            (before - 0.5_f32.hypot(wall.clearance_m())).abs() < 1e-3,
            "{before}"
        );
    }
}
