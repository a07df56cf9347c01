//! Worlds: courses of free-standing obstacles between a start and a goal.
//!
//! A world is a box with obstacles in it. The drone flies from the start region to the goal region
//! by any way. So that progress can be counted as in a corridor, the way is divided into
//! [`STAGES`] stages of equal length: a stage counts as a wall passed, and training starts at each.

mod check;
mod fault;
mod file;
mod generator;
mod mesh_file;
#[cfg(test)]
mod tests;
mod way;

use nalgebra::{Point3, Vector3};
use rand::{Rng, RngExt};
use rapier3d::parry::bounding_volume::Aabb;
use serde::{Deserialize, Serialize};

pub use fault::WorldFault;
pub(super) use file::{is_world, mesh_files, parse};
pub(super) use generator::generate;
pub use generator::{ForestRanges, GatesRanges, HallRanges, RoomsRanges, WorldRanges};

use super::check::{LARGEST_M, in_range};
use super::{
    Corridor, Course, CourseFault, FaultLocation, Obstacle, ObstacleShape, Sidestep, StartArea,
};
use crate::surfaces::Surfaces;
use way::{Grid, Ways};

/// Stages of the way through a world. Each counts as a wall passed.
pub const STAGES: u8 = 5;

/// Most obstacles of a world.
pub const MAX_OBSTACLES: usize = 4096;

/// Most triangles of all obstacles of a world.
pub const MAX_TRIANGLES: usize = 500_000;

/// Visibility of the sides and the ceiling of a world. The drone must not leave it either way.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Sides {
    /// Walls and a ceiling, which the camera sees.
    #[default]
    Closed,
    /// Open air. Only the floor is seen.
    Open,
}

/// A box, upright and along the axes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Region {
    /// Middle, metres.
    pub centre_m: [f32; 3],
    /// Along x, y and z, metres.
    pub size_m: [f32; 3],
}

/// Description of a world before it is checked.
#[derive(Debug, Clone, PartialEq)]
pub struct WorldLayout {
    /// Name for reports.
    pub name: String,
    /// Inner size: `0..length_m`, `-width_m/2..width_m/2`, `0..height_m`.
    pub bounds: Corridor,
    /// Visibility of sides and ceiling.
    pub sides: Sides,
    /// Region in which episodes start: the places of the drone's middle.
    pub start: Region,
    /// Region that the drone's middle must reach.
    pub goal: Region,
    /// Obstacles in the bounds.
    pub obstacles: Vec<Obstacle>,
}

/// Obstacles, start, goal and ways of a course without walls.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct World {
    pub(super) sides: Sides,
    start: Region,
    goal: Region,
    pub(super) obstacles: Vec<Obstacle>,
    ways: Ways,
    /// Length of the way from the middle of the start region, metres.
    length_m: f32,
    /// Where the stages begin, in order.
    stage_starts: Vec<Point3<f32>>,
}

impl Region {
    pub(super) fn least(&self) -> Point3<f32> {
        Point3::from(self.centre_m) - Vector3::from(self.size_m) / 2.0
    }

    pub(super) fn most(&self) -> Point3<f32> {
        Point3::from(self.centre_m) + Vector3::from(self.size_m) / 2.0
    }

    /// Returns `true` if the region holds a point.
    #[must_use]
    pub fn contains(&self, point: &Point3<f32>) -> bool {
        let (least, most) = (self.least(), self.most());
        (0..3).all(|axis| (least[axis]..=most[axis]).contains(&point[axis]))
    }

    fn draw(&self, rng: &mut impl Rng) -> Point3<f32> {
        let half = Vector3::from(self.size_m) / 2.0;
        let off = half.map(|half| rng.random_range(-half..=half));
        Point3::from(self.centre_m) + off
    }
}

impl Course {
    /// Checks the description of a world and turns it into a course.
    ///
    /// # Errors
    /// The first [`WorldFault`] found: a value out of bounds, or a goal to which no way leads.
    pub fn of_world(layout: WorldLayout) -> Result<Self, WorldFault> {
        let world = World::new(&layout)?;
        Ok(Self {
            name: layout.name,
            corridor: layout.bounds,
            // A corridor's end lies as far from its start as this goal.
            start: StartArea {
                offset_m: layout.bounds.length_m - world.straight_m(),
                ..StartArea::default()
            },
            wall_thickness_m: 0.0,
            sidestep: Sidestep::default(),
            walls: Vec::new(),
            world: Some(world.into()),
        })
    }
}

impl World {
    fn new(layout: &WorldLayout) -> Result<Self, WorldFault> {
        let WorldLayout {
            bounds,
            sides,
            start,
            goal,
            ref obstacles,
            ..
        } = *layout;
        check_bounds(bounds)?;
        check_region("start", &start, bounds)?;
        check_region("goal", &goal, bounds)?;
        check_obstacles(obstacles)?;
        check_motions(layout)?;
        let ways = ways(layout)?;
        let middle = Point3::from(start.centre_m);
        let length_m = match ways.length_m(&middle) {
            Some(length_m) if ways.leads_from(&middle) => length_m,
            _ => return Err(no_way(&ways, layout)),
        };
        if length_m < f32::from(STAGES) {
            return Err(WorldFault::TooNear { length_m });
        }
        let mut world = Self {
            sides,
            start,
            goal,
            obstacles: obstacles.clone(),
            ways,
            length_m,
            stage_starts: vec![middle],
        };
        for at in world.ways.from(&middle).collect::<Vec<_>>() {
            let behind = world.stages_behind(&at).min(usize::from(STAGES) - 1);
            // A short way may pass two stages in one cell.
            world
                .stage_starts
                .resize((behind + 1).max(world.stage_starts.len()), at);
        }
        Ok(world)
    }

    /// Returns the distance from the middle of the start region to the goal, metres: no way is
    /// shorter.
    fn straight_m(&self) -> f32 {
        let middle = Point3::from(self.start.centre_m);
        let nearest = middle.sup(&self.goal.least()).inf(&self.goal.most());
        nalgebra::distance(&middle, &nearest)
    }

    pub(super) fn goal(&self) -> &Region {
        &self.goal
    }

    /// Returns the number of stages that a drone at `point` has behind it.
    pub(super) fn stages_behind(&self, point: &Point3<f32>) -> usize {
        let left_m = match self.ways.length_m(point) {
            _ if self.goal.contains(point) => 0.0,
            Some(left_m) => left_m,
            None => return 0,
        };
        let share = 1.0 - left_m / self.length_m;
        (share * f32::from(STAGES)).clamp(0.0, f32::from(STAGES)) as usize
    }

    /// Draws where an episode of `level` (1 = the first stage) starts.
    pub(super) fn start_position(&self, level: u8, rng: &mut impl Rng) -> Point3<f32> {
        /// Places tried before the episode starts in the middle.
        const TRIES: usize = 64;
        /// Size of the region around the start of a later stage, metres.
        const SPREAD_M: f32 = 0.5;

        let place = usize::from(level.max(1)) - 1;
        let middle = self.stage_starts[place.min(self.stage_starts.len() - 1)];
        let region = match place {
            0 => self.start,
            _ => Region {
                centre_m: middle.coords.into(),
                size_m: [SPREAD_M; 3],
            },
        };
        let mut tried = std::iter::repeat_with(|| region.draw(rng)).take(TRIES);
        tried
            .find(|at| self.ways.is_roomy(at) && self.stages_behind(at) == place)
            .unwrap_or(middle)
    }

    /// Returns where to fly next from `point`: on the way, at most about `ahead_m` away and in
    /// sight.
    pub(super) fn aim(&self, point: &Point3<f32>, ahead_m: f32) -> Point3<f32> {
        match self.goal.contains(point) {
            true => self.goal.centre_m.into(),
            false => self.ways.aim(point, ahead_m),
        }
    }

    /// Returns the length of the way from `point`, metres.
    pub(super) fn left_m(&self, point: &Point3<f32>) -> f32 {
        self.ways.length_m(point).unwrap_or(self.length_m)
    }

    /// Returns `true` if a way leads from `point` to the goal: it lies in no obstacle.
    pub(super) fn is_reachable(&self, point: &Point3<f32>) -> bool {
        self.ways.leads_from(point)
    }
}

fn check_bounds(bounds: Corridor) -> Result<(), WorldFault> {
    for (key, value, most) in [
        ("bounds.length_m", bounds.length_m, LARGEST_M),
        ("bounds.width_m", bounds.width_m, LARGEST_M),
        ("bounds.height_m", bounds.height_m, 100.0),
    ] {
        in_range(FaultLocation::Course, key, value, 2.0, most)?;
    }
    Ok(())
}

fn check_region(name: &'static str, region: &Region, bounds: Corridor) -> Result<(), WorldFault> {
    let inside = Region {
        centre_m: [bounds.length_m / 2.0, 0.0, bounds.height_m / 2.0],
        size_m: [bounds.length_m, bounds.width_m, bounds.height_m],
    };
    let fits = region.size_m.iter().all(|size| *size >= 0.0)
        && inside.contains(&region.least())
        && inside.contains(&region.most());
    match fits {
        true => Ok(()),
        false => Err(WorldFault::Region {
            name,
            region: *region,
            least: inside.least().coords.into(),
            most: inside.most().coords.into(),
        }),
    }
}

fn check_obstacles(obstacles: &[Obstacle]) -> Result<(), WorldFault> {
    if obstacles.len() > MAX_OBSTACLES {
        return Err(WorldFault::ObstacleCount {
            count: obstacles.len(),
        });
    }
    let mut triangles = 0;
    for (number, obstacle) in (1..).zip(obstacles) {
        obstacle.check(number)?;
        triangles += match &obstacle.shape {
            ObstacleShape::Mesh(mesh) => mesh.triangles.len(),
            _ => 0,
        };
    }
    match triangles <= MAX_TRIANGLES {
        true => Ok(()),
        false => Err(WorldFault::TriangleCount { count: triangles }),
    }
}

/// Checks that no obstacle moves through the start: an episode could begin in a collision.
fn check_motions(layout: &WorldLayout) -> Result<(), WorldFault> {
    let least = layout.start.least() - way::BODY_M;
    let most = layout.start.most() + way::BODY_M;
    for (obstacle, number) in layout.obstacles.iter().zip(1..) {
        let Some(motion) = obstacle.motion else {
            continue;
        };
        let [back_m, ahead_m] = motion.reach_m();
        let meets = |axis: usize| {
            let mesh = obstacle.mesh();
            let along = mesh.vertices.iter().map(|vertex| vertex[axis]);
            let from = along.clone().fold(f32::INFINITY, f32::min) + back_m[axis];
            let to = along.fold(f32::NEG_INFINITY, f32::max) + ahead_m[axis];
            from < most[axis] && to > least[axis]
        };
        if (0..3).all(meets) {
            return Err(WorldFault::MovesThroughStart { obstacle: number });
        }
    }
    Ok(())
}

/// Returns the ways through a world.
fn ways(layout: &WorldLayout) -> Result<Ways, WorldFault> {
    let bounds = layout.bounds;
    let grid = Grid::of(bounds).ok_or(WorldFault::TooLarge { bounds })?;
    let half_m = bounds.width_m / 2.0;
    let least = Point3::new(0.0, -half_m, 0.0) + way::BODY_M;
    let most = Point3::new(bounds.length_m, half_m, bounds.height_m) - way::BODY_M;
    let mut is_free = vec![false; grid.count()];
    for cell in grid.between(&least, &most) {
        is_free[cell] = true;
    }
    let start = Point3::from(layout.start.centre_m);
    let still = layout.obstacles.iter().filter(|one| one.motion.is_none());
    for obstacle in still {
        let surfaces = Surfaces::of(&obstacle.mesh()).map_err(WorldFault::Mesh)?;
        let Aabb { mins, maxs } = surfaces.bounds();
        let [least, most] = [mins, maxs].map(|corner| Point3::new(corner.x, corner.y, corner.z));
        if start.sup(&least).inf(&most) == start && surfaces.hold(&start) {
            return Err(WorldFault::Blocked { name: "start" });
        }
        for cell in grid.between(&(least - way::BODY_M), &(most + way::BODY_M)) {
            if is_free[cell] {
                is_free[cell] = !surfaces.touch_box(&grid.middle_m(cell), &way::BODY_M);
            }
        }
    }
    Ok(Ways::to(&layout.goal, grid, is_free))
}

/// Returns why no way leads from the start to the goal.
fn no_way(ways: &Ways, layout: &WorldLayout) -> WorldFault {
    if !ways.fits(&layout.start.centre_m.into()) {
        return WorldFault::Blocked { name: "start" };
    }
    match ways.have_an_end() {
        true => WorldFault::NoWay,
        false => WorldFault::Blocked { name: "goal" },
    }
}

impl From<CourseFault> for WorldFault {
    fn from(fault: CourseFault) -> Self {
        Self::Value(fault)
    }
}
