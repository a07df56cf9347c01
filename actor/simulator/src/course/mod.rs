//! Courses: a corridor, its walls and their openings, in the order in which the drone meets them;
//! or a world of obstacles between a start and a goal.
//!
//! Every [`Course`] can be flown: [`Course::new`] refuses anything else and names the wall, the key
//! and the remedy. So neither the physics nor the camera checks again. The drone sees and hits the
//! same mesh of surfaces.
//!
//! World frame: x forward along the corridor from 0, y to the left from the middle, z up from the
//! floor; metres.

mod check;
mod fault;
mod file;
mod generator;
mod mesh;
mod motion;
mod obstacle;
mod opening;
pub(crate) mod polygon;
mod source_location;
mod world;

use std::fmt;
use std::sync::Arc;

use nalgebra::Point3;
use rand::{Rng, RngExt};
use serde::{Deserialize, Serialize};

pub use fault::{CourseFault, FaultLocation, NoSuchLevel};
pub use file::CourseError;
pub use generator::{GeneratedShape, GeneratorRanges, LayoutRanges, RangesError};
pub(crate) use mesh::{Mesh, MeshSurface, SurfaceKind};
pub use motion::{Moment, Motion};
pub use obstacle::{Obstacle, ObstacleShape, ROUND_SIDES, TriangleMesh};
pub use opening::{CIRCLE_SIDES, Opening, Shape};
pub use world::{
    ForestRanges, GatesRanges, HallRanges, MAX_OBSTACLES, MAX_TRIANGLES, Region, RoomsRanges,
    STAGES, Sides, WorldFault, WorldLayout, WorldRanges,
};

use world::World;

/// Width and length of the drone's body, metres. Source: AirSim's generic quadrotor mesh, 0.98 x
/// 0.98 x 0.29 m.
pub const DRONE_WIDTH_M: f32 = 0.98;

/// Radius around an opening's safe point that must be free, metres. Half the diagonal of the
/// drone's cross-section, 0.98 x 0.29 m, is 0.511 m at any roll angle; 0.14 m is for the policy's
/// error.
pub const BODY_CLEARANCE_M: f32 = 0.65;

/// Least width of the wall's frame around an opening, metres.
pub const FRAME_M: f32 = 0.1;

/// Most corners of a polygon opening.
pub const MAX_CORNERS: usize = 64;

/// Most walls of a course.
pub const MAX_WALLS: usize = 32;

/// Number that names a wall in course files and reports, independent of its place in the order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(transparent)]
pub struct WallLabel(pub u32);

impl fmt::Display for WallLabel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// Inner size of the closed corridor: `0..length_m`, `-width_m/2..width_m/2`, `0..height_m`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Corridor {
    /// Along x, metres. The end wall is the destination.
    pub length_m: f32,
    /// Along y, metres.
    pub width_m: f32,
    /// Along z, metres.
    pub height_m: f32,
}

impl Default for Corridor {
    /// The paper's corridor: 60 x 6 x 7 m.
    fn default() -> Self {
        Self {
            length_m: 60.0,
            width_m: 6.0,
            height_m: 7.0,
        }
    }
}

/// Area in which episodes start: a fixed distance behind the previous wall's front face, around the
/// middle of the corridor.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StartArea {
    /// Distance behind the previous wall's front face (or the corridor's start), metres.
    pub offset_m: f32,
    /// Largest deviation from the middle along y, metres; drawn uniformly.
    pub jitter_y_m: f32,
    /// Largest deviation from half the height along z, metres; drawn uniformly.
    pub jitter_z_m: f32,
}

impl Default for StartArea {
    /// An offset of 1.5 m clears a wall of 0.3 m by more than half the drone's length; a jitter of
    /// 0.5 m makes every episode different.
    fn default() -> Self {
        Self {
            offset_m: 1.5,
            jitter_y_m: 0.5,
            jitter_z_m: 0.5,
        }
    }
}

/// Description of a course before it is checked.
#[derive(Debug, Clone, PartialEq)]
pub struct CourseLayout {
    /// Name for reports.
    pub name: String,
    /// The corridor.
    pub corridor: Corridor,
    /// Area in which episodes start.
    pub start: StartArea,
    /// Thickness of every wall along x, metres.
    pub wall_thickness_m: f32,
    /// Walls in course order.
    pub walls: Vec<WallLayout>,
}

/// Description of a wall before it is checked.
#[derive(Debug, Clone, PartialEq)]
pub struct WallLayout {
    /// The wall's number.
    pub label: WallLabel,
    /// Position of its front face, which the drone meets first, metres.
    pub x_m: f32,
    /// Its opening.
    pub opening: Opening,
}

/// A wall across the whole corridor with one opening.
#[derive(Debug, Clone, PartialEq)]
pub struct Wall {
    label: WallLabel,
    x_m: f32,
    opening: Opening,
    outline: Vec<[f32; 2]>,
    safe_point: [f32; 2],
    clearance_m: f32,
}

/// A corridor with walls, or a world of obstacles, that the drone can fly from the start to the
/// end.
#[derive(Debug, Clone, PartialEq)]
pub struct Course {
    name: String,
    corridor: Corridor,
    start: StartArea,
    wall_thickness_m: f32,
    sidestep: Sidestep,
    walls: Vec<Wall>,
    /// Obstacles, start and goal of a world, which has no walls.
    world: Option<Arc<World>>,
}

/// How a drone gets from one opening to the next, and so how far apart walls must be.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) enum Sidestep {
    /// While it flies on at 1 m/s.
    #[default]
    Flying,
    /// While it hovers between the walls.
    Hovering,
}

impl Course {
    /// Checks a layout and turns it into a course.
    ///
    /// # Errors
    /// The first [`CourseFault`] found, from the corridor to the walls in course order.
    pub fn new(layout: CourseLayout) -> Result<Self, CourseFault> {
        let mut course = Self::without_walls(
            layout.name,
            layout.corridor,
            layout.start,
            layout.wall_thickness_m,
            Sidestep::Flying,
        )?;
        check::wall_count(layout.walls.len())?;
        for wall in layout.walls {
            course.add_wall(wall)?;
        }
        Ok(course)
    }

    /// Returns a course without walls, to which [`Self::add_wall`] adds them.
    fn without_walls(
        name: String,
        corridor: Corridor,
        start: StartArea,
        wall_thickness_m: f32,
        sidestep: Sidestep,
    ) -> Result<Self, CourseFault> {
        let course = Self {
            name,
            corridor,
            start,
            wall_thickness_m,
            sidestep,
            walls: Vec::new(),
            world: None,
        };
        check::corridor_and_start(&course)?;
        Ok(course)
    }

    /// Adds the next wall in course order if it can be flown.
    fn add_wall(&mut self, layout: WallLayout) -> Result<(), CourseFault> {
        let wall = check::next_wall(self, layout)?;
        self.walls.push(wall);
        Ok(())
    }

    /// Returns a course with the same walls in another order. `order[i]` is the present index of
    /// the wall that becomes number `i`; the positions along x stay the same.
    ///
    /// # Errors
    /// The first [`CourseFault`], from the first wall on: not every order leaves enough distance
    /// from one opening to the next.
    ///
    /// # Panics
    /// If `order` is not a permutation of the walls' places.
    pub(crate) fn reordered(&self, order: &[usize]) -> Result<Self, CourseFault> {
        assert_eq!(
            order.len(),
            self.walls.len(),
            "an order names each wall once"
        );
        let walls = order
            .iter()
            .zip(&self.walls)
            .map(|(&from, place)| WallLayout {
                label: self.walls[from].label,
                x_m: place.x_m,
                opening: self.walls[from].opening.clone(),
            });
        Self::new(CourseLayout {
            name: self.name.clone(),
            corridor: self.corridor,
            start: self.start,
            wall_thickness_m: self.wall_thickness_m,
            walls: walls.collect(),
        })
    }

    /// Returns the name for reports.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the inner size of the corridor, or the bounds of a world.
    #[must_use]
    pub fn corridor(&self) -> Corridor {
        self.corridor
    }

    /// Returns the area in which episodes start. Of a world, only its offset has a meaning: the end
    /// of a corridor lies as far behind it as the goal from the start.
    #[must_use]
    pub fn start(&self) -> StartArea {
        self.start
    }

    /// Returns the thickness of every wall along x, metres: a wall fills `x_m .. x_m +
    /// wall_thickness_m`.
    #[must_use]
    pub fn wall_thickness_m(&self) -> f32 {
        self.wall_thickness_m
    }

    /// Returns the walls in course order.
    #[must_use]
    pub fn walls(&self) -> &[Wall] {
        &self.walls
    }

    /// Returns `true` for a world of obstacles, `false` for a corridor with walls.
    #[must_use]
    pub fn is_world(&self) -> bool {
        self.world.is_some()
    }

    /// Returns the visibility of sides and ceiling: a corridor is closed.
    pub(crate) fn sides(&self) -> Sides {
        self.world
            .as_ref()
            .map_or(Sides::Closed, |world| world.sides)
    }

    /// Returns the obstacles of a world; a corridor has none.
    #[must_use]
    pub fn obstacles(&self) -> &[Obstacle] {
        self.world.as_ref().map_or(&[], |world| &world.obstacles)
    }

    /// Returns the goal of a world; `None` for a corridor, whose end wall is the destination.
    #[must_use]
    pub fn goal(&self) -> Option<Region> {
        self.world.as_ref().map(|world| *world.goal())
    }

    /// Returns the number of walls or stages that a drone at `position_m` with its tail at
    /// `tail_x_m` has left: walls whose back face lies before its tail, or stages of the way.
    pub(crate) fn walls_behind(&self, position_m: &Point3<f32>, tail_x_m: f32) -> usize {
        if let Some(world) = &self.world {
            return world.stages_behind(position_m);
        }
        self.walls
            .iter()
            .take_while(|wall| wall.x_m + self.wall_thickness_m < tail_x_m)
            .count()
    }

    /// Returns where to fly next in a world from `position_m`: a point on the way, at most about
    /// `ahead_m` away and in sight. `None` in a corridor.
    pub(crate) fn aim_m(&self, position_m: &Point3<f32>, ahead_m: f32) -> Option<Point3<f32>> {
        let world = self.world.as_ref()?;
        Some(world.aim(position_m, ahead_m))
    }

    /// Returns the distance left from `position_m` to the end wall, or along the way to the goal of
    /// a world, metres.
    pub(crate) fn to_end_m(&self, position_m: &Point3<f32>) -> f32 {
        match &self.world {
            Some(world) => world.left_m(position_m),
            None => self.corridor.length_m - position_m.x,
        }
    }

    /// Returns `true` if the end can be reached from `position_m`: in a world, the point lies
    /// inside no obstacle.
    pub(crate) fn is_reachable(&self, position_m: &Point3<f32>) -> bool {
        let world = self.world.as_ref();
        world.is_none_or(|world| world.is_reachable(position_m))
    }

    /// Returns the number of start levels: one before each wall, or one for each stage of a world.
    #[must_use]
    pub fn levels(&self) -> u8 {
        match self.world {
            Some(_) => STAGES,
            // `new` allows at most MAX_WALLS.
            None => self.walls.len() as u8,
        }
    }

    /// Draws the start position of an episode of `level` (1 = before the first wall), world frame,
    /// metres.
    ///
    /// # Errors
    /// [`NoSuchLevel`] if the course has fewer walls.
    pub(crate) fn start_position(
        &self,
        level: u8,
        rng: &mut impl Rng,
    ) -> Result<Point3<f32>, NoSuchLevel> {
        let levels = self.levels();
        if !(1..=levels).contains(&level) {
            return Err(NoSuchLevel { level, levels });
        }
        if let Some(world) = &self.world {
            return Ok(world.start_position(level, rng));
        }
        let behind_m = match level {
            1 => 0.0,
            _ => self.walls[usize::from(level) - 2].x_m,
        };
        let StartArea {
            offset_m,
            jitter_y_m,
            jitter_z_m,
        } = self.start;
        Ok(Point3::new(
            behind_m + offset_m,
            rng.random_range(-jitter_y_m..=jitter_y_m),
            self.corridor.height_m / 2.0 + rng.random_range(-jitter_z_m..=jitter_z_m),
        ))
    }

    /// Returns the triangles of all obstacles of a world that stand still: corners in the world
    /// frame, metres, counter-clockwise seen from the free side.
    #[must_use]
    pub fn obstacle_triangles(&self) -> Vec<[[f32; 3]; 3]> {
        let still = self.obstacles().iter().filter(|one| one.motion.is_none());
        let mut all = Vec::new();
        for mesh in still.map(Obstacle::mesh) {
            let corner = |vertex: u32| mesh.vertices[vertex as usize].coords.into();
            let triangles = mesh.triangles().into_iter();
            all.extend(triangles.map(|(triangle, _)| triangle.map(corner)));
        }
        all
    }

    /// Returns the triangles of each wall, by wall in course order: corners in the world frame,
    /// metres, counter-clockwise seen from the free side.
    #[must_use]
    pub fn wall_triangles(&self) -> Vec<Vec<[[f32; 3]; 3]>> {
        let mesh = self.mesh();
        let mut walls = vec![Vec::new(); self.walls.len()];
        for (triangle, surface) in mesh.triangles() {
            if let SurfaceKind::Wall(place) = mesh.surfaces[surface].kind {
                let corner = |vertex: u32| mesh.vertices[vertex as usize].coords.into();
                walls[place].push(triangle.map(corner));
            }
        }
        walls
    }

    /// Returns all surfaces of the course but its obstacles, seen from the inside.
    pub(crate) fn mesh(&self) -> Mesh {
        Mesh::of(self)
    }
}

impl Wall {
    /// Returns the wall's number, independent of its place in the order.
    #[must_use]
    pub fn label(&self) -> WallLabel {
        self.label
    }

    /// Returns the position of the front face, which the drone meets first, metres.
    #[must_use]
    pub fn x_m(&self) -> f32 {
        self.x_m
    }

    /// Returns the opening as described.
    #[must_use]
    pub fn opening(&self) -> &Opening {
        &self.opening
    }

    /// Returns the opening's corners `[y, z]` in metres, counter-clockwise with y to the right and
    /// z up.
    #[must_use]
    pub fn outline(&self) -> &[[f32; 2]] {
        &self.outline
    }

    /// Returns the point to fly through: the centre `[y, z]` of the widest circle inside the
    /// opening, metres.
    #[must_use]
    pub fn safe_point(&self) -> [f32; 2] {
        self.safe_point
    }

    /// Returns the radius of the widest circle inside the opening, metres.
    #[must_use]
    pub fn clearance_m(&self) -> f32 {
        self.clearance_m
    }
}

/// Returns a course with one wall per kind of opening, for the tests of this crate.
#[cfg(test)]
pub(crate) fn test_course() -> Course {
    let square = Shape::Rectangle {
        width_m: 2.0,
        height_m: 2.2,
    };
    let shapes = [
        (square, [0.9, 2.4], 20.0),
        (Shape::Circle { diameter_m: 2.2 }, [-1.2, 4.1], 0.0),
        (
            Shape::Cross {
                width_m: 3.0,
                height_m: 3.0,
                arm_m: 1.4,
            },
            [0.6, 3.5],
            45.0,
        ),
        (
            Shape::L {
                width_m: 3.0,
                height_m: 3.0,
                arm_m: 1.6,
            },
            [-0.4, 2.5],
            0.0,
        ),
        (
            Shape::Triangle {
                width_m: 3.6,
                height_m: 3.2,
            },
            [0.2, 4.0],
            180.0,
        ),
    ];
    let walls = shapes
        .into_iter()
        .zip(1u32..)
        .map(|((shape, centre_m, rotation_deg), number)| WallLayout {
            label: WallLabel(number),
            x_m: 10.0 * number as f32,
            opening: Opening {
                shape,
                centre_m,
                rotation_deg,
            },
        })
        .collect();
    Course::new(CourseLayout {
        name: "one of each".into(),
        corridor: Corridor::default(),
        start: StartArea::default(),
        wall_thickness_m: 0.3,
        walls,
    })
    .expect("the test course can be flown")
}
