//! The body among the course's surfaces: what it touches.
//!
//! Any contact ends an episode, so contact forces never act: after each physics step, the body's
//! cuboid is tested exactly against the surfaces that the depth camera also draws. The corridor's
//! inside is a box, so the cuboid's bounds decide whether it touches that; a wall is tested,
//! triangle by triangle, only while the bounds reach into it. The body moves centimetres a step and
//! is longer than that in every direction it can move, so it cannot pass a surface between two
//! tests. Obstacles that stand still are one set of triangles in a tree of boxes. A moving one
//! keeps its triangles: the body is seen from it.

use nalgebra::{Isometry3, Point3, Vector3};
use rapier3d::math::{Pose, Rotation};
use rapier3d::parry::bounding_volume::Aabb;
use rapier3d::parry::shape::{Cuboid, Shape, TriMeshBuilderError};

use crate::body::{Body, glam};
use crate::course::{Course, Mesh, Moment, Motion, Region, SurfaceKind, Wall};
use crate::surfaces::Surfaces;
use crate::vehicle::{Actuation, BodyProperties, VehicleState};

/// Contact of the body with the course.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Contact {
    Nothing,
    /// The corridor, a wall, the inside of an opening, or an obstacle of a world.
    Obstacle,
    /// The destination and nothing else: the wall at the corridor's end, or the goal of a world.
    EndWall,
}

/// A wall that the body may touch.
struct WallBody {
    surfaces: Surfaces,
    front_m: f32,
    back_m: f32,
    /// Middle `[y, z]` of a disc inside the opening.
    free_middle_m: [f32; 2],
    free_radius_m: f32,
}

/// An obstacle that moves.
struct MovingBody {
    surfaces: Surfaces,
    motion: Motion,
    /// Place among the course's obstacles.
    number: usize,
}

/// The vehicle's body in the course.
pub(crate) struct World {
    /// The corridor's inside.
    interior: Aabb,
    /// The walls in course order.
    walls: Vec<WallBody>,
    /// All obstacles that stand still; `None` if there are none.
    still: Option<Surfaces>,
    moving: Vec<MovingBody>,
    /// Goal of a world; `None` in a corridor, whose end is the destination.
    goal: Option<Region>,
    moment: Moment,
    body_shape: Cuboid,
    nominal: BodyProperties,
    dt_secs: f32,
    body: Body,
    /// Bounds of the body at its pose.
    bounds: Aabb,
}

impl World {
    /// Builds a world with the surfaces of `course` and a body at rest at the corridor's start. A
    /// physics step takes `dt_secs`.
    ///
    /// # Errors
    /// parry's reason if the surfaces of a wall form no triangle mesh. Such a wall would be air.
    pub(crate) fn new(
        course: &Course,
        properties: BodyProperties,
        dt_secs: f32,
    ) -> Result<Self, TriMeshBuilderError> {
        let mesh = course.mesh();
        let (still, moving) = obstacle_bodies(course)?;
        let body = Body::at_rest(&properties, &Point3::origin(), dt_secs);
        let body_shape = Cuboid::new(glam(&properties.half_extents_m));
        Ok(Self {
            interior: interior(course),
            walls: wall_bodies(&mesh, course)?,
            still,
            moving,
            goal: course.goal(),
            moment: Moment::default(),
            bounds: body_shape.compute_aabb(body.pose()),
            body_shape,
            nominal: properties,
            dt_secs,
            body,
        })
    }

    /// Puts a new body at rest at `position_m`, with `mass_factor` times the nominal mass: an
    /// episode depends on its start and actions alone. Moving obstacles start where `motion_seed`
    /// puts them.
    pub(crate) fn reset(&mut self, position_m: &Point3<f32>, mass_factor: f32, motion_seed: u64) {
        self.moment = Moment {
            secs: 0.0,
            seed: motion_seed,
        };
        let properties = self.nominal.scaled(mass_factor);
        self.body = Body::at_rest(&properties, position_m, self.dt_secs);
        self.bounds = self.body_shape.compute_aabb(self.body.pose());
    }

    /// Integrates one physics step under `actuation` and the gust force `gust_n` (world frame, N).
    /// If the state is no longer finite, [`World::is_quarantined`] returns `true`.
    pub(crate) fn advance(&mut self, actuation: &Actuation, gust_n: Option<Vector3<f32>>) {
        self.body.advance(actuation, gust_n);
        self.moment.secs += self.dt_secs;
        self.bounds = self.body_shape.compute_aabb(self.body.pose());
    }

    /// Returns the body's pose and motion.
    pub(crate) fn state(&self) -> VehicleState {
        self.body.state()
    }

    /// Returns the instant, which places the moving obstacles.
    pub(crate) fn moment(&self) -> Moment {
        self.moment
    }

    /// Returns the position of the body's rearmost point along the corridor, m.
    pub(crate) fn tail_x_m(&self) -> f32 {
        self.bounds.mins.x
    }

    /// Returns `true` if a pose or velocity was not finite in the last step.
    pub(crate) fn is_quarantined(&self) -> bool {
        self.body.is_quarantined()
    }

    /// Returns the wall that the body touches, by its place in course order from 0.
    pub(crate) fn touched_wall(&self) -> Option<usize> {
        let (pose, bounds) = (self.body.pose(), &self.bounds);
        self.walls
            .iter()
            .position(|wall| self.touches(pose, bounds, wall))
    }

    /// Returns what the body touches.
    pub(crate) fn contact(&self) -> Contact {
        self.contact_at(self.body.pose(), &self.bounds)
    }

    /// Returns `true` if a body at `world_from_body` would touch no obstacle.
    pub(crate) fn is_free_at(&self, world_from_body: &Isometry3<f32>) -> bool {
        let [x, y, z, w] = world_from_body.rotation.coords.into();
        let rotation = Rotation::from_xyzw(x, y, z, w);
        let pose = Pose::from_parts(glam(&world_from_body.translation.vector), rotation);
        self.contact_at(&pose, &self.body_shape.compute_aabb(&pose)) != Contact::Obstacle
    }

    /// Returns `true` if the body touches an obstacle of a world.
    pub(crate) fn touches_obstacle(&self) -> bool {
        self.touches_obstacle_at(self.body.pose())
    }

    /// Returns the distance of the body's middle to the nearest obstacle of a world, m; infinite
    /// without obstacles.
    pub(crate) fn to_obstacle_m(&self) -> f32 {
        let middle = point(self.body.pose());
        let still = self.still.as_ref().map(|still| still.distance_m(&middle));
        let moving = self.moving.iter().map(|obstacle| {
            let offset_m = obstacle.motion.offset_m(obstacle.number, self.moment);
            obstacle.surfaces.distance_m(&(middle - offset_m))
        });
        still
            .into_iter()
            .chain(moving)
            .fold(f32::INFINITY, f32::min)
    }

    /// Returns what a body of these `bounds` touches at `world_from_body`.
    fn contact_at(&self, world_from_body: &Pose, bounds: &Aabb) -> Contact {
        let inside = &self.interior;
        let touches_corridor = bounds.mins.cmple(inside.mins).any()
            || bounds.maxs.y >= inside.maxs.y
            || bounds.maxs.z >= inside.maxs.z;
        let mut walls = self.walls.iter();
        let touches_end = bounds.maxs.x >= inside.maxs.x;
        if touches_corridor
            || walls.any(|wall| self.touches(world_from_body, bounds, wall))
            || self.touches_obstacle_at(world_from_body)
        {
            return Contact::Obstacle;
        }
        match &self.goal {
            Some(_) if touches_end => Contact::Obstacle,
            Some(goal) if goal.contains(&point(world_from_body)) => Contact::EndWall,
            None if touches_end => Contact::EndWall,
            _ => Contact::Nothing,
        }
    }

    fn touches(&self, world_from_body: &Pose, bounds: &Aabb, wall: &WallBody) -> bool {
        wall.is_near(bounds) && wall.surfaces.touch(world_from_body, &self.body_shape)
    }

    fn touches_obstacle_at(&self, world_from_body: &Pose) -> bool {
        let touches_moving = |obstacle: &MovingBody| {
            let offset_m = obstacle.motion.offset_m(obstacle.number, self.moment);
            let seen_from_it = world_from_body.append_translation(-glam(&offset_m));
            obstacle.surfaces.touch(&seen_from_it, &self.body_shape)
        };
        let still = self.still.as_ref();
        still.is_some_and(|still| still.touch(world_from_body, &self.body_shape))
            || self.moving.iter().any(touches_moving)
    }
}

impl WallBody {
    /// Returns `false` if a body within `bounds` cannot touch the wall.
    fn is_near(&self, bounds: &Aabb) -> bool {
        if bounds.maxs.x < self.front_m || bounds.mins.x > self.back_m {
            return false;
        }
        let [y_m, z_m] = self.free_middle_m;
        let off_m = |least: f32, most: f32, middle: f32| (most - middle).max(middle - least);
        let beside_m = off_m(bounds.mins.y, bounds.maxs.y, y_m);
        let above_m = off_m(bounds.mins.z, bounds.maxs.z, z_m);
        beside_m * beside_m + above_m * above_m >= self.free_radius_m * self.free_radius_m
    }
}

/// Returns the box whose sides are the corridor's surfaces and the end wall.
fn interior(course: &Course) -> Aabb {
    let corridor = course.corridor();
    let half_m = corridor.width_m / 2.0;
    Aabb::new(
        glam(&Vector3::new(0.0, -half_m, 0.0)),
        glam(&Vector3::new(corridor.length_m, half_m, corridor.height_m)),
    )
}

/// Returns the walls of `course` with their triangles.
fn wall_bodies(mesh: &Mesh, course: &Course) -> Result<Vec<WallBody>, TriMeshBuilderError> {
    /// Rounding must not make the free disc reach into the wall.
    const MARGIN_M: f32 = 1e-3;

    let triangles = mesh.triangles();
    let of_wall = |(place, wall): (usize, &Wall)| {
        let is_of_wall = |surface: usize| mesh.surfaces[surface].kind == SurfaceKind::Wall(place);
        let chosen = triangles.iter().filter(|(_, surface)| is_of_wall(*surface));
        let chosen = chosen.map(|(triangle, _)| *triangle).collect();
        Ok(WallBody {
            surfaces: Surfaces::of_triangles(mesh, chosen)?,
            front_m: wall.x_m(),
            back_m: wall.x_m() + course.wall_thickness_m(),
            free_middle_m: wall.safe_point(),
            free_radius_m: wall.clearance_m() - MARGIN_M,
        })
    };
    course.walls().iter().enumerate().map(of_wall).collect()
}

/// Returns the obstacles of `course` that stand still, and those that move.
fn obstacle_bodies(
    course: &Course,
) -> Result<(Option<Surfaces>, Vec<MovingBody>), TriMeshBuilderError> {
    let (mut still, mut moving) = (Mesh::default(), Vec::new());
    for (number, obstacle) in course.obstacles().iter().enumerate() {
        match obstacle.motion {
            None => still.append(obstacle.mesh()),
            Some(motion) => moving.push(MovingBody {
                surfaces: Surfaces::of(&obstacle.mesh())?,
                motion,
                number,
            }),
        }
    }
    let still = match still.surfaces.is_empty() {
        true => None,
        false => Some(Surfaces::of(&still)?),
    };
    Ok((still, moving))
}

/// Returns the place of a body's middle.
fn point(world_from_body: &Pose) -> Point3<f32> {
    let [x, y, z] = world_from_body.translation.into();
    Point3::new(x, y, z)
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;
    use rapier3d::glamx::EulerRot;
    use rapier3d::math::{Pose, Rotation, Vector};

    use super::*;
    use crate::course::test_course;

    const PROPERTIES: BodyProperties = BodyProperties {
        mass_kg: 2.0,
        inertia_kgm2: Vector3::new(0.01, 0.02, 0.04),
        half_extents_m: Vector3::new(0.5, 0.4, 0.1),
    };

    fn world_at(position_m: Point3<f32>) -> World {
        let mut world = World::new(&test_course(), PROPERTIES, 0.005).unwrap();
        world.reset(&position_m, 1.0, 0);
        world
    }

    impl World {
        /// Moves the body.
        fn put(&mut self, pose: Pose) {
            self.body.put(pose);
            self.bounds = self.body_shape.compute_aabb(self.body.pose());
        }
    }

    fn push(world: &mut World, force_n: Vector3<f32>, torque_nm: Vector3<f32>, secs: f32) {
        for _ in 0..(secs / 0.005).round() as u32 {
            world.advance(&Actuation::Wrench { force_n, torque_nm }, None);
        }
    }

    #[test]
    fn body_without_thrust_falls() {
        let mut world = world_at(Point3::new(5.0, 0.0, 6.0));
        push(&mut world, Vector3::zeros(), Vector3::zeros(), 1.0);
        let state = world.state();
        assert!(
            (state.velocity_mps.z + 9.81).abs() < 1e-3,
            "{}",
            state.velocity_mps
        );
        // Half a step more than g/2, because velocity is integrated before position.
        assert!(
            (state.position_m.z - (6.0 - 4.905)).abs() < 0.03,
            "{}",
            state.position_m
        );
    }

    #[test]
    fn force_and_torque_act_through_mass_and_inertia() {
        for (axis, rate_radps) in [
            (Vector3::x(), 1.0),
            (Vector3::y(), 0.5),
            (Vector3::z(), 0.25),
        ] {
            let mut world = world_at(Point3::new(5.0, 0.0, 3.5));
            push(
                &mut world,
                Vector3::new(1.0, 0.0, 2.0 * 9.81),
                axis * 0.1,
                0.1,
            );
            let state = world.state();
            assert!(
                (state.velocity_mps - Vector3::new(0.05, 0.0, 0.0)).norm() < 1e-4,
                "{}",
                state.velocity_mps
            );
            assert!(
                (state.body_rates_radps - axis * rate_radps).norm() < 1e-3,
                "{}",
                state.body_rates_radps
            );
        }
    }

    #[test]
    fn contact_begins_where_surfaces_meet() {
        // The corridor's left side is at y = 3 and its floor at z = 0. The body reaches 0.4 m to
        // the side and 0.1 m down.
        for (y_m, z_m, contact) in [
            (2.599, 3.5, Contact::Nothing),
            (2.601, 3.5, Contact::Obstacle),
            (0.0, 0.101, Contact::Nothing),
            (0.0, 0.099, Contact::Obstacle),
        ] {
            assert_eq!(
                world_at(Point3::new(5.0, y_m, z_m)).contact(),
                contact,
                "y = {y_m}, z = {z_m}"
            );
        }
    }

    #[test]
    fn tilted_body_reaches_lower() {
        let mut world = world_at(Point3::new(5.0, 0.0, 0.15));
        assert_eq!(world.contact(), Contact::Nothing);
        // Pitched by some 0.25 rad, its corners hang at least 0.5 m · sin(0.25) below the middle.
        push(
            &mut world,
            Vector3::z() * 2.0 * 9.81,
            Vector3::y() * 0.1,
            0.32,
        );
        assert!((world.state().position_m.z - 0.15).abs() < 1e-3);
        assert_eq!(world.contact(), Contact::Obstacle);
    }

    #[test]
    fn end_wall_is_reached_by_the_nose_but_not_along_a_side() {
        assert_eq!(
            world_at(Point3::new(59.499, 0.0, 3.5)).contact(),
            Contact::Nothing
        );
        assert_eq!(
            world_at(Point3::new(59.501, 0.0, 3.5)).contact(),
            Contact::EndWall
        );
        assert_eq!(
            world_at(Point3::new(59.501, 2.7, 3.5)).contact(),
            Contact::Obstacle
        );
    }

    #[test]
    fn the_tail_is_the_turned_bodys_rearmost_point() {
        let mut world = world_at(Point3::new(5.0, 0.0, 3.5));
        assert!((world.tail_x_m() - 4.5).abs() < 1e-6);
        push(
            &mut world,
            Vector3::z() * 2.0 * 9.81,
            Vector3::y() * 0.1,
            0.32,
        );
        let (_, pitch_rad, _) = world.state().world_from_body.euler_angles();
        let half_m = 0.5 * pitch_rad.cos() + 0.1 * pitch_rad.sin();
        assert!(pitch_rad > 0.2 && (world.tail_x_m() - (5.0 - half_m)).abs() < 1e-4);
    }

    #[test]
    fn opening_is_free_and_its_edge_is_not() {
        let course = test_course();
        let wall = &course.walls()[0];
        let [y_m, z_m] = wall.safe_point();
        let mid_wall_m = wall.x_m() + course.wall_thickness_m() / 2.0;
        assert_eq!(
            world_at(Point3::new(mid_wall_m, y_m, z_m)).contact(),
            Contact::Nothing
        );
        let beside_m = y_m + wall.clearance_m();
        let beside = world_at(Point3::new(mid_wall_m, beside_m, z_m));
        assert_eq!(beside.contact(), Contact::Obstacle);
        assert_eq!(beside.touched_wall(), Some(0));
    }

    #[test]
    fn the_corridor_is_not_a_wall() {
        let on_the_floor = world_at(Point3::new(5.0, 0.0, 0.05));
        assert_eq!(on_the_floor.contact(), Contact::Obstacle);
        assert_eq!(on_the_floor.touched_wall(), None);
    }

    #[test]
    fn a_course_with_a_wall_that_nothing_could_touch_is_refused() {
        let course = test_course();
        let mut mesh = course.mesh();
        assert!(wall_bodies(&mesh, &course).is_ok());
        let last = SurfaceKind::Wall(course.walls().len() - 1);
        mesh.surfaces.retain(|surface| surface.kind != last);
        assert!(wall_bodies(&mesh, &course).is_err());
    }

    #[test]
    fn contact_equals_that_with_every_triangle_of_the_course() {
        let course = test_course();
        let mesh = course.mesh();
        let is_obstacle = |surface: usize| mesh.surfaces[surface].kind != SurfaceKind::EndWall;
        let triangles = mesh.triangles().into_iter();
        let obstacles = triangles.filter(|(_, surface)| is_obstacle(*surface));
        let obstacles = obstacles.map(|(triangle, _)| triangle).collect();
        let obstacles = Surfaces::of_triangles(&mesh, obstacles).unwrap();

        let mut world = world_at(Point3::origin());
        let mut rng = Pcg64Mcg::seed_from_u64(1);
        let mut touched = 0;
        for number in 0..20_000 {
            // Every other pose is near a wall. None reaches through the end wall.
            let x_m = if number % 2 == 0 {
                rng.random_range(0.3..=59.35)
            } else {
                10.0 * rng.random_range(1.0_f32..=5.0).round() + rng.random_range(-0.7..=1.0)
            };
            let (y_m, z_m) = (rng.random_range(-2.9..=2.9), rng.random_range(0.1..=6.9));
            let mut turn = |most: f32| rng.random_range(-most..=most);
            let turn = Rotation::from_euler(EulerRot::XYZ, turn(0.6), turn(0.6), turn(3.0));
            let pose = Pose::from_parts(Vector::new(x_m, y_m, z_m), turn);
            world.put(pose);
            let expected = obstacles.touch(&pose, &world.body_shape);
            touched += u32::from(expected);
            assert_eq!(world.contact() == Contact::Obstacle, expected, "{pose:?}");
        }
        assert!((2000..18_000).contains(&touched), "{touched}");
    }

    #[test]
    fn twice_the_mass_is_moved_half_as_far_and_falls_alike() {
        let mut world = World::new(&test_course(), PROPERTIES, 0.005).unwrap();
        world.reset(&Point3::new(5.0, 0.0, 6.0), 2.0, 0);
        push(
            &mut world,
            Vector3::new(1.0, 0.0, 0.0),
            Vector3::x() * 0.1,
            0.1,
        );
        let state = world.state();
        let expected_mps = Vector3::new(0.025, 0.0, -0.981);
        assert!(
            (state.velocity_mps - expected_mps).norm() < 1e-3,
            "{}",
            state.velocity_mps
        );
        assert!(
            (state.body_rates_radps.x - 0.5).abs() < 1e-3,
            "{}",
            state.body_rates_radps
        );
    }
}
