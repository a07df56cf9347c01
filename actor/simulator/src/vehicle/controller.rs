//! Cascade flight controller: velocity → tilt → body rates → rotor commands, and climb → throttle.
//!
//! The structure is SimpleFlight's, with one difference: velocity errors are taken in the heading
//! frame (yawed but level), while SimpleFlight takes them in the tilted body frame. At the few
//! degrees flown here the two agree to second order.

use std::f32::consts::{PI, TAU};

use nalgebra::Vector3;

use super::airframe::{Airframe, Gains};
use super::rotors::RotorCommand;
use super::{Command, VehicleState};

/// State of the controller: the climb loop integrates, and the heading is held.
#[derive(Debug, Clone)]
pub(crate) struct Cascade {
    /// Integral part of the throttle; starts at the hover command.
    throttle_integral: f32,
    /// Heading to hold, in [-π, π]; a commanded turning rate moves it.
    heading_rad: f32,
}

impl Cascade {
    /// Returns a controller trimmed for hover.
    pub(crate) fn trimmed(airframe: &Airframe) -> Self {
        Self {
            throttle_integral: airframe.hover_command(),
            heading_rad: 0.0,
        }
    }

    /// Returns the rotor command that brings the drone to `command`.
    pub(crate) fn command(
        &mut self,
        gains: &Gains,
        state: &VehicleState,
        command: &Command,
        dt_secs: f32,
    ) -> RotorCommand {
        self.heading_rad = wrapped(self.heading_rad + command.yaw_rate_radps * dt_secs);
        let error_mps = command.velocity_mps - state.heading_velocity_mps();
        let attitude_rad = attitude_target_rad(gains, &error_mps, self.heading_rad);
        RotorCommand {
            throttle: self.throttle(gains, error_mps.z, dt_secs),
            turn: turn_command(gains, state, &attitude_rad),
        }
    }

    fn throttle(&mut self, gains: &Gains, climb_error_mps: f32, dt_secs: f32) -> f32 {
        // Clamped to prevent windup in a long saturation.
        self.throttle_integral = (self.throttle_integral
            + gains.throttle_per_m * climb_error_mps * dt_secs)
            .clamp(0.0, 1.0);
        (self.throttle_integral + gains.throttle_per_mps * climb_error_mps)
            .clamp(gains.throttle_min, 1.0)
    }
}

/// Returns the target roll, pitch and yaw. Rolling left side up moves the drone to the right (−y);
/// pitching nose down moves it forward.
fn attitude_target_rad(gains: &Gains, error_mps: &Vector3<f32>, heading_rad: f32) -> Vector3<f32> {
    let tilt = |error_mps: f32| {
        (gains.tilt_per_mps * error_mps).clamp(-gains.tilt_limit_rad, gains.tilt_limit_rad)
    };
    Vector3::new(-tilt(error_mps.y), tilt(error_mps.x), heading_rad)
}

/// Returns an angle between -2π and 2π as the same one in [-π, π].
fn wrapped(angle_rad: f32) -> f32 {
    if angle_rad > PI {
        angle_rad - TAU
    } else if angle_rad < -PI {
        angle_rad + TAU
    } else {
        angle_rad
    }
}

fn turn_command(gains: &Gains, state: &VehicleState, target_rad: &Vector3<f32>) -> Vector3<f32> {
    let (roll, pitch, yaw) = state.world_from_body.euler_angles();
    let limit = gains.rate_limit_radps;
    let mut error_rad = target_rad - Vector3::new(roll, pitch, yaw);
    error_rad.z = wrapped(error_rad.z);
    let rate_target = error_rad.map(|e| (gains.rate_per_rad * e).clamp(-limit, limit));
    (rate_target - state.body_rates_radps).map(|e| (gains.command_per_radps * e).clamp(-1.0, 1.0))
}

#[cfg(test)]
mod tests {
    use nalgebra::{Point3, UnitQuaternion};

    use super::*;

    #[test]
    fn target_tilt_never_exceeds_the_limit() {
        let gains = &Airframe::AIRSIM.gains;
        let target = attitude_target_rad(gains, &Vector3::new(100.0, 100.0, 0.0), 0.0);
        assert!((target.x.to_degrees() + 32.7).abs() < 0.05);
        assert!((target.y.to_degrees() - 32.7).abs() < 0.05);
        // An error of 1 m/s gives a fifth of the limit: SimpleFlight's P is 0.2.
        let target = attitude_target_rad(gains, &Vector3::new(0.0, 1.0, 0.0), 0.0);
        assert!((target.x + 0.2 * gains.tilt_limit_rad).abs() < 1e-6);
    }

    #[test]
    fn target_body_rate_is_limited() {
        let gains = &Airframe::AIRSIM.gains;
        let on_its_side = VehicleState {
            world_from_body: UnitQuaternion::from_euler_angles(1.5, 0.0, 0.0),
            ..VehicleState::at_rest(Point3::origin())
        };
        let turn = turn_command(gains, &on_its_side, &Vector3::zeros());
        assert!((turn.x + gains.command_per_radps * gains.rate_limit_radps).abs() < 1e-6);
    }

    #[test]
    fn climb_integral_does_not_wind_up() {
        let airframe = &Airframe::AIRSIM;
        let mut cascade = Cascade::trimmed(airframe);
        for _ in 0..100_000 {
            cascade.throttle(&airframe.gains, 5.0, 0.005);
        }
        // After full saturation, a small sink error takes effect at once.
        let throttle = cascade.throttle(&airframe.gains, -0.5, 0.005);
        assert!(throttle < 0.6, "{throttle}");
    }
}
