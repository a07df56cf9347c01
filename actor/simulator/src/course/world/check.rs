//! Rules for the numbers of an obstacle.

use super::WorldFault;
use crate::course::check::{LARGEST_M, in_range};
use crate::course::{
    FaultLocation, MAX_CORNERS, Motion, Obstacle, ObstacleShape, Opening, Shape, polygon,
};

/// Least size of an obstacle, metres.
const SMALLEST_M: f32 = 0.02;
/// Least width of a wall's frame around an opening, metres.
const FRAME_M: f32 = 0.02;
/// Most openings of a wall.
const MAX_OPENINGS: usize = 16;
/// Fastest motion, m/s. Faster ones would pass the drone between two physics steps.
const FASTEST_MPS: f32 = 20.0;

impl Obstacle {
    /// Checks all numbers but the triangles of a mesh. `number`: of the obstacle, from 1.
    pub(super) fn check(&self, number: usize) -> Result<(), WorldFault> {
        let check = |key: &'static str, values: &[f32], least: f32, most: f32| {
            values.iter().try_for_each(|&value| {
                in_range(FaultLocation::Obstacle(number), key, value, least, most)
            })
        };
        check("centre_m", &self.centre_m, -LARGEST_M, LARGEST_M)?;
        check("rotation_deg", &self.rotation_deg, -360.0, 360.0)?;
        match &self.shape {
            ObstacleShape::Box { size_m } => check("size_m", size_m, SMALLEST_M, LARGEST_M)?,
            ObstacleShape::Cylinder { radius_m, height_m } => {
                check("radius_m", &[*radius_m], SMALLEST_M, LARGEST_M)?;
                check("height_m", &[*height_m], SMALLEST_M, LARGEST_M)?;
            }
            ObstacleShape::Sphere { radius_m } => {
                check("radius_m", &[*radius_m], SMALLEST_M, LARGEST_M)?;
            }
            ObstacleShape::Wall { size_m, openings } => {
                check("size_m", size_m, SMALLEST_M, LARGEST_M)?;
                check_openings(number, *size_m, openings)?;
            }
            ObstacleShape::Mesh(_) => {}
        }
        match self.motion {
            None => {}
            Some(Motion::ToAndFro { by_m, speed_mps } | Motion::Across { by_m, speed_mps }) => {
                check("motion.by_m", &by_m, -LARGEST_M, LARGEST_M)?;
                let length_m = by_m.iter().map(|m| m * m).sum::<f32>().sqrt();
                check("motion.by_m", &[length_m], 0.1, 2.0 * LARGEST_M)?;
                check("motion.speed_mps", &[speed_mps], 0.01, FASTEST_MPS)?;
            }
            Some(Motion::Circle {
                radius_m,
                speed_mps,
            }) => {
                check("motion.radius_m", &[radius_m], 0.1, LARGEST_M)?;
                check("motion.speed_mps", &[speed_mps], 0.01, FASTEST_MPS)?;
            }
        }
        Ok(())
    }
}

/// Checks that the openings are simple polygons, inside the wall and apart from each other.
fn check_openings(
    obstacle: usize,
    [_, width_m, height_m]: [f32; 3],
    openings: &[Opening],
) -> Result<(), WorldFault> {
    let mut boxes: Vec<[[f32; 2]; 2]> = Vec::new();
    for (opening, number) in openings.iter().zip(1..) {
        let fault = |problem| WorldFault::Opening {
            obstacle,
            opening: number,
            problem,
        };
        if number > MAX_OPENINGS {
            return Err(fault("is the 17th of this wall, which takes 16"));
        }
        if !is_finite(opening) {
            return Err(fault(
                "has a length that is not above 0, or has too few corners",
            ));
        }
        let outline = opening.outline();
        if polygon::self_intersection(&outline).is_some() {
            return Err(fault("crosses or touches itself"));
        }
        let corners = || outline.iter().copied();
        let least = corners().reduce(|a, b| [a[0].min(b[0]), a[1].min(b[1])]);
        let most = corners().reduce(|a, b| [a[0].max(b[0]), a[1].max(b[1])]);
        let (least, most) = (least.unwrap_or_default(), most.unwrap_or_default());
        let inside = [width_m, height_m].map(|side_m| side_m / 2.0 - FRAME_M);
        if (0..2).any(|axis| least[axis] < -inside[axis] || most[axis] > inside[axis]) {
            return Err(fault("reaches the wall's rim: 0.02 m must be left"));
        }
        let is_beside = |[other_least, other_most]: &[[f32; 2]; 2]| {
            (0..2).any(|axis| {
                least[axis] > other_most[axis] + FRAME_M || most[axis] < other_least[axis] - FRAME_M
            })
        };
        if !boxes.iter().all(is_beside) {
            return Err(fault(
                "is not beside, above or below another one: 0.02 m must be left",
            ));
        }
        boxes.push([least, most]);
    }
    Ok(())
}

/// Returns `true` if every number of an opening is finite, and its lengths are above 0.
fn is_finite(opening: &Opening) -> bool {
    let is_place = |value: &f32| (-LARGEST_M..=LARGEST_M).contains(value);
    let lengths_m = opening.shape.lengths_m();
    let fits = match &opening.shape {
        Shape::Polygon { points_m } => {
            (3..=MAX_CORNERS).contains(&points_m.len()) && points_m.iter().flatten().all(is_place)
        }
        Shape::Cross {
            width_m,
            height_m,
            arm_m,
        }
        | Shape::L {
            width_m,
            height_m,
            arm_m,
        } => *arm_m < 0.99 * width_m.min(*height_m),
        _ => true,
    };
    fits && opening.centre_m.iter().all(is_place)
        && (-360.0..=360.0).contains(&opening.rotation_deg)
        && lengths_m
            .iter()
            .all(|(_, length_m)| (SMALLEST_M..=LARGEST_M).contains(length_m))
}
