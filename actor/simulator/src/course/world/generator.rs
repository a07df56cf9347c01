//! Random worlds from a seed: forests, halls, rooms, gates.
//!
//! A pair of numbers holds the least and the largest value, drawn uniformly. A world through which
//! no way leads is drawn again.

use rand::{Rng, RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use serde::{Deserialize, Serialize};

use super::{Region, Sides, WorldFault, WorldLayout};
use crate::course::{
    Corridor, Course, FaultLocation, Motion, Obstacle, ObstacleShape, Opening, Shape,
    check::in_range,
};
use crate::text::exactly;

/// Room without obstacles at the start and at the goal, metres.
const CLEAR_M: f32 = 3.0;

/// Ranges for one kind of world.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum WorldRanges {
    /// Trees.
    Forest(ForestRanges),
    /// Pillars, beams under the ceiling, and what moves between them.
    Hall(HallRanges),
    /// Rooms with doors.
    Rooms(RoomsRanges),
    /// Free-standing frames.
    Gates(GatesRanges),
}

/// A forest: trunks from the ground to the top of the world, with branches.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ForestRanges {
    /// Length, width and height, metres. Default 46, 20 and 6: the goal is 40 m away.
    #[serde(deserialize_with = "exactly")]
    pub size_m: [f32; 3],
    /// Visibility of the sides and the top. Default `closed`.
    pub sides: Sides,
    /// Trees a square metre. Default 1/49 to 1/25.
    #[serde(deserialize_with = "exactly")]
    pub density_per_m2: [f32; 2],
    /// Radius of a trunk, metres. Default 0.1 to 0.35.
    #[serde(deserialize_with = "exactly")]
    pub radius_m: [f32; 2],
    /// Largest lean of a trunk to any side, degrees. Default 10.
    pub lean_deg: f32,
    /// Branches of a tree. Default 0 to 2.
    #[serde(deserialize_with = "exactly")]
    pub branches: [u8; 2],
}

/// A hall with pillars, beams that hang from the ceiling, and moving balls.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct HallRanges {
    /// Length, width and height, metres. Default 40, 14 and 6.
    #[serde(deserialize_with = "exactly")]
    pub size_m: [f32; 3],
    /// Number of pillars. Default 8 to 14.
    #[serde(deserialize_with = "exactly")]
    pub pillars: [u8; 2],
    /// Width of a pillar, metres. Default 0.4 to 1.
    #[serde(deserialize_with = "exactly")]
    pub pillar_m: [f32; 2],
    /// Number of beams across the hall. Default 2 to 5.
    #[serde(deserialize_with = "exactly")]
    pub beams: [u8; 2],
    /// Height of a beam's lower edge as a share of the hall's. Default 0.4 to 0.75.
    #[serde(deserialize_with = "exactly")]
    pub beam_edge: [f32; 2],
    /// Number of balls that move across, to and fro. Default 0.
    #[serde(deserialize_with = "exactly")]
    pub balls: [u8; 2],
    /// Speed of a ball, m/s. Default 0.3 to 1.
    #[serde(deserialize_with = "exactly")]
    pub ball_mps: [f32; 2],
}

/// Rows of rooms, with a door in every wall between two rooms.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RoomsRanges {
    /// Length, width and height, metres. Default 24, 10 and 3.
    #[serde(deserialize_with = "exactly")]
    pub size_m: [f32; 3],
    /// Number of rooms along the way. Default 3 to 4.
    #[serde(deserialize_with = "exactly")]
    pub along: [u8; 2],
    /// Number of rooms side by side. Default 1 to 2.
    #[serde(deserialize_with = "exactly")]
    pub across: [u8; 2],
    /// Width of a door, metres. Default 1.5 to 2.
    #[serde(deserialize_with = "exactly")]
    pub door_m: [f32; 2],
    /// Pieces of furniture in a room. Default 0 to 2.
    #[serde(deserialize_with = "exactly")]
    pub furniture: [u8; 2],
}

/// Square frames that stand in the air, one behind the other.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GatesRanges {
    /// Length, width and height, metres. Default 46, 14 and 7.
    #[serde(deserialize_with = "exactly")]
    pub size_m: [f32; 3],
    /// Number of gates. Default 4 to 7.
    #[serde(deserialize_with = "exactly")]
    pub gates: [u8; 2],
    /// Side of a gate's opening, metres. Default 1.6 to 2.4.
    #[serde(deserialize_with = "exactly")]
    pub opening_m: [f32; 2],
    /// Width of a gate's frame, metres. Default 0.3 to 1.5.
    #[serde(deserialize_with = "exactly")]
    pub frame_m: [f32; 2],
    /// Largest turn of a gate to the left or right, degrees. Default 25.
    pub turn_deg: f32,
}

impl Default for ForestRanges {
    fn default() -> Self {
        Self {
            size_m: [46.0, 20.0, 6.0],
            sides: Sides::Closed,
            density_per_m2: [1.0 / 49.0, 1.0 / 25.0],
            radius_m: [0.1, 0.35],
            lean_deg: 10.0,
            branches: [0, 2],
        }
    }
}

impl Default for HallRanges {
    fn default() -> Self {
        Self {
            size_m: [40.0, 14.0, 6.0],
            pillars: [8, 14],
            pillar_m: [0.4, 1.0],
            beams: [2, 5],
            beam_edge: [0.4, 0.75],
            balls: [0, 0],
            ball_mps: [0.3, 1.0],
        }
    }
}

impl Default for RoomsRanges {
    fn default() -> Self {
        Self {
            size_m: [24.0, 10.0, 3.0],
            along: [3, 4],
            across: [1, 2],
            door_m: [1.5, 2.0],
            furniture: [0, 2],
        }
    }
}

impl Default for GatesRanges {
    fn default() -> Self {
        Self {
            size_m: [46.0, 14.0, 7.0],
            gates: [4, 7],
            opening_m: [1.6, 2.4],
            frame_m: [0.3, 1.5],
            turn_deg: 25.0,
        }
    }
}

/// Generates the world of a seed: the same seed and ranges give the same world.
///
/// # Errors
/// [`WorldFault`] if a range is invalid, or if no world drawn from the ranges can be flown.
pub(in crate::course) fn generate(seed: u64, ranges: &WorldRanges) -> Result<Course, WorldFault> {
    /// Nearly all of the densest forests of the default ranges can be flown.
    const MOST_RETRIES: u32 = 20;

    ranges.check()?;
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let mut retries = 0;
    loop {
        let layout = WorldLayout {
            name: format!("{} {seed}", ranges.name()),
            ..ranges.draw(&mut rng)
        };
        match Course::of_world(layout) {
            Err(last) if retries == MOST_RETRIES => {
                return Err(WorldFault::NothingFits {
                    kind: ranges.name(),
                    last: last.into(),
                });
            }
            Err(_) => retries += 1,
            course => return course,
        }
    }
}

impl WorldRanges {
    /// Returns the name of the section.
    #[must_use]
    pub fn name(&self) -> &'static str {
        match self {
            Self::Forest(_) => "forest",
            Self::Hall(_) => "hall",
            Self::Rooms(_) => "rooms",
            Self::Gates(_) => "gates",
        }
    }

    /// Returns the length of the bounds, metres.
    #[must_use]
    pub fn length_m(&self) -> f32 {
        let size_m = match self {
            Self::Forest(ranges) => ranges.size_m,
            Self::Hall(ranges) => ranges.size_m,
            Self::Rooms(ranges) => ranges.size_m,
            Self::Gates(ranges) => ranges.size_m,
        };
        size_m[0]
    }

    fn draw(&self, rng: &mut Pcg64Mcg) -> WorldLayout {
        match self {
            Self::Forest(ranges) => ranges.draw(rng),
            Self::Hall(ranges) => ranges.draw(rng),
            Self::Rooms(ranges) => ranges.draw(rng),
            Self::Gates(ranges) => ranges.draw(rng),
        }
    }

    fn check(&self) -> Result<(), WorldFault> {
        match self {
            Self::Forest(ranges) => {
                check_size("forest.size_m", ranges.size_m)?;
                check("forest.density_per_m2", ranges.density_per_m2, 0.0, 1.0)?;
                check("forest.radius_m", ranges.radius_m, 0.02, 5.0)?;
                check("forest.lean_deg", [ranges.lean_deg; 2], 0.0, 45.0)?;
                check("forest.branches", ranges.branches.map(f32::from), 0.0, 8.0)
            }
            Self::Hall(ranges) => {
                check_size("hall.size_m", ranges.size_m)?;
                check("hall.pillars", ranges.pillars.map(f32::from), 0.0, 255.0)?;
                check("hall.pillar_m", ranges.pillar_m, 0.02, 5.0)?;
                check("hall.beams", ranges.beams.map(f32::from), 0.0, 255.0)?;
                check("hall.beam_edge", ranges.beam_edge, 0.05, 0.95)?;
                check("hall.balls", ranges.balls.map(f32::from), 0.0, 255.0)?;
                check("hall.ball_mps", ranges.ball_mps, 0.01, 5.0)
            }
            Self::Rooms(ranges) => {
                check_size("rooms.size_m", ranges.size_m)?;
                let [length_m, width_m, _] = ranges.size_m;
                let most = |side_m: f32| (side_m / ROOM_M).floor().min(20.0);
                check(
                    "rooms.along",
                    ranges.along.map(f32::from),
                    1.0,
                    most(length_m),
                )?;
                check(
                    "rooms.across",
                    ranges.across.map(f32::from),
                    1.0,
                    most(width_m),
                )?;
                check("rooms.door_m", ranges.door_m, 1.3, ROOM_M - 0.5)?;
                check(
                    "rooms.furniture",
                    ranges.furniture.map(f32::from),
                    0.0,
                    16.0,
                )
            }
            Self::Gates(ranges) => {
                check_size("gates.size_m", ranges.size_m)?;
                check("gates.gates", ranges.gates.map(f32::from), 0.0, 64.0)?;
                let [_, width_m, height_m] = ranges.size_m;
                check("gates.frame_m", ranges.frame_m, 0.05, 5.0)?;
                let most_m = width_m.min(height_m) - 2.0 * ranges.frame_m[1] - 0.1;
                check("gates.opening_m", ranges.opening_m, 0.5, most_m)?;
                check("gates.turn_deg", [ranges.turn_deg; 2], 0.0, 90.0)
            }
        }
    }
}

/// Least side of a room, metres.
const ROOM_M: f32 = 3.0;

fn check_size(key: &'static str, size_m: [f32; 3]) -> Result<(), WorldFault> {
    let [length_m, width_m, height_m] = size_m;
    let at = FaultLocation::Course;
    in_range(at, key, length_m, 3.0 * CLEAR_M, 500.0)?;
    in_range(at, key, width_m, 3.0, 200.0)?;
    in_range(at, key, height_m, 2.0, 50.0)?;
    Ok(())
}

/// Checks the range `key` against its bounds.
fn check(key: &'static str, range: [f32; 2], least: f32, most: f32) -> Result<(), WorldFault> {
    in_range(FaultLocation::Course, key, range[0], least, most)?;
    in_range(FaultLocation::Course, key, range[1], range[0], most)?;
    Ok(())
}

fn draw([least, most]: [f32; 2], rng: &mut impl Rng) -> f32 {
    rng.random_range(least..=most)
}

fn count([least, most]: [u8; 2], rng: &mut impl Rng) -> u8 {
    rng.random_range(least..=most)
}

/// Returns a world with a start at its beginning and a goal across its end.
fn between_start_and_goal(
    [length_m, width_m, height_m]: [f32; 3],
    sides: Sides,
    obstacles: Vec<Obstacle>,
) -> WorldLayout {
    WorldLayout {
        name: String::new(),
        bounds: Corridor {
            length_m,
            width_m,
            height_m,
        },
        sides,
        start: Region {
            centre_m: [1.5, 0.0, height_m / 2.0],
            size_m: [1.0, width_m / 3.0, height_m / 4.0],
        },
        goal: Region {
            centre_m: [length_m - CLEAR_M / 2.0, 0.0, height_m / 2.0],
            size_m: [CLEAR_M, width_m, height_m],
        },
        obstacles,
    }
}

impl ForestRanges {
    fn draw(&self, rng: &mut Pcg64Mcg) -> WorldLayout {
        let [length_m, width_m, height_m] = self.size_m;
        let between_m = length_m - 2.0 * CLEAR_M;
        let trees = (draw(self.density_per_m2, rng) * between_m * width_m).round() as usize;
        let mut obstacles = Vec::new();
        for _ in 0..trees {
            let at = [
                CLEAR_M + rng.random_range(0.0..=between_m),
                rng.random_range(-width_m / 2.0..=width_m / 2.0),
            ];
            let radius_m = draw(self.radius_m, rng);
            let lean = [0; 2].map(|_| rng.random_range(-self.lean_deg..=self.lean_deg));
            obstacles.push(Obstacle {
                rotation_deg: [lean[0], lean[1], rng.random_range(0.0..=360.0)],
                ..Obstacle::still(
                    ObstacleShape::Cylinder {
                        radius_m,
                        // A leaning trunk still reaches from the ground to the top.
                        height_m: 1.6 * height_m,
                    },
                    [at[0], at[1], height_m / 2.0],
                )
            });
            for _ in 0..count(self.branches, rng) {
                obstacles.push(self.branch(at, radius_m, rng));
            }
        }
        between_start_and_goal(self.size_m, self.sides, obstacles)
    }

    /// Returns a branch from the trunk at `[x, y]` to one side, rising.
    fn branch(&self, [x, y]: [f32; 2], trunk_m: f32, rng: &mut Pcg64Mcg) -> Obstacle {
        let height_m = self.size_m[2];
        let length_m = rng.random_range(0.5..=2.0);
        let (from_upright_deg, yaw_deg) = (
            rng.random_range(45.0f32..=80.0),
            rng.random_range(0.0f32..=360.0),
        );
        let (out, up) = from_upright_deg.to_radians().sin_cos();
        let (left, ahead) = yaw_deg.to_radians().sin_cos();
        let half_m = length_m / 2.0;
        let foot_m = rng.random_range(0.3 * height_m..=0.9 * height_m);
        Obstacle {
            rotation_deg: [0.0, from_upright_deg, yaw_deg],
            ..Obstacle::still(
                ObstacleShape::Cylinder {
                    radius_m: (0.3 * trunk_m).max(0.03),
                    height_m: length_m,
                },
                [
                    x + half_m * out * ahead,
                    y + half_m * out * left,
                    foot_m + half_m * up,
                ],
            )
        }
    }
}

impl HallRanges {
    fn draw(&self, rng: &mut Pcg64Mcg) -> WorldLayout {
        let [length_m, width_m, height_m] = self.size_m;
        let (half_m, along) = (width_m / 2.0, CLEAR_M..=length_m - CLEAR_M);
        let mut obstacles = Vec::new();
        for _ in 0..count(self.pillars, rng) {
            let width_m = draw(self.pillar_m, rng);
            let shape = match rng.random_bool(0.5) {
                true => ObstacleShape::Box {
                    size_m: [width_m, width_m, height_m],
                },
                false => ObstacleShape::Cylinder {
                    radius_m: width_m / 2.0,
                    height_m,
                },
            };
            let place = [
                rng.random_range(along.clone()),
                rng.random_range(-half_m..=half_m),
                height_m / 2.0,
            ];
            obstacles.push(Obstacle {
                rotation_deg: [0.0, 0.0, rng.random_range(0.0..=90.0)],
                ..Obstacle::still(shape, place)
            });
        }
        for _ in 0..count(self.beams, rng) {
            let edge_m = draw(self.beam_edge, rng) * height_m;
            let deep_m = (height_m - edge_m).min(1.0);
            obstacles.push(Obstacle::still(
                ObstacleShape::Box {
                    size_m: [rng.random_range(0.2..=0.5), width_m, deep_m],
                },
                [rng.random_range(along.clone()), 0.0, edge_m + deep_m / 2.0],
            ));
        }
        for _ in 0..count(self.balls, rng) {
            let radius_m = rng.random_range(0.3..=0.6);
            let reach_m = half_m - radius_m;
            let clear_of_start = along.start() + 1.0..=*along.end();
            let from_m = rng.random_range(-reach_m..=0.0);
            obstacles.push(Obstacle {
                motion: Some(Motion::ToAndFro {
                    by_m: [0.0, rng.random_range(0.5 * half_m..=reach_m - from_m), 0.0],
                    speed_mps: draw(self.ball_mps, rng),
                }),
                ..Obstacle::still(
                    ObstacleShape::Sphere { radius_m },
                    [
                        rng.random_range(clear_of_start),
                        from_m,
                        rng.random_range(0.25..=0.75) * height_m,
                    ],
                )
            });
        }
        between_start_and_goal(self.size_m, Sides::Closed, obstacles)
    }
}

impl RoomsRanges {
    fn draw(&self, rng: &mut Pcg64Mcg) -> WorldLayout {
        let [length_m, width_m, _] = self.size_m;
        let (along, across) = (count(self.along, rng), count(self.across, rng));
        let (room_x_m, room_y_m) = (length_m / f32::from(along), width_m / f32::from(across));
        let mut obstacles = Vec::new();
        for x in 0..along {
            for y in 0..across {
                let (left_m, right_m) = (
                    f32::from(x) * room_x_m,
                    f32::from(y) * room_y_m - width_m / 2.0,
                );
                let middle = [left_m + room_x_m / 2.0, right_m + room_y_m / 2.0];
                if x > 0 {
                    obstacles.push(self.wall([left_m, middle[1]], room_y_m, 0.0, rng));
                }
                if y > 0 {
                    obstacles.push(self.wall([middle[0], right_m], room_x_m, 90.0, rng));
                }
                for _ in 0..count(self.furniture, rng) {
                    obstacles.push(self.piece(middle, [room_x_m, room_y_m], rng));
                }
            }
        }
        between_start_and_goal(self.size_m, Sides::Closed, obstacles)
    }

    /// Returns a wall with a door. `yaw_deg`: 0 across the way, 90 along it.
    fn wall(&self, [x, y]: [f32; 2], width_m: f32, yaw_deg: f32, rng: &mut Pcg64Mcg) -> Obstacle {
        const THICKNESS_M: f32 = 0.15;
        const THRESHOLD_M: f32 = 0.03;

        let height_m = self.size_m[2];
        let door_m = draw(self.door_m, rng);
        let beside_m = (width_m - door_m) / 2.0 - 0.1;
        let high_m = (0.75 * height_m).max(1.5);
        let door = Opening {
            shape: Shape::Rectangle {
                width_m: door_m,
                height_m: high_m,
            },
            centre_m: [
                rng.random_range(-beside_m..=beside_m),
                THRESHOLD_M + (high_m - height_m) / 2.0,
            ],
            rotation_deg: 0.0,
        };
        Obstacle {
            rotation_deg: [0.0, 0.0, yaw_deg],
            ..Obstacle::still(
                ObstacleShape::Wall {
                    size_m: [THICKNESS_M, width_m, height_m],
                    openings: vec![door],
                },
                [x, y, height_m / 2.0],
            )
        }
    }

    /// Returns a cupboard or a lamp in a room around `middle`.
    fn piece(&self, middle: [f32; 2], room_m: [f32; 2], rng: &mut Pcg64Mcg) -> Obstacle {
        let height_m = self.size_m[2];
        let place = [0, 1].map(|axis| middle[axis] + rng.random_range(-0.4..=0.4) * room_m[axis]);
        let size_m = [
            rng.random_range(0.3..=1.0),
            rng.random_range(0.3..=1.0),
            rng.random_range(0.2..=0.7) * height_m,
        ];
        let centre_z_m = match rng.random_bool(0.7) {
            true => size_m[2] / 2.0,
            false => height_m - size_m[2] / 2.0,
        };
        Obstacle::still(
            ObstacleShape::Box { size_m },
            [place[0], place[1], centre_z_m],
        )
    }
}

impl GatesRanges {
    fn draw(&self, rng: &mut Pcg64Mcg) -> WorldLayout {
        const THICKNESS_M: f32 = 0.2;

        let [length_m, width_m, height_m] = self.size_m;
        let gates = count(self.gates, rng);
        let spacing_m = (length_m - 2.0 * CLEAR_M) / f32::from(gates + 1);
        let mut gate = |number: u8| {
            let opening_m = draw(self.opening_m, rng);
            let side_m = opening_m + 2.0 * draw(self.frame_m, rng);
            let opening = Opening {
                shape: Shape::Rectangle {
                    width_m: opening_m,
                    height_m: opening_m,
                },
                centre_m: [0.0; 2],
                rotation_deg: 0.0,
            };
            let mut off = |room_m: f32| {
                let most_m = ((room_m - side_m) / 2.0).max(0.0);
                rng.random_range(-most_m..=most_m)
            };
            let place = [
                CLEAR_M + spacing_m * f32::from(number),
                off(width_m),
                height_m / 2.0 + off(height_m),
            ];
            Obstacle {
                rotation_deg: [0.0, 0.0, rng.random_range(-self.turn_deg..=self.turn_deg)],
                ..Obstacle::still(
                    ObstacleShape::Wall {
                        size_m: [THICKNESS_M, side_m, side_m],
                        openings: vec![opening],
                    },
                    place,
                )
            }
        };
        let obstacles = (1..=gates).map(&mut gate).collect();
        between_start_and_goal(self.size_m, Sides::Closed, obstacles)
    }
}
