//! The drone: its presets, its flight controller, and the force it exerts in each physics step.
//!
//! Three presets share one interface. `airsim` and `hummingbird` are quadrotors: their controller
//! turns a velocity command into tilt, tilt into torques, and torques into rotor thrust. `point`
//! follows the command with a first-order lag. Nothing here integrates motion: rapier does, in
//! `body.rs`.

mod airframe;
mod controller;
mod rotors;
mod settings;
#[cfg(test)]
mod step_response_tests;

pub use settings::{Preset, VehicleSettings, VehicleSettingsError};

use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};

use airframe::Airframe;
pub(crate) use airframe::GRAVITY_MPS2;
use controller::Cascade;
use rotors::Rotors;

/// Pose and motion of the drone. World frame: x along the corridor, y left, z up. Body frame: x
/// forward, y left, z up.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VehicleState {
    /// Centre of mass, world frame, m.
    pub position_m: Point3<f32>,
    /// Attitude: rotates body vectors into the world frame.
    pub world_from_body: UnitQuaternion<f32>,
    /// Velocity of the centre of mass, world frame, m/s.
    pub velocity_mps: Vector3<f32>,
    /// Angular velocity about the body's axes, rad/s.
    pub body_rates_radps: Vector3<f32>,
}

impl VehicleState {
    /// Returns the state of a level, motionless drone at `position_m` that faces along the
    /// corridor.
    pub fn at_rest(position_m: Point3<f32>) -> Self {
        Self {
            position_m,
            world_from_body: UnitQuaternion::identity(),
            velocity_mps: Vector3::zeros(),
            body_rates_radps: Vector3::zeros(),
        }
    }

    /// Returns position and attitude as one transform, world from body.
    pub fn pose(&self) -> Isometry3<f32> {
        Isometry3::from_parts(Translation3::from(self.position_m), self.world_from_body)
    }

    /// Returns the velocity in the heading frame, m/s: x where the nose points, y left of it, z up.
    /// A real drone can measure it.
    pub fn heading_velocity_mps(&self) -> Vector3<f32> {
        self.in_heading_frame(&self.velocity_mps)
    }

    /// Returns a vector of the world in the heading frame.
    pub(crate) fn in_heading_frame(&self, vector: &Vector3<f32>) -> Vector3<f32> {
        let [i, j, k, w]: [f32; 4] = self.world_from_body.coords.into();
        // Where the nose points, seen from above: no angle is needed.
        let (along, beside) = (1.0 - 2.0 * (j * j + k * k), 2.0 * (i * j + w * k));
        let level = (along * along + beside * beside).sqrt();
        if level == 0.0 {
            // The nose points straight up or down.
            return *vector;
        }
        let (cos, sin) = (along / level, beside / level);
        Vector3::new(
            cos * vector.x + sin * vector.y,
            cos * vector.y - sin * vector.x,
            vector.z,
        )
    }
}

/// Motion that an action asks for, in the heading frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Command {
    /// Forward, left, up, m/s.
    pub(crate) velocity_mps: Vector3<f32>,
    /// Turning rate of the nose to the left, rad/s.
    pub(crate) yaw_rate_radps: f32,
}

/// Effect of the vehicle on its rigid body during one physics step, in the world frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Actuation {
    /// Force at the centre of mass without gravity, N, and torque, N·m.
    Wrench {
        force_n: Vector3<f32>,
        torque_nm: Vector3<f32>,
    },
    /// Velocity during the step, m/s, and turning rate about the upright axis, rad/s; the body does
    /// not fall.
    Motion {
        velocity_mps: Vector3<f32>,
        yaw_rate_radps: f32,
    },
}

/// Mass and size of the rigid body that rapier integrates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct BodyProperties {
    pub(crate) mass_kg: f32,
    pub(crate) inertia_kgm2: Vector3<f32>,
    pub(crate) half_extents_m: Vector3<f32>,
}

impl BodyProperties {
    /// Returns the same body with `factor` times the density.
    pub(crate) fn scaled(self, factor: f32) -> Self {
        Self {
            mass_kg: self.mass_kg * factor,
            inertia_kgm2: self.inertia_kgm2 * factor,
            ..self
        }
    }
}

/// A drone and the state of its controller and rotors at a moment of an episode.
#[derive(Debug, Clone)]
pub(crate) enum Vehicle {
    Quadrotor {
        airframe: Airframe,
        cascade: Cascade,
        rotors: Rotors,
    },
    Point {
        time_constant_secs: f32,
    },
}

impl Vehicle {
    /// Returns the vehicle at the start of an episode: rotors and controller trimmed for hover.
    pub(crate) fn trimmed(settings: &VehicleSettings) -> Self {
        let quadrotor = |airframe: Airframe| Self::Quadrotor {
            airframe,
            cascade: Cascade::trimmed(&airframe),
            rotors: Rotors::at(airframe.hover_command()),
        };
        match settings.preset {
            Preset::Airsim => quadrotor(Airframe::AIRSIM),
            Preset::Hummingbird => quadrotor(Airframe::HUMMINGBIRD),
            Preset::Point => Self::Point {
                time_constant_secs: settings.point_time_constant_secs,
            },
        }
    }

    /// Returns the body's mass and size. The point drone uses AirSim's: its size decides what it
    /// touches, its mass has no effect.
    pub(crate) fn body(&self) -> BodyProperties {
        let airframe = match self {
            Self::Quadrotor { airframe, .. } => airframe,
            Self::Point { .. } => &Airframe::AIRSIM,
        };
        BodyProperties {
            mass_kg: airframe.mass_kg,
            inertia_kgm2: airframe.inertia_kgm2,
            half_extents_m: airframe.half_extents_m,
        }
    }

    /// Runs controller and rotors for `dt_secs` towards `command`.
    pub(crate) fn actuate(
        &mut self,
        state: &VehicleState,
        command: &Command,
        dt_secs: f32,
    ) -> Actuation {
        match self {
            Self::Quadrotor {
                airframe,
                cascade,
                rotors,
            } => {
                let turn = cascade.command(&airframe.gains, state, command, dt_secs);
                let wrench = rotors.advance(airframe, &turn, dt_secs);
                let force_n = Vector3::z() * wrench.thrust_n + drag_n(airframe, state);
                Actuation::Wrench {
                    force_n: state.world_from_body * force_n,
                    torque_nm: state.world_from_body * wrench.torque_nm,
                }
            }
            Self::Point { time_constant_secs } => {
                // The lag's exact solution over one step, so that the result does not depend on the
                // step's length.
                let reached = 1.0 - (-dt_secs / *time_constant_secs).exp();
                let wanted = state.world_from_body * command.velocity_mps;
                Actuation::Motion {
                    velocity_mps: state.velocity_mps + (wanted - state.velocity_mps) * reached,
                    yaw_rate_radps: command.yaw_rate_radps,
                }
            }
        }
    }
}

/// Returns the quadratic drag in the body frame, N.
fn drag_n(airframe: &Airframe, state: &VehicleState) -> Vector3<f32> {
    let velocity_mps = state
        .world_from_body
        .inverse_transform_vector(&state.velocity_mps);
    -airframe
        .drag_n_per_mps2
        .component_mul(&velocity_mps.map(|v| v * v.abs()))
}

#[cfg(test)]
mod tests {
    use std::f32::consts::FRAC_PI_2;

    use super::*;

    #[test]
    fn heading_velocity_turns_with_the_nose_but_not_with_the_tilt() {
        // Nose to the left and rolled: a motion to the left is forward, and up stays up.
        let state = VehicleState {
            world_from_body: UnitQuaternion::from_euler_angles(0.3, 0.0, FRAC_PI_2),
            velocity_mps: Vector3::new(0.0, 2.0, 0.5),
            ..VehicleState::at_rest(Point3::origin())
        };
        assert!((state.heading_velocity_mps() - Vector3::new(2.0, 0.0, 0.5)).norm() < 1e-5);
    }

    #[test]
    fn drag_acts_along_the_bodys_axes_against_the_motion() {
        let mut state = VehicleState {
            velocity_mps: Vector3::new(2.0, 0.0, -1.0),
            ..VehicleState::at_rest(Point3::origin())
        };
        assert!(
            (drag_n(&Airframe::AIRSIM, &state) - Vector3::new(-0.0264, 0.0, 0.1347)).norm() < 1e-5
        );
        // Nose straight down: the body's up axis now points forward in the world.
        state.world_from_body = UnitQuaternion::from_euler_angles(0.0, FRAC_PI_2, 0.0);
        assert!(
            (drag_n(&Airframe::AIRSIM, &state) - Vector3::new(-0.0066, 0.0, -4.0 * 0.1347)).norm()
                < 1e-5
        );
    }
}
