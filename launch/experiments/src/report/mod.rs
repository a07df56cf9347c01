//! What an experiment found: tables, pictures, and what they rest on.

mod curves;
mod document;
mod outcomes;
mod publication;
mod runs;
mod tables;
#[cfg(test)]
mod tests;

use std::fs;
use std::path::{Path, PathBuf};

use super::definition::Experiment;
use super::plan::{Plan, REPORT, State};
use super::results::{ResultError, RunResult};
use super::statistics::Bootstrap;
use runs::RUNS;
use skein_reports::ReportError;
use skein_simulator::course::CourseError;

pub use publication::{Publication, PublicationError};

/// Where a report that lies beside its runs sends its reader.
const LEGEND: &str = "How to read these tables and pictures: docs/results/README.md.\n\n";

/// What a report is drawn from.
#[derive(Debug)]
pub struct Findings<'a> {
    /// The experiment.
    pub experiment: &'a Experiment,
    /// Its runs.
    pub plan: &'a Plan,
    /// Those of them that are complete.
    pub results: &'a [RunResult],
    /// The command that makes this report, for readers.
    pub command: String,
}

/// Why a report cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum ExperimentReportError {
    /// Nothing is complete.
    #[error("no run in {} is complete: there is nothing to report yet", .0.display())]
    Nothing(PathBuf),
    /// A run cannot be read.
    #[error(transparent)]
    Result(#[from] ResultError),
    /// A picture cannot be drawn.
    #[error(transparent)]
    Picture(#[from] ReportError),
    /// A course cannot be read.
    #[error(transparent)]
    Course(#[from] CourseError),
    /// The report cannot be written.
    #[error("cannot write {}: {source}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// Why.
        #[source]
        source: std::io::Error,
    },
}

/// A picture of a report.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    /// Its file's name.
    pub file: String,
    /// What it shows.
    pub caption: String,
}

/// A report that was written.
#[derive(Debug)]
pub struct Written {
    /// The document, beside which lie its pictures and the figures of each run.
    pub document: PathBuf,
    /// Its text.
    pub text: String,
    /// Its pictures, in its folder.
    pub pictures: Vec<Picture>,
}

impl Findings<'_> {
    /// Draws all of it into the experiment's folder.
    ///
    /// # Errors
    /// [`ExperimentReportError`] names the file.
    pub fn write(&self) -> Result<Written, ExperimentReportError> {
        let folder = self.plan.root.join(REPORT);
        if self.results.is_empty() {
            return Err(ExperimentReportError::Nothing(self.plan.root.clone()));
        }
        let write = |path: &Path| {
            let path = path.to_owned();
            move |source| ExperimentReportError::Write { path, source }
        };
        fs::create_dir_all(&folder).map_err(write(&folder))?;
        let pictures = self.draw(&folder)?;
        let runs = folder.join(RUNS);
        self.write_runs(&runs).map_err(write(&runs))?;
        let text = format!(
            "{}{}{LEGEND}{}",
            self.heading(),
            self.body(&pictures, RUNS),
            self.how_to_repeat()
        );
        let document = folder.join("report.md");
        fs::write(&document, &text).map_err(write(&document))?;
        Ok(Written {
            document,
            text,
            pictures,
        })
    }

    /// Whether every run is complete.
    pub fn is_whole(&self) -> bool {
        self.plan
            .runs
            .iter()
            .all(|run| run.state == State::Complete)
    }

    /// The complete runs of an arm, by its place.
    fn of_arm(&self, arm: usize) -> impl Iterator<Item = &RunResult> {
        self.results.iter().filter(move |result| result.arm == arm)
    }

    /// Resamples of the complete runs of an arm.
    fn bootstrap(&self, arm: usize, resamples: usize) -> Bootstrap {
        Bootstrap::new(self.of_arm(arm).count(), resamples)
    }
}
