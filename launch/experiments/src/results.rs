//! Results of an experiment's runs, read from their directories.

use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;
use skein_protocol::config::Config;
use skein_protocol::evaluation::EvaluationReport;
use skein_protocol::files::{self, REPORT_BYTES};
use skein_protocol::summary::RunSummary;

use super::definition::{Axis, Measure};
use super::plan::{ExperimentPlan, PlannedRun, RunState};
use super::statistics::{dispersion_across_time, drawdowns, level, volatility};
use skein_reports::curves::{PlottedEpisode, read_episodes, trailing_mean};
use skein_reports::{ReportError, TornRow};

/// A complete run.
#[derive(Debug)]
pub struct RunResult {
    /// Index of its arm in the experiment.
    pub arm: usize,
    /// Its seed.
    pub seed: u64,
    /// Its counts and times.
    pub summary: RunSummary,
    /// Evaluation of its best snapshot.
    pub evaluation: EvaluationReport,
    /// Evaluation of its best snapshot in the experiment's suite, if there is one and it was flown.
    pub suite: Option<EvaluationReport>,
    /// Its training episodes, in order.
    pub(super) episodes: Vec<PlottedEpisode>,
    window: usize,
    warmup_steps: u64,
}

/// Reason why a complete run cannot be reported.
#[derive(Debug, thiserror::Error)]
pub enum ResultError {
    /// A file is missing or invalid.
    #[error("{}: {problem}; to train the run again, move its directory away", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// Problem of the file.
        problem: String,
    },
    /// The result of the suite is missing or invalid.
    #[error("{}: {problem}; to fly the suite again, move this file away", path.display())]
    Suite {
        /// The file.
        path: PathBuf,
        /// Problem of the file.
        problem: String,
    },
    /// The file of its episodes cannot be read.
    #[error("{0}; to train the run again, move its directory away")]
    Episodes(#[from] ReportError),
    /// The file of its episodes lacks a part of its last row.
    #[error(
        "{}: its last row is cut off; to train the run again, move its directory away",
        .0.path.display()
    )]
    Torn(TornRow),
}

/// Reads the complete runs of `plan`, in its order. Also returns a [`ResultError`] for each run
/// whose files are invalid; the others are read nevertheless.
pub fn read(plan: &ExperimentPlan) -> (Vec<RunResult>, Vec<ResultError>) {
    let (mut results, mut failures) = (Vec::new(), Vec::new());
    let complete = |run: &&PlannedRun| run.state == RunState::Complete;
    for run in plan.runs.iter().filter(complete) {
        match RunResult::trained(run).and_then(|result| result.with_suite(run)) {
            Ok(result) => results.push(result),
            Err(error) => failures.push(error),
        }
    }
    (results, failures)
}

impl RunResult {
    /// Reads the results of its training.
    pub(super) fn trained(run: &PlannedRun) -> Result<Self, ResultError> {
        let Config {
            evaluation,
            learning,
            ..
        } = &run.config;
        let (episodes, torn) = read_episodes(&run.directory.episodes_csv())?;
        if let Some(torn) = torn {
            return Err(ResultError::Torn(torn));
        }
        Ok(Self {
            arm: run.arm,
            seed: run.seed,
            summary: of_training(&run.directory.summary_json())?,
            evaluation: of_training(&run.directory.evaluation_json())?,
            suite: None,
            episodes,
            window: evaluation.window_episodes as usize,
            warmup_steps: learning.warmup_steps as u64,
        })
    }

    /// Adds the result of the experiment's suite, if there is one.
    fn with_suite(mut self, run: &PlannedRun) -> Result<Self, ResultError> {
        if let Some(path) = &run.suite_json {
            self.suite = Some(of_suite(path)?);
        }
        Ok(self)
    }

    /// Returns the walls passed per episode over the last window of training episodes; `None` if
    /// there were none.
    pub fn final_walls_passed(&self) -> Option<f64> {
        trailing_mean(&self.values(Measure::WallsPassed), self.window).pop()
    }

    /// Returns the mean return over the last window of training episodes; `None` if there were
    /// none.
    pub fn final_return(&self) -> Option<f64> {
        trailing_mean(&self.values(Measure::Return), self.window).pop()
    }

    /// Returns the number of training episodes until the average over a window first reached one
    /// wall passed; `None` if it never did. This dates the rise itself. Confirmations, which decide
    /// when the agent is trained, are far apart.
    pub fn one_wall_after(&self) -> Option<f64> {
        let mut curve = self.curve(Measure::WallsPassed, Axis::Episodes).into_iter();
        curve
            .find(|(_, walls)| *walls >= 1.0)
            .map(|(episodes, _)| episodes)
    }

    /// Returns the level of walls passed per episode that training reached; see [`level`].
    pub fn level(&self) -> Option<f64> {
        level(&self.values(Measure::WallsPassed), self.window)
    }

    /// Returns the volatility of its walls passed after their rise; see [`volatility`].
    pub fn volatility(&self) -> Option<f64> {
        volatility(&self.values(Measure::WallsPassed), self.window)
    }

    /// Returns the dispersion across time of its walls passed; see [`dispersion_across_time`].
    pub fn dispersion_across_time(&self) -> Option<f64> {
        dispersion_across_time(&self.values(Measure::WallsPassed), self.window)
    }

    /// Returns the largest drop of the window average of walls passed below its previous maximum;
    /// `None` without a whole window.
    pub fn largest_drawdown(&self) -> Option<f64> {
        let fallen = self.curve(Measure::Drawdown, Axis::Episodes).into_iter();
        fallen.map(|(_, below)| below).max_by(f64::total_cmp)
    }

    /// Returns the average of `measure` over each whole window of training episodes, against the
    /// number of episodes, steps or updates completed at its end.
    pub fn curve(&self, measure: Measure, over: Axis) -> Vec<(f64, f64)> {
        let partial = self.window.saturating_sub(1);
        let means = trailing_mean(&self.values(measure), self.window);
        let whole = means.get(partial..).unwrap_or_default();
        let points = match measure {
            Measure::WallsPassed | Measure::Return => whole.to_vec(),
            Measure::Drawdown => drawdowns(whole),
        };
        self.places(over)
            .into_iter()
            .skip(partial)
            .zip(points)
            .collect()
    }

    fn values(&self, measure: Measure) -> Vec<f64> {
        self.episodes
            .iter()
            .map(|episode| match measure {
                Measure::WallsPassed | Measure::Drawdown => f64::from(episode.walls_passed),
                Measure::Return => episode.episode_return,
            })
            .collect()
    }

    /// Returns the number of episodes, steps or updates completed after each episode. Updates
    /// follow from steps: each step after the warm-up has the same number of updates.
    fn places(&self, over: Axis) -> Vec<f64> {
        let mut steps = 0;
        let learned_steps = self.summary.steps.saturating_sub(self.warmup_steps).max(1);
        let updates_per_step = self.summary.updates as f64 / learned_steps as f64;
        self.episodes
            .iter()
            .enumerate()
            .map(|(number, episode)| {
                steps += u64::from(episode.steps);
                match over {
                    Axis::Episodes => (number + 1) as f64,
                    Axis::Steps => steps as f64,
                    Axis::Updates => {
                        steps.saturating_sub(self.warmup_steps) as f64 * updates_per_step
                    }
                }
            })
            .collect()
    }
}

fn of_training<T: DeserializeOwned>(path: &Path) -> Result<T, ResultError> {
    json(path).map_err(|problem| ResultError::File {
        path: path.to_owned(),
        problem,
    })
}

/// Reads the evaluation of a suite.
pub(super) fn of_suite(path: &Path) -> Result<EvaluationReport, ResultError> {
    json(path).map_err(|problem| ResultError::Suite {
        path: path.to_owned(),
        problem,
    })
}

fn json<T: DeserializeOwned>(path: &Path) -> Result<T, String> {
    let bytes = files::read(path, REPORT_BYTES).map_err(|error| error.to_string())?;
    serde_json::from_slice(&bytes).map_err(|error| error.to_string())
}
