//! Text of a report: all that a reader needs to judge the figures and to reproduce them.

use std::collections::BTreeSet;
use std::fmt::Write;

use super::{Findings, Picture};
use crate::definition::Experiment;
use crate::results::RunResult;
use skein_reports::Clock;

impl Findings<'_> {
    /// Returns the report as Markdown, without heading, command and legend. The paths of
    /// `pictures`, and of `runs` with the figures of each run, are relative to the document.
    ///
    /// The legend of all reports is in `docs/results/README.md`.
    pub(super) fn body(&self, pictures: &[Picture], runs: &str) -> String {
        let mut text = String::new();
        push(&mut text, &self.what_was_run());
        for note in [self.shortened(), self.missing()].into_iter().flatten() {
            push(&mut text, &note);
        }
        push(&mut text, &self.sample());
        for note in [self.several_builds(), self.how_differences_are_meant()]
            .into_iter()
            .flatten()
        {
            push(&mut text, &note);
        }
        for &kind in &self.experiment.tables {
            for titled in self.tables(kind) {
                push(&mut text, &format!("*{}.*", titled.title));
                push(&mut text, &titled.table);
            }
        }
        for Picture { caption, file } in pictures {
            push(&mut text, &format!("![{caption}]({file})"));
        }
        let figures = "Figures of each run, with the SHA-256 of its policy";
        push(&mut text, &format!("{figures}: [{runs}]({runs})."));
        text.trim_end().to_owned()
    }

    /// Returns the heading of a separate document: the question.
    pub(super) fn heading(&self) -> String {
        format!("# {}\n\n", self.experiment.question)
    }

    /// Returns a section with the command that repeats the experiment.
    pub(super) fn how_to_repeat(&self) -> String {
        format!("## Repeat it\n\n```sh\n{}\n```\n", self.command)
    }

    fn what_was_run(&self) -> String {
        let Experiment {
            base_name,
            settings,
            arms,
            ..
        } = self.experiment;
        let mut text = format!("Trained with `configs/{base_name}` and {}", code(settings));
        if let [arm] = &arms[..]
            && arm.settings.is_empty()
        {
            text.push('.');
            return text;
        }
        text.push_str(". The arms also set:\n\n");
        for arm in arms {
            let settings = match arm.settings.is_empty() {
                true => "nothing".to_owned(),
                false => code(&arm.settings),
            };
            let _ = writeln!(text, "- {}: {settings}", arm.label);
        }
        text.trim_end().to_owned()
    }

    fn shortened(&self) -> Option<String> {
        let shortened = self.experiment.shortened()?;
        Some(format!("**Shortened**: {shortened}."))
    }

    fn missing(&self) -> Option<String> {
        let (planned, complete) = (self.plan.runs.len(), self.results.len());
        (complete < planned)
            .then(|| format!("**Incomplete**: {complete} of {planned} runs are complete."))
    }

    /// Returns the numbers of seeds, episodes, steps and updates, and the builds, behind the
    /// figures.
    fn sample(&self) -> String {
        let seeds = match self.plan.seeds {
            1 => "1 seed".to_owned(),
            seeds => format!("{seeds} seeds"),
        };
        format!(
            "{seeds} an arm. A run: {} episodes, {} steps, {} updates, {} of wall time. Skein {}.",
            range(
                self.results,
                |run| run.summary.episodes as f64,
                |value| format!("{value:.0}")
            ),
            range(
                self.results,
                |run| run.summary.steps as f64,
                |value| format!("{value:.0}")
            ),
            range(
                self.results,
                |run| run.summary.updates as f64,
                |value| format!("{value:.0}")
            ),
            range(
                self.results,
                |run| run.summary.wall_secs,
                |secs| Clock(secs).to_string()
            ),
            self.builds().join(", ")
        )
    }

    fn several_builds(&self) -> Option<String> {
        (self.builds().len() > 1).then(|| {
            "**Several builds**: differences between runs may come from changes between the \
             builds. To train runs again with one build, move their directories away."
                .to_owned()
        })
    }

    fn how_differences_are_meant(&self) -> Option<String> {
        let [first, _, ..] = &self.experiment.arms[..] else {
            return None;
        };
        Some(format!(
            "A row \"difference to {0}\" is the arm's figure minus that of {0}, \
             over the seeds that \
             both have completed. Its 95 % interval compares seed by seed: where it leaves out 0, \
             the arms differ.",
            first.label
        ))
    }

    /// Returns the versions that trained the runs, each once.
    fn builds(&self) -> Vec<&str> {
        let versions: BTreeSet<_> = self
            .results
            .iter()
            .map(|run| run.summary.skein_version.as_str())
            .collect();
        versions.into_iter().collect()
    }
}

/// Appends a paragraph.
fn push(text: &mut String, paragraph: &str) {
    text.push_str(paragraph);
    text.push_str("\n\n");
}

fn code(settings: &[String]) -> String {
    let quoted: Vec<_> = settings
        .iter()
        .map(|setting| format!("`{setting}`"))
        .collect();
    quoted.join(", ")
}

/// Returns the range of a value over the runs, or the single value that all runs have.
fn range(
    results: &[RunResult],
    of: impl Fn(&RunResult) -> f64,
    show: impl Fn(f64) -> String,
) -> String {
    let values = || results.iter().map(&of);
    let (least, most) = (
        values().fold(f64::INFINITY, f64::min),
        values().fold(0.0, f64::max),
    );
    match (show(least), show(most)) {
        (least, most) if least == most => least,
        (least, most) => format!("{least} to {most}"),
    }
}
