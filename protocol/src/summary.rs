//! The summary of a run, `summary.json`.

use std::collections::BTreeMap;
use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::config::Config;
use crate::files::{self, REPORT_BYTES};
use crate::ids::{PolicyVersion, RunId};
use crate::stages::StageTimes;

/// Summary of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunSummary {
    /// Version of Skein and, if known, the last commit that changed the learner:
    /// `0.1.0+b8735651a2c3`, with `-dirty` appended if the code was modified.
    pub skein_version: String,
    /// The run.
    pub run: RunId,
    /// Its seed.
    pub seed: u64,
    /// Its ending.
    pub ending: RunEnding,
    /// SHA-256 of the final encoder and policy parameters: equal exactly if two runs learned
    /// bit-equal policies.
    pub policy_sha256: String,
    /// The final snapshot.
    pub final_version: PolicyVersion,
    /// The best snapshot, if one was confirmed.
    pub best_version: Option<PolicyVersion>,
    /// Mean walls passed in the best snapshot's confirmation episodes.
    pub best_confirmed_walls_passed: Option<f64>,
    /// First time that a candidate for the best snapshot passed the share `evaluation.trained_rate`
    /// of walls, if one did.
    #[serde(default)]
    pub trained: Option<Trained>,
    /// Reason why the policy is untrained and the remedy, if no update was made.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub untrained: Option<String>,
    /// Training episodes committed.
    pub episodes: u64,
    /// Environment steps of training episodes.
    pub steps: u64,
    /// Updates of the agent, SAC or TD3.
    pub updates: u64,
    /// VAE updates.
    pub vae_updates: u64,
    /// Episodes without exploration: confirmation episodes and those of the final evaluation. Their
    /// steps are not in any other count.
    pub evaluation_episodes: u64,
    /// Tickets issued again, for any reason.
    pub tickets_reissued: u64,
    /// Records that were refused.
    pub records_refused: u64,
    /// [`RunSummary::tickets_reissued`] by reason; reasons that did not occur
    /// are left out.
    #[serde(default)]
    pub reissued_by_reason: BTreeMap<String, u64>,
    /// [`RunSummary::records_refused`] by reason; reasons that did not occur
    /// are left out.
    #[serde(default)]
    pub refused_by_reason: BTreeMap<String, u64>,
    /// Restarts of the learner, from a checkpoint or from the first episode.
    #[serde(default)]
    pub resumes: u64,
    /// Seconds from the learner's start to its end, over all its incarnations, without work that a
    /// death undid.
    pub wall_secs: f64,
    /// Time of actors and learner by stage, up to `wall_secs`. For a killed actor it ends at its
    /// last heartbeat or the end of its last episode, whichever was later.
    #[serde(default)]
    pub stages: StageTimes,
    /// Processor seconds of the learner's last incarnation, by thread, for the threads that lived
    /// until its end; `receiver` receives and assembles episodes.
    #[serde(default)]
    pub thread_cpu_secs: BTreeMap<String, f64>,
}

impl RunSummary {
    /// Returns `true` if the run completed all episodes of `config`. One that was lengthened
    /// afterwards has more to fly.
    pub fn is_of_whole(&self, config: &Config) -> bool {
        self.ending == RunEnding::Completed && self.episodes >= config.run.episodes
    }

    /// Reads the summary at `path`; returns `None` if there is none, or it cannot be read.
    pub fn load(path: &Path) -> Option<Self> {
        serde_json::from_slice(&files::read(path, REPORT_BYTES).ok()?).ok()
    }

    /// Returns the summary as JSON, for its file.
    pub fn to_json(&self) -> String {
        serde_json::to_string_pretty(self).expect("a summary is plain data")
    }
}

/// Counters at the time that a policy first counted as trained.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Trained {
    /// Share R of walls passed in its confirmation episodes (without exploration noise, from the
    /// start of level 1, on the courses of `evaluation.confirm_on`).
    pub rate: f64,
    /// Number of these confirmation episodes; 0 where it was not recorded.
    #[serde(default)]
    pub confirmation_episodes: u64,
    /// Training episodes committed.
    pub episodes: u64,
    /// Environment steps of training episodes.
    pub steps: u64,
    /// Policy updates.
    pub updates: u64,
    /// Seconds from the learner's start until its confirmation episodes were flown, over all
    /// incarnations, without work that a death undid.
    pub wall_secs: f64,
}

/// Ending of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RunEnding {
    /// All episodes were flown.
    Completed,
    /// The run was interrupted.
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
        assert_eq!(RunSummary::load(&path), None);
        let mut stages = StageTimes::default();
        stages.add(Stage::Publish, 3, Duration::from_millis(500));
        let summary = RunSummary {
            skein_version: "0.1.0".to_owned(),
            run: RunId(3),
            seed: 1,
            ending: RunEnding::Completed,
            policy_sha256: "ab".to_owned(),
            final_version: PolicyVersion(4),
            best_version: None,
            best_confirmed_walls_passed: None,
            trained: Some(Trained {
                rate: 0.95,
                confirmation_episodes: 20,
                episodes: 30,
                steps: 300,
                updates: 15,
                wall_secs: 1.25,
            }),
            untrained: None,
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
        assert_eq!(RunSummary::load(&path), Some(summary));
        std::fs::write(&path, "{").unwrap();
        assert_eq!(RunSummary::load(&path), None);
    }

    #[test]
    fn a_summary_without_optional_fields_is_read() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("summary.json");
        let short = r#"{"skein_version":"0.1.0","run":7,"seed":1,"ending":"completed",
            "policy_sha256":"ab","final_version":80,"best_version":70,
            "best_confirmed_walls_passed":4.9,"episodes":800,"steps":42837,"updates":20418,
            "vae_updates":400,"evaluation_episodes":400,"tickets_reissued":0,
            "records_refused":0,"wall_secs":333.3,"phase_secs":{"publish":12.5}}"#;
        std::fs::write(&path, short).unwrap();
        assert_eq!(
            RunSummary::load(&path).unwrap().stages,
            StageTimes::default()
        );
    }
}
