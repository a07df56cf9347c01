//! How far a run has come: one line of JSON on the learner's standard output for each report, for
//! whoever watches it.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

/// A report of the learner.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Progress {
    /// What the learner is about.
    pub phase: Phase,
    /// Training episodes committed.
    pub episodes: u64,
    /// Training episodes in the whole run.
    pub total_episodes: u64,
    /// Evaluation episodes committed and to be flown in the present evaluation.
    pub evaluation_episodes: (u64, u64),
    /// Environment steps committed.
    pub steps: u64,
    /// SAC updates done.
    pub updates: u64,
    /// VAE steps done.
    pub vae_updates: u64,
    /// Environment steps per second, over the last few seconds.
    pub steps_per_sec: f64,
    /// SAC updates per second, over the last few seconds.
    pub updates_per_sec: f64,
    /// Walls passed per episode, over the last 50 episodes.
    pub walls_passed: Option<f64>,
    /// Sum of rewards per episode, over the last 50 episodes.
    pub mean_return: Option<f64>,
    /// Temperature α, once there were updates.
    pub temperature: Option<f64>,
    /// VAE loss of the last epoch that trained it.
    pub vae_loss: Option<f64>,
    /// Actors that sent a heartbeat.
    pub actors: usize,
    /// Their numbers, in ascending order.
    #[serde(default)]
    pub live_actors: Vec<u32>,
    /// Tickets issued again since the learner's start, by reason; without reasons that did not
    /// occur.
    #[serde(default)]
    pub reissued: BTreeMap<String, u64>,
    /// Records refused since the learner's start, by reason; without reasons that did not occur.
    #[serde(default)]
    pub refused: BTreeMap<String, u64>,
    /// Who waits for whom, when nothing has moved for a while.
    #[serde(default)]
    pub stalled: Option<String>,
    /// Seconds that the learner has run, earlier incarnations included as far as checkpoints tell.
    pub elapsed_secs: f64,
}

impl Progress {
    /// Of a run of `total_episodes` training episodes that has not begun.
    pub fn start(total_episodes: u64) -> Self {
        Self {
            phase: Phase::Flying,
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

/// What the learner is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Phase {
    /// Waits for episodes.
    Flying,
    /// Updates the networks.
    Learning,
    /// Confirms a candidate for the best snapshot, or evaluates it at the end.
    Evaluating,
    /// Writes what remains.
    Finishing,
}
