//! Rows of `episodes.csv`, read as a user reads them, and the results that two runs share.

use std::fs;

use serde::Deserialize;
use skein_protocol::summary::RunSummary;
use skein_run::RunDirectory;

/// Row of `episodes.csv`.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)] // the columns, by their names
pub struct RecordedEpisode {
    pub episode: u64,
    pub epoch: u64,
    pub policy_version: u64,
    pub actor: u32,
    pub level: u8,
    pub steps: u64,
    pub walls_passed: u8,
    /// Text as written, to the last digit.
    pub r#return: String,
    pub outcome: String,
}

/// Returns the complete rows of a run's `episodes.csv`; none before the file exists.
///
/// # Panics
/// Panics if a row is malformed.
pub fn episodes(run: &RunDirectory) -> Vec<RecordedEpisode> {
    let text = fs::read_to_string(run.episodes_csv()).unwrap_or_default();
    let whole = text.rfind('\n').map_or("", |end| &text[..=end]);
    csv::Reader::from_reader(whole.as_bytes())
        .deserialize()
        .collect::<Result<_, _>>()
        .unwrap()
}

/// Results of a run, without the actor that flew each episode. Two runs with the same configuration
/// and seed share them.
#[derive(Debug, Clone)]
pub struct LearnedResults {
    policy_sha256: String,
    episodes: Vec<RecordedEpisode>,
}

impl LearnedResults {
    pub(crate) fn of(run: &RunDirectory, summary: &RunSummary) -> Self {
        let nobody = |episode| RecordedEpisode {
            actor: 0,
            ..episode
        };
        Self {
            policy_sha256: summary.policy_sha256.clone(),
            episodes: episodes(run).into_iter().map(nobody).collect(),
        }
    }

    /// Asserts that both runs flew the same episodes and learned the same parameters, bit for bit.
    ///
    /// # Panics
    /// Panics if they did not; the message names the first episode that differs.
    pub fn assert_same(&self, other: &Self, whose: &str) {
        for (mine, others) in self.episodes.iter().zip(&other.episodes) {
            assert_eq!(mine, others, "{whose}: an episode differs");
        }
        assert_eq!(
            self.episodes.len(),
            other.episodes.len(),
            "{whose}: the number of episodes differs"
        );
        assert_eq!(
            self.policy_sha256, other.policy_sha256,
            "{whose}: parameters differ after the same episodes"
        );
    }

    /// Returns the SHA-256 of the final parameters.
    pub fn policy_sha256(&self) -> &str {
        &self.policy_sha256
    }
}
