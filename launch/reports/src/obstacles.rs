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
    let triangles = course.obstacle_triangles();
    for triangle in &triangles {
        let corners = triangle.map(&place).to_vec();
        area.draw(&Polygon::new(corners, PARTLY_OPEN.filled()))?;
    }
    let (across, cut_m) = match axis {
        0 => (2, course.corridor().height_m / 2.0),
        _ => (1, 0.0),
    };
    for triangle in &triangles {
        let ends: Vec<_> = cut(triangle, across, cut_m)
            .into_iter()
            .map(&place)
            .collect();
        area.draw(&PathElement::new(ends, WALL.stroke_width(px(1))))?;
    }
    Ok(())
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
}
