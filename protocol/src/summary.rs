//! `summary.json`: what a run came to.

use std::collections::BTreeMap;
use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::ids::{PolicyVersion, RunId};
use crate::stages::Times;

/// What a run came to.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// Version of Skein, and the last commit that changed what the learner is made of, where that
    /// is known: `0.1.0+b8735651a2c3`, with `-dirty` behind it if it had been changed since.
    pub skein_version: String,
    /// The run.
    pub run: RunId,
    /// Its seed.
    pub seed: u64,
    /// How it ended.
    pub ending: Ending,
    /// SHA-256 of the final encoder and policy parameters: equal exactly when two runs learned the
    /// same, bit for bit.
    pub policy_sha256: String,
    /// The final snapshot.
    pub final_version: PolicyVersion,
    /// The best snapshot, if one was confirmed.
    pub best_version: Option<PolicyVersion>,
    /// Walls passed in the best snapshot's confirmation episodes, on average.
    pub best_confirmed_walls_passed: Option<f64>,
    /// When a candidate for the best snapshot first passed the share `evaluation.trained_rate` of
    /// walls, if one did.
    #[serde(default)]
    pub trained: Option<Trained>,
    /// Training episodes committed.
    pub episodes: u64,
    /// Environment steps of training episodes.
    pub steps: u64,
    /// Updates of the agent, SAC or TD3.
    pub updates: u64,
    /// VAE steps.
    pub vae_updates: u64,
    /// Episodes without exploration: those that the best snapshot was chosen by, and those of its
    /// evaluation. Their steps are in no other count.
    pub evaluation_episodes: u64,
    /// Tickets issued again, for whatever reason.
    pub tickets_reissued: u64,
    /// Records that were refused.
    pub records_refused: u64,
    /// [`Summary::tickets_reissued`] by reason; without reasons that did not occur.
    #[serde(default)]
    pub reissued_by_reason: BTreeMap<String, u64>,
    /// [`Summary::records_refused`] by reason; without reasons that did not occur.
    #[serde(default)]
    pub refused_by_reason: BTreeMap<String, u64>,
    /// Times the learner was started again, whether it went on from a checkpoint or from the first
    /// episode.
    #[serde(default)]
    pub resumes: u64,
    /// Seconds from the learner's start to its end, over all its incarnations; what a death undid
    /// is not counted.
    pub wall_secs: f64,
    /// What the time of actors and learner went into, as far as `wall_secs`. An actor that was
    /// killed has told of it until its last heartbeat or the end of its last episode, whichever was
    /// later.
    #[serde(default)]
    pub stages: Times,
    /// Seconds of processor time in the learner's last incarnation by those of its threads that
    /// lived until its end; `receiver` receives and assembles episodes.
    #[serde(default)]
    pub thread_cpu_secs: BTreeMap<String, f64>,
}

impl Summary {
    /// Reads the summary at `path`; `None` if there is none that can be read.
    pub fn load(path: &Path) -> Option<Self> {
        serde_json::from_slice(&std::fs::read(path).ok()?).ok()
    }

    /// The summary as JSON, for its file.
    pub fn to_json(&self) -> String {
        serde_json::to_string_pretty(self).expect("a summary is plain data")
    }
}

/// When a policy first did what it was trained for: what is behind it then.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Trained {
    /// Share R of walls passed in its evaluation episodes, without exploration noise, from the
    /// start of level 1, where `evaluation.confirm_on` says.
    pub rate: f64,
    /// Training episodes committed.
    pub episodes: u64,
    /// Environment steps of training episodes.
    pub steps: u64,
    /// Policy updates.
    pub updates: u64,
    /// Seconds from the learner's start until its evaluation episodes were flown, over all
    /// incarnations; what a death undid is not counted.
    pub wall_secs: f64,
}

/// How a run ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Ending {
    /// All episodes were flown.
    Completed,
    /// It was told to stop.
    Interrupted,
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::stages::Stage;

    #[test]
    fn a_saved_summary_is_loaded_and_a_damaged_one_is_no_summary() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("summary.json");
        assert_eq!(Summary::load(&path), None);
        let mut stages = Times::default();
        stages.add(Stage::Publish, 3, Duration::from_millis(500));
        let summary = Summary {
            skein_version: "0.1.0".to_owned(),
            run: RunId(3),
            seed: 1,
            ending: Ending::Completed,
            policy_sha256: "ab".to_owned(),
            final_version: PolicyVersion(4),
            best_version: None,
            best_confirmed_walls_passed: None,
            trained: Some(Trained {
                rate: 0.95,
                episodes: 30,
                steps: 300,
                updates: 15,
                wall_secs: 1.25,
            }),
            episodes: 40,
            steps: 400,
            updates: 20,
            vae_updates: 10,
            evaluation_episodes: 6,
            tickets_reissued: 0,
            records_refused: 0,
            reissued_by_reason: BTreeMap::new(),
            refused_by_reason: BTreeMap::new(),
            resumes: 2,
            wall_secs: 1.5,
            stages,
            thread_cpu_secs: BTreeMap::from([("receiver".to_owned(), 0.25)]),
        };
        std::fs::write(&path, summary.to_json()).unwrap();
        assert_eq!(Summary::load(&path), Some(summary));
        std::fs::write(&path, "{").unwrap();
        assert_eq!(Summary::load(&path), None);
    }

    #[test]
    fn a_summary_from_before_there_were_stages_is_read() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("summary.json");
        let old = r#"{"skein_version":"0.1.0","run":7,"seed":1,"ending":"completed","policy_sha256":"ab","final_version":80,"best_version":70,
            "best_confirmed_walls_passed":4.9,"episodes":800,"steps":42837,"updates":20418,"vae_updates":400,"evaluation_episodes":400,
            "tickets_reissued":0,"records_refused":0,"wall_secs":333.3,"phase_secs":{"publish":12.5}}"#;
        std::fs::write(&path, old).unwrap();
        assert_eq!(Summary::load(&path).unwrap().stages, Times::default());
    }
}
