//! Each run's own figures: what the estimates of a report are made of, and what another run of the same configuration and seed must come to.

use std::io;
use std::path::Path;

use skein_protocol::evaluation::CourseEvaluation;

use super::Findings;
use super::outcomes::entry_of;
use super::tables::course_of;
use crate::experiments::results::RunResult;

/// The file's name in a report's folder.
pub(super) const RUNS: &str = "runs.csv";

impl Findings<'_> {
    /// Writes a line for every complete run, in the plan's order.
    pub(super) fn write_runs(&self, path: &Path) -> io::Result<()> {
        let mut writer = csv::Writer::from_path(path)?;
        writer.write_record(self.header())?;
        for result in self.results {
            writer.write_record(self.figures(result))?;
        }
        writer.flush()
    }

    fn header(&self) -> Vec<String> {
        let counts = [
            "arm",
            "seed",
            "skein_version",
            "policy_sha256",
            "flights",
            "steps",
            "updates",
            "vae_updates",
            "evaluation_flights",
            "wall_secs",
            "trained_flights",
            "trained_steps",
            "trained_updates",
            "trained_wall_secs",
            "final_walls_passed",
            "final_return",
            "volatility",
        ];
        let flown = self.courses().into_iter().chain(self.entries());
        let rates = flown.flat_map(|name| [format!("R {name}"), format!("completed {name}")]);
        counts.map(str::to_owned).into_iter().chain(rates).collect()
    }

    fn figures(&self, run: &RunResult) -> Vec<String> {
        let summary = &run.summary;
        let trained = summary.trained.as_ref();
        let count = |value: Option<u64>| value.map_or(String::new(), |value| value.to_string());
        let measure = |value: Option<f64>| value.map_or(String::new(), |value| format!("{value:.4}"));
        let mut figures = vec![
            self.experiment.arms[run.arm].name.clone(),
            run.seed.to_string(),
            summary.skein_version.clone(),
            summary.policy_sha256.clone(),
            summary.flights.to_string(),
            summary.steps.to_string(),
            summary.updates.to_string(),
            summary.vae_updates.to_string(),
            summary.evaluation_flights.to_string(),
            format!("{:.1}", summary.wall_secs),
            count(trained.map(|at| at.flights)),
            count(trained.map(|at| at.steps)),
            count(trained.map(|at| at.updates)),
            trained.map_or(String::new(), |at| format!("{:.1}", at.wall_secs)),
            measure(run.final_walls_passed()),
            measure(run.final_return()),
            measure(run.volatility()),
        ];
        let courses = self.courses();
        let flown = courses.iter().map(|name| course_of(run, name));
        let suite = self.entries();
        let flown = flown.chain(suite.iter().map(|name| entry_of(run, name)));
        let rate = |of: fn(&CourseEvaluation) -> f64, flown: Option<&CourseEvaluation>| measure(flown.map(of));
        for course in flown {
            figures.push(rate(|course| course.r, course));
            figures.push(rate(|course| course.completed, course));
        }
        figures
    }

    /// Names of the suite's entries, if there is one.
    fn entries(&self) -> Vec<String> {
        let suite = self.experiment.suite.as_ref();
        suite.map_or(Vec::new(), |flown| {
            flown.suite.entries.iter().map(|entry| entry.name.clone()).collect()
        })
    }
}
