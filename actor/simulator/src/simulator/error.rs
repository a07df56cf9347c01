//! Errors of building a simulator and of flying a step.

use rapier3d::parry::shape::TriMeshBuilderError;

use crate::camera::CameraSettingsError;
use crate::disturbances::DisturbanceSettingsError;
use crate::reward::RewardSettingsError;
use crate::vehicle::VehicleSettingsError;

/// Reason why a simulator cannot be built.
#[derive(Debug, thiserror::Error)]
pub enum SimulatorError {
    /// A vehicle setting is out of bounds.
    #[error(transparent)]
    Vehicle(#[from] VehicleSettingsError),
    /// A camera setting is out of bounds.
    #[error(transparent)]
    Camera(#[from] CameraSettingsError),
    /// A reward is out of bounds.
    #[error(transparent)]
    Reward(#[from] RewardSettingsError),
    /// A disturbance is out of bounds.
    #[error(transparent)]
    Disturbances(#[from] DisturbanceSettingsError),
    /// The step limit allows no step.
    #[error(
        "[simulator] max_steps = 0: every episode would end before its first step; set at least 1"
    )]
    NoSteps,
    /// The course's surfaces form no mesh.
    #[error("course \"{course}\": its surfaces form no collision mesh")]
    Mesh {
        /// The course's name.
        course: String,
        /// parry's reason.
        source: TriMeshBuilderError,
    },
}

/// Reason why a step fails. The episode is over then; [`Simulator::reset`](super::Simulator::reset)
/// starts another.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum SimulationError {
    /// A number became NaN or infinite.
    #[error("{what} is not finite in step {step}: the episode is aborted")]
    NonFinite {
        /// Name of the number.
        what: &'static str,
        /// The step's number within the episode, from 1.
        step: u32,
    },
    /// No episode is in progress.
    #[error("no episode is in progress: call reset to start one")]
    NotFlying,
}
