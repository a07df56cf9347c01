//! Checkpoints: everything that determines the rest of a run, in a directory of its own.
//!
//! A run resumed from one continues bit for bit as if it had never stopped, so all of it is here:
//! parameters and moments of every network, the replay buffer with the depth images it still needs,
//! snapshots that are still flown or are the best, counters, averages, how far the files of metrics
//! had come. Random generators are not: they are derived anew for every epoch.
//!
//! `checkpoints/episode-<n>/` holds
//! - `tensors.safetensors`: parameters, targets, moments, log α;
//! - `replay.safetensors`: rows of both parts, numbers of their images, images;
//! - `snapshots.safetensors`: snapshots by their versions;
//! - `progress.bin`: [`Progress`], bincode;
//! - `config.toml`: the configuration, to say what differs from another one;
//! - `manifest.json`: format, size and checksum of each of the above, and a checksum of itself.
//!
//! It is written aside and renamed into place when all of it is on disk ([`store`]): a directory of
//! that name is complete, and what is damaged later is refused by its checksum, never learned from.

mod error;
mod files;
mod manifest;
mod store;
#[cfg(test)]
mod tests;
mod writer;

use serde::{Deserialize, Serialize};
use skein_protocol::ids::PolicyVersion;
use skein_protocol::snapshot::Snapshot;
use skein_protocol::summary::Trained;
use skein_protocol::ticket::Exploration;

use crate::episodes::assembly::Keep;
use crate::metrics::MetricsState;
use crate::replay::ReplayState;
use crate::spent::Spent;
use crate::state::NamedTensor;

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
    /// Snapshots that are still needed, the newest among them, by rising version.
    pub snapshots: Vec<Snapshot>,
}

/// How far a run is: every counter that decides what happens next, and what it came to so far.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Progress {
    /// Training episodes committed; the checkpoint's name.
    pub episodes: u64,
    /// Epochs learned from.
    pub epochs: u64,
    /// The version of the newest snapshot. One is published after each epoch, and after each
    /// segment within one that brought an update.
    pub version: u64,
    /// SHA-256 of the newest snapshot.
    pub policy_sha256: String,
    /// Environment steps committed.
    pub environment_steps: u64,
    /// Steps the VAE was trained.
    pub vae_steps: u64,
    /// Policy updates done.
    pub policy_updates: u64,
    /// Epochs whose episodes were ordered and not learned from, in order.
    pub in_flight: Vec<EpochOrder>,
    /// Evaluations flown to confirm a candidate for the best snapshot; numbers their episodes.
    pub evaluations: u64,
    /// Evaluation episodes flown.
    pub evaluation_episodes: u64,
    /// Episodes committed when the latest candidate was confirmed.
    pub latest_candidate: Option<u64>,
    /// The best snapshot so far.
    pub best: Option<BestSnapshot>,
    /// When a candidate first did what it was trained for.
    pub trained: Option<Trained>,
    /// Averages over the latest episodes, and where the files of metrics end.
    pub metrics: MetricsState,
    /// Time and losses so far.
    pub spent: Spent,
}

impl Progress {
    /// Of a run that has not begun, whose averages are over `window_episodes` episodes.
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
            spent: Spent::default(),
        }
    }

    /// The newest snapshot's version.
    pub fn version(&self) -> PolicyVersion {
        PolicyVersion(self.version)
    }
}

/// Episodes of one epoch as they were ordered: what makes their tickets, besides configuration and
/// run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct EpochOrder {
    /// The epoch.
    pub epoch: u64,
    /// The snapshot it is flown with.
    pub policy_version: u64,
    /// How actions are chosen.
    pub exploration: Exploration,
    /// What is kept of its episodes.
    pub keep: Keep,
}

/// The best snapshot, and why it is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct BestSnapshot {
    /// The snapshot.
    pub policy_version: u64,
    /// Training episodes committed when it was chosen.
    pub episodes: u64,
    /// Walls passed in the training episodes of the window then, on average.
    pub window_walls_passed: f64,
    /// Walls passed in the evaluation episodes that confirmed it, on average.
    pub confirmed_walls_passed: f64,
}
