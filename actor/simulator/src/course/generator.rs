//! Random courses from a seed.
//!
//! What generalises is diversity in training, not more training: a policy that meets random
//! openings cannot learn an order by heart. An opening is drawn by the free space it leaves: of
//! whatever shape, a disc of that radius fits.

mod corners;

use rand::{Rng, RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use serde::{Deserialize, Serialize};

use super::{
    BODY_CLEARANCE_M, Corridor, Course, CourseFault, Opening, Shape, StartArea, WallLabel,
    WallLayout, check, polygon,
};

/// What random courses are drawn from. Pairs are the least and the largest value, drawn uniformly.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GeneratorRanges {
    /// The corridor.
    pub corridor: Corridor,
    /// Where episodes begin.
    pub start: StartArea,
    /// Front face of each wall, metres; as many walls as entries.
    pub wall_x_m: Vec<f32>,
    /// Thickness of every wall, metres.
    pub wall_thickness_m: f32,
    /// Kinds of openings, each as likely to be drawn; where one cannot be flown from the wall
    /// before, or does not fit, all is drawn anew, so that kinds which need more room come up less
    /// often. Default: the families for training, [`GeneratedShape::TRAINED`].
    pub shapes: Vec<GeneratedShape>,
    /// Radius of the widest circle inside an opening, metres: at least [`BODY_CLEARANCE_M`].
    pub clearance_m: [f32; 2],
    /// Turn of an opening, degrees.
    pub rotation_deg: [f32; 2],
}

/// A kind of opening that the generator draws.
///
/// Some families are for training, the others are held out, so that flying them shows what an agent
/// makes of shapes that it never met: [`GeneratedShape::TRAINED`], [`GeneratedShape::HELD_OUT`],
/// [`GeneratedShape::UNTRIED`]. `shapes` decides which are drawn; by default those of training.
/// Neighbours remain: a square on its corner is a diamond of equal diagonals, a polygon of eight
/// corners is near a circle, a T has an inner corner as an L and a cross have, and a keyhole, like
/// an L, is widest away from its middle.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum GeneratedShape {
    /// Sides up to 1 : 1.4.
    Rectangle,
    /// A circle.
    Circle,
    /// Close to equilateral.
    Triangle,
    /// Diagonals up to 1 : 1.3.
    Diamond,
    /// Beams of 0.45 to 0.65 of the width.
    Cross,
    /// Beams of 0.45 to 0.65 of the width.
    L,
    /// Five to eight corners around the centre.
    Polygon,
    /// The upper side 0.5 to 0.8 of the lower one.
    Trapezoid,
    /// A level beam upon an upright one, each of 0.45 to 0.65 of the width.
    T,
    /// Four to seven points, notches of 0.55 to 0.75 of the radius between them.
    Star,
    /// Nine to fourteen corners around a centre, each at 0.4 to 1 of the radius: bays and points
    /// wherever they come to lie.
    Blob,
    /// A head of six to nine corners with a slot at one side, 0.4 to 0.65 as wide as the head: what
    /// is widest is not in the middle.
    Keyhole,
    /// What a disc leaves of another that lies 0.9 to 1.3 of the radius beside it.
    Crescent,
    /// Three beams of 0.36 to 0.44 of the width, 0.8 to 1 as high as it is wide: what is widest are
    /// its corners.
    U,
}

impl GeneratedShape {
    /// Families for training.
    pub const TRAINED: [Self; 7] = [
        Self::Rectangle,
        Self::Polygon,
        Self::Trapezoid,
        Self::T,
        Self::Star,
        Self::Blob,
        Self::Keyhole,
    ];

    /// Families that training never shows: those of the gates in
    /// `configs/courses/non_rectangular.toml`.
    pub const HELD_OUT: [Self; 5] = [
        Self::Circle,
        Self::Triangle,
        Self::Diamond,
        Self::Cross,
        Self::L,
    ];

    /// Families that nothing was ever tuned on. How a policy fared on the gates' families was
    /// looked at while `configs/generalist.toml` was made; on these, only once it was finished.
    pub const UNTRIED: [Self; 2] = [Self::Crescent, Self::U];

    /// Its name in the configuration.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Rectangle => "rectangle",
            Self::Circle => "circle",
            Self::Triangle => "triangle",
            Self::Diamond => "diamond",
            Self::Cross => "cross",
            Self::L => "l",
            Self::Polygon => "polygon",
            Self::Trapezoid => "trapezoid",
            Self::T => "t",
            Self::Star => "star",
            Self::Blob => "blob",
            Self::Keyhole => "keyhole",
            Self::Crescent => "crescent",
            Self::U => "u",
        }
    }
}

/// Ranges that no course can be drawn from.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RangesError {
    /// A range upside down, or with a bound that is not a number or too small.
    #[error("generator: {key} = [{least}, {most}] is no range from {smallest} upwards")]
    NoRange {
        /// The key.
        key: &'static str,
        /// Its lower bound.
        least: f32,
        /// Its upper bound.
        most: f32,
        /// Smallest lower bound accepted.
        smallest: f32,
    },
    /// No shapes to choose from.
    #[error("generator: shapes is empty: name at least one")]
    NoShapes,
    /// The corridor, the start area or the number of walls.
    #[error("generator: {0}")]
    Corridor(#[from] CourseFault),
    /// Nothing drawn from the ranges could be flown.
    #[error("generator: nothing drawn for wall {wall} could be flown, for instance: {last}")]
    NothingFits {
        /// The wall.
        wall: WallLabel,
        /// Why the last try was refused.
        last: CourseFault,
    },
}

impl Default for GeneratorRanges {
    /// Five walls as in the paper's corridor, with the free space of the shipped courses, of the
    /// shapes that are for training.
    fn default() -> Self {
        Self {
            corridor: Corridor::default(),
            start: StartArea::default(),
            wall_x_m: vec![10.0, 20.0, 30.0, 40.0, 50.0],
            wall_thickness_m: 0.3,
            shapes: GeneratedShape::TRAINED.to_vec(),
            clearance_m: [0.9, 1.15],
            rotation_deg: [-180.0, 180.0],
        }
    }
}

impl Course {
    /// The course that belongs to a seed: the same seed and ranges give the same course.
    ///
    /// # Errors
    /// [`RangesError`] if the ranges are none, or hold nothing that can be flown.
    pub fn generate(seed: u64, ranges: &GeneratorRanges) -> Result<Self, RangesError> {
        ranges.check()?;
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let mut course = Self::without_walls(
            format!("generated {seed}"),
            ranges.corridor,
            ranges.start,
            ranges.wall_thickness_m,
        )?;
        for &x_m in &ranges.wall_x_m {
            course.add_random_wall(x_m, ranges, &mut rng)?;
        }
        Ok(course)
    }

    /// Draws walls until one can be flown after those already there.
    fn add_random_wall(
        &mut self,
        x_m: f32,
        ranges: &GeneratorRanges,
        rng: &mut impl Rng,
    ) -> Result<(), RangesError> {
        /// With the default ranges about every third try fits.
        const TRIES: u32 = 1000;

        let label = WallLabel(self.walls.len() as u32 + 1);
        let mut tries = 0;
        loop {
            let opening = ranges.draw_opening(rng);
            match self.add_wall(WallLayout {
                label,
                x_m,
                opening,
            }) {
                Ok(()) => return Ok(()),
                Err(last) if tries == TRIES => {
                    return Err(RangesError::NothingFits { wall: label, last });
                }
                Err(_) => tries += 1,
            }
        }
    }
}

impl GeneratorRanges {
    fn check(&self) -> Result<(), RangesError> {
        check::wall_count(self.wall_x_m.len())?;
        if self.shapes.is_empty() {
            return Err(RangesError::NoShapes);
        }
        let ranges = [
            ("clearance_m", self.clearance_m, BODY_CLEARANCE_M),
            ("rotation_deg", self.rotation_deg, -360.0),
        ];
        for (key, [least, most], smallest) in ranges {
            let sound = least >= smallest && most >= least && most.is_finite();
            if !sound {
                return Err(RangesError::NoRange {
                    key,
                    least,
                    most,
                    smallest,
                });
            }
        }
        Ok(())
    }

    fn draw_opening(&self, rng: &mut impl Rng) -> Opening {
        let kind = self.shapes[rng.random_range(0..self.shapes.len())];
        let clearance_m = rng.random_range(self.clearance_m[0]..=self.clearance_m[1]);
        let (half_y, height) = (self.corridor.width_m / 2.0, self.corridor.height_m);
        Opening {
            shape: kind.draw(clearance_m, rng),
            centre_m: [
                rng.random_range(-half_y..=half_y),
                rng.random_range(0.0..=height),
            ],
            rotation_deg: rng.random_range(self.rotation_deg[0]..=self.rotation_deg[1]),
        }
    }
}

impl GeneratedShape {
    /// A shape whose widest inner circle has the radius `clearance_m`.
    fn draw(self, clearance_m: f32, rng: &mut impl Rng) -> Shape {
        let shape = self.draw_proportions(rng);
        let unscaled = Opening {
            shape: shape.clone(),
            centre_m: [0.0; 2],
            rotation_deg: 0.0,
        };
        let (_, radius) = polygon::widest_circle(&unscaled.outline());
        shape.scaled(clearance_m / radius)
    }

    fn draw_proportions(self, rng: &mut impl Rng) -> Shape {
        let width_m = 1.0;
        match self {
            Self::Rectangle => Shape::Rectangle {
                width_m,
                height_m: rng.random_range(1.0..=1.4),
            },
            Self::Circle => Shape::Circle { diameter_m: 1.0 },
            Self::Triangle => Shape::Triangle {
                width_m,
                height_m: rng.random_range(0.75..=1.0),
            },
            Self::Diamond => Shape::Diamond {
                width_m,
                height_m: rng.random_range(1.0..=1.3),
            },
            Self::Cross => Shape::Cross {
                width_m,
                height_m: 1.0,
                arm_m: rng.random_range(0.45..=0.65),
            },
            Self::L => Shape::L {
                width_m,
                height_m: 1.0,
                arm_m: rng.random_range(0.45..=0.65),
            },
            Self::Polygon => corners::polygon(rng),
            Self::Trapezoid => corners::trapezoid(rng),
            Self::T => corners::t(rng),
            Self::Star => corners::star(rng),
            Self::Blob => corners::blob(rng),
            Self::Keyhole => corners::keyhole(rng),
            Self::Crescent => corners::crescent(rng),
            Self::U => corners::u(rng),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_family_is_drawn_with_exactly_the_free_space_asked_for() {
        let held_out = [&GeneratedShape::HELD_OUT[..], &GeneratedShape::UNTRIED].concat();
        for shape in GeneratedShape::TRAINED.into_iter().chain(held_out) {
            for clearance_m in [BODY_CLEARANCE_M + 0.01, 0.75, 1.0] {
                let ranges = GeneratorRanges {
                    shapes: vec![shape],
                    clearance_m: [clearance_m; 2],
                    ..Default::default()
                };
                for seed in 0..10 {
                    let course = Course::generate(seed, &ranges).unwrap();
                    for wall in course.walls() {
                        // The widest circle is found to a millimetre.
                        let off_m = (wall.clearance_m() - clearance_m).abs();
                        assert!(off_m < 0.003, "{shape:?}: {} m", wall.clearance_m());
                    }
                }
            }
        }
    }

    #[test]
    fn no_family_is_both_trained_on_and_held_out_and_defaults_hold_out() {
        let held_out = [&GeneratedShape::HELD_OUT[..], &GeneratedShape::UNTRIED].concat();
        let is_held_out = |shape: &GeneratedShape| held_out.contains(shape);
        assert!(!GeneratedShape::TRAINED.iter().any(is_held_out));
        assert!(!GeneratorRanges::default().shapes.iter().any(is_held_out));
    }

    #[test]
    fn every_seed_gives_a_course_with_the_free_space_asked_for() {
        let ranges = GeneratorRanges::default();
        let mut outlines = Vec::new();
        for seed in 0..40 {
            let course = Course::generate(seed, &ranges).unwrap();
            assert_eq!(course.walls().len(), 5);
            for wall in course.walls() {
                assert!(
                    (0.89..=1.16).contains(&wall.clearance_m()),
                    "{}",
                    wall.clearance_m()
                );
            }
            outlines.push(course.walls()[0].outline().to_vec());
        }
        outlines.dedup();
        assert_eq!(outlines.len(), 40, "seeds must give different courses");
    }

    #[test]
    fn the_same_seed_gives_the_same_course() {
        let ranges = GeneratorRanges::default();
        assert_eq!(Course::generate(3, &ranges), Course::generate(3, &ranges));
    }

    #[test]
    fn impossible_ranges_are_refused_and_say_why() {
        let upside_down = GeneratorRanges {
            clearance_m: [1.2, 1.0],
            ..Default::default()
        };
        let error = Course::generate(0, &upside_down).unwrap_err().to_string();
        assert!(error.contains("clearance_m = [1.2, 1]"), "{error}");

        let no_corridor = GeneratorRanges {
            corridor: Corridor {
                width_m: f32::NAN,
                ..Corridor::default()
            },
            ..Default::default()
        };
        let error = Course::generate(0, &no_corridor).unwrap_err().to_string();
        assert!(error.contains("corridor.width_m = NaN"), "{error}");

        let too_wide = GeneratorRanges {
            clearance_m: [3.5, 3.5],
            ..Default::default()
        };
        let error = Course::generate(0, &too_wide).unwrap_err().to_string();
        assert!(
            error.contains("nothing drawn for wall 1") && error.contains("must stay within"),
            "{error}"
        );
    }
}
