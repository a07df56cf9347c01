//! Figures of each run: the values behind a report's estimates, which a repeated run with the same
//! configuration and seed must reproduce.

use std::io;
use std::path::Path;

use skein_protocol::evaluation::CourseEvaluation;
use skein_protocol::summary::Trained;

use super::Findings;
use super::outcomes::entry_of;
use super::tables::course_of;
use crate::results::RunResult;

/// Name of the file in a report's folder.
pub(super) const RUNS: &str = "runs.csv";

impl Findings<'_> {
    /// Writes a row per complete run, in the plan's order.
    pub(super) fn write_runs(&self, path: &Path) -> io::Result<()> {
        let mut writer = csv::Writer::from_path(path)?;
        for (number, result) in self.results.iter().enumerate() {
            let (header, figures): (Vec<_>, Vec<_>) = self.columns(result).into_iter().unzip();
            if number == 0 {
                writer.write_record(header)?;
            }
            writer.write_record(figures)?;
        }
        writer.flush()
    }

    /// Returns the name and value of every column; the value is empty if the run has none.
    fn columns(&self, run: &RunResult) -> Vec<(String, String)> {
        let summary = &run.summary;
        let trained =
            |of: fn(&Trained) -> String| summary.trained.as_ref().map_or(String::new(), of);
        let measure =
            |value: Option<f64>| value.map_or(String::new(), |value| format!("{value:.4}"));
        let counts = [
            ("arm", self.experiment.arms[run.arm].name.clone()),
            ("seed", run.seed.to_string()),
            ("skein_version", summary.skein_version.clone()),
            ("policy_sha256", summary.policy_sha256.clone()),
            ("episodes", summary.episodes.to_string()),
            ("steps", summary.steps.to_string()),
            ("updates", summary.updates.to_string()),
            ("vae_updates", summary.vae_updates.to_string()),
            (
                "evaluation_episodes",
                summary.evaluation_episodes.to_string(),
            ),
            ("wall_secs", format!("{:.1}", summary.wall_secs)),
            ("trained_episodes", trained(|at| at.episodes.to_string())),
            ("trained_steps", trained(|at| at.steps.to_string())),
            ("trained_updates", trained(|at| at.updates.to_string())),
            (
                "trained_wall_secs",
                trained(|at| format!("{:.1}", at.wall_secs)),
            ),
            (
                "one_wall_episodes",
                run.one_wall_after()
                    .map_or(String::new(), |episodes| episodes.to_string()),
            ),
            ("final_walls_passed", measure(run.final_walls_passed())),
            ("final_return", measure(run.final_return())),
            ("volatility", measure(run.volatility())),
        ];
        let mut columns: Vec<_> = counts
            .map(|(name, value)| (name.to_owned(), value))
            .to_vec();
        let mut flown = |name: &str, course: Option<&CourseEvaluation>| {
            columns.push((format!("R {name}"), measure(course.map(|course| course.r))));
            columns.push((
                format!("completed {name}"),
                measure(course.map(|course| course.completed)),
            ));
        };
        for name in self.courses() {
            flown(&name, course_of(run, &name));
        }
        for name in self.entries() {
            flown(&name, entry_of(run, &name));
        }
        columns
    }

    /// Returns the names of the suite's entries; none without a suite.
    pub(super) fn entries(&self) -> Vec<String> {
        let suite = self.experiment.suite.as_ref();
        suite.map_or(Vec::new(), |flown| {
            flown
                .suite
                .entries
                .iter()
                .map(|entry| entry.name.clone())
                .collect()
        })
    }
}
