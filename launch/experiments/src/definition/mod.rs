//! Definition of an experiment (`configs/experiments/NAME.toml`): its question and the runs that
//! answer it.

mod check;
mod file;
mod suite;
#[cfg(test)]
mod tests;

use std::fmt::{self, Display, Formatter};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use skein_protocol::config::Config;

use skein_prepare::PrepareError;

pub use file::{is_path, names};
pub use suite::FlownSuite;

/// Largest number of arms whose lines can be distinguished in one picture.
pub const MOST_ARMS: usize = skein_reports::comparison::MOST_LINES;

/// An experiment whose arms can all run.
#[derive(Debug, Clone, PartialEq)]
pub struct Experiment {
    /// The file's name without its extension.
    pub name: String,
    /// Question to answer, with the figure or table of the paper that it belongs to.
    pub question: String,
    /// Name of the base configuration as written in the file, for readers.
    pub base_name: String,
    /// Path of the base configuration.
    pub base: PathBuf,
    /// Number of training episodes in the base configuration.
    pub base_episodes: u64,
    /// Number of training episodes of the paper's own runs, for experiments that reproduce these.
    pub paper_episodes: Option<u64>,
    /// Settings in which all arms differ from the base, including the single learner thread:
    /// `section.key=value`.
    pub settings: Vec<String>,
    /// Number of runs per arm, with seeds from 1.
    pub seeds: u64,
    /// Suite that the best snapshot of every run flies in addition to the evaluation courses.
    pub suite: Option<FlownSuite>,
    /// Tables of the report.
    pub tables: Vec<TableKind>,
    /// Pictures of the report.
    pub curves: Vec<CurveSpec>,
    /// Name and unit of a number in which arms differ; then each has its [`Arm::at`], and a picture
    /// shows R over it. Arms may fly other courses.
    pub factor: Option<String>,
    /// Arms that are compared.
    pub arms: Vec<Arm>,
}

/// Runs with fewer episodes than complete ones.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Shortened {
    /// Number of training episodes flown.
    pub flown: u64,
    /// Number of training episodes of a complete run.
    pub whole: u64,
    /// Origin of the complete run, for readers.
    pub whose: String,
}

impl Display for Shortened {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let Self {
            flown,
            whole,
            whose,
        } = self;
        write!(
            f,
            "{flown} training episodes a run instead of the {whole} of {whose}"
        )
    }
}

/// One of several compared ways of training.
#[derive(Debug, Clone, PartialEq)]
pub struct Arm {
    /// Folder of its runs.
    pub name: String,
    /// Label in tables and pictures.
    pub label: String,
    /// Where it stands in the pictures over [`Experiment::factor`].
    pub at: Option<FactorPoint>,
    /// Settings in which it differs from the other arms: `section.key=value`.
    pub settings: Vec<String>,
    /// All settings beyond the base configuration, except the seed, as arguments of `--set` in this
    /// order.
    pub overrides: Vec<String>,
    /// Resulting configuration, for seed 1.
    pub config: Config,
}

/// Place of an arm in the pictures over a factor.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FactorPoint {
    /// Picture of the arm: those with the same line are drawn together.
    pub line: String,
    /// The arm's value of the factor.
    pub value: f64,
}

/// A table of a report.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum TableKind {
    /// R (share of walls passed) and completed courses of the best snapshot, per evaluation course.
    Evaluation,
    /// Outcomes of the evaluation episodes: walls passed, and causes of failure.
    Outcomes,
    /// Completed courses and R of the best snapshot, per suite entry.
    Suite,
    /// Episodes until the first wall was passed and until the goal was reached, and quality and
    /// stability at the end of training.
    Learning,
    /// Fluctuation during training, and loss of what was learned.
    Steadiness,
    /// Cost of the runs: steps, updates, time.
    Cost,
}

/// A picture of a report, with one line per arm.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct CurveSpec {
    /// Quantity on the y axis.
    pub measure: Measure,
    /// Quantity on the x axis.
    pub over: Axis,
}

/// Quantity of a curve, averaged over `evaluation.window_episodes` training episodes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Measure {
    /// Walls passed per episode.
    WallsPassed,
    /// Sum of an episode's rewards.
    Return,
    /// Distance of the walls passed per episode below their previous maximum.
    Drawdown,
}

/// Quantity on a curve's x axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Axis {
    /// Training episodes.
    Episodes,
    /// Environment steps of training episodes.
    Steps,
    /// Updates of the agent.
    Updates,
}

/// Reason why an experiment cannot run.
#[derive(Debug, thiserror::Error)]
pub enum DefinitionError {
    /// The folder or file cannot be read.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// The folder or file.
        path: PathBuf,
        /// The operating system's error.
        #[source]
        source: std::io::Error,
    },
    /// The experiment's file does not exist.
    #[error(
        "cannot read {}: {source}; give the path of an experiment's file, FOLDER/NAME.toml, or \
         one of the names that skein experiment --list prints",
        path.display()
    )]
    Missing {
        /// The file.
        path: PathBuf,
        /// The operating system's error.
        #[source]
        source: std::io::Error,
    },
    /// No experiment has this name.
    #[error(
        "no experiment is called \"{name}\": {} holds {known}; give one of these names, \
         or the path of a file, FOLDER/NAME.toml",
        folder.display()
    )]
    Unknown {
        /// The name.
        name: String,
        /// Folder that was searched.
        folder: PathBuf,
        /// Names of the experiments in it.
        known: String,
    },
    /// The name of its file cannot name the folder of its runs.
    #[error(
        "{}: the runs lie in a folder of the same name: rename the file so that it begins with \
         a letter or digit and has only letters, digits, -, _ and .",
        path.display()
    )]
    FileName {
        /// The file.
        path: PathBuf,
    },
    /// The file is not TOML, or has unknown keys or types.
    #[error("{} is not an experiment: {source}", path.display())]
    Syntax {
        /// The file.
        path: PathBuf,
        /// Position and reason.
        #[source]
        source: Box<toml::de::Error>,
    },
    /// An integer that TOML does not hold.
    #[error("{}: {problem}", path.display())]
    Integer {
        /// The file.
        path: PathBuf,
        /// Line, key, value and remedy.
        problem: String,
    },
    /// A value is not allowed.
    #[error("{}: {key} = {value} {problem}", path.display())]
    Value {
        /// The file.
        path: PathBuf,
        /// Key of the value.
        key: &'static str,
        /// The value found.
        value: String,
        /// Problem and remedy.
        problem: String,
    },
    /// The settings of an arm, or of all arms, cannot be used.
    #[error("{}: {whose}: {problem}", path.display())]
    Settings {
        /// The file.
        path: PathBuf,
        /// Owner of the settings.
        whose: String,
        /// Problem of the settings.
        problem: String,
    },
    /// An arm cannot run.
    #[error("{}: arm {arm} cannot run: {source}", path.display())]
    Arm {
        /// The file.
        path: PathBuf,
        /// Name of the arm.
        arm: String,
        /// Reason; an override named in it is a setting of the file.
        #[source]
        source: Box<PrepareError>,
    },
}

impl Experiment {
    /// Reads the experiment `named`, a name in `folder` or the path of a file, and checks that each
    /// of its arms can run. `episodes` shortens all runs to this number of episodes.
    ///
    /// # Errors
    /// [`DefinitionError`] names file, arm, key, value and remedy.
    pub fn load(
        folder: &Path,
        named: &str,
        episodes: Option<u64>,
    ) -> Result<Self, DefinitionError> {
        let (path, name) = file::find(folder, named)?;
        check::resolve(file::read(&path)?, &path, &name, episodes)
    }

    /// Compares the shortest arm with the paper's run, or with the base configuration; `None` if it
    /// flies at least as many episodes.
    pub fn shortened(&self) -> Option<Shortened> {
        let paper = self
            .paper_episodes
            .map(|episodes| (episodes, "the paper".to_owned()));
        let base = (self.base_episodes, format!("`configs/{}`", self.base_name));
        let flown = self.arms.iter().map(|arm| arm.config.run.episodes).min()?;
        let (whole, whose) = paper
            .into_iter()
            .chain([base])
            .find(|(whole, _)| flown < *whole)?;
        Some(Shortened {
            flown,
            whole,
            whose,
        })
    }

    /// Returns `true` if all arms have the same reward, so that their returns can be compared.
    pub fn has_one_reward(&self) -> bool {
        self.arms
            .windows(2)
            .all(|pair| pair[0].reward() == pair[1].reward())
    }
}

impl Arm {
    fn reward(&self) -> Option<toml::Value> {
        self.config.simulator.get("reward").cloned()
    }
}
