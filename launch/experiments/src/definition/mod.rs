//! `configs/experiments/NAME.toml`: what an experiment asks, and what is run to answer it.

mod check;
mod file;
mod suite;
#[cfg(test)]
mod tests;

use std::fmt::{self, Display, Formatter};
use std::path::{Path, PathBuf};

use serde::Deserialize;
use skein_protocol::config::Config;

use skein_prepare::PrepareError;

pub use file::names;
pub use suite::FlownSuite;

/// More arms than this could not be told apart in one picture.
pub const MOST_ARMS: usize = skein_reports::comparison::MOST_LINES;

/// An experiment whose every arm can be run.
#[derive(Debug, Clone, PartialEq)]
pub struct Experiment {
    /// The file's name without its ending.
    pub name: String,
    /// What it is to find out, and which figure or table of the paper it belongs to.
    pub question: String,
    /// The configuration that all arms differ from, as the file names it, for readers.
    pub base_name: String,
    /// Its path.
    pub base: PathBuf,
    /// Training episodes that the base configuration flies.
    pub base_episodes: u64,
    /// Training episodes of the paper's own runs, where the experiment stands for them.
    pub paper_episodes: Option<u64>,
    /// In what all arms differ from the base, the one thread of each run among it:
    /// `section.key=value`.
    pub settings: Vec<String>,
    /// Runs of each arm, with seeds from 1.
    pub seeds: u64,
    /// What the best snapshot of every run flies beside the evaluation courses.
    pub suite: Option<FlownSuite>,
    /// What is set in tables.
    pub tables: Vec<TableKind>,
    /// What is drawn.
    pub curves: Vec<Curve>,
    /// What is compared.
    pub arms: Vec<Arm>,
}

/// Runs that fly less than whole ones.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Shortened {
    /// Their training episodes.
    pub flown: u64,
    /// Those of a whole run.
    pub whole: u64,
    /// Whose that is, for readers.
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

/// One way of training, of several that are compared.
#[derive(Debug, Clone, PartialEq)]
pub struct Arm {
    /// The folder of its runs.
    pub name: String,
    /// What it is called in tables and pictures.
    pub label: String,
    /// In what it differs from the other arms: `section.key=value`.
    pub settings: Vec<String>,
    /// Everything that is set beside the base configuration, but for the seed: for `--set`, in this
    /// order.
    pub overrides: Vec<String>,
    /// What comes of it, for seed 1.
    pub config: Config,
}

/// A table of a report.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TableKind {
    /// R and completed courses of the best snapshot, for each evaluation course.
    Evaluation,
    /// How the evaluation episodes went: wall by wall, and what ended those that did not get
    /// through.
    Outcomes,
    /// Completed courses and R of the best snapshot, for each entry of the suite.
    Suite,
    /// What it took until the first wall was passed and until the agent was trained, and how well
    /// and steadily it flew at the end of training.
    Learning,
    /// How much training swung, and how much of what was learned was lost again.
    Steadiness,
    /// What the runs took: steps, updates, time.
    Cost,
}

/// A picture of a report: one line an arm.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Curve {
    /// What is shown.
    pub measure: Measure,
    /// Over what.
    pub over: Axis,
}

/// What a curve shows, averaged over `evaluation.window_episodes` training episodes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Measure {
    /// Walls passed an episode.
    WallsPassed,
    /// Sum of an episode's rewards.
    Return,
    /// How far the walls passed an episode lie below the most they had been.
    Drawdown,
}

/// What a curve is drawn over.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Axis {
    /// Training episodes.
    Episodes,
    /// Environment steps of training episodes.
    Steps,
    /// Updates of the agent.
    Updates,
}

/// Why an experiment cannot be run.
#[derive(Debug, thiserror::Error)]
pub enum DefinitionError {
    /// The folder or file cannot be read.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// The folder or file.
        path: PathBuf,
        /// Why.
        #[source]
        source: std::io::Error,
    },
    /// There is no experiment of this name.
    #[error("no experiment is called {name}: {} has {known}", folder.display())]
    Unknown {
        /// The name.
        name: String,
        /// Where it was looked for.
        folder: PathBuf,
        /// Those that are there.
        known: String,
    },
    /// It is not TOML, or has other keys or kinds of value.
    #[error("{} is no experiment: {source}", path.display())]
    Syntax {
        /// The file.
        path: PathBuf,
        /// Where and why.
        #[source]
        source: Box<toml::de::Error>,
    },
    /// A value makes no sense.
    #[error("{}: {key} = {value} {problem}", path.display())]
    Value {
        /// The file.
        path: PathBuf,
        /// Which key.
        key: &'static str,
        /// The value found.
        value: String,
        /// What is wrong with it, and what to write instead.
        problem: String,
    },
    /// The settings of an arm, or of all of them, cannot be used.
    #[error("{}: {whose}: {problem}", path.display())]
    Settings {
        /// The file.
        path: PathBuf,
        /// Whose settings.
        whose: String,
        /// What is wrong with them.
        problem: String,
    },
    /// An arm cannot be run.
    #[error("{}: arm {arm} cannot be run: {source}", path.display())]
    Arm {
        /// The file.
        path: PathBuf,
        /// Its name.
        arm: String,
        /// Why; an override that it names is a setting of the file.
        #[source]
        source: Box<PrepareError>,
    },
}

impl Experiment {
    /// Reads the experiment called `name` in `folder`, and checks that each of its arms can be run.
    /// `episodes` shortens all runs to so many.
    ///
    /// # Errors
    /// [`DefinitionError`] names file, arm, key, value and remedy.
    pub fn load(folder: &Path, name: &str, episodes: Option<u64>) -> Result<Self, DefinitionError> {
        let path = file::find(folder, name)?;
        check::resolve(file::read(&path)?, &path, name, episodes)
    }

    /// How much less the shortest arm flies than the paper, or than the configuration that all are
    /// based on; `None` if it flies as much.
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

    /// Whether all arms are rewarded alike, so that their returns can be compared.
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
