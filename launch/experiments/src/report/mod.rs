//! Report of an experiment: tables, pictures, and the runs behind them.

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
use super::plan::{ExperimentPlan, REPORT};
use super::results::RunResult;
use super::statistics::Bootstrap;
use runs::RUNS;
use skein_reports::ReportError;
use skein_simulator::course::CourseError;

pub use publication::{Publication, PublicationError};

/// Link to the legend, for a report that lies beside its runs.
const LEGEND: &str = "How to read the tables and pictures: docs/results/README.md.\n\n";

/// Input of a report.
#[derive(Debug)]
pub struct Findings<'a> {
    /// Experiment to report.
    pub experiment: &'a Experiment,
    /// Its runs, complete or not.
    pub plan: &'a ExperimentPlan,
    /// Results of its complete runs.
    pub results: &'a [RunResult],
    /// Command that creates this report, for readers.
    pub command: String,
}

/// Reason why a report cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum ExperimentReportError {
    /// No run is complete.
    #[error("no run in {} is complete and can be read: there is nothing to report", .0.display())]
    Nothing(PathBuf),
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
        /// The operating system's error.
        #[source]
        source: std::io::Error,
    },
}

/// A picture of a report.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    /// Name of its file.
    pub file: String,
    /// Caption of the picture.
    pub caption: String,
}

/// A written report.
#[derive(Debug)]
pub struct WrittenReport {
    /// Path of the document. Its pictures and the figures of each run lie beside it.
    pub document: PathBuf,
    /// Text of the document.
    pub text: String,
    /// Pictures, in the document's folder.
    pub pictures: Vec<Picture>,
    /// Reasons why other pictures are missing.
    pub failures: Vec<ExperimentReportError>,
}

impl Findings<'_> {
    /// Writes the report with its pictures into the experiment's folder. A picture that cannot be
    /// drawn costs only itself.
    ///
    /// # Errors
    /// [`ExperimentReportError`] names the file.
    pub fn write(&self) -> Result<WrittenReport, ExperimentReportError> {
        let folder = self.plan.root.join(REPORT);
        if self.results.is_empty() {
            return Err(ExperimentReportError::Nothing(self.plan.root.clone()));
        }
        let write = |path: &Path| {
            let path = path.to_owned();
            move |source| ExperimentReportError::Write { path, source }
        };
        fs::create_dir_all(&folder).map_err(write(&folder))?;
        let (pictures, failures) = self.draw(&folder);
        let runs = folder.join(RUNS);
        self.write_runs(&runs).map_err(write(&runs))?;
        let text = format!(
            "{}{}\n\n{LEGEND}{}",
            self.heading(),
            self.body(&pictures, RUNS),
            self.how_to_repeat()
        );
        let document = folder.join("report.md");
        fs::write(&document, &text).map_err(write(&document))?;
        Ok(WrittenReport {
            document,
            text,
            pictures,
            failures,
        })
    }

    /// Returns `true` if every run is complete and its results were read.
    pub fn is_whole(&self) -> bool {
        self.results.len() == self.plan.runs.len()
    }

    /// Returns the complete runs of the arm with this index.
    fn of_arm(&self, arm: usize) -> impl Iterator<Item = &RunResult> {
        self.results.iter().filter(move |result| result.arm == arm)
    }

    /// Returns resamples of the complete runs of an arm.
    fn bootstrap(&self, arm: usize, resamples: usize) -> Bootstrap {
        Bootstrap::new(self.of_arm(arm).count(), resamples)
    }
}
