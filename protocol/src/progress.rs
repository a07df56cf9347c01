//! Progress reports: one line of JSON each on the learner's standard output.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

/// Progress report of the learner.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ProgressReport {
    /// Current phase of the learner.
    pub phase: LearnerPhase,
    /// Training episodes committed.
    pub episodes: u64,
    /// Training episodes of the run.
    pub total_episodes: u64,
    /// Evaluation episodes of the current evaluation: committed and total.
    pub evaluation_episodes: (u64, u64),
    /// Environment steps committed.
    pub steps: u64,
    /// Policy updates done.
    pub updates: u64,
    /// VAE updates done.
    pub vae_updates: u64,
    /// Environment steps per second over the last few seconds.
    pub steps_per_sec: f64,
    /// Policy updates per second over the last few seconds.
    pub updates_per_sec: f64,
    /// Mean walls passed per episode over the last 50 episodes.
    pub walls_passed: Option<f64>,
    /// Mean sum of rewards per episode over the last 50 episodes.
    pub mean_return: Option<f64>,
    /// Temperature α, after the first update.
    pub temperature: Option<f64>,
    /// VAE loss of the last epoch that trained it.
    pub vae_loss: Option<f64>,
    /// Living actors, by their heartbeats.
    pub actors: usize,
    /// Numbers of the living actors, in ascending order.
    #[serde(default)]
    pub live_actors: Vec<u32>,
    /// Tickets issued again since the learner's start, by reason; reasons that did not occur are
    /// left out.
    #[serde(default)]
    pub reissued: BTreeMap<String, u64>,
    /// Records refused since the learner's start, by reason; reasons that did not occur are left
    /// out.
    #[serde(default)]
    pub refused: BTreeMap<String, u64>,
    /// Description of who waits for whom, if nothing has moved for a while.
    #[serde(default)]
    pub stalled: Option<String>,
    /// Seconds that the learner has run, including earlier incarnations as far as checkpoints
    /// record them.
    pub elapsed_secs: f64,
}

impl ProgressReport {
    /// Returns the report of a run of `total_episodes` training episodes that has not begun.
    pub fn start(total_episodes: u64) -> Self {
        Self {
            phase: LearnerPhase::Flying,
            episodes: 0,
            total_episodes,
            evaluation_episodes: (0, 0),
            steps: 0,
            updates: 0,
            vae_updates: 0,
            steps_per_sec: 0.0,
            updates_per_sec: 0.0,
            walls_passed: None,
            mean_return: None,
            temperature: None,
            vae_loss: None,
            actors: 0,
            live_actors: Vec::new(),
            reissued: BTreeMap::new(),
            refused: BTreeMap::new(),
            stalled: None,
            elapsed_secs: 0.0,
        }
    }
}

/// Current phase of the learner.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LearnerPhase {
    /// Waits for training episodes.
    Flying,
    /// Updates the networks.
    Learning,
    /// Waits for evaluation episodes, of a candidate or at the end.
    Evaluating,
    /// Writes the final files.
    Finishing,
}
