//! The text of a report: everything a reader needs to judge a figure, and to have it again.

use std::collections::BTreeSet;
use std::fmt::Write;

use super::{Findings, Picture};
use crate::definition::{Experiment, TableKind};
use crate::results::RunResult;
use skein_reports::Clock;

impl Findings<'_> {
    /// The report as Markdown; its pictures and `runs`, the figures of each run, lie where `prefix`
    /// and a file's name say.
    pub(super) fn document(&self, pictures: &[Picture], prefix: &str, runs: &str) -> String {
        let mut text = format!(
            "**{}**\n\n```sh\n{}\n```\n\n",
            self.experiment.question, self.command
        );
        push(&mut text, &self.what_was_run());
        if let Some(note) = self.shortened() {
            push(&mut text, &note);
        }
        if let Some(note) = self.missing() {
            push(&mut text, &note);
        }
        push(&mut text, &self.rests_on());
        if let Some(note) = self.of_several_builds() {
            push(&mut text, &note);
        }
        for &kind in &self.experiment.tables {
            for titled in self.tables(kind) {
                push(&mut text, &format!("*{}.*", titled.title));
                push(&mut text, &titled.table);
            }
        }
        for picture in pictures {
            push(
                &mut text,
                &format!("![{}]({prefix}{})", picture.caption, picture.file),
            );
        }
        push(
            &mut text,
            &format!(
                "Every run's own figures, and the SHA-256 of what it learned: [one line a run]({prefix}{runs})."
            ),
        );
        push(&mut text, &self.how_to_read(pictures));
        text
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
        text.push_str("; the arms set, beside that:\n\n");
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
            .then(|| format!("**Not all of it**: {complete} of {planned} runs are complete."))
    }

    /// What all figures rest on.
    fn rests_on(&self) -> String {
        let seeds = match self.plan.seeds {
            1 => "1 seed".to_owned(),
            seeds => format!("{seeds} seeds"),
        };
        format!(
            "{seeds} an arm; a run: {} episodes, {} steps, {} updates, {} of wall time. Skein {}.",
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

    fn of_several_builds(&self) -> Option<String> {
        (self.builds().len() > 1).then(|| {
            "**Of several builds**: what differs between runs may be what changed between them. Runs that are moved away are done again, with one build.".to_owned()
        })
    }

    /// Versions that the runs were trained with, each once.
    fn builds(&self) -> Vec<&str> {
        let versions: BTreeSet<_> = self
            .results
            .iter()
            .map(|run| run.summary.skein_version.as_str())
            .collect();
        versions.into_iter().collect()
    }

    fn how_to_read(&self, pictures: &[Picture]) -> String {
        let tables = &self.experiment.tables;
        let estimates = tables.iter().any(|kind| *kind != TableKind::Outcomes);
        let mut text = String::new();
        if estimates {
            text.push_str(match self.plan.seeds {
                1 => "One seed has no interval, and says nothing about others. ",
                2 | 3 => "Interquartile mean over the seeds, in brackets its 95 % bootstrap interval, which of so few seeds reaches from the least value to the greatest, and is rather too narrow. ",
                4 | 5 => "Interquartile mean over the seeds, in brackets its 95 % bootstrap interval; of so few seeds it is a rough one, and rather too narrow. ",
                _ => "Interquartile mean over the seeds, in brackets its 95 % bootstrap interval. ",
            });
        }
        if tables.contains(&TableKind::Suite) {
            text.push_str("*Completed, mean* is the plain mean, in which the worst seed counts as much as any, with an interval of its own. ");
        }
        let window = self.experiment.arms[0].config.evaluation.window_episodes;
        if tables.contains(&TableKind::Learning) {
            text.push_str(
                "A run that never came to a wall or to the rate counts with all that it took (≥). ",
            );
        }
        if tables.contains(&TableKind::Learning) || tables.contains(&TableKind::Steadiness) {
            let _ = write!(
                text,
                "Volatility is the root mean square of the differences between the walls passed in successive {window} episodes, once they have risen to 0.9 of the level that the run comes to; – where a run has too few episodes after that. A run that has learned nothing has a small one as well: read it beside the walls passed. "
            );
        }
        if tables.contains(&TableKind::Steadiness) {
            let _ = write!(
                text,
                "The level is what a run comes to: the median of the averages over {window} episodes in its second half. Dispersion across time is the interquartile range of the differences between the walls passed in successive {window} episodes, once they have risen to 0.9 of the level that the run comes to; the largest drawdown is how far the average over {window} episodes ever fell below the highest it had been (arXiv:1912.05663). "
            );
        }
        if !pictures.is_empty() {
            text.push_str("Lines are interquartile means over the seeds, bands their 95 % bootstrap intervals; a line ends where the first of its runs does. ");
        }
        text.trim_end().to_owned()
    }
}

/// One paragraph more.
fn push(text: &mut String, paragraph: &str) {
    if !paragraph.is_empty() {
        text.push_str(paragraph);
        text.push_str("\n\n");
    }
}

fn code(settings: &[String]) -> String {
    let quoted: Vec<_> = settings
        .iter()
        .map(|setting| format!("`{setting}`"))
        .collect();
    quoted.join(", ")
}

/// From the least to the most, or the one that all have.
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
