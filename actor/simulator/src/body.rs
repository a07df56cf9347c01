//! The vehicle's rigid body. rapier integrates it, without its pipeline.
//!
//! The pipeline serves many bodies that touch: for a single free one, islands, broad phase and
//! solver took two thirds of an environment step. [`Body::advance`] calls the functions by which
//! rapier integrates a body, in the pipeline's order. `body/pipeline_tests.rs` compares the two.
//!
//! rapier and parry use glam, the rest of this crate uses nalgebra: only this file and `world.rs`
//! convert between them.

#[cfg(test)]
mod pipeline_tests;

use nalgebra::{Point3, Quaternion, UnitQuaternion, Vector3};
use rapier3d::dynamics::{MassProperties, RigidBody, RigidBodyBuilder};
use rapier3d::geometry::ColliderSet;
use rapier3d::math::{Pose, Vector};

use crate::vehicle::{Actuation, BodyProperties, GRAVITY_MPS2, VehicleState};

/// A free body that feels its vehicle, its weight and gusts.
pub(crate) struct Body {
    rigid: RigidBody,
    mass_kg: f32,
    dt_secs: f32,
    integrity: Integrity,
}

/// `Broken` once a pose or velocity was not finite. The pose stays the last finite one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Integrity {
    Sound,
    Broken,
}

impl Body {
    /// Returns a body at rest at `position_m`. A physics step takes `dt_secs`.
    pub(crate) fn at_rest(
        properties: &BodyProperties,
        position_m: &Point3<f32>,
        dt_secs: f32,
    ) -> Self {
        let mut rigid = builder(properties, position_m).build();
        // A body outside the pipeline computes its mass when told to. It has no colliders.
        rigid.recompute_mass_properties_from_colliders(&ColliderSet::new());
        Self {
            rigid,
            mass_kg: properties.mass_kg,
            dt_secs,
            integrity: Integrity::Sound,
        }
    }

    /// Integrates one physics step under `actuation` and the gust force `gust_n` (world frame, N).
    /// If the state is no longer finite, [`Body::is_quarantined`] returns `true`.
    pub(crate) fn advance(&mut self, actuation: &Actuation, gust_n: Option<Vector3<f32>>) {
        let (body, dt_secs) = (&mut self.rigid, self.dt_secs);
        match actuation {
            Actuation::Wrench { force_n, torque_nm } => {
                let weight_n = Vector3::z() * (self.mass_kg * GRAVITY_MPS2);
                let force_n = force_n - weight_n + gust_n.unwrap_or_default();
                body.apply_impulse(glam(&force_n) * dt_secs, false);
                body.apply_torque_impulse(glam(torque_nm) * dt_secs, false);
                body.set_angvel(body.angvel_with_gyroscopic_forces(dt_secs), false);
            }
            Actuation::Motion {
                velocity_mps,
                yaw_rate_radps,
            } => {
                body.set_linvel(glam(velocity_mps), false);
                body.set_angvel(glam(&(Vector3::z() * *yaw_rate_radps)), false);
            }
        }
        let mut pose = body.predict_position_using_velocity(dt_secs);
        // Otherwise rounding would stretch the quaternion step by step.
        pose.rotation = pose.rotation.normalize();
        if pose.is_finite() && body.linvel().is_finite() && body.angvel().is_finite() {
            body.set_position(pose, false);
        } else {
            self.integrity = Integrity::Broken;
        }
    }

    /// Returns the body's pose and motion.
    pub(crate) fn state(&self) -> VehicleState {
        state_of(&self.rigid)
    }

    /// Returns the body's pose, world from body.
    pub(crate) fn pose(&self) -> &Pose {
        self.rigid.position()
    }

    /// Moves the body.
    #[cfg(test)]
    pub(crate) fn put(&mut self, pose: Pose) {
        self.rigid.set_position(pose, false);
    }

    /// Returns `true` if a pose or velocity was not finite: the body's state is meaningless.
    pub(crate) fn is_quarantined(&self) -> bool {
        self.integrity == Integrity::Broken
    }
}

/// Returns the description of a body at rest at `position_m`.
fn builder(properties: &BodyProperties, position_m: &Point3<f32>) -> RigidBodyBuilder {
    let mass = MassProperties::new(
        Vector::ZERO,
        properties.mass_kg,
        glam(&properties.inertia_kgm2),
    );
    RigidBodyBuilder::dynamic()
        .translation(glam(&position_m.coords))
        .additional_mass_properties(mass)
        .gyroscopic_forces_enabled(true)
        .can_sleep(false)
}

fn state_of(body: &RigidBody) -> VehicleState {
    let rotation = body.rotation();
    // `advance` normalizes it.
    let world_from_body = UnitQuaternion::new_unchecked(Quaternion::new(
        rotation.w, rotation.x, rotation.y, rotation.z,
    ));
    VehicleState {
        position_m: Point3::from(nalgebra(body.translation())),
        world_from_body,
        velocity_mps: nalgebra(body.linvel()),
        body_rates_radps: world_from_body.inverse_transform_vector(&nalgebra(body.angvel())),
    }
}

pub(crate) fn glam(v: &Vector3<f32>) -> Vector {
    Vector::new(v.x, v.y, v.z)
}

fn nalgebra(v: Vector) -> Vector3<f32> {
    Vector3::new(v.x, v.y, v.z)
}
