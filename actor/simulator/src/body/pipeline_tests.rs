//! The body against rapier's whole pipeline: the same responses, and no drift between the two.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use rapier3d::dynamics::RigidBodyHandle;
use rapier3d::pipeline::PhysicsWorld;

use super::*;
use crate::disturbances::{Gust, GustSettings};
use crate::vehicle::{Command, Preset, Vehicle, VehicleSettings};

/// Largest difference accepted, m, m/s, rad/s, and of a quaternion's parts.
const SAME: f32 = 1e-3;

/// The body in rapier's own world.
struct Reference {
    physics: PhysicsWorld,
    body: RigidBodyHandle,
    mass_kg: f32,
}

impl Reference {
    fn at_rest(properties: &BodyProperties, position_m: &Point3<f32>, dt_secs: f32) -> Self {
        let mut physics = PhysicsWorld::new();
        physics.gravity = Vector::ZERO;
        physics.integration_parameters.dt = dt_secs;
        physics.integration_parameters.num_solver_iterations = 1;
        let body = physics.insert_body(builder(properties, position_m));
        Self {
            physics,
            body,
            mass_kg: properties.mass_kg,
        }
    }

    fn advance(&mut self, actuation: &Actuation, gust_n: Option<Vector3<f32>>) {
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
            Actuation::Motion {
                velocity_mps,
                yaw_rate_radps,
            } => {
                body.set_linvel(glam(velocity_mps), true);
                body.set_angvel(glam(&(Vector3::z() * *yaw_rate_radps)), true);
            }
        }
        self.physics.step();
    }

    fn state(&self) -> VehicleState {
        state_of(&self.physics.bodies[self.body])
    }
}

/// Returns the largest difference between two states.
fn difference(one: &VehicleState, other: &VehicleState) -> f32 {
    let quaternions = one.world_from_body.coords - other.world_from_body.coords;
    [
        (one.position_m - other.position_m).amax(),
        quaternions.amax(),
        (one.velocity_mps - other.velocity_mps).amax(),
        (one.body_rates_radps - other.body_rates_radps).amax(),
    ]
    .into_iter()
    .fold(0.0, f32::max)
}

/// Flies the same commands with a body and its reference, each with its own controller, and returns
/// the largest difference. `command` gives the velocity of each half second.
fn largest_difference(
    preset: Preset,
    gusts: &GustSettings,
    secs: f32,
    mut command: impl FnMut() -> Vector3<f32>,
) -> f32 {
    let settings = VehicleSettings {
        preset,
        ..Default::default()
    };
    let (physics_steps, dt_secs) = settings.physics_steps();
    let mut vehicles = [(); 2].map(|()| Vehicle::trimmed(&settings));
    let properties = vehicles[0].body().scaled(1.1);
    let start_m = Point3::new(1.5, 0.3, 3.5);
    let mut body = Body::at_rest(&properties, &start_m, dt_secs);
    let mut reference = Reference::at_rest(&properties, &start_m, dt_secs);
    let mut gust = Gust::new(gusts, dt_secs, 7);
    let mut largest = 0.0_f32;
    for _ in 0..(secs / settings.control_period_secs) as u32 {
        let command = Command {
            velocity_mps: command(),
            yaw_rate_radps: 0.0,
        };
        for _ in 0..physics_steps {
            let gust_n = gust.as_mut().map(Gust::advance);
            let wrench = vehicles[0].actuate(&body.state(), &command, dt_secs);
            body.advance(&wrench, gust_n);
            let wrench = vehicles[1].actuate(&reference.state(), &command, dt_secs);
            reference.advance(&wrench, gust_n);
            largest = largest.max(difference(&body.state(), &reference.state()));
        }
    }
    assert!(body.state().position_m.x > 2.0, "it did not fly");
    largest
}

const PRESETS: [Preset; 3] = [Preset::Airsim, Preset::Hummingbird, Preset::Point];

#[test]
fn step_responses_equal_the_pipelines() {
    for preset in PRESETS {
        for command in [
            Vector3::new(1.0, 1.0, 1.0),
            Vector3::new(1.0, -1.0, 0.0),
            Vector3::new(10.0, 8.0, -1.0),
        ] {
            let apart = largest_difference(preset, &GustSettings::default(), 4.0, || command);
            assert!(apart < SAME, "{preset:?} {command}: {apart}");
        }
    }
}

#[test]
fn a_minute_of_flight_in_gusts_does_not_drift_from_the_pipelines() {
    for preset in PRESETS {
        let force_rms_n = if preset == Preset::Point { 0.0 } else { 0.3 };
        let gusts = GustSettings {
            force_rms_n,
            ..Default::default()
        };
        let mut rng = Pcg64Mcg::seed_from_u64(3);
        let mut draw = || rng.random_range(-1.0..=1.0);
        let apart = largest_difference(preset, &gusts, 60.0, || Vector3::new(1.0, draw(), draw()));
        assert!(apart < SAME, "{preset:?}: {apart}");
    }
}

#[test]
fn a_tumbling_body_precesses_as_in_the_pipeline() {
    let properties = BodyProperties {
        mass_kg: 1.0,
        inertia_kgm2: Vector3::new(0.01, 0.02, 0.04),
        half_extents_m: Vector3::new(0.5, 0.4, 0.1),
    };
    let dt_secs = 0.005;
    let mut body = Body::at_rest(&properties, &Point3::origin(), dt_secs);
    let mut reference = Reference::at_rest(&properties, &Point3::origin(), dt_secs);
    let push = |torque_nm| Actuation::Wrench {
        force_n: Vector3::z() * GRAVITY_MPS2,
        torque_nm,
    };
    for step in 0..200 {
        let torque_nm = if step < 20 {
            Vector3::new(0.1, 0.4, 0.2)
        } else {
            Vector3::zeros()
        };
        body.advance(&push(torque_nm), None);
        reference.advance(&push(torque_nm), None);
    }
    let rates = body.state().body_rates_radps;
    assert!(rates.norm() > 2.0, "{rates}");
    // A linearized rotation lags behind the exact one by (ω·dt)²/12 of its angle: 3 · 10⁻⁵ rad.
    let apart = difference(&body.state(), &reference.state());
    assert!(apart < SAME, "{apart}");
}

#[test]
fn a_torque_that_is_not_finite_quarantines_the_body_at_its_last_pose() {
    let properties = Vehicle::trimmed(&VehicleSettings::default()).body();
    for wrong in [f32::NAN, f32::INFINITY] {
        for (force_n, torque_nm) in [
            (Vector3::new(0.0, wrong, 0.0), Vector3::zeros()),
            (Vector3::zeros(), Vector3::new(0.0, 0.0, wrong)),
        ] {
            let mut body = Body::at_rest(&properties, &Point3::new(1.0, 2.0, 3.0), 0.005);
            assert!(!body.is_quarantined());
            body.advance(&Actuation::Wrench { force_n, torque_nm }, None);
            assert!(body.is_quarantined());
            assert_eq!(body.state().position_m, Point3::new(1.0, 2.0, 3.0));
        }
    }
}
