//! The tables of a report, as Markdown.

use comfy_table::presets::ASCII_MARKDOWN;
use comfy_table::{CellAlignment, Table};
use skein_protocol::config::ConfirmOn;
use skein_protocol::evaluation::CourseEvaluation;
use skein_protocol::summary::Trained;

use super::Findings;
use super::outcomes::entry_of;
use crate::definition::{Arm, TableKind};
use crate::results::RunResult;
use crate::statistics::{Estimate, RESAMPLES, interquartile_mean};
use skein_reports::Clock;

/// What is shown where there is nothing to show.
pub(super) const NOTHING: &str = "–";

/// What is measured of a run; `None` where there is too little to measure.
type Measured = fn(&RunResult) -> Option<f64>;

/// A table and what stands above it.
pub(super) struct Titled {
    pub(super) title: String,
    pub(super) table: String,
}

impl Findings<'_> {
    /// The tables of one kind.
    pub(super) fn tables(&self, kind: TableKind) -> Vec<Titled> {
        match kind {
            TableKind::Evaluation => self.evaluation(),
            TableKind::Outcomes => self.outcomes(),
            TableKind::Suite => self.suite().into_iter().collect(),
            TableKind::Learning => vec![self.learning()],
            TableKind::Steadiness => vec![self.steadiness()],
            TableKind::Cost => vec![self.cost()],
        }
    }

    fn evaluation(&self) -> Vec<Titled> {
        let episodes = self.experiment.arms[0].config.evaluation.episodes;
        vec![
            Titled {
                title: format!("R of the best snapshot, {episodes} episodes a course"),
                table: self.by_course(|course| course.r, rate),
            },
            Titled {
                title: format!("Share of these {episodes} episodes that completed the course"),
                table: self.by_course(|course| course.completed, percent),
            },
        ]
    }

    /// A row an arm, a column a course.
    fn by_course(
        &self,
        value: impl Fn(&CourseEvaluation) -> f64,
        show: impl Fn(Estimate) -> String,
    ) -> String {
        let courses = self.courses();
        let mut rows = Vec::new();
        for (number, arm) in self.experiment.arms.iter().enumerate() {
            let mut row = self.head(number, arm).to_vec();
            row.extend(courses.iter().map(|name| {
                let of_course = |result: &RunResult| course_of(result, name).map(&value);
                self.estimate(number, of_course)
                    .map_or(NOTHING.to_owned(), &show)
            }));
            rows.push(row);
        }
        let header = ["arm".to_owned(), "seeds".to_owned()]
            .into_iter()
            .chain(courses);
        grid(header.collect(), rows, 1)
    }

    /// A row for each arm and entry of the suite.
    fn suite(&self) -> Option<Titled> {
        let flown = self.experiment.suite.as_ref()?;
        let mut rows = Vec::new();
        for (number, arm) in self.experiment.arms.iter().enumerate() {
            for entry in &flown.suite.entries {
                let estimate = |value: fn(&CourseEvaluation) -> f64| {
                    let of_entry = |result: &RunResult| entry_of(result, &entry.name).map(value);
                    self.estimate(number, of_entry)
                };
                let [label, seeds] = self.head(number, arm);
                let completed =
                    self.values(number, |run| Some(entry_of(run, &entry.name)?.completed));
                let mean =
                    completed.and_then(|values| self.bootstrap(number, RESAMPLES).mean(&values));
                rows.push(vec![
                    label,
                    entry.name.clone(),
                    seeds,
                    entry.episodes.to_string(),
                    mean.map_or(NOTHING.to_owned(), percent),
                    estimate(|course| course.completed).map_or(NOTHING.to_owned(), percent),
                    estimate(|course| course.r).map_or(NOTHING.to_owned(), rate),
                ]);
            }
        }
        let header = [
            "arm",
            "entry",
            "seeds",
            "episodes",
            "completed, mean",
            "completed",
            "R",
        ];
        Some(Titled {
            title: format!("The best snapshot in the suite `{}`", flown.file_name()),
            table: grid(header.map(str::to_owned).to_vec(), rows, 2),
        })
    }

    fn learning(&self) -> Titled {
        let evaluation = &self.experiment.arms[0].config.evaluation;
        let window = evaluation.window_episodes;
        let mut at_the_end: Vec<(String, Measured)> = vec![(
            format!("walls passed, last {window}"),
            RunResult::final_walls_passed,
        )];
        if self.experiment.has_one_reward() {
            at_the_end.push((format!("return, last {window}"), RunResult::final_return));
        }
        at_the_end.push(("volatility".to_owned(), RunResult::volatility));
        let (names, measures): (Vec<_>, Vec<_>) = at_the_end.into_iter().unzip();
        let count = |value: f64| format!("{value:.0}");
        let time = |secs| Clock(secs).to_string();
        let mut rows = Vec::new();
        for (number, arm) in self.experiment.arms.iter().enumerate() {
            let mut row = self.head(number, arm).to_vec();
            let episodes = |run: &RunResult| run.summary.episodes as f64;
            row.push(self.until(number, RunResult::one_wall_after, episodes, &count));
            let trained = self
                .of_arm(number)
                .filter(|result| result.summary.trained.is_some())
                .count();
            row.push(format!("{trained} of {}", self.of_arm(number).count()));
            row.push(self.until_trained(number, |at| at.episodes as f64, episodes, &count));
            row.push(self.until_trained(
                number,
                |at| at.steps as f64,
                |run| run.summary.steps as f64,
                &count,
            ));
            row.push(self.until_trained(
                number,
                |at| at.updates as f64,
                |run| run.summary.updates as f64,
                &count,
            ));
            row.push(self.until_trained(
                number,
                |at| at.wall_secs,
                |run| run.summary.wall_secs,
                &time,
            ));
            row.extend(self.measured(number, &measures));
            rows.push(row);
        }
        let mut header = vec![
            "arm".to_owned(),
            "seeds".to_owned(),
            "episodes to one wall".to_owned(),
            format!("R ≥ {} reached", evaluation.trained_rate),
            "after episodes".to_owned(),
            "steps".to_owned(),
            "updates".to_owned(),
            "time".to_owned(),
        ];
        header.extend(names);
        Titled {
            title: format!(
                "Learning, with R ≥ {} confirmed in {} episodes on {}",
                evaluation.trained_rate,
                evaluation.confirm_episodes,
                match evaluation.confirm_on {
                    ConfirmOn::FirstCourse => "the first course",
                    ConfirmOn::Generated => "generated courses",
                }
            ),
            table: grid(header, rows, 1),
        }
    }

    fn steadiness(&self) -> Titled {
        let mut rows = Vec::new();
        for (number, arm) in self.experiment.arms.iter().enumerate() {
            let mut row = self.head(number, arm).to_vec();
            row.extend(self.measured(
                number,
                &[
                    RunResult::level,
                    RunResult::volatility,
                    RunResult::dispersion_across_time,
                    RunResult::largest_drawdown,
                ],
            ));
            rows.push(row);
        }
        let header = [
            "arm",
            "seeds",
            "level",
            "volatility",
            "dispersion across time",
            "largest drawdown",
        ];
        Titled {
            title: "Steadiness of the walls passed in training".to_owned(),
            table: grid(header.map(str::to_owned).to_vec(), rows, 1),
        }
    }

    /// Cells of what is measured of the runs of an arm.
    fn measured(&self, arm: usize, measures: &[Measured]) -> Vec<String> {
        let cell = |of_run: &Measured| {
            let estimate = self.estimate(arm, of_run);
            estimate.map_or(NOTHING.to_owned(), |estimate| {
                with_interval(estimate, |value| format!("{value:.2}"))
            })
        };
        measures.iter().map(cell).collect()
    }

    /// When the runs of an arm were trained.
    fn until_trained(
        &self,
        arm: usize,
        at: impl Fn(&Trained) -> f64,
        whole: impl Fn(&RunResult) -> f64,
        show: &dyn Fn(f64) -> String,
    ) -> String {
        self.until(
            arm,
            |result| result.summary.trained.as_ref().map(&at),
            whole,
            show,
        )
    }

    /// When the runs of an arm had `reached` something. A run that never had counts with the
    /// `whole` that it took, which is the least it would have taken.
    fn until(
        &self,
        arm: usize,
        reached: impl Fn(&RunResult) -> Option<f64>,
        whole: impl Fn(&RunResult) -> f64,
        show: &dyn Fn(f64) -> String,
    ) -> String {
        let by_all = self.of_arm(arm).all(|result| reached(result).is_some());
        let value = |result: &RunResult| Some(reached(result).unwrap_or_else(|| whole(result)));
        match self.estimate(arm, value) {
            None => NOTHING.to_owned(),
            Some(estimate) if by_all => with_interval(estimate, show),
            Some(estimate) => format!("≥ {}", with_interval(estimate, show)),
        }
    }

    fn cost(&self) -> Titled {
        let mut rows = Vec::new();
        for (number, arm) in self.experiment.arms.iter().enumerate() {
            let mean = |of: &dyn Fn(&RunResult) -> f64| {
                let values: Vec<_> = self.of_arm(number).map(of).collect();
                interquartile_mean(&values)
            };
            let count = |of: &dyn Fn(&RunResult) -> f64| {
                mean(of).map_or(NOTHING.to_owned(), |value| format!("{value:.0}"))
            };
            let mut row = self.head(number, arm).to_vec();
            row.push(count(&|run| run.summary.episodes as f64));
            row.push(count(&|run| run.summary.steps as f64));
            row.push(count(&|run| run.summary.updates as f64));
            row.push(count(&|run| run.summary.vae_updates as f64));
            row.push(count(&|run| run.summary.evaluation_episodes as f64));
            row.push(
                mean(&|run| run.summary.wall_secs)
                    .map_or(NOTHING.to_owned(), |secs| Clock(secs).to_string()),
            );
            rows.push(row);
        }
        let header = [
            "arm",
            "seeds",
            "episodes",
            "steps",
            "updates",
            "VAE steps",
            "evaluation episodes",
            "wall time",
        ];
        Titled {
            title: "Cost of a run".to_owned(),
            table: grid(header.map(str::to_owned).to_vec(), rows, 1),
        }
    }

    /// The first cells of an arm's row: its label, and how many of its runs are complete.
    fn head(&self, number: usize, arm: &Arm) -> [String; 2] {
        let (complete, planned) = (self.of_arm(number).count() as u64, self.plan.seeds);
        let seeds = match complete == planned {
            true => planned.to_string(),
            false => format!("{complete} of {planned}"),
        };
        [arm.label.clone(), seeds]
    }

    /// The estimate of what `of_run` says of the complete runs of an arm; `None` when it says
    /// nothing of one of them.
    fn estimate(&self, arm: usize, of_run: impl Fn(&RunResult) -> Option<f64>) -> Option<Estimate> {
        self.bootstrap(arm, RESAMPLES)
            .interquartile_mean(&self.values(arm, of_run)?)
    }

    /// What `of_run` says of each of the complete runs of an arm; `None` when it says nothing of
    /// one of them.
    fn values(&self, arm: usize, of_run: impl Fn(&RunResult) -> Option<f64>) -> Option<Vec<f64>> {
        self.of_arm(arm).map(of_run).collect()
    }

    /// Names of the evaluation courses.
    pub(super) fn courses(&self) -> Vec<String> {
        let first = self.results.first();
        first.map_or(Vec::new(), |result| {
            let courses = result.evaluation.courses.iter();
            courses.map(|course| course.course.clone()).collect()
        })
    }
}

pub(super) fn course_of<'a>(result: &'a RunResult, name: &str) -> Option<&'a CourseEvaluation> {
    result
        .evaluation
        .courses
        .iter()
        .find(|course| course.course == name)
}

fn rate(estimate: Estimate) -> String {
    with_interval(estimate, |value| format!("{value:.3}"))
}

fn percent(estimate: Estimate) -> String {
    with_interval(estimate, share)
}

fn share(value: f64) -> String {
    format!("{:.1} %", 100.0 * value)
}

/// `value [low, high]`.
fn with_interval(estimate: Estimate, show: impl Fn(f64) -> String) -> String {
    let value = show(estimate.value);
    match estimate.interval {
        None => value,
        Some((low, high)) => format!("{value} [{}, {}]", show(low), show(high)),
    }
}

/// A Markdown table whose first `left` columns are aligned left, all others right.
pub(super) fn grid(header: Vec<String>, rows: Vec<Vec<String>>, left: usize) -> String {
    let mut table = Table::new();
    table.load_preset(ASCII_MARKDOWN).set_header(header);
    for row in rows {
        table.add_row(row);
    }
    for column in table.column_iter_mut().skip(left) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    let text = table.to_string();
    let mut lines: Vec<_> = text.lines().map(str::to_owned).collect();
    // Those who render Markdown learn of the alignment from the line under the header alone.
    if let Some(rule) = lines.get_mut(1) {
        let mut column = 0;
        *rule = rule
            .split_inclusive('|')
            .map(|dashes| {
                column += 1;
                match column > left + 1 {
                    true => dashes.replace("-|", ":|"),
                    false => dashes.to_owned(),
                }
            })
            .collect();
    }
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_of_figures_are_aligned_right_for_those_who_render_it_too() {
        let row = |cells: [&str; 3]| cells.map(str::to_owned).to_vec();
        let text = grid(
            row(["arm", "seeds", "R"]),
            vec![row(["one", "3", "0.5 [0.4, 0.6]"])],
            1,
        );
        assert_eq!(
            text,
            "| arm | seeds |              R |\n|-----|------:|---------------:|\n| one |     3 | 0.5 [0.4, 0.6] |"
        );
    }

    #[test]
    fn an_interval_is_shown_where_there_is_one() {
        let show = |value: f64| format!("{value:.1}");
        let of = |interval| {
            with_interval(
                Estimate {
                    value: 0.5,
                    interval,
                },
                show,
            )
        };
        assert_eq!(
            (of(None), of(Some((0.25, 1.0)))),
            ("0.5".to_owned(), "0.5 [0.2, 1.0]".to_owned())
        );
    }
}
