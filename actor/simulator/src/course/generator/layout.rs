//! Ranges for the corridor of a random course, and for where its walls stand.

use rand::{Rng, RngExt};
use serde::{Deserialize, Serialize};

use super::{RangesError, check_range};
use crate::course::check::{LARGEST_M, NEAR_MIDDLE_M, SETTLING_M};
use crate::course::{BODY_CLEARANCE_M, Corridor, MAX_WALLS, Sidestep, StartArea};
use crate::oracle::{HOVER_BEHIND_START_M, HOVER_BEHIND_WALL_M};
use crate::text::exactly;

/// Ranges for corridors: section `[simulator.generator.layout]`. Every key has a least and a
/// largest value, drawn uniformly. Without the section, every course has the generator's
/// `corridor`, `start`, `wall_x_m` and `wall_thickness_m`. The defaults here give that same
/// corridor.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LayoutRanges {
    /// Width of the corridor, metres. Default 6.
    #[serde(deserialize_with = "exactly")]
    pub width_m: [f32; 2],
    /// Height of the corridor, metres. Default 7.
    #[serde(deserialize_with = "exactly")]
    pub height_m: [f32; 2],
    /// Number of walls. An episode from a later level has at least a wall for that level. Default
    /// 5.
    #[serde(deserialize_with = "exactly")]
    pub walls: [u8; 2],
    /// Distance from one wall's front face to the next one's, and from the corridor's start to the
    /// first wall, metres; drawn for each wall. Default 10.
    #[serde(deserialize_with = "exactly")]
    pub spacing_m: [f32; 2],
    /// Distance from the corridor's start to the first wall, metres, if not as `spacing_m`.
    /// Default: none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub first_wall_m: Option<[f32; 2]>,
    /// Thickness of a course's walls, metres. Default 0.3.
    #[serde(deserialize_with = "exactly")]
    pub wall_thickness_m: [f32; 2],
    /// Distance from the last wall's front face to the end wall, metres. Default 10.
    #[serde(deserialize_with = "exactly")]
    pub end_m: [f32; 2],
    /// `start.offset_m` of a course. Default 1.5.
    #[serde(deserialize_with = "exactly")]
    pub start_offset_m: [f32; 2],
    /// `start.jitter_y_m` of a course. Default 0.5.
    #[serde(deserialize_with = "exactly")]
    pub start_jitter_y_m: [f32; 2],
    /// `start.jitter_z_m` of a course. Default 0.5.
    #[serde(deserialize_with = "exactly")]
    pub start_jitter_z_m: [f32; 2],
    /// `true` puts the openings in turn into the left and the right half of the corridor. The walls
    /// may then stand too close for a drone that flies on at 1 m/s: 2 m from back to front, where
    /// one that hovers has room. Such courses need `vehicle.action = "velocity"`. Default false.
    pub slalom: bool,
}

impl Default for LayoutRanges {
    fn default() -> Self {
        Self {
            width_m: [6.0; 2],
            height_m: [7.0; 2],
            walls: [5; 2],
            spacing_m: [10.0; 2],
            first_wall_m: None,
            wall_thickness_m: [0.3; 2],
            end_m: [10.0; 2],
            start_offset_m: [1.5; 2],
            start_jitter_y_m: [0.5; 2],
            start_jitter_z_m: [0.5; 2],
            slalom: false,
        }
    }
}

/// A corridor without openings.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Layout {
    pub(super) corridor: Corridor,
    pub(super) start: StartArea,
    pub(super) wall_x_m: Vec<f32>,
    pub(super) wall_thickness_m: f32,
    /// Half of the corridor in which a slalom's first opening lies; `None` for any other course.
    pub(super) slalom: Option<Half>,
}

/// Half of a corridor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Half {
    Left,
    Right,
}

impl Layout {
    /// Returns how the drone gets from one opening to the next.
    pub(super) fn sidestep(&self) -> Sidestep {
        match self.slalom {
            Some(_) => Sidestep::Hovering,
            None => Sidestep::Flying,
        }
    }

    /// Returns the range along y for the centre of the opening of the wall at `place`, metres.
    pub(super) fn across_m(&self, place: usize) -> [f32; 2] {
        let half_m = self.corridor.width_m / 2.0;
        match (self.slalom, place.is_multiple_of(2)) {
            (None, _) => [-half_m, half_m],
            (Some(Half::Left), true) | (Some(Half::Right), false) => [0.0, half_m],
            (Some(Half::Right), true) | (Some(Half::Left), false) => [-half_m, 0.0],
        }
    }
}

impl LayoutRanges {
    /// Checks that any corridor drawn from the ranges has openings that can be flown.
    pub(super) fn validate(&self) -> Result<(), RangesError> {
        let [least_walls, most_walls] = self.walls.map(f32::from);
        let thickest_m = self.wall_thickness_m[1];
        let widest_jitter_m = self.start_jitter_y_m[1].max(self.start_jitter_z_m[1]);
        let least_spacing_m = match self.slalom {
            false => {
                let aside_m = SETTLING_M + NEAR_MIDDLE_M;
                (self.start_offset_m[1] + widest_jitter_m + aside_m).max(thickest_m + aside_m)
            }
            true => (self.start_offset_m[1] + HOVER_BEHIND_START_M)
                .max(thickest_m + HOVER_BEHIND_WALL_M),
        };
        let jitter_m = |section_m: [f32; 2]| section_m[0] / 2.0 - BODY_CLEARANCE_M;
        for (key, range, smallest, largest) in [
            ("layout.width_m", self.width_m, 2.0, 100.0),
            ("layout.height_m", self.height_m, 2.0, 100.0),
            (
                "layout.walls",
                [least_walls, most_walls],
                1.0,
                MAX_WALLS as f32,
            ),
            ("layout.wall_thickness_m", self.wall_thickness_m, 0.01, 2.0),
            (
                "layout.start_offset_m",
                self.start_offset_m,
                thickest_m + BODY_CLEARANCE_M,
                LARGEST_M,
            ),
            (
                "layout.start_jitter_y_m",
                self.start_jitter_y_m,
                0.0,
                jitter_m(self.width_m),
            ),
            (
                "layout.start_jitter_z_m",
                self.start_jitter_z_m,
                0.0,
                jitter_m(self.height_m),
            ),
            (
                "layout.end_m",
                self.end_m,
                thickest_m + 2.0 * BODY_CLEARANCE_M,
                LARGEST_M,
            ),
            (
                "layout.spacing_m",
                self.spacing_m,
                least_spacing_m,
                (LARGEST_M - self.end_m[1]) / most_walls,
            ),
            (
                "layout.first_wall_m",
                self.to_first_m(),
                least_spacing_m,
                LARGEST_M - self.end_m[1] - (most_walls - 1.0) * self.spacing_m[1],
            ),
        ] {
            check_range(key, range, smallest, largest)?;
        }
        Ok(())
    }

    fn to_first_m(&self) -> [f32; 2] {
        self.first_wall_m.unwrap_or(self.spacing_m)
    }

    /// Draws a corridor with at least `least_walls` walls, but not more than the ranges allow.
    pub(super) fn draw(&self, least_walls: u8, rng: &mut impl Rng) -> Layout {
        let mut draw = |[least, most]: [f32; 2]| rng.random_range(least..=most);
        let (width_m, height_m) = (draw(self.width_m), draw(self.height_m));
        let start = StartArea {
            offset_m: draw(self.start_offset_m),
            jitter_y_m: draw(self.start_jitter_y_m),
            jitter_z_m: draw(self.start_jitter_z_m),
        };
        let (wall_thickness_m, end_m) = (draw(self.wall_thickness_m), draw(self.end_m));
        let [least, most] = self.walls;
        let walls = rng.random_range(least.max(least_walls).min(most)..=most);
        let mut front_m = 0.0;
        let wall_x_m: Vec<f32> = (0..walls)
            .map(|place| {
                let [least, most] = match place {
                    0 => self.to_first_m(),
                    _ => self.spacing_m,
                };
                front_m += rng.random_range(least..=most);
                front_m
            })
            .collect();
        let slalom = self.slalom.then(|| match rng.random() {
            true => Half::Left,
            false => Half::Right,
        });
        Layout {
            slalom,
            corridor: Corridor {
                length_m: front_m + end_m,
                width_m,
                height_m,
            },
            start,
            wall_x_m,
            wall_thickness_m,
        }
    }

    /// Returns the ranges of the corridor whose openings are the hardest to place: the narrowest
    /// one with the most walls, closest together.
    pub(super) fn hardest(&self) -> Self {
        let [least, most] = [0, 1].map(|end| move |range: [f32; 2]| [range[end]; 2]);
        Self {
            width_m: least(self.width_m),
            height_m: least(self.height_m),
            walls: [self.walls[1]; 2],
            spacing_m: least(self.spacing_m),
            first_wall_m: self.first_wall_m.map(least),
            wall_thickness_m: most(self.wall_thickness_m),
            end_m: least(self.end_m),
            start_offset_m: most(self.start_offset_m),
            start_jitter_y_m: most(self.start_jitter_y_m),
            start_jitter_z_m: most(self.start_jitter_z_m),
            slalom: self.slalom,
        }
    }

    /// Returns the longest corridor, and the start that lies farthest from its end.
    pub(super) fn longest(&self) -> (Corridor, StartArea) {
        let corridor = Corridor {
            length_m: self.to_first_m()[1]
                + f32::from(self.walls[1].saturating_sub(1)) * self.spacing_m[1]
                + self.end_m[1],
            width_m: self.width_m[1],
            height_m: self.height_m[1],
        };
        let start = StartArea {
            offset_m: self.start_offset_m[0],
            jitter_y_m: self.start_jitter_y_m[1],
            jitter_z_m: self.start_jitter_z_m[1],
        };
        (corridor, start)
    }
}
