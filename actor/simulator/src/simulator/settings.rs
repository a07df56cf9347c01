//! The `[simulator]` section of the configuration.

use serde::{Deserialize, Serialize};

use crate::camera::CameraSettings;
use crate::course::GeneratorRanges;
use crate::disturbances::DisturbanceSettings;
use crate::reward::RewardSettings;
use crate::vehicle::VehicleSettings;

/// All settings of a simulator except its course: section `[simulator]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimulatorSettings {
    /// The drone and its control.
    pub vehicle: VehicleSettings,
    /// The drone's depth camera.
    pub camera: CameraSettings,
    /// Size of each reward term. The simulator only checks them; the caller computes the reward
    /// with [`RewardTerms::of`](crate::reward::RewardTerms::of).
    pub reward: RewardSettings,
    /// Ranges from which [`Course::generate`](crate::course::Course::generate) draws random
    /// courses. The simulator itself does not use them.
    pub generator: GeneratorRanges,
    /// Disturbances of episodes: depth noise, gusts, latency, a different mass. All are off by
    /// default.
    pub disturbances: DisturbanceSettings,
    /// Steps after which an episode ends as
    /// [`EpisodeOutcome::TimedOut`](super::EpisodeOutcome::TimedOut). Default 160: the corridor
    /// takes 120 steps of 0.5 s at 1 m/s, plus a third.
    pub max_steps: u32,
}

impl Default for SimulatorSettings {
    fn default() -> Self {
        Self {
            vehicle: VehicleSettings::default(),
            camera: CameraSettings::default(),
            reward: RewardSettings::default(),
            generator: GeneratorRanges::default(),
            disturbances: DisturbanceSettings::default(),
            max_steps: 160,
        }
    }
}
