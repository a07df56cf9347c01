//! `summary.json`: what a run came to.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::ids::{PolicyVersion, RunId};
use crate::run::RunDirectory;

/// What a run came to.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// Version of Skein.
    pub skein_version: String,
    /// The run.
    pub run: RunId,
    /// Its seed.
    pub seed: u64,
    /// How it ended.
    pub ending: Ending,
    /// SHA-256 of the final encoder and policy parameters: equal exactly when two runs learned the same, bit for bit.
    pub policy_sha256: String,
    /// The final snapshot.
    pub final_version: PolicyVersion,
    /// The best snapshot, if one was confirmed.
    pub best_version: Option<PolicyVersion>,
    /// Walls passed in the best snapshot's confirmation flights, on average.
    pub best_confirmed_walls_passed: Option<f64>,
    /// Training flights committed.
    pub flights: u64,
    /// Environment steps of training flights.
    pub steps: u64,
    /// SAC updates.
    pub updates: u64,
    /// VAE steps.
    pub vae_updates: u64,
    /// Evaluation flights.
    pub evaluation_flights: u64,
    /// Tickets issued again, for whatever reason.
    pub tickets_reissued: u64,
    /// Records that were refused.
    pub records_refused: u64,
    /// Seconds from the learner's start to its end.
    pub wall_secs: f64,
    /// Seconds of the learner's main thread by what it did.
    pub phase_secs: BTreeMap<String, f64>,
}

impl Summary {
    /// That of `run`; `None` if it has none, or none that can be read.
    pub fn of(run: &RunDirectory) -> Option<Self> {
        serde_json::from_slice(&std::fs::read(run.summary_json()).ok()?).ok()
    }
}

/// How a run ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Ending {
    /// All flights were flown.
    Completed,
    /// It was told to stop.
    Interrupted,
}
