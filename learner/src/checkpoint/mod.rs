//! Checkpoints: everything that determines the rest of a run, in a directory of its own.
//!
//! On the type of processor that began it, a run resumed from a checkpoint continues bit for bit as
//! if it had never stopped. So a checkpoint holds parameters and moments of every network, the
//! replay buffer with the depth images still needed, snapshots that still fly or are the best,
//! counters, averages, and the lengths of the metrics files. It holds no random generators: they
//! are derived again for every epoch.
//!
//! `checkpoints/episode-<n>/` contains
//! - `tensors.safetensors`: parameters, targets, moments, log α;
//! - `replay.safetensors`: rows of both parts, numbers of their images, images;
//! - `snapshots.safetensors`: snapshots by version;
//! - `progress.bin`: [`TrainingProgress`], bincode;
//! - `config.toml`: the configuration, to show differences from another one;
//! - `manifest.json`: format, size and checksum of each file above, and its own checksum.
//!
//! It is written under another name and renamed when everything is on disk ([`store`]). So a
//! directory of this name is complete. Later damage is detected by checksum, and damaged state is
//! never learned from.

mod error;
mod files;
mod manifest;
mod storage;
mod store;
#[cfg(test)]
mod tests;
mod writer;

use serde::{Deserialize, Serialize};
use skein_protocol::ids::PolicyVersion;
use skein_protocol::snapshot::Snapshot;
use skein_protocol::summary::Trained;
use skein_protocol::ticket::Exploration;

use crate::episodes::assembly::KeptData;
use crate::metrics::MetricsState;
use crate::replay::ReplayState;
use crate::spent::RunCosts;
use crate::state::NamedTensor;

pub use error::CheckpointError;
pub use storage::{Files, Storage};
pub use store::{CheckpointStore, checkpoint_directory};
pub use writer::CheckpointWriter;

/// Everything that determines the rest of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct CheckpointState {
    /// Counters and results so far.
    pub progress: TrainingProgress,
    /// All tensors that updates change, by name.
    pub tensors: Vec<NamedTensor>,
    /// Content of the replay buffer.
    pub replay: ReplayState,
    /// Snapshots that are still needed, the newest among them, by rising version.
    pub snapshots: Vec<Snapshot>,
}

/// Progress of a run: every counter that decides what happens next, and the results so far.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrainingProgress {
    /// Training episodes committed; the checkpoint's name.
    pub episodes: u64,
    /// Epochs learned from.
    pub epochs: u64,
    /// Version of the newest snapshot. One is published after each epoch, and after each segment
    /// within an epoch that brought an update.
    pub version: u64,
    /// SHA-256 of the newest snapshot.
    pub policy_sha256: String,
    /// Environment steps committed.
    pub environment_steps: u64,
    /// VAE steps done.
    pub vae_steps: u64,
    /// Policy updates done.
    pub policy_updates: u64,
    /// Orders of epochs that are not learned from yet, in order.
    pub in_flight: Vec<EpochOrder>,
    /// Evaluations flown to confirm candidates; numbers their episodes.
    pub evaluations: u64,
    /// Confirmation and evaluation episodes flown.
    pub evaluation_episodes: u64,
    /// Episodes committed when the latest candidate was confirmed.
    pub latest_candidate: Option<u64>,
    /// Best snapshot so far.
    pub best: Option<BestSnapshot>,
    /// Effort until a candidate first reached the configured success rate.
    pub trained: Option<Trained>,
    /// Averages over the latest episodes, and the lengths of the metrics files.
    pub metrics: MetricsState,
    /// Time and losses so far.
    pub spent: RunCosts,
}

impl TrainingProgress {
    /// Progress of a run that has not begun; its averages are over `window_episodes` episodes.
    pub fn start(window_episodes: usize) -> Self {
        Self {
            episodes: 0,
            epochs: 0,
            version: 0,
            policy_sha256: String::new(),
            environment_steps: 0,
            vae_steps: 0,
            policy_updates: 0,
            in_flight: Vec::new(),
            evaluations: 0,
            evaluation_episodes: 0,
            latest_candidate: None,
            best: None,
            trained: None,
            metrics: MetricsState::new(window_episodes),
            spent: RunCosts::default(),
        }
    }

    /// Version of the newest snapshot.
    pub fn version(&self) -> PolicyVersion {
        PolicyVersion(self.version)
    }
}

/// Order of one epoch's episodes. With configuration and run, it determines their tickets.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct EpochOrder {
    /// Epoch.
    pub epoch: u64,
    /// Version of the snapshot that the epoch is flown with.
    pub policy_version: u64,
    /// Exploration of the episodes.
    pub exploration: Exploration,
    /// Share of the steps that the teacher flies; `None` without a teacher.
    pub teacher_share: Option<f32>,
    /// Data to keep of the episodes.
    pub keep: KeptData,
}

/// The best snapshot and its results.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct BestSnapshot {
    /// Version of the snapshot.
    pub policy_version: u64,
    /// Training episodes committed when it was chosen.
    pub episodes: u64,
    /// Mean number of walls passed in the training episodes of the window at that time.
    pub window_walls_passed: f64,
    /// Its confirmation episodes, in order.
    pub confirmed: Vec<EpisodeWalls>,
}

/// Walls of an episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct EpisodeWalls {
    /// Walls passed.
    pub passed: u8,
    /// Walls of the course.
    pub of: u8,
}

impl BestSnapshot {
    /// Mean number of walls passed in its confirmation episodes.
    pub fn confirmed_walls_passed(&self) -> f64 {
        let passed: u64 = self
            .confirmed
            .iter()
            .map(|walls| u64::from(walls.passed))
            .sum();
        passed as f64 / self.confirmed.len() as f64
    }
}
