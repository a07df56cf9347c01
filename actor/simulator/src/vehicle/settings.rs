//! The `[simulator.vehicle]` section of the configuration.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use skein_action::{Action, ActionSpace, Axis, MAX_ACTION};

use super::Command;

/// A drone that can be flown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Preset {
    /// AirSim's generic quadrotor with its SimpleFlight controller: 1 kg, 0.98 m across, sluggish
    /// (lateral time constant 0.9 s).
    Airsim,
    /// AscTec Hummingbird with a quicker controller: 0.5 kg, 0.44 m across, lateral time constant
    /// 0.4 s.
    Hummingbird,
    /// A drone without attitude: a first-order velocity lag in AirSim's collision body.
    Point,
}

/// The drone and its control: section `[simulator.vehicle]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct VehicleSettings {
    /// The drone that flies. Default `airsim`, the paper's.
    pub preset: Preset,
    /// Numbers of an action: `lateral` (left and up, at a constant speed forward), `velocity`
    /// (forward, left and up) or `velocity+yaw` (also the nose's turning rate). Default `lateral`,
    /// as in the paper.
    pub action: ActionSpace,
    /// Time between two actions, s, 0.01 to 5. Default 0.5: the paper's step counts imply 0.5 to
    /// 1 s.
    pub control_period_secs: f32,
    /// Least rate of physics and flight controller, Hz, 200 to 10,000. It is rounded up to whole
    /// steps per control period. Default 200.
    pub physics_hz: f32,
    /// Forward velocity commanded throughout an episode, m/s, 0.05 to 10; for `lateral` alone.
    /// Default 1, as in the paper.
    pub forward_speed_mps: f32,
    /// Forward velocity that an action of 1 commands, m/s, 0.05 to 5; not for `lateral`. An action
    /// of 0 hovers, and -1 flies back at 1 m/s. Default 1.
    pub max_speed_mps: f32,
    /// Time constant of the `point` preset's velocity, s, 0.01 to 10; other presets ignore it.
    /// Default 0.3.
    pub point_time_constant_secs: f32,
}

impl Default for VehicleSettings {
    fn default() -> Self {
        Self {
            preset: Preset::Airsim,
            action: ActionSpace::Lateral,
            control_period_secs: 0.5,
            physics_hz: 200.0,
            forward_speed_mps: 1.0,
            max_speed_mps: 1.0,
            point_time_constant_secs: 0.3,
        }
    }
}

impl VehicleSettings {
    /// Checks every value against its bounds.
    ///
    /// # Errors
    /// [`VehicleSettingsError`] names the key, the value, the bounds and what would go wrong.
    pub fn validate(&self) -> Result<(), VehicleSettingsError> {
        let bounds = [
            (
                "control_period_secs",
                self.control_period_secs,
                0.01,
                5.0,
                "the policy could not steer",
            ),
            // The rate loop of `airsim` settles in 10 ms: below 200 Hz it oscillates.
            (
                "physics_hz",
                self.physics_hz,
                200.0,
                10_000.0,
                "the flight controller would be unstable, or a step would take too long",
            ),
            (
                "forward_speed_mps",
                self.forward_speed_mps,
                0.05,
                10.0,
                "the drone would never arrive, or would cross surfaces between two steps",
            ),
            // Faster than the tilt limit and the camera's range allow to stop in time.
            (
                "max_speed_mps",
                self.max_speed_mps,
                0.05,
                5.0,
                "the drone would never arrive, or could not stop before what it sees",
            ),
            (
                "point_time_constant_secs",
                self.point_time_constant_secs,
                0.01,
                10.0,
                "the point drone could not be steered",
            ),
        ];
        for (key, value, least, most, consequence) in bounds {
            // Written so that NaN is refused as well.
            if !(least..=most).contains(&value) {
                return Err(VehicleSettingsError {
                    key,
                    value,
                    least,
                    most,
                    consequence,
                });
            }
        }
        Ok(())
    }

    /// Returns the largest speed forward that can be commanded, m/s.
    #[must_use]
    pub fn top_speed_mps(&self) -> f32 {
        match self.action.has_speed() {
            true => self.max_speed_mps,
            false => self.forward_speed_mps,
        }
    }

    /// Returns what `action` commands.
    pub(crate) fn command(&self, action: &Action) -> Command {
        let mut command = Command {
            velocity_mps: Vector3::new(self.forward_speed_mps, 0.0, 0.0),
            yaw_rate_radps: 0.0,
        };
        for (axis, number) in self.action.axes().iter().zip(action) {
            let value = axis.command(*number, self.max_speed_mps);
            match axis {
                Axis::Forward => command.velocity_mps.x = value,
                Axis::Left => command.velocity_mps.y = value,
                Axis::Up => command.velocity_mps.z = value,
                Axis::YawRate => command.yaw_rate_radps = value,
            }
        }
        command
    }

    /// Returns the action that comes nearest to a command.
    pub(crate) fn action_for(&self, command: &Command) -> Action {
        let mut action = [0.0; MAX_ACTION];
        for (axis, number) in self.action.axes().iter().zip(&mut action) {
            let value = match axis {
                Axis::Forward => command.velocity_mps.x,
                Axis::Left => command.velocity_mps.y,
                Axis::Up => command.velocity_mps.z,
                Axis::YawRate => command.yaw_rate_radps,
            };
            *number = axis.number(value, self.max_speed_mps);
        }
        action
    }

    /// Returns the number of physics steps in one control period, and the length of one, s.
    pub(crate) fn physics_steps(&self) -> (u32, f32) {
        // The small subtraction keeps 0.5 s · 200 Hz at 100 steps where the product rounds up.
        let steps = (self.control_period_secs * self.physics_hz - 1e-3)
            .ceil()
            .max(1.0);
        (steps as u32, self.control_period_secs / steps)
    }
}

/// A vehicle setting outside its bounds.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("[simulator.vehicle] {key} = {value} is outside {least} to {most}: {consequence}")]
pub struct VehicleSettingsError {
    key: &'static str,
    value: f32,
    least: f32,
    most: f32,
    consequence: &'static str,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_are_valid_and_give_100_physics_steps_of_5_ms() {
        let settings = VehicleSettings::default();
        assert_eq!(settings.validate(), Ok(()));
        let (steps, dt_secs) = settings.physics_steps();
        assert_eq!(steps, 100);
        assert!((dt_secs - 0.005).abs() < 1e-9);
    }

    #[test]
    fn physics_never_runs_slower_than_configured() {
        let settings = VehicleSettings {
            control_period_secs: 0.333,
            physics_hz: 210.0,
            ..Default::default()
        };
        let (steps, dt_secs) = settings.physics_steps();
        assert_eq!(steps, 70);
        assert!(1.0 / dt_secs >= 210.0);
    }

    #[test]
    fn an_action_commands_what_its_space_says() {
        let command = |action: ActionSpace| {
            let settings = VehicleSettings {
                action,
                forward_speed_mps: 1.5,
                max_speed_mps: 4.0,
                ..Default::default()
            };
            let Command {
                velocity_mps,
                yaw_rate_radps,
            } = settings.command(&[0.5, -0.25, 0.75, -1.0]);
            let back = settings.action_for(&settings.command(&[0.5, -0.25, 0.75, -1.0]));
            let numbers = action.numbers();
            assert_eq!(back[..numbers], [0.5, -0.25, 0.75, -1.0][..numbers]);
            [
                velocity_mps.x,
                velocity_mps.y,
                velocity_mps.z,
                yaw_rate_radps,
            ]
        };
        assert_eq!(command(ActionSpace::Lateral), [1.5, 0.5, -0.25, 0.0]);
        assert_eq!(command(ActionSpace::Velocity), [2.0, -0.25, 0.75, 0.0]);
        assert_eq!(command(ActionSpace::VelocityYaw), [2.0, -0.25, 0.75, -1.0]);
    }

    #[test]
    fn nan_is_refused_by_key() {
        let settings = VehicleSettings {
            forward_speed_mps: f32::NAN,
            ..Default::default()
        };
        let message = settings.validate().unwrap_err().to_string();
        assert!(message.contains("forward_speed_mps = NaN"), "{message}");
    }

    #[test]
    fn unknown_key_is_refused() {
        let error = toml::from_str::<VehicleSettings>("presett = \"airsim\"").unwrap_err();
        assert!(error.to_string().contains("presett"), "{error}");
    }
}
