//! The `[simulator.vehicle]` section of the configuration.

use serde::{Deserialize, Serialize};

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
    /// Time between two actions, s, 0.01 to 5. Default 0.5: the paper's step counts imply 0.5 to
    /// 1 s.
    pub control_period_secs: f32,
    /// Least rate of physics and flight controller, Hz, 200 to 10,000. It is rounded up to whole
    /// steps per control period. Default 200.
    pub physics_hz: f32,
    /// Forward velocity commanded throughout an episode, m/s, 0.05 to 10. Default 1, as in the
    /// paper.
    pub forward_speed_mps: f32,
    /// Time constant of the `point` preset's velocity, s, 0.01 to 10; other presets ignore it.
    /// Default 0.3.
    pub point_time_constant_secs: f32,
}

impl Default for VehicleSettings {
    fn default() -> Self {
        Self {
            preset: Preset::Airsim,
            control_period_secs: 0.5,
            physics_hz: 200.0,
            forward_speed_mps: 1.0,
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
