//! `episodes.csv`, read as its user reads it, and what makes two runs the same.

use std::fs;

use serde::Deserialize;
use skein_protocol::summary::Summary;
use skein_run::RunDirectory;

/// A row of `episodes.csv`.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)] // the columns, under their names
pub struct Episode {
    pub episode: u64,
    pub epoch: u64,
    pub policy_version: u64,
    pub actor: u32,
    pub level: u8,
    pub steps: u64,
    pub walls_passed: u8,
    /// As written, to the last digit.
    pub r#return: String,
    pub outcome: String,
}

/// The rows of a run's `episodes.csv` so far; none before there is a file. A row that is still
/// being written is left out.
///
/// # Panics
/// When a row is malformed.
pub fn episodes(run: &RunDirectory) -> Vec<Episode> {
    let text = fs::read_to_string(run.episodes_csv()).unwrap_or_default();
    let whole = text.rfind('\n').map_or("", |end| &text[..=end]);
    csv::Reader::from_reader(whole.as_bytes())
        .deserialize()
        .collect::<Result<_, _>>()
        .unwrap()
}

/// What a run came to, apart from who flew which episode: two runs of one configuration and seed
/// have it in common.
#[derive(Debug, Clone)]
pub struct Learned {
    policy_sha256: String,
    episodes: Vec<Episode>,
}

impl Learned {
    pub(crate) fn of(run: &RunDirectory, summary: &Summary) -> Self {
        let nobody = |episode| Episode {
            actor: 0,
            ..episode
        };
        Self {
            policy_sha256: summary.policy_sha256.clone(),
            episodes: episodes(run).into_iter().map(nobody).collect(),
        }
    }

    /// Requires that both runs flew the same episodes and learned the same parameters, bit for bit.
    ///
    /// # Panics
    /// When they did not; the message names the first episode that differs.
    pub fn assert_same(&self, other: &Self, whose: &str) {
        for (mine, others) in self.episodes.iter().zip(&other.episodes) {
            assert_eq!(mine, others, "{whose}: another episode");
        }
        assert_eq!(
            self.episodes.len(),
            other.episodes.len(),
            "{whose}: another number of episodes"
        );
        assert_eq!(
            self.policy_sha256, other.policy_sha256,
            "{whose}: other parameters after the same episodes"
        );
    }

    /// SHA-256 of the final parameters.
    pub fn policy_sha256(&self) -> &str {
        &self.policy_sha256
    }
}
