//! World files, in TOML. An error names the file, the obstacle and the key.

use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::mesh_file::{self, MeshScale};
use super::{Region, Sides, WorldFault, WorldLayout, WorldRanges};
use crate::course::file::Corner;
use crate::course::{
    Corridor, Course, CourseError, CourseFault, Motion, Obstacle, ObstacleShape, Opening, Shape,
};
use crate::text::{exactly, fits_in_a_table, parse_whole};

/// Returns `true` if the text of a course file describes a world.
pub(in crate::course) fn is_world(text: &str) -> bool {
    let keys = ["bounds", "generated"];
    toml::from_str::<toml::Table>(text)
        .is_ok_and(|table| keys.iter().any(|key| table.contains_key(*key)))
        || text.lines().any(|line| {
            let line = line.trim_start();
            line.starts_with("[bounds]") || line.starts_with("[generated")
        })
}

/// Reads a world from the text of a world file at `path`; mesh files lie relative to it.
///
/// # Errors
/// [`CourseError`] names the file, the obstacle and the key.
pub(in crate::course) fn parse(text: &str, path: &Path) -> Result<Course, CourseError> {
    let file: WorldFile =
        parse_whole(text).map_err(|error| CourseError::syntax(path, text, &error))?;
    let folder = path.parent().unwrap_or(Path::new(""));
    file.course(folder).map_err(|source| CourseError::World {
        path: path.to_owned(),
        source,
    })
}

/// Returns the mesh files that the text of a course file names.
pub(in crate::course) fn mesh_files(text: &str) -> Vec<PathBuf> {
    let table: toml::Table = toml::from_str(text).unwrap_or_default();
    let obstacles = table.get("obstacle").and_then(toml::Value::as_array);
    let file = |obstacle: &toml::Value| Some(obstacle.get("file")?.as_str()?.into());
    obstacles.into_iter().flatten().filter_map(file).collect()
}

/// Contents of a world file: obstacles one by one, or the section `generated`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct WorldFile {
    name: String,
    generated: Option<GeneratedTable>,
    bounds: Option<BoundsTable>,
    start: Option<RegionTable>,
    goal: Option<RegionTable>,
    #[serde(default)]
    obstacle: Vec<ObstacleTable>,
}

/// Section `[generated]`: a world drawn from ranges.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct GeneratedTable {
    seed: u64,
    world: WorldRanges,
}

/// Section `[bounds]`.
#[derive(Clone, Copy, Deserialize)]
#[serde(deny_unknown_fields)]
struct BoundsTable {
    length_m: f32,
    width_m: f32,
    height_m: f32,
    #[serde(default)]
    sides: Sides,
}

/// Sections `[start]` and `[goal]`.
#[derive(Clone, Copy, Deserialize)]
#[serde(deny_unknown_fields)]
struct RegionTable {
    #[serde(deserialize_with = "exactly")]
    centre_m: [f32; 3],
    #[serde(deserialize_with = "exactly")]
    size_m: [f32; 3],
}

/// Contents of an `[[obstacle]]` table. The shape decides which of the optional keys it needs.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ObstacleTable {
    shape: ShapeName,
    #[serde(deserialize_with = "exactly")]
    centre_m: [f32; 3],
    #[serde(default, deserialize_with = "exactly")]
    rotation_deg: [f32; 3],
    size_m: Option<Numbers>,
    radius_m: Option<f32>,
    height_m: Option<f32>,
    file: Option<PathBuf>,
    scale: Option<f32>,
    up: Option<UpAxis>,
    with_holes: Option<bool>,
    opening: Option<Vec<OpeningTable>>,
    motion: Option<MotionTable>,
}

/// Three numbers.
#[derive(Clone, Copy, Deserialize)]
struct Numbers(#[serde(deserialize_with = "exactly")] [f32; 3]);

#[derive(Clone, Copy, Deserialize)]
#[serde(rename_all = "lowercase")]
enum ShapeName {
    Box,
    Cylinder,
    Sphere,
    Wall,
    Mesh,
}

/// Axis of a mesh file that points up.
#[derive(Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum UpAxis {
    Y,
    Z,
}

/// Contents of an `opening` of a wall: a rectangle, or a polygon with `points_m`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct OpeningTable {
    #[serde(deserialize_with = "exactly")]
    centre_m: [f32; 2],
    #[serde(default)]
    rotation_deg: f32,
    width_m: Option<f32>,
    height_m: Option<f32>,
    diameter_m: Option<f32>,
    points_m: Option<Vec<Corner>>,
}

/// Contents of a `motion`.
#[derive(Clone, Copy, Deserialize)]
#[serde(deny_unknown_fields)]
struct MotionTable {
    way: MotionName,
    speed_mps: f32,
    by_m: Option<Numbers>,
    radius_m: Option<f32>,
}

#[derive(Clone, Copy, Deserialize)]
#[serde(rename_all = "snake_case")]
enum MotionName {
    ToAndFro,
    Circle,
    Across,
}

impl WorldFile {
    fn course(self, folder: &Path) -> Result<Course, WorldFault> {
        if !fits_in_a_table(&self.name) {
            return Err(CourseFault::Name { name: self.name }.into());
        }
        let Some(generated) = self.generated else {
            return Course::of_world(self.layout(folder)?);
        };
        let by_hand = [
            ("bounds", self.bounds.is_some()),
            ("start", self.start.is_some()),
            ("goal", self.goal.is_some()),
            ("obstacle", !self.obstacle.is_empty()),
        ];
        if let Some((key, _)) = by_hand.into_iter().find(|(_, given)| *given) {
            return Err(WorldFault::GeneratedBeside { key });
        }
        let course = super::generate(generated.seed, &generated.world)?;
        Ok(Course {
            name: self.name,
            ..course
        })
    }

    fn layout(self, folder: &Path) -> Result<WorldLayout, WorldFault> {
        let missing = |section| WorldFault::MissingSection { section };
        let bounds = self.bounds.ok_or_else(|| missing("bounds"))?;
        let region = |table: Option<RegionTable>, section| {
            let RegionTable { centre_m, size_m } = table.ok_or_else(|| missing(section))?;
            Ok::<_, WorldFault>(Region { centre_m, size_m })
        };
        let obstacles = self.obstacle.into_iter().zip(1..);
        Ok(WorldLayout {
            name: self.name,
            bounds: Corridor {
                length_m: bounds.length_m,
                width_m: bounds.width_m,
                height_m: bounds.height_m,
            },
            sides: bounds.sides,
            start: region(self.start, "start")?,
            goal: region(self.goal, "goal")?,
            obstacles: obstacles
                .map(|(table, number)| table.obstacle(number, folder))
                .collect::<Result<_, _>>()?,
        })
    }
}

/// Takes the keys of one `[[obstacle]]` or of its motion.
struct Keys {
    obstacle: usize,
    shape: &'static str,
    needed: &'static str,
}

impl Keys {
    fn need<T>(&self, key: &'static str, value: &mut Option<T>) -> Result<T, WorldFault> {
        value.take().ok_or(WorldFault::MissingKey {
            obstacle: self.obstacle,
            key,
            shape: self.shape,
            needed: self.needed,
        })
    }

    /// Refuses a key that was given but not taken.
    fn refuse_others<const N: usize>(
        &self,
        left: [(&'static str, bool); N],
    ) -> Result<(), WorldFault> {
        match left.into_iter().find(|(_, given)| *given) {
            Some((key, _)) => Err(WorldFault::ForeignKey {
                obstacle: self.obstacle,
                key,
                shape: self.shape,
                needed: self.needed,
            }),
            None => Ok(()),
        }
    }
}

impl ObstacleTable {
    fn obstacle(mut self, obstacle: usize, folder: &Path) -> Result<Obstacle, WorldFault> {
        let keys = Keys {
            obstacle,
            shape: self.shape.name(),
            needed: self.shape.keys(),
        };
        let shape = self.take_shape(&keys, folder)?;
        keys.refuse_others([
            ("size_m", self.size_m.is_some()),
            ("radius_m", self.radius_m.is_some()),
            ("height_m", self.height_m.is_some()),
            ("file", self.file.is_some()),
            ("scale", self.scale.is_some()),
            ("up", self.up.is_some()),
            ("with_holes", self.with_holes.is_some()),
            ("opening", self.opening.is_some()),
        ])?;
        Ok(Obstacle {
            shape,
            centre_m: self.centre_m,
            rotation_deg: self.rotation_deg,
            motion: self
                .motion
                .map(|motion| motion.motion(obstacle))
                .transpose()?,
        })
    }

    fn take_shape(&mut self, keys: &Keys, folder: &Path) -> Result<ObstacleShape, WorldFault> {
        Ok(match self.shape {
            ShapeName::Box => ObstacleShape::Box {
                size_m: keys.need("size_m", &mut self.size_m)?.0,
            },
            ShapeName::Cylinder => ObstacleShape::Cylinder {
                radius_m: keys.need("radius_m", &mut self.radius_m)?,
                height_m: keys.need("height_m", &mut self.height_m)?,
            },
            ShapeName::Sphere => ObstacleShape::Sphere {
                radius_m: keys.need("radius_m", &mut self.radius_m)?,
            },
            ShapeName::Wall => {
                let openings = self.opening.take().unwrap_or_default().into_iter().zip(1..);
                ObstacleShape::Wall {
                    size_m: keys.need("size_m", &mut self.size_m)?.0,
                    openings: openings
                        .map(|(table, number)| table.opening(keys.obstacle, number))
                        .collect::<Result<_, _>>()?,
                }
            }
            ShapeName::Mesh => {
                let path = folder.join(keys.need("file", &mut self.file)?);
                let scale = MeshScale {
                    factor: self.scale.take().unwrap_or(1.0),
                    up: self.up.take().unwrap_or(UpAxis::Z),
                    with_holes: self.with_holes.take().unwrap_or(false),
                };
                let mesh =
                    mesh_file::load(&path, scale).map_err(|problem| WorldFault::MeshFile {
                        obstacle: keys.obstacle,
                        path,
                        problem,
                    })?;
                ObstacleShape::Mesh(mesh.into())
            }
        })
    }
}

impl OpeningTable {
    fn opening(self, obstacle: usize, opening: usize) -> Result<Opening, WorldFault> {
        let shape = match (self.width_m, self.height_m, self.diameter_m, self.points_m) {
            (Some(width_m), Some(height_m), None, None) => Shape::Rectangle { width_m, height_m },
            (None, None, Some(diameter_m), None) => Shape::Circle { diameter_m },
            (None, None, None, Some(corners)) => Shape::Polygon {
                points_m: corners.into_iter().map(|Corner(place)| place).collect(),
            },
            _ => {
                return Err(WorldFault::Opening {
                    obstacle,
                    opening,
                    problem: "needs width_m and height_m, or diameter_m, or points_m, and no other",
                });
            }
        };
        Ok(Opening {
            shape,
            centre_m: self.centre_m,
            rotation_deg: self.rotation_deg,
        })
    }
}

impl MotionTable {
    fn motion(mut self, obstacle: usize) -> Result<Motion, WorldFault> {
        let keys = Keys {
            obstacle,
            shape: self.way.name(),
            needed: self.way.keys(),
        };
        let speed_mps = self.speed_mps;
        let motion = match self.way {
            MotionName::ToAndFro => Motion::ToAndFro {
                by_m: keys.need("motion.by_m", &mut self.by_m)?.0,
                speed_mps,
            },
            MotionName::Across => Motion::Across {
                by_m: keys.need("motion.by_m", &mut self.by_m)?.0,
                speed_mps,
            },
            MotionName::Circle => Motion::Circle {
                radius_m: keys.need("motion.radius_m", &mut self.radius_m)?,
                speed_mps,
            },
        };
        keys.refuse_others([
            ("motion.by_m", self.by_m.is_some()),
            ("motion.radius_m", self.radius_m.is_some()),
        ])?;
        Ok(motion)
    }
}

impl ShapeName {
    fn name(self) -> &'static str {
        match self {
            Self::Box => "box",
            Self::Cylinder => "cylinder",
            Self::Sphere => "sphere",
            Self::Wall => "wall",
            Self::Mesh => "mesh",
        }
    }

    fn keys(self) -> &'static str {
        match self {
            Self::Box => "size_m",
            Self::Cylinder => "radius_m, height_m",
            Self::Sphere => "radius_m",
            Self::Wall => "size_m and, if it is open, opening",
            Self::Mesh => "file and, if needed, scale, up, with_holes",
        }
    }
}

impl MotionName {
    fn name(self) -> &'static str {
        match self {
            Self::ToAndFro => "motion to_and_fro",
            Self::Circle => "motion circle",
            Self::Across => "motion across",
        }
    }

    fn keys(self) -> &'static str {
        match self {
            Self::ToAndFro | Self::Across => "by_m, speed_mps",
            Self::Circle => "radius_m, speed_mps",
        }
    }
}
