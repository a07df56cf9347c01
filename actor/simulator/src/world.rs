//! The rigid body among the course's surfaces: rapier integrates it, parry finds what it touches.
//!
//! Any contact ends an episode, so contact forces never act and rapier's solver has nothing to
//! solve: the course is not in rapier's world at all. After each physics step, the body's cuboid is
//! tested exactly against the triangles that the depth camera also draws. A bounding-volume tree
//! makes that test take some 0.1 µs when nothing is near. The body moves centimetres a step and is
//! longer than that in every direction it can move, so it cannot pass a surface between two tests.
//!
//! rapier and parry use glam, the rest of this crate uses nalgebra: only this file converts between
//! them.

use nalgebra::{Point3, Quaternion, UnitQuaternion, Vector3};
use rapier3d::dynamics::{MassProperties, RigidBodyBuilder, RigidBodyHandle};
use rapier3d::math::Vector;
use rapier3d::parry::query::{DefaultQueryDispatcher, QueryDispatcher};
use rapier3d::parry::shape::{Cuboid, Shape, TriMesh, TriMeshBuilderError};
use rapier3d::pipeline::PhysicsWorld;

use crate::course::{Course, Mesh, SurfaceKind};
use crate::vehicle::{Actuation, BodyProperties, GRAVITY_MPS2, VehicleState};

/// Contact of the body with the course.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Contact {
    Nothing,
    /// The corridor, a wall, or the inside of an opening.
    Obstacle,
    /// The wall at the corridor's end and nothing else.
    EndWall,
}

/// The vehicle's body in the course.
pub(crate) struct World {
    obstacles: TriMesh,
    /// The walls one by one, in course order: parts of `obstacles`.
    walls: Vec<TriMesh>,
    end_wall_m: f32,
    body_shape: Cuboid,
    nominal: BodyProperties,
    /// Mass of the body in the current episode, kg.
    mass_kg: f32,
    dt_secs: f32,
    physics: PhysicsWorld,
    body: RigidBodyHandle,
}

impl World {
    /// Builds a world with the surfaces of `course` and a body at rest at the corridor's start. A
    /// physics step takes `dt_secs`.
    ///
    /// # Errors
    /// parry's reason if the course's surfaces, or those of one wall, form no triangle mesh. Such a
    /// wall would be air.
    pub(crate) fn new(
        course: &Course,
        properties: BodyProperties,
        dt_secs: f32,
    ) -> Result<Self, TriMeshBuilderError> {
        let (physics, body) = pristine_physics(&properties, dt_secs, &Point3::origin());
        let (obstacles, walls) = collision_meshes(&course.mesh(), course.walls().len())?;
        Ok(Self {
            obstacles,
            walls,
            end_wall_m: course.corridor().length_m,
            body_shape: Cuboid::new(glam(&properties.half_extents_m)),
            nominal: properties,
            mass_kg: properties.mass_kg,
            dt_secs,
            physics,
            body,
        })
    }

    /// Puts the body at rest at `position_m`, with `mass_factor` times its nominal mass.
    ///
    /// Rebuilds the physics, so that nothing of an earlier episode remains in rapier's caches: an
    /// episode depends on its start and actions alone.
    pub(crate) fn reset(&mut self, position_m: &Point3<f32>, mass_factor: f32) {
        let body = self.nominal.scaled(mass_factor);
        self.mass_kg = body.mass_kg;
        (self.physics, self.body) = pristine_physics(&body, self.dt_secs, position_m);
    }

    /// Integrates one physics step under `actuation` and the gust force `gust_n` (world frame, N).
    /// If the state is no longer finite, [`World::is_quarantined`] returns `true`.
    pub(crate) fn advance(&mut self, actuation: &Actuation, gust_n: Option<Vector3<f32>>) {
        let body = &mut self.physics.bodies[self.body];
        match actuation {
            Actuation::Wrench { force_n, torque_nm } => {
                body.reset_forces(false);
                body.reset_torques(false);
                let weight_n = Vector3::z() * (self.mass_kg * GRAVITY_MPS2);
                body.add_force(glam(&(force_n - weight_n)), true);
                if let Some(gust_n) = gust_n {
                    body.add_force(glam(&gust_n), true);
                }
                body.add_torque(glam(torque_nm), true);
            }
            Actuation::Velocity(velocity_mps) => body.set_linvel(glam(velocity_mps), true),
        }
        self.physics.step();
    }

    /// Returns the body's pose and motion.
    pub(crate) fn state(&self) -> VehicleState {
        let body = &self.physics.bodies[self.body];
        let rotation = body.rotation();
        let world_from_body = UnitQuaternion::from_quaternion(Quaternion::new(
            rotation.w, rotation.x, rotation.y, rotation.z,
        ));
        VehicleState {
            position_m: Point3::from(nalgebra(body.translation())),
            world_from_body,
            velocity_mps: nalgebra(body.linvel()),
            body_rates_radps: world_from_body.inverse_transform_vector(&nalgebra(body.angvel())),
        }
    }

    /// Returns the position of the body's rearmost point along the corridor, m.
    pub(crate) fn tail_x_m(&self) -> f32 {
        let world_from_body = self.physics.bodies[self.body].position();
        self.body_shape.compute_aabb(world_from_body).mins.x
    }

    /// Returns `true` if rapier found a pose or velocity that is not finite in the last step and
    /// switched the body off.
    pub(crate) fn is_quarantined(&self) -> bool {
        !self.physics.quarantine().is_empty()
    }

    /// Returns the wall that the body touches, by its place in course order from 0.
    pub(crate) fn touched_wall(&self) -> Option<usize> {
        self.walls.iter().position(|wall| self.touches(wall))
    }

    /// Returns what the body touches.
    pub(crate) fn contact(&self) -> Contact {
        let world_from_body = self.physics.bodies[self.body].position();
        let touches_obstacle = self.touches(&self.obstacles);
        // The end wall fills the whole cross-section: a body that touches nothing else meets it
        // like a plane.
        let past_end_wall = self.body_shape.compute_aabb(world_from_body).maxs.x >= self.end_wall_m;
        if touches_obstacle {
            Contact::Obstacle
        } else if past_end_wall {
            Contact::EndWall
        } else {
            Contact::Nothing
        }
    }

    fn touches(&self, surfaces: &TriMesh) -> bool {
        let body_from_world = self.physics.bodies[self.body].position().inverse();
        DefaultQueryDispatcher
            .intersection_test(&body_from_world, &self.body_shape, surfaces)
            // Fails for unsupported shapes alone. A failure must never mean "no contact".
            .expect("parry tests a cuboid against a triangle mesh")
            .intersecting
    }
}

/// Returns a rapier world that holds only the body, at rest at `position_m`.
fn pristine_physics(
    properties: &BodyProperties,
    dt_secs: f32,
    position_m: &Point3<f32>,
) -> (PhysicsWorld, RigidBodyHandle) {
    let mut physics = PhysicsWorld::new();
    // `advance` adds the weight as a force, because the point drone has none.
    physics.gravity = Vector::ZERO;
    physics.integration_parameters.dt = dt_secs;
    // Solver iterations serve contacts and joints, and there are none.
    physics.integration_parameters.num_solver_iterations = 1;
    let mass = MassProperties::new(
        Vector::ZERO,
        properties.mass_kg,
        glam(&properties.inertia_kgm2),
    );
    let body = RigidBodyBuilder::dynamic()
        .translation(glam(&position_m.coords))
        .additional_mass_properties(mass)
        .gyroscopic_forces_enabled(true)
        .can_sleep(false);
    let body = physics.insert_body(body);
    (physics, body)
}

/// Returns the triangles of all obstacles, and those of each of the `walls` walls.
fn collision_meshes(
    mesh: &Mesh,
    walls: usize,
) -> Result<(TriMesh, Vec<TriMesh>), TriMeshBuilderError> {
    let vertices: Vec<Vector> = mesh
        .vertices
        .iter()
        .map(|vertex| glam(&vertex.coords))
        .collect();
    let triangles = mesh.triangles();
    let of = |wanted: &dyn Fn(SurfaceKind) -> bool| {
        let chosen = triangles
            .iter()
            .filter(|&&(_, surface)| wanted(mesh.surfaces[surface].kind))
            .map(|&(triangle, _)| triangle)
            .collect();
        TriMesh::new(vertices.clone(), chosen)
    };
    let obstacles = of(&|kind| kind != SurfaceKind::EndWall)?;
    let walls = (0..walls).map(|place| of(&|kind| kind == SurfaceKind::Wall(place)));
    Ok((obstacles, walls.collect::<Result<_, _>>()?))
}

fn glam(v: &Vector3<f32>) -> Vector {
    Vector::new(v.x, v.y, v.z)
}

fn nalgebra(v: Vector) -> Vector3<f32> {
    Vector3::new(v.x, v.y, v.z)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::course::test_course;

    const PROPERTIES: BodyProperties = BodyProperties {
        mass_kg: 2.0,
        inertia_kgm2: Vector3::new(0.01, 0.02, 0.04),
        half_extents_m: Vector3::new(0.5, 0.4, 0.1),
    };

    fn world_at(position_m: Point3<f32>) -> World {
        let mut world = World::new(&test_course(), PROPERTIES, 0.005).unwrap();
        world.reset(&position_m, 1.0);
        world
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
        let (mut mesh, walls) = (course.mesh(), course.walls().len());
        assert!(collision_meshes(&mesh, walls).is_ok());
        let last = SurfaceKind::Wall(walls - 1);
        mesh.surfaces.retain(|surface| surface.kind != last);
        assert!(collision_meshes(&mesh, walls).is_err());
    }

    #[test]
    fn twice_the_mass_is_moved_half_as_far_and_falls_alike() {
        let mut world = World::new(&test_course(), PROPERTIES, 0.005).unwrap();
        world.reset(&Point3::new(5.0, 0.0, 6.0), 2.0);
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
