//! Families of openings that are polygons.
//!
//! Each function draws corners `[y, z]`, counter-clockwise and of arbitrary scale.

use std::f32::consts::TAU;
use std::ops::RangeInclusive;

use rand::{Rng, RngExt};

use crate::course::Shape;

/// Five to eight corners around the centre.
pub(super) fn polygon(rng: &mut impl Rng) -> Shape {
    let corners = rng.random_range(5..=8);
    let points_m = (0..corners)
        .map(|corner| {
            let share = (corner as f32 + rng.random_range(-0.2..=0.2)) / corners as f32;
            polar(share, rng.random_range(0.8..=1.2))
        })
        .collect();
    Shape::Polygon { points_m }
}

pub(super) fn trapezoid(rng: &mut impl Rng) -> Shape {
    let (upper, height) = (rng.random_range(0.25..=0.4), rng.random_range(0.35..=0.5));
    let points_m = vec![
        [-0.5, -height],
        [0.5, -height],
        [upper, height],
        [-upper, height],
    ];
    Shape::Polygon { points_m }
}

pub(super) fn t(rng: &mut impl Rng) -> Shape {
    let (stem, bar) = (
        rng.random_range(0.225..=0.325),
        rng.random_range(0.45..=0.65),
    );
    let under = 0.5 - bar;
    mirrored(&[[stem, -0.5], [stem, under], [0.5, under], [0.5, 0.5]])
}

pub(super) fn star(rng: &mut impl Rng) -> Shape {
    let points = rng.random_range(4..=7);
    let notch = rng.random_range(0.55..=0.75);
    let points_m = (0..2 * points)
        .map(|corner| {
            let radius = if corner % 2 == 0 { 1.0 } else { notch };
            polar(corner as f32 / (2 * points) as f32, radius)
        })
        .collect();
    Shape::Polygon { points_m }
}

/// Corners around a centre, with bays and points at random.
pub(super) fn blob(rng: &mut impl Rng) -> Shape {
    let corners = rng.random_range(9..=14);
    let points_m = (0..corners)
        .map(|corner| polar(corner as f32 / corners as f32, rng.random_range(0.4..=1.0)))
        .collect();
    Shape::Polygon { points_m }
}

pub(super) fn keyhole(rng: &mut impl Rng) -> Shape {
    let (sides, half_slot) = (rng.random_range(5..=8), rng.random_range(0.065..=0.11));
    let (length, taper) = (rng.random_range(0.8..=1.8), rng.random_range(0.7..=1.1));
    let [neck, edge] = polar(half_slot, 1.0);
    let mut points_m = open_head(sides, half_slot, 0.85..=1.15, rng);
    points_m.extend([-1.0, 1.0].map(|side| [neck + length, side * taper * edge]));
    Shape::Polygon { points_m }
}

/// Corners around a centre, and a tongue of wall from one side that ends near the middle.
pub(super) fn notch(rng: &mut impl Rng) -> Shape {
    let (sides, half_width) = (rng.random_range(7..=10), rng.random_range(0.15..=0.3_f32));
    let (end, taper) = (rng.random_range(-0.25..=0.1), rng.random_range(0.7..=1.1));
    let mut points_m = open_head(sides, half_width.asin() / TAU, 0.9..=1.1, rng);
    points_m.extend([-1.0, 1.0].map(|side| [end, side * taper * half_width]));
    Shape::Polygon { points_m }
}

/// Corners around a centre, at random `radii`, that leave a gap of `half_gap` turns on either side
/// of the axis y. The first and the last, at the gap, are on the unit circle.
fn open_head(
    sides: i32,
    half_gap: f32,
    radii: RangeInclusive<f32>,
    rng: &mut impl Rng,
) -> Vec<[f32; 2]> {
    let corner = |corner| {
        let share = half_gap + (1.0 - 2.0 * half_gap) * corner as f32 / sides as f32;
        let radius = match corner {
            _ if corner == 0 || corner == sides => 1.0,
            _ => rng.random_range(radii.clone()),
        };
        polar(share, radius)
    };
    (0..=sides).map(corner).collect()
}

/// The unit disc without a second one: around on its own edge, back on the edge of the second.
pub(super) fn crescent(rng: &mut impl Rng) -> Shape {
    const OUTER: usize = 12;
    const INNER: usize = 6;
    let beside: f32 = rng.random_range(0.9..=1.3);
    // Half of the angle, seen from either centre, between the points where the two edges cross.
    let crossing = (beside / 2.0).acos() / TAU;
    let outer = (0..=OUTER).map(|corner| {
        polar(
            crossing + (1.0 - 2.0 * crossing) * corner as f32 / OUTER as f32,
            1.0,
        )
    });
    let inner = (1..INNER).map(|corner| {
        let [y, z] = polar(
            0.5 + crossing - 2.0 * crossing * corner as f32 / INNER as f32,
            1.0,
        );
        [beside + y, z]
    });
    let points_m = outer.chain(inner).collect();
    Shape::Polygon { points_m }
}

pub(super) fn u(rng: &mut impl Rng) -> Shape {
    let (beam, half_height) = (rng.random_range(0.36..=0.44), rng.random_range(0.4..=0.5));
    let inside = 0.5 - beam;
    mirrored(&[
        [0.5, -half_height],
        [0.5, half_height],
        [inside, half_height],
        [inside, beam - half_height],
    ])
}

/// Completes the right half of a shape, from bottom to top, with its mirror image.
fn mirrored(right: &[[f32; 2]]) -> Shape {
    let left = right.iter().rev().map(|[y, z]| [-y, *z]);
    Shape::Polygon {
        points_m: right.iter().copied().chain(left).collect(),
    }
}

/// Returns the point at `share` of a full turn, `radius` from the centre.
fn polar(share: f32, radius: f32) -> [f32; 2] {
    let (sin, cos) = (share * TAU).sin_cos();
    [radius * cos, radius * sin]
}
