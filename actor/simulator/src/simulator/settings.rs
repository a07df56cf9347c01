//! The simulator's section of the configuration, and why a simulator cannot be built from it.

use rapier3d::parry::shape::TriMeshBuilderError;
use serde::{Deserialize, Serialize};

use crate::camera::{CameraFault, CameraSettings};
use crate::course::GeneratorRanges;
use crate::disturbances::{DisturbanceFault, DisturbanceSettings};
use crate::reward::{RewardSettings, RewardSettingsError};
use crate::vehicle::{VehicleSettings, VehicleSettingsError};

/// Everything about a simulator but its course: the `[simulator]` section of the configuration.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimulatorSettings {
    /// The drone and its control.
    pub vehicle: VehicleSettings,
    /// Its depth camera.
    pub camera: CameraSettings,
    /// Size of the reward terms. The simulator itself gives no reward: see
    /// [`crate::reward::RewardTerms`].
    pub reward: RewardSettings,
    /// Ranges that random courses are drawn from, for whoever trains on them: see
    /// [`Course::generate`](crate::course::Course::generate).
    pub generator: GeneratorRanges,
    /// What disturbs episodes: noise in the image, gusts, latency, another mass. All off by
    /// default.
    pub disturbances: DisturbanceSettings,
    /// Steps after which an episode is broken off as
    /// [`Outcome::TimedOut`](super::Outcome::TimedOut). Default 160: the corridor takes 120 steps
    /// of 0.5 s at 1 m/s, and a third is added.
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

/// Why a simulator cannot be built.
#[derive(Debug, thiserror::Error)]
pub enum SimulatorError {
    /// A vehicle setting is out of bounds.
    #[error(transparent)]
    Vehicle(#[from] VehicleSettingsError),
    /// A camera setting is out of bounds.
    #[error(transparent)]
    Camera(#[from] CameraFault),
    /// A reward is out of bounds.
    #[error(transparent)]
    Reward(#[from] RewardSettingsError),
    /// A disturbance is out of bounds.
    #[error(transparent)]
    Disturbances(#[from] DisturbanceFault),
    /// No episode could ever begin.
    #[error(
        "[simulator] max_steps = 0: every episode would be over before its first step; give it at least 1"
    )]
    NoSteps,
    /// The course's surfaces are not a mesh.
    #[error("course \"{course}\": its surfaces make no collision mesh")]
    Mesh {
        /// The course's name.
        course: String,
        /// parry's reason.
        source: TriMeshBuilderError,
    },
}
