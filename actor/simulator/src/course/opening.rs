//! The opening in a wall: a shape, its centre and its rotation.
//!
//! The rest of the crate sees every shape as a simple polygon in the wall's plane.

use super::polygon;

/// Number of sides of the regular polygon that stands for a circle. It deviates from the circle by
/// 0.5 % of the radius.
pub const CIRCLE_SIDES: usize = 32;

/// An opening in a wall's plane. Coordinates are `[y, z]` in metres, as in the world frame: y to
/// the left, z up.
#[derive(Debug, Clone, PartialEq)]
pub struct Opening {
    /// Shape of the opening.
    pub shape: Shape,
    /// Middle of the shape's bounding box (for a polygon, the origin of `points_m`), `[y, z]` in
    /// metres.
    pub centre_m: [f32; 2],
    /// Rotation about the centre from y towards z, degrees.
    pub rotation_deg: f32,
}

/// Shape of an opening before it is rotated and moved. Lengths are in metres.
#[derive(Debug, Clone, PartialEq)]
pub enum Shape {
    /// Axis-parallel rectangle.
    Rectangle {
        /// Along y.
        width_m: f32,
        /// Along z.
        height_m: f32,
    },
    /// Circle, approximated by a polygon of [`CIRCLE_SIDES`] corners.
    Circle {
        /// Distance between opposite corners of that polygon.
        diameter_m: f32,
    },
    /// Isosceles triangle standing on its base.
    Triangle {
        /// The base, along y.
        width_m: f32,
        /// From the base to the tip, along z.
        height_m: f32,
    },
    /// Rhombus standing on a corner.
    Diamond {
        /// The diagonal along y.
        width_m: f32,
        /// The diagonal along z.
        height_m: f32,
    },
    /// An upright and a level beam that cross in the middle.
    Cross {
        /// Along y.
        width_m: f32,
        /// Along z.
        height_m: f32,
        /// Thickness of both beams.
        arm_m: f32,
    },
    /// An upright beam at the least y and a level beam at the bottom: the letter L with y to the
    /// right.
    L {
        /// Along y.
        width_m: f32,
        /// Along z.
        height_m: f32,
        /// Thickness of both beams.
        arm_m: f32,
    },
    /// A simple polygon.
    Polygon {
        /// Corners `[y, z]` relative to the centre, clockwise or counter-clockwise.
        points_m: Vec<[f32; 2]>,
    },
}

impl Opening {
    /// Returns the corners `[y, z]` in metres, counter-clockwise with y to the right and z up.
    #[must_use]
    pub fn outline(&self) -> Vec<[f32; 2]> {
        let (sin, cos) = self.rotation_deg.to_radians().sin_cos();
        let place = |[y, z]: [f32; 2]| {
            let turned = [y * cos - z * sin, y * sin + z * cos];
            [self.centre_m[0] + turned[0], self.centre_m[1] + turned[1]]
        };
        let mut points: Vec<_> = self.shape.corners().into_iter().map(place).collect();
        if polygon::signed_area(&points) < 0.0 {
            points.reverse();
        }
        points
    }
}

impl Shape {
    /// Returns the shape's name in course files.
    #[must_use]
    pub fn name(&self) -> &'static str {
        match self {
            Self::Rectangle { .. } => "rectangle",
            Self::Circle { .. } => "circle",
            Self::Triangle { .. } => "triangle",
            Self::Diamond { .. } => "diamond",
            Self::Cross { .. } => "cross",
            Self::L { .. } => "l",
            Self::Polygon { .. } => "polygon",
        }
    }

    /// Returns the shape's lengths with the keys that set them. A polygon has none.
    pub(crate) fn lengths_m(&self) -> Vec<(&'static str, f32)> {
        match *self {
            Self::Rectangle { width_m, height_m }
            | Self::Triangle { width_m, height_m }
            | Self::Diamond { width_m, height_m } => {
                vec![("width_m", width_m), ("height_m", height_m)]
            }
            Self::Circle { diameter_m } => vec![("diameter_m", diameter_m)],
            Self::Cross {
                width_m,
                height_m,
                arm_m,
            }
            | Self::L {
                width_m,
                height_m,
                arm_m,
            } => {
                vec![
                    ("width_m", width_m),
                    ("height_m", height_m),
                    ("arm_m", arm_m),
                ]
            }
            Self::Polygon { .. } => Vec::new(),
        }
    }

    /// Returns the same shape, `factor` times as large.
    pub(crate) fn scaled(mut self, factor: f32) -> Self {
        match &mut self {
            Self::Rectangle { width_m, height_m }
            | Self::Triangle { width_m, height_m }
            | Self::Diamond { width_m, height_m } => {
                *width_m *= factor;
                *height_m *= factor;
            }
            Self::Circle { diameter_m } => *diameter_m *= factor,
            Self::Cross {
                width_m,
                height_m,
                arm_m,
            }
            | Self::L {
                width_m,
                height_m,
                arm_m,
            } => {
                *width_m *= factor;
                *height_m *= factor;
                *arm_m *= factor;
            }
            Self::Polygon { points_m } => points_m
                .iter_mut()
                .flatten()
                .for_each(|value| *value *= factor),
        }
        self
    }

    /// Returns the corners relative to the centre.
    pub(crate) fn corners(&self) -> Vec<[f32; 2]> {
        match *self {
            Self::Rectangle { width_m, height_m } => {
                let (y, z) = (width_m / 2.0, height_m / 2.0);
                vec![[-y, -z], [y, -z], [y, z], [-y, z]]
            }
            Self::Circle { diameter_m } => (0..CIRCLE_SIDES)
                .map(|side| {
                    let angle = side as f32 / CIRCLE_SIDES as f32 * std::f32::consts::TAU;
                    [
                        diameter_m / 2.0 * angle.cos(),
                        diameter_m / 2.0 * angle.sin(),
                    ]
                })
                .collect(),
            Self::Triangle { width_m, height_m } => {
                let (y, z) = (width_m / 2.0, height_m / 2.0);
                vec![[-y, -z], [y, -z], [0.0, z]]
            }
            Self::Diamond { width_m, height_m } => {
                let (y, z) = (width_m / 2.0, height_m / 2.0);
                vec![[y, 0.0], [0.0, z], [-y, 0.0], [0.0, -z]]
            }
            Self::Cross {
                width_m,
                height_m,
                arm_m,
            } => {
                let (y, z, a) = (width_m / 2.0, height_m / 2.0, arm_m / 2.0);
                vec![
                    [-a, -z],
                    [a, -z],
                    [a, -a],
                    [y, -a],
                    [y, a],
                    [a, a],
                    [a, z],
                    [-a, z],
                    [-a, a],
                    [-y, a],
                    [-y, -a],
                    [-a, -a],
                ]
            }
            Self::L {
                width_m,
                height_m,
                arm_m,
            } => {
                let (y, z) = (width_m / 2.0, height_m / 2.0);
                vec![
                    [-y, -z],
                    [y, -z],
                    [y, arm_m - z],
                    [arm_m - y, arm_m - z],
                    [arm_m - y, z],
                    [-y, z],
                ]
            }
            Self::Polygon { ref points_m } => points_m.clone(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn area(shape: Shape, rotation_deg: f32) -> f32 {
        let opening = Opening {
            shape,
            centre_m: [0.7, 3.1],
            rotation_deg,
        };
        polygon::signed_area(&opening.outline())
    }

    #[test]
    fn areas_equal_those_of_the_textbook() {
        for turn in [0.0, 33.0, -190.0] {
            let (width_m, height_m, arm_m) = (3.0, 2.0, 0.5);
            let near = |got: f32, expected: f32| {
                assert!((got - expected).abs() < 1e-4, "{got} {expected}")
            };
            near(area(Shape::Rectangle { width_m, height_m }, turn), 6.0);
            near(area(Shape::Triangle { width_m, height_m }, turn), 3.0);
            near(area(Shape::Diamond { width_m, height_m }, turn), 3.0);
            near(
                area(
                    Shape::Cross {
                        width_m,
                        height_m,
                        arm_m,
                    },
                    turn,
                ),
                1.5 + 1.0 - 0.25,
            );
            near(
                area(
                    Shape::L {
                        width_m,
                        height_m,
                        arm_m,
                    },
                    turn,
                ),
                1.5 + 1.0 - 0.25,
            );
            let circle = area(Shape::Circle { diameter_m: 2.0 }, turn);
            assert!((3.11..std::f32::consts::PI).contains(&circle), "{circle}");
        }
    }

    #[test]
    fn a_clockwise_polygon_is_reversed() {
        let points_m = vec![[0.0, 0.0], [0.0, 1.0], [1.0, 0.0]];
        assert!((area(Shape::Polygon { points_m }, 0.0) - 0.5).abs() < 1e-6);
    }

    #[test]
    fn rotation_turns_y_towards_z() {
        let points_m = vec![[1.0, 0.0], [0.0, 0.5], [0.0, -0.5]];
        let opening = Opening {
            shape: Shape::Polygon { points_m },
            centre_m: [0.0, 0.0],
            rotation_deg: 90.0,
        };
        let [y, z] = opening.outline()[0];
        assert!(y.abs() < 1e-6 && (z - 1.0).abs() < 1e-6, "{y} {z}");
    }
}
