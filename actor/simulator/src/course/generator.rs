//! Random courses from a seed.
//!
//! Diverse courses make a policy generalise, more training on one course does not: with random
//! openings a policy cannot memorise an order. An opening is sized by its free space: a disc of the
//! drawn radius fits inside, for any shape.

mod corners;
mod layout;
#[cfg(test)]
mod tests;

use rand::{Rng, RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use serde::{Deserialize, Serialize};

pub use layout::LayoutRanges;

use layout::Layout;

use super::{
    BODY_CLEARANCE_M, Corridor, Course, CourseFault, Opening, STAGES, Shape, StartArea, WallLabel,
    WallLayout, WorldFault, WorldRanges, check, polygon, world,
};
use crate::text::exactly;

/// Ranges for random courses: section `[simulator.generator]`. A pair holds the least and the
/// largest value, drawn uniformly.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GeneratorRanges {
    /// The corridor.
    pub corridor: Corridor,
    /// Area in which episodes start.
    pub start: StartArea,
    /// Front face of each wall, metres; one wall per number. Default 10, 20, 30, 40, 50.
    pub wall_x_m: Vec<f32>,
    /// Thickness of every wall, metres. Default 0.3.
    pub wall_thickness_m: f32,
    /// Families of openings, drawn with equal probability. If an opening does not fit, or cannot be
    /// reached from the previous wall, the generator draws everything again, so families that need
    /// more room are less frequent. Default: [`GeneratedShape::TRAINED`].
    pub shapes: Vec<GeneratedShape>,
    /// Radius of the widest circle inside an opening, metres: at least [`BODY_CLEARANCE_M`].
    /// Default 0.9 to 1.15.
    #[serde(deserialize_with = "exactly")]
    pub clearance_m: [f32; 2],
    /// Rotation of an opening, degrees. Default −180 to 180.
    #[serde(deserialize_with = "exactly")]
    pub rotation_deg: [f32; 2],
    /// Ranges for the corridor and its walls. They replace `corridor`, `start`, `wall_x_m` and
    /// `wall_thickness_m`, which then keep their defaults. Default: none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub layout: Option<LayoutRanges>,
    /// Kinds of worlds, drawn with equal probability. They replace all other keys, which then keep
    /// their defaults. Default: none, that is, corridors.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub worlds: Vec<WorldRanges>,
}

/// A family of openings that the generator draws.
///
/// Some families are for training ([`GeneratedShape::TRAINED`]). The others are held out, to show
/// how an agent flies shapes it never met ([`GeneratedShape::HELD_OUT`],
/// [`GeneratedShape::UNTRIED`]). Some held-out families resemble trained ones: a square on its
/// corner is a diamond of equal diagonals, a polygon of eight corners is close to a circle, a T has
/// inner corners like an L and a cross, a keyhole, like an L, is widest away from its middle, and a
/// notch has a tongue of wall like a U.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum GeneratedShape {
    /// Sides with a ratio up to 1 : 1.4.
    Rectangle,
    /// A circle.
    Circle,
    /// Close to equilateral.
    Triangle,
    /// Diagonals with a ratio up to 1 : 1.3.
    Diamond,
    /// Two crossing beams, 0.45 to 0.65 of the width thick.
    Cross,
    /// Two beams that meet in a corner, 0.45 to 0.65 of the width thick.
    L,
    /// Five to eight corners around the centre.
    Polygon,
    /// An upper side of 0.5 to 0.8 of the lower one.
    Trapezoid,
    /// A level beam on an upright one, each 0.45 to 0.65 of the width thick.
    T,
    /// Four to seven points, with notches at 0.55 to 0.75 of the radius between them.
    Star,
    /// Nine to fourteen corners around a centre, each at 0.4 to 1 of the radius: bays and points at
    /// random.
    Blob,
    /// A head of six to nine corners with a slot on one side, 0.4 to 0.65 as wide as the head. Its
    /// widest part is not in the middle.
    Keyhole,
    /// Seven to ten corners around a centre, with a tongue of wall from one side to the middle, 0.3
    /// to 0.6 of the radius wide. Its middle is closed.
    Notch,
    /// A disc without a second one of the same size, whose centre is 0.9 to 1.3 of the radius away.
    Crescent,
    /// Three beams of 0.36 to 0.44 of the width, 0.8 to 1 as high as wide. Its widest parts are the
    /// corners.
    U,
}

impl GeneratedShape {
    /// Families for training.
    pub const TRAINED: [Self; 8] = [
        Self::Rectangle,
        Self::Polygon,
        Self::Trapezoid,
        Self::T,
        Self::Star,
        Self::Blob,
        Self::Keyhole,
        Self::Notch,
    ];

    /// Families held out of training: those of the gates in
    /// `configs/courses/non_rectangular.toml`.
    pub const HELD_OUT: [Self; 5] = [
        Self::Circle,
        Self::Triangle,
        Self::Diamond,
        Self::Cross,
        Self::L,
    ];

    /// Families that neither training nor the gates have. Results on them were looked at
    /// once: [`Self::Notch`] is trained because Us failed most.
    pub const UNTRIED: [Self; 2] = [Self::Crescent, Self::U];

    /// Returns the name in the configuration.
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
            Self::Notch => "notch",
            Self::Crescent => "crescent",
            Self::U => "u",
        }
    }
}

/// Reason why no course can be drawn from ranges.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RangesError {
    /// A range with reversed bounds, or with a bound that is too small or too large.
    #[error(
        "generator: {key} = [{least}, {most}] must be a least and a largest value from {smallest} \
         to {largest}"
    )]
    NoRange {
        /// The key.
        key: &'static str,
        /// Its lower bound.
        least: f32,
        /// Its upper bound.
        most: f32,
        /// Smallest lower bound accepted.
        smallest: f32,
        /// Largest upper bound accepted.
        largest: f32,
    },
    /// A key of a fixed corridor beside ranges of corridors.
    #[error(
        "generator: {key} and layout exclude each other: remove {key}, or the section layout and \
         its keys"
    )]
    LayoutTwice {
        /// The key of the fixed corridor.
        key: &'static str,
    },
    /// Keys of corridors beside kinds of worlds.
    #[error(
        "generator: worlds excludes all other keys of the section: remove them, or remove worlds"
    )]
    WorldsAndCorridors,
    /// A world is at fault.
    #[error("generator: {0}")]
    World(#[from] WorldFault),
    /// No families of openings.
    #[error("generator: shapes is empty: name at least one")]
    NoShapes,
    /// The corridor, the start area or the number of walls is at fault.
    #[error("generator: {0}")]
    Corridor(#[from] CourseFault),
    /// No opening drawn from the ranges could be flown.
    #[error("generator: no opening drawn for wall {wall} could be flown, for example: {last}")]
    NothingFits {
        /// The wall.
        wall: WallLabel,
        /// Reason why the last attempt was refused.
        last: CourseFault,
    },
}

impl Default for GeneratorRanges {
    /// Five walls as in the paper's corridor, the free space of the shipped courses, and the
    /// families for training.
    fn default() -> Self {
        Self {
            corridor: Corridor::default(),
            start: StartArea::default(),
            wall_x_m: vec![10.0, 20.0, 30.0, 40.0, 50.0],
            wall_thickness_m: 0.3,
            shapes: GeneratedShape::TRAINED.to_vec(),
            clearance_m: [0.9, 1.15],
            rotation_deg: [-180.0, 180.0],
            layout: None,
            worlds: Vec::new(),
        }
    }
}

impl Course {
    /// Generates the course of a seed: the same seed and ranges give the same course.
    ///
    /// # Errors
    /// [`RangesError`] if the ranges are invalid, or if no course drawn from them can be flown.
    pub fn generate(seed: u64, ranges: &GeneratorRanges) -> Result<Self, RangesError> {
        Self::generate_from_level(seed, 1, ranges)
    }

    /// Generates the course of a seed and a start level. It has a wall for that level, if the
    /// ranges allow as many walls.
    ///
    /// # Errors
    /// Like [`Course::generate`].
    pub fn generate_from_level(
        seed: u64,
        level: u8,
        ranges: &GeneratorRanges,
    ) -> Result<Self, RangesError> {
        ranges.validate()?;
        if let Some(world) = ranges.draw_world(seed) {
            return Ok(world::generate(seed, world)?);
        }
        let layout = ranges.draw_layout(seed, level);
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let mut course = Self::without_walls(
            format!("generated {seed}"),
            layout.corridor,
            layout.start,
            layout.wall_thickness_m,
            layout.sidestep(),
        )?;
        let next = layout.wall_x_m.iter().copied().map(Some).skip(1);
        for (&x_m, next_x_m) in layout.wall_x_m.iter().zip(next.chain([None])) {
            let across_m = layout.across_m(course.walls.len());
            course.add_random_wall(x_m, next_x_m, across_m, ranges, &mut rng)?;
        }
        Ok(course)
    }

    /// Draws walls until one can be flown after those already in the course, and leaves room for
    /// the wall at `next_x_m`. `across_m`: range of its opening's centre along y.
    fn add_random_wall(
        &mut self,
        x_m: f32,
        next_x_m: Option<f32>,
        across_m: [f32; 2],
        ranges: &GeneratorRanges,
        rng: &mut impl Rng,
    ) -> Result<(), RangesError> {
        /// With the default ranges about every third attempt fits.
        const MOST_RETRIES: u32 = 1000;

        let label = WallLabel(self.walls.len() as u32 + 1);
        let mut retries = 0;
        loop {
            let layout = WallLayout {
                label,
                x_m,
                opening: ranges.draw_opening(self, x_m, across_m, rng),
            };
            match self.add_wall_before(layout, next_x_m) {
                Ok(()) => return Ok(()),
                Err(last) if retries == MOST_RETRIES => {
                    return Err(RangesError::NothingFits { wall: label, last });
                }
                Err(_) => retries += 1,
            }
        }
    }

    /// Adds a wall if a wall at `next_x_m` can follow it.
    fn add_wall_before(
        &mut self,
        layout: WallLayout,
        next_x_m: Option<f32>,
    ) -> Result<(), CourseFault> {
        self.add_wall(layout)?;
        let followed = next_x_m.map_or(Ok(()), |x_m| check::leads_on(self, x_m));
        if followed.is_err() {
            self.walls.pop();
        }
        followed
    }
}

impl GeneratorRanges {
    /// Checks that courses can be drawn: not only usual ones, but some of the narrowest corridors
    /// with the closest walls. An actor would otherwise fail in the middle of a run.
    ///
    /// # Errors
    /// [`RangesError`] names the key or the wall.
    pub fn check(&self) -> Result<(), RangesError> {
        const HARDEST: std::ops::Range<u64> = 0..8;
        for world in &self.worlds {
            world::generate(0, world)?;
        }
        Course::generate(0, self)?;
        let Some(layout) = &self.layout else {
            return Ok(());
        };
        let hardest = Self {
            layout: Some(layout.hardest()),
            ..self.clone()
        };
        HARDEST
            .into_iter()
            .try_for_each(|seed| Course::generate(seed, &hardest).map(drop))
    }

    /// Returns the longest corridor of a course, and the start that lies farthest from its end.
    #[must_use]
    pub fn longest(&self) -> (Corridor, StartArea) {
        let lengths_m = self.worlds.iter().map(WorldRanges::length_m);
        if let Some(length_m) = lengths_m.reduce(f32::max) {
            let corridor = Corridor {
                length_m,
                ..self.corridor
            };
            return (corridor, self.start);
        }
        match &self.layout {
            Some(layout) => layout.longest(),
            None => (self.corridor, self.start),
        }
    }

    /// Returns the most walls, or stages, of a course.
    #[must_use]
    pub fn most_walls(&self) -> usize {
        match &self.layout {
            _ if !self.worlds.is_empty() => STAGES.into(),
            Some(layout) => layout.walls[1].into(),
            None => self.wall_x_m.len(),
        }
    }

    fn validate(&self) -> Result<(), RangesError> {
        check::wall_count(self.wall_x_m.len())?;
        if self.shapes.is_empty() {
            return Err(RangesError::NoShapes);
        }
        check_range("clearance_m", self.clearance_m, BODY_CLEARANCE_M, 50.0)?;
        check_range("rotation_deg", self.rotation_deg, -360.0, 360.0)?;
        if !self.worlds.is_empty() {
            let of_corridors = Self {
                worlds: Vec::new(),
                ..self.clone()
            };
            return match of_corridors == Self::default() {
                true => Ok(()),
                false => Err(RangesError::WorldsAndCorridors),
            };
        }
        let Some(layout) = &self.layout else {
            return Ok(());
        };
        let usual = Self::default();
        for (key, is_set) in [
            ("corridor", self.corridor != usual.corridor),
            ("start", self.start != usual.start),
            ("wall_x_m", self.wall_x_m != usual.wall_x_m),
            (
                "wall_thickness_m",
                self.wall_thickness_m != usual.wall_thickness_m,
            ),
        ] {
            if is_set {
                return Err(RangesError::LayoutTwice { key });
            }
        }
        layout.validate()
    }

    /// Draws the kind of world of a seed; `None` if the ranges are for corridors.
    fn draw_world(&self, seed: u64) -> Option<&WorldRanges> {
        let kinds = self.worlds.len();
        let mut rng = Pcg64Mcg::seed_from_u64(!seed);
        (kinds > 0).then(|| &self.worlds[rng.random_range(0..kinds)])
    }

    /// Draws from a generator of its own, so that the openings of a seed do not depend on whether
    /// corridors vary.
    fn draw_layout(&self, seed: u64, level: u8) -> Layout {
        match &self.layout {
            Some(layout) => layout.draw(level, &mut Pcg64Mcg::seed_from_u64(!seed)),
            None => Layout {
                corridor: self.corridor,
                start: self.start,
                wall_x_m: self.wall_x_m.clone(),
                wall_thickness_m: self.wall_thickness_m,
                slalom: None,
            },
        }
    }

    /// Draws an opening for the next wall of `course`, where the drone can reach it.
    fn draw_opening(
        &self,
        course: &Course,
        x_m: f32,
        across_m: [f32; 2],
        rng: &mut impl Rng,
    ) -> Opening {
        let kind = self.shapes[rng.random_range(0..self.shapes.len())];
        let clearance_m = rng.random_range(self.clearance_m[0]..=self.clearance_m[1]);
        let shape = kind.draw(clearance_m, rng);
        let [in_reach_y, in_reach_z] = check::in_reach(course, x_m);
        // A shape's safe point may lie beside its centre, but not farther than its free space.
        let mut within = |[least, most]: [f32; 2], [near, far]: [f32; 2]| {
            let (least, most) = (least.max(near - clearance_m), most.min(far + clearance_m));
            rng.random_range(least..=most.max(least))
        };
        Opening {
            shape,
            centre_m: [
                within(across_m, in_reach_y),
                within([0.0, course.corridor.height_m], in_reach_z),
            ],
            rotation_deg: rng.random_range(self.rotation_deg[0]..=self.rotation_deg[1]),
        }
    }
}

/// Checks the range `key` against its bounds.
fn check_range(
    key: &'static str,
    [least, most]: [f32; 2],
    smallest: f32,
    largest: f32,
) -> Result<(), RangesError> {
    // Written so that a NaN is refused as well.
    if least >= smallest && most >= least && most <= largest {
        return Ok(());
    }
    Err(RangesError::NoRange {
        key,
        least,
        most,
        smallest,
        largest,
    })
}

impl GeneratedShape {
    /// Draws a shape whose widest inner circle has the radius `clearance_m`.
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
            Self::Notch => corners::notch(rng),
            Self::Crescent => corners::crescent(rng),
            Self::U => corners::u(rng),
        }
    }
}
