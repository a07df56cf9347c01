//! Checkpoints: everything that determines the rest of a run, in a directory of its own.
//!
//! A run resumed from one continues bit for bit as if it had never stopped, so all of it is here: parameters and moments of every network, the replay
//! buffer with the depth images it still needs, counters, averages. Random generators are not: they are derived anew for every epoch.
//!
//! `checkpoints/flight-<n>/` holds
//! - `tensors.safetensors`: parameters, targets, moments, log α;
//! - `replay.safetensors`: rows of both parts, numbers of their images, images;
//! - `progress.bin`: [`Progress`], bincode;
//! - `manifest.json`: format, configuration, and size and checksum of each of the above.
//!
//! It is written aside and renamed into place when all of it is on disk ([`store`]): a directory of that name is complete, and what is damaged later
//! is refused by its checksum, never learned from.

mod error;
mod files;
mod manifest;
mod store;
#[cfg(test)]
mod tests;
mod writer;

use serde::{Deserialize, Serialize};

use crate::metrics::Windows;
use crate::replay::ReplayState;

pub use error::CheckpointError;
pub use store::{CheckpointStore, checkpoint_directory};
pub use writer::CheckpointWriter;

/// Everything that determines the rest of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct CheckpointState {
    /// How far the run is.
    pub progress: Progress,
    /// Everything that updates change, by name.
    pub tensors: Vec<NamedTensor>,
    /// The replay buffer's content.
    pub replay: ReplayState,
}

/// How far a run is: every counter that decides what happens next.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Progress {
    /// Training flights committed; the checkpoint's name.
    pub flights: u64,
    /// Epochs completed.
    pub epochs: u64,
    /// The newest published snapshot.
    pub policy_version: u64,
    /// Environment steps committed.
    pub environment_steps: u64,
    /// Steps the VAE was trained.
    pub vae_steps: u64,
    /// SAC updates done.
    pub sac_updates: u64,
    /// Evaluations begun to confirm a candidate for the best snapshot; numbers their flights.
    pub evaluations: u64,
    /// Flights committed when the latest candidate was chosen.
    pub latest_candidate: Option<u64>,
    /// The best snapshot so far.
    pub best: Option<BestSnapshot>,
    /// Averages over the latest flights.
    pub windows: Windows,
}

/// The best snapshot, and why it is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct BestSnapshot {
    /// The snapshot.
    pub policy_version: u64,
    /// Training flights committed when it was chosen.
    pub flights: u64,
    /// Walls passed in the training flights of the window then, on average.
    pub window_walls_passed: f64,
    /// Walls passed in the evaluation flights that confirmed it, on average.
    pub confirmed_walls_passed: f64,
}

/// A tensor on the processor, by name.
#[derive(Debug, Clone, PartialEq)]
pub struct NamedTensor {
    /// Its name, unique in a checkpoint.
    pub name: String,
    /// Its shape, outermost first.
    pub shape: Vec<usize>,
    /// Its values in row-major order, as many as the shape says.
    pub values: TensorValues,
}

/// A tensor's values.
#[derive(Debug, Clone, PartialEq)]
pub enum TensorValues {
    /// Parameters, moments.
    F32(Vec<f32>),
    /// What must be exact in double precision.
    F64(Vec<f64>),
    /// Counters.
    I64(Vec<i64>),
}
