//! Courses as TOML files.
//!
//! Walls are defined once, each under its label; `order` puts them into the corridor at the places `wall_x_m`. So a
//! rearranged course is a changed line of data. A file that is refused is refused by file, wall and key.

use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::{Corridor, Course, CourseFault, CourseLayout, Opening, Place, Shape, StartArea, WallLabel, WallLayout};

/// Why a course file cannot be flown.
#[derive(Debug, thiserror::Error)]
pub enum CourseError {
    /// The file cannot be read.
    #[error("{}: cannot be read", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// Not TOML, an unknown key, or a value of the wrong kind; the message shows the line.
    #[error("{}: {place}: {source}", path.display())]
    Syntax {
        /// The file.
        path: PathBuf,
        /// The wall whose definition holds the line.
        place: Place,
        /// What and where.
        source: toml::de::Error,
    },
    /// The file says something that cannot be flown.
    #[error("{}: {source}", path.display())]
    Fault {
        /// The file.
        path: PathBuf,
        /// What and where.
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
        let text = std::fs::read_to_string(path).map_err(|source| CourseError::Read {
            path: path.to_owned(),
            source,
        })?;
        Self::parse(&text, path)
    }

    /// Reads a course from the text of a course file. `path` is named in errors only.
    ///
    /// # Errors
    /// As [`Course::load`].
    pub fn parse(text: &str, path: impl AsRef<Path>) -> Result<Self, CourseError> {
        let path = path.as_ref();
        let file: CourseFile = toml::from_str(text).map_err(|source| CourseError::Syntax {
            path: path.to_owned(),
            place: source.span().map_or(Place::Course, |span| place_of(text, span.start)),
            source,
        })?;
        file.layout().and_then(Self::new).map_err(|source| CourseError::Fault {
            path: path.to_owned(),
            source,
        })
    }
}

/// A course file as it is written.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct CourseFile {
    name: String,
    order: Vec<WallLabel>,
    wall_x_m: Vec<f32>,
    wall_thickness_m: f32,
    corridor: Corridor,
    start: StartArea,
    wall: Vec<WallEntry>,
}

/// A `[[wall]]`: which of the optional keys must be there depends on the shape.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct WallEntry {
    label: WallLabel,
    shape: ShapeName,
    centre_m: [f32; 2],
    #[serde(default)]
    rotation_deg: f32,
    width_m: Option<f32>,
    height_m: Option<f32>,
    diameter_m: Option<f32>,
    arm_m: Option<f32>,
    points_m: Option<Vec<[f32; 2]>>,
}

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

impl WallEntry {
    fn opening(mut self) -> Result<Opening, CourseFault> {
        let shape = self.take_shape()?;
        self.refuse_foreign_keys()?;
        Ok(Opening {
            shape,
            centre_m: self.centre_m,
            rotation_deg: self.rotation_deg,
        })
    }

    /// Takes the keys of the shape, so that those left over are foreign to it.
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
                points_m: points_m.take().ok_or(CourseFault::MissingKey {
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

/// The wall in whose `[[wall]]` table the byte lies.
fn place_of(text: &str, byte: usize) -> Place {
    /// Only what is needed to name a wall; everything else may be wrong.
    #[derive(Deserialize)]
    struct Labels {
        #[serde(default)]
        wall: Vec<Labelled>,
    }
    #[derive(Deserialize)]
    struct Labelled {
        label: WallLabel,
    }

    let line_end = text[byte..].find('\n').map_or(text.len(), |end| byte + end);
    let headers = text[..line_end]
        .lines()
        .map(str::trim_start)
        .filter(|line| line.starts_with('['));
    let mut walls_begun = 0;
    let mut in_wall = false;
    for header in headers {
        in_wall = header.starts_with("[[wall]]");
        walls_begun += usize::from(in_wall);
    }
    let labels = toml::from_str::<Labels>(text)
        .map(|labels| labels.wall)
        .unwrap_or_default();
    match labels.get(walls_begun.wrapping_sub(1)) {
        Some(wall) if in_wall => Place::Wall(wall.label),
        _ => Place::Course,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GOOD: &str = r#"
name = "two walls"
order = [7, 4]
wall_x_m = [10.0, 20.0]
wall_thickness_m = 0.3
[corridor]
length_m = 30.0
width_m = 6.0
height_m = 7.0
[start]
offset_m = 1.5
jitter_y_m = 0.5
jitter_z_m = 0.5
[[wall]]
label = 4
shape = "rectangle"
centre_m = [1.0, 3.0]
width_m = 2.0
height_m = 2.5
[[wall]]
label = 7
shape = "circle"
centre_m = [-1.0, 4.0]
diameter_m = 2.2
"#;

    fn refusal(from: &str, to: &str) -> String {
        assert!(GOOD.contains(from), "{from} is not in the file");
        let text = GOOD.replacen(from, to, 1);
        match Course::parse(&text, "configs/courses/x.toml") {
            Ok(_) => panic!("{to} was accepted"),
            Err(error) => error.to_string(),
        }
    }

    #[track_caller]
    fn assert_says(message: &str, parts: &[&str]) {
        assert!(message.starts_with("configs/courses/x.toml: "), "{message}");
        for part in parts {
            assert!(message.contains(part), "{part:?} is missing in: {message}");
        }
    }

    #[test]
    fn order_puts_walls_into_the_corridor() {
        let course = Course::parse(GOOD, "x.toml").unwrap();
        let placed: Vec<_> = course.walls().iter().map(|wall| (wall.label().0, wall.x_m())).collect();
        assert_eq!(placed, [(7, 10.0), (4, 20.0)]);
        assert_eq!(course.levels(), 2);
    }

    #[test]
    fn an_unknown_key_is_named_with_its_wall_and_line() {
        let message = refusal("diameter_m = 2.2", "diameter_m = 2.2\nradius_m = 1.1");
        assert_says(&message, &["wall 7", "radius_m", "unknown field", "line 25"]);
        assert_says(&refusal("name =", "nmae = 3\nname ="), &["course", "nmae", "line 2"]);
    }

    #[test]
    fn keys_are_those_of_the_shape() {
        assert_says(&refusal("diameter_m = 2.2", ""), &["wall 7", "diameter_m is missing"]);
        let foreign = refusal("diameter_m = 2.2", "diameter_m = 2.2\narm_m = 1.0");
        assert_says(&foreign, &["wall 7", "arm_m does not belong to a circle", "remove it"]);
    }

    #[test]
    fn an_opening_smaller_than_the_drone_is_refused() {
        assert_says(
            &refusal("width_m = 2.0", "width_m = 0.4"),
            &["wall 4", "width_m = 0.4 m", "narrower than the drone"],
        );
        assert_says(
            &refusal("width_m = 2.0", "width_m = 1.1"),
            &["wall 4", "radius of 0.55 m", "enlarge"],
        );
    }

    #[test]
    fn an_opening_over_the_rim_is_refused() {
        assert_says(
            &refusal("[1.0, 3.0]", "[2.0, 3.0]"),
            &["wall 4", "y = 3.00 m", "centre_m"],
        );
        assert_says(
            &refusal("[-1.0, 4.0]", "[-1.0, 0.8]"),
            &["wall 7", "0.1 m <= z <= 6.90 m"],
        );
    }

    #[test]
    fn a_polygon_that_crosses_itself_is_refused() {
        let bow_tie = "shape = \"polygon\"\npoints_m = [[-1.5, -1.5], [1.5, 1.5], [1.5, -1.5], [-1.5, 1.5]]\n";
        let text = bow_tie.to_owned() + "centre_m = [0.0, 3.0]";
        let message = refusal("shape = \"circle\"\ncentre_m = [-1.0, 4.0]\ndiameter_m = 2.2", &text);
        assert_says(&message, &["wall 7", "crosses or touches itself (edges 1 and 3)"]);
    }

    #[test]
    fn walls_too_close_or_outside_are_refused() {
        assert_says(
            &refusal("[10.0, 20.0]", "[10.0, 14.0]"),
            &["wall 4", "leaves 2.50 m", "move the wall back"],
        );
        assert_says(&refusal("[10.0, 20.0]", "[10.0, 29.5]"), &["wall 4", "wall_x_m = 29.5"]);
        assert_says(&refusal("[10.0, 20.0]", "[20.0, 10.0]"), &["wall 4", "wall_x_m"]);
    }

    #[test]
    fn order_must_match_walls_and_places() {
        assert_says(&refusal("[7, 4]", "[7, 5]"), &["order names wall 5"]);
        assert_says(&refusal("[7, 4]", "[7, 7]"), &["wall 7", "order"]);
        assert_says(&refusal("[7, 4]", "[7]"), &["order has 1 walls and wall_x_m 2 places"]);
        assert_says(&refusal("label = 7", "label = 4"), &["wall 4", "label"]);
    }

    #[test]
    fn numbers_that_are_none_are_refused() {
        for key in ["length_m", "offset_m", "wall_thickness_m", "rotation_deg"] {
            let text = match key {
                "length_m" => GOOD.replace("length_m = 30.0", "length_m = nan"),
                "offset_m" => GOOD.replace("offset_m = 1.5", "offset_m = inf"),
                "wall_thickness_m" => GOOD.replace("wall_thickness_m = 0.3", "wall_thickness_m = -0.3"),
                _ => GOOD.replace("diameter_m", "rotation_deg = nan\ndiameter_m"),
            };
            let error = Course::parse(&text, "x.toml").unwrap_err().to_string();
            assert!(error.contains(key), "{error}");
        }
        assert_says(&refusal("[10.0, 20.0]", "[10.0, nan]"), &["wall 4", "NaN"]);
        assert_says(&refusal("[-1.0, 4.0]", "[nan, 4.0]"), &["wall 7", "centre_m = NaN"]);
    }
}
