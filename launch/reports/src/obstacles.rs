//! Obstacles of a world from above or from the side.

use plotters::prelude::*;
use skein_simulator::course::Course;

use super::canvas::{Area, px};
use super::trajectories::{PARTLY_OPEN, WALL};

/// Draws the obstacles that stand still: pale where there is one at any height, dark in a cut
/// through the middle of the world. `axis`: 0 from above, 1 from the side. `place`: of a point in
/// the picture.
pub(super) fn draw_obstacles(
    area: &Area<'_>,
    course: &Course,
    axis: usize,
    place: impl Fn([f32; 3]) -> (i32, i32),
) -> Result<(), Box<dyn std::error::Error>> {
    let bounds = course.corridor();
    let half_m = bounds.width_m / 2.0;
    let sides_m = [
        (0.0, bounds.length_m),
        (-half_m, half_m),
        (0.0, bounds.height_m),
    ];
    // Trees, for example, reach beyond the world.
    let inside = |triangle: [[f32; 3]; 3]| {
        let whole = triangle.to_vec();
        (0..3).fold(whole, |face, along| within(&face, along, sides_m[along]))
    };
    let triangles = course.obstacle_triangles();
    for triangle in &triangles {
        let corners: Vec<_> = inside(*triangle).into_iter().map(&place).collect();
        if corners.len() > 2 {
            area.draw(&Polygon::new(corners, PARTLY_OPEN.filled()))?;
        }
    }
    let (across, cut_m) = match axis {
        0 => (2, course.corridor().height_m / 2.0),
        _ => (1, 0.0),
    };
    for triangle in &triangles {
        let ends = cut(triangle, across, cut_m);
        let ends = (0..3).fold(ends, |line, along| within(&line, along, sides_m[along]));
        let ends: Vec<_> = ends.into_iter().map(&place).collect();
        area.draw(&PathElement::new(ends, WALL.stroke_width(px(1))))?;
    }
    Ok(())
}

/// Returns the part of a face, or of a line, between two values on axis `along`.
fn within(corners: &[[f32; 3]], along: usize, (least, most): (f32, f32)) -> Vec<[f32; 3]> {
    let beyond = |corners: &[[f32; 3]], limit: f32, sign: f32| {
        let off = |corner: &[f32; 3]| sign * (corner[along] - limit);
        let mut kept = Vec::new();
        let before = corners.iter().cycle().skip(corners.len().saturating_sub(1));
        for (from, to) in before.zip(corners) {
            if (off(from) < 0.0) != (off(to) < 0.0) {
                let share = off(from) / (off(from) - off(to));
                kept.push(std::array::from_fn(|axis| {
                    from[axis] + share * (to[axis] - from[axis])
                }));
            }
            if off(to) >= 0.0 {
                kept.push(*to);
            }
        }
        kept
    };
    beyond(&beyond(corners, least, 1.0), most, -1.0)
}

/// Returns the ends of the line in which a triangle meets the plane `cut_m` on axis `across`; none
/// if it does not.
fn cut(triangle: &[[f32; 3]; 3], across: usize, cut_m: f32) -> Vec<[f32; 3]> {
    let sides = [(0, 1), (1, 2), (2, 0)].map(|(from, to)| (triangle[from], triangle[to]));
    let crossing = |(from, to): ([f32; 3], [f32; 3])| {
        let crosses = (from[across] > cut_m) != (to[across] > cut_m);
        let share = (cut_m - from[across]) / (to[across] - from[across]);
        crosses.then(|| std::array::from_fn(|axis| from[axis] + share * (to[axis] - from[axis])))
    };
    sides.into_iter().filter_map(crossing).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_triangle_is_cut_where_it_meets_the_plane() {
        let triangle = [[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 4.0]];
        let ends = cut(&triangle, 2, 2.0);
        assert_eq!(ends, [[1.0, 0.0, 2.0], [0.0, 0.0, 2.0]]);
        assert!(cut(&triangle, 2, 5.0).is_empty());
    }

    #[test]
    fn a_face_is_kept_between_two_values_and_dropped_beyond_them() {
        let triangle = [[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 0.0, 4.0]];
        let kept = within(&triangle, 2, (1.0, 2.0));
        assert_eq!(
            kept,
            [
                [0.0, 0.0, 2.0],
                [0.0, 0.0, 1.0],
                [3.0, 0.0, 1.0],
                [2.0, 0.0, 2.0]
            ]
        );
        assert_eq!(within(&triangle, 2, (-1.0, 9.0)), triangle);
        assert!(within(&triangle, 2, (5.0, 9.0)).is_empty());
    }
}
