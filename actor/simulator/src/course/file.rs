//! Course files, in TOML.
//!
//! A file defines each wall once, under its label. `order` puts the walls into the corridor at the
//! positions `wall_x_m`, so a rearranged course differs in one line. An error names the file, the
//! wall and the key.

use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::source_location::SourceLocation;
use super::{
    Corridor, Course, CourseFault, CourseLayout, FaultLocation, Opening, Shape, StartArea,
    WallLabel, WallLayout, WorldFault, world,
};
use crate::text::{exactly, fits_in_a_table, message_of, parse_whole, read_text};

/// Reason why a course file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum CourseError {
    /// The file cannot be read.
    #[error("{}: cannot be read", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The file is not TOML, or has an unknown key or a value of the wrong kind.
    #[error("{}: {location}: line {line}: {message}", path.display())]
    Syntax {
        /// The file.
        path: PathBuf,
        /// The wall or obstacle whose definition holds the line.
        location: FaultLocation,
        /// The line, from 1.
        line: usize,
        /// The key and the problem on one line; the parser's own error takes several.
        message: String,
    },
    /// The file describes a world that cannot be flown.
    #[error("{}: {source}", path.display())]
    World {
        /// The file.
        path: PathBuf,
        /// The fault.
        source: WorldFault,
    },
    /// The file describes a course that cannot be flown.
    #[error("{}: {source}", path.display())]
    Fault {
        /// The file.
        path: PathBuf,
        /// The fault.
        source: CourseFault,
    },
}

impl Course {
    /// Reads a course file.
    ///
    /// # Errors
    /// [`CourseError`] names the file, the wall and the key, and says what to change.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, CourseError> {
        let path = path.as_ref();
        let text = read_text(path).map_err(|source| CourseError::Read {
            path: path.to_owned(),
            source,
        })?;
        Self::parse(&text, path)
    }

    /// Returns the mesh files that the course file `path` names, as they stand there.
    ///
    /// # Errors
    /// As [`Course::load`], if the file cannot be read.
    pub fn mesh_files(path: impl AsRef<Path>) -> Result<Vec<PathBuf>, CourseError> {
        let path = path.as_ref();
        let text = read_text(path).map_err(|source| CourseError::Read {
            path: path.to_owned(),
            source,
        })?;
        Ok(world::mesh_files(&text))
    }

    /// Reads a course from the text of a course file. `path` serves errors only.
    ///
    /// # Errors
    /// Like [`Course::load`].
    pub fn parse(text: &str, path: impl AsRef<Path>) -> Result<Self, CourseError> {
        let path = path.as_ref();
        if world::is_world(text) {
            return world::parse(text, path);
        }
        let file: CourseFile =
            parse_whole(text).map_err(|error| CourseError::syntax(path, text, &error))?;
        file.layout()
            .and_then(Self::new)
            .map_err(|source| CourseError::Fault {
                path: path.to_owned(),
                source,
            })
    }
}

impl CourseError {
    /// Converts the parser's error to one that names the wall or obstacle and the key.
    pub(super) fn syntax(path: &Path, text: &str, error: &toml::de::Error) -> Self {
        let SourceLocation {
            line,
            location,
            key,
        } = SourceLocation::of(error.span().unwrap_or_default(), text);
        let problem = message_of(text, error);
        let message = match key {
            Some(key) if !problem.contains(&format!("`{key}`")) => format!("key {key}: {problem}"),
            _ => problem,
        };
        Self::Syntax {
            path: path.to_owned(),
            location,
            line,
            message,
        }
    }
}

/// Contents of a course file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct CourseFile {
    name: String,
    order: Vec<WallLabel>,
    wall_x_m: Vec<f32>,
    wall_thickness_m: f32,
    corridor: Corridor,
    start: StartArea,
    wall: Vec<WallTable>,
}

/// Contents of a `[[wall]]` table. The shape decides which of the optional keys it needs.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct WallTable {
    label: WallLabel,
    shape: ShapeName,
    #[serde(deserialize_with = "exactly")]
    centre_m: [f32; 2],
    #[serde(default)]
    rotation_deg: f32,
    width_m: Option<f32>,
    height_m: Option<f32>,
    diameter_m: Option<f32>,
    arm_m: Option<f32>,
    points_m: Option<Vec<Corner>>,
}

/// Corner `[y, z]` of a polygon.
#[derive(Deserialize)]
pub(super) struct Corner(#[serde(deserialize_with = "exactly")] pub(super) [f32; 2]);

#[derive(Clone, Copy, Deserialize)]
#[serde(rename_all = "lowercase")]
enum ShapeName {
    Rectangle,
    Circle,
    Triangle,
    Diamond,
    Cross,
    L,
    Polygon,
}

impl CourseFile {
    fn layout(self) -> Result<CourseLayout, CourseFault> {
        if !fits_in_a_table(&self.name) {
            return Err(CourseFault::Name { name: self.name });
        }
        if self.order.len() != self.wall_x_m.len() {
            let (order, places) = (self.order.len(), self.wall_x_m.len());
            return Err(CourseFault::OrderLength { order, places });
        }
        let mut defined: Vec<(WallLabel, Opening)> = Vec::new();
        for entry in self.wall {
            let wall = entry.label;
            if defined.iter().any(|(label, _)| *label == wall) {
                return Err(CourseFault::RepeatedWall { wall, key: "label" });
            }
            defined.push((wall, entry.opening()?));
        }
        let walls = self
            .order
            .into_iter()
            .zip(self.wall_x_m)
            .map(|(label, x_m)| {
                let (_, opening) = defined
                    .iter()
                    .find(|(other, _)| *other == label)
                    .ok_or(CourseFault::UnknownWall { wall: label })?;
                Ok(WallLayout {
                    label,
                    x_m,
                    opening: opening.clone(),
                })
            })
            .collect::<Result<_, _>>()?;
        Ok(CourseLayout {
            name: self.name,
            corridor: self.corridor,
            start: self.start,
            wall_thickness_m: self.wall_thickness_m,
            walls,
        })
    }
}

impl WallTable {
    fn opening(mut self) -> Result<Opening, CourseFault> {
        let shape = self.take_shape()?;
        self.refuse_foreign_keys()?;
        Ok(Opening {
            shape,
            centre_m: self.centre_m,
            rotation_deg: self.rotation_deg,
        })
    }

    /// Takes the keys of the shape out of the table; the keys that remain do not belong to it.
    fn take_shape(&mut self) -> Result<Shape, CourseFault> {
        let (wall, shape) = (self.label, self.shape);
        let need = |key: &'static str, value: Option<f32>| {
            value.ok_or(CourseFault::MissingKey {
                wall,
                key,
                shape: shape.name(),
                needed: shape.keys(),
            })
        };
        let Self {
            width_m,
            height_m,
            diameter_m,
            arm_m,
            points_m,
            ..
        } = self;
        let points_m = points_m
            .take()
            .map(|corners| corners.into_iter().map(|Corner(place)| place).collect());
        Ok(match shape {
            ShapeName::Rectangle => Shape::Rectangle {
                width_m: need("width_m", width_m.take())?,
                height_m: need("height_m", height_m.take())?,
            },
            ShapeName::Triangle => Shape::Triangle {
                width_m: need("width_m", width_m.take())?,
                height_m: need("height_m", height_m.take())?,
            },
            ShapeName::Diamond => Shape::Diamond {
                width_m: need("width_m", width_m.take())?,
                height_m: need("height_m", height_m.take())?,
            },
            ShapeName::Cross => Shape::Cross {
                width_m: need("width_m", width_m.take())?,
                height_m: need("height_m", height_m.take())?,
                arm_m: need("arm_m", arm_m.take())?,
            },
            ShapeName::L => Shape::L {
                width_m: need("width_m", width_m.take())?,
                height_m: need("height_m", height_m.take())?,
                arm_m: need("arm_m", arm_m.take())?,
            },
            ShapeName::Circle => Shape::Circle {
                diameter_m: need("diameter_m", diameter_m.take())?,
            },
            ShapeName::Polygon => Shape::Polygon {
                points_m: points_m
                    .map(without_closing_corner)
                    .ok_or(CourseFault::MissingKey {
                        wall,
                        key: "points_m",
                        shape: shape.name(),
                        needed: shape.keys(),
                    })?,
            },
        })
    }

    fn refuse_foreign_keys(&self) -> Result<(), CourseFault> {
        let left_over = [
            ("width_m", self.width_m.is_some()),
            ("height_m", self.height_m.is_some()),
            ("diameter_m", self.diameter_m.is_some()),
            ("arm_m", self.arm_m.is_some()),
            ("points_m", self.points_m.is_some()),
        ];
        match left_over.into_iter().find(|(_, given)| *given) {
            Some((key, _)) => Err(CourseFault::ForeignKey {
                wall: self.label,
                key,
                shape: self.shape.name(),
                needed: self.shape.keys(),
            }),
            None => Ok(()),
        }
    }
}

/// Returns the corners of a polygon without a last one that repeats the first: other programs write
/// polygons as closed rings.
fn without_closing_corner(mut points_m: Vec<[f32; 2]>) -> Vec<[f32; 2]> {
    if points_m.len() > 3 && points_m.first() == points_m.last() {
        points_m.pop();
    }
    points_m
}

impl ShapeName {
    fn name(self) -> &'static str {
        match self {
            Self::Rectangle => "rectangle",
            Self::Circle => "circle",
            Self::Triangle => "triangle",
            Self::Diamond => "diamond",
            Self::Cross => "cross",
            Self::L => "l",
            Self::Polygon => "polygon",
        }
    }

    fn keys(self) -> &'static str {
        match self {
            Self::Rectangle | Self::Triangle | Self::Diamond => "width_m, height_m",
            Self::Cross | Self::L => "width_m, height_m, arm_m",
            Self::Circle => "diameter_m",
            Self::Polygon => "points_m",
        }
    }
}

#[cfg(test)]
mod tests;
