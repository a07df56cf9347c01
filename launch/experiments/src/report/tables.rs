//! Tables of a report, as Markdown.

use comfy_table::presets::ASCII_MARKDOWN;
use comfy_table::{CellAlignment, Table};
use skein_protocol::config::ConfirmOn;
use skein_protocol::evaluation::CourseEvaluation;
use skein_protocol::summary::Trained;

use super::Findings;
use super::outcomes::entry_of;
use crate::definition::{Arm, TableKind};
use crate::results::RunResult;
use crate::statistics::{Bootstrap, Estimate, RESAMPLES, interquartile_mean};
use skein_reports::Clock;

/// Content of a cell without a value.
pub(super) const NOTHING: &str = "–";

/// Measure of a run; `None` if the run is too short for it.
type RunMeasure = fn(&RunResult) -> Option<f64>;

/// A table and its title.
pub(super) struct TitledTable {
    pub(super) title: String,
    pub(super) table: String,
}

impl Findings<'_> {
    /// Returns the tables of one kind.
    pub(super) fn tables(&self, kind: TableKind) -> Vec<TitledTable> {
        match kind {
            TableKind::Evaluation => self.evaluation(),
            TableKind::Outcomes => self.outcomes(),
            TableKind::Suite => self.suite().into_iter().collect(),
            TableKind::Learning => vec![self.learning()],
            TableKind::Steadiness => vec![self.steadiness()],
            TableKind::Cost => vec![self.cost()],
        }
    }

    fn evaluation(&self) -> Vec<TitledTable> {
        let episodes = self.experiment.arms[0].config.evaluation.episodes;
        vec![
            TitledTable {
                title: format!(
                    "R, the share of walls passed, of the best snapshot in {episodes} episodes a \
                     course without exploration"
                ),
                table: self.by_course(|course| course.r, rate, rate_difference),
            },
            TitledTable {
                title: format!("Share of these {episodes} episodes that completed the course"),
                table: self.by_course(|course| course.completed, percent, points),
            },
        ]
    }

    /// Returns a table with a row per arm and per difference, and a column per course.
    fn by_course(
        &self,
        value: impl Fn(&CourseEvaluation) -> f64,
        show: impl Fn(Estimate) -> String,
        show_difference: impl Fn(Estimate) -> String,
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
        for (number, head) in self.differences() {
            let mut row = head.to_vec();
            row.extend(courses.iter().map(|name| {
                let of_course = |result: &RunResult| course_of(result, name).map(&value);
                self.difference(number, of_course)
                    .map_or(NOTHING.to_owned(), &show_difference)
            }));
            rows.push(row);
        }
        let header = ["arm".to_owned(), "seeds".to_owned()]
            .into_iter()
            .chain(courses);
        grid(header.collect(), rows, 1)
    }

    /// Returns a table with a row per arm and suite entry, and per difference and suite entry.
    fn suite(&self) -> Option<TitledTable> {
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
        for (number, [label, seeds]) in self.differences() {
            for entry in &flown.suite.entries {
                let of_entry = |value: fn(&CourseEvaluation) -> f64| {
                    move |result: &RunResult| entry_of(result, &entry.name).map(value)
                };
                let completed = of_entry(|course| course.completed);
                let r = of_entry(|course| course.r);
                let mean = self.pairs(number, completed).and_then(|pairs| {
                    let (values, reference) = pairs;
                    Bootstrap::new(values.len(), RESAMPLES).difference_of_means(&values, &reference)
                });
                rows.push(vec![
                    label.clone(),
                    entry.name.clone(),
                    seeds.clone(),
                    entry.episodes.to_string(),
                    mean.map_or(NOTHING.to_owned(), points),
                    self.difference(number, completed)
                        .map_or(NOTHING.to_owned(), points),
                    self.difference(number, r)
                        .map_or(NOTHING.to_owned(), rate_difference),
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
        Some(TitledTable {
            title: format!(
                "The best snapshot in the suite `{}`, without exploration: \
                     share of episodes that completed the course, and R",
                flown.file_name()
            ),
            table: grid(header.map(str::to_owned).to_vec(), rows, 2),
        })
    }

    fn learning(&self) -> TitledTable {
        let evaluation = &self.experiment.arms[0].config.evaluation;
        let window = evaluation.window_episodes;
        let mut at_the_end: Vec<(String, RunMeasure)> = vec![(
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
        for (number, head) in self.differences() {
            let mut row = head.to_vec();
            let later = |reached: &dyn Fn(&RunResult) -> Option<f64>,
                         show: &dyn Fn(f64) -> String| {
                let difference = self.difference(number, reached);
                difference.map_or(NOTHING.to_owned(), |estimate| {
                    with_interval(estimate, |value| signed(value, show))
                })
            };
            let trained = |at: fn(&Trained) -> f64| {
                move |run: &RunResult| run.summary.trained.as_ref().map(at)
            };
            row.push(later(&RunResult::one_wall_after, &count));
            row.push(NOTHING.to_owned());
            row.push(later(&trained(|at| at.episodes as f64), &count));
            row.push(later(&trained(|at| at.steps as f64), &count));
            row.push(later(&trained(|at| at.updates as f64), &count));
            row.push(later(&trained(|at| at.wall_secs), &time));
            row.extend(self.measured_differences(number, &measures));
            rows.push(row);
        }
        let mut header = vec![
            "arm".to_owned(),
            "seeds".to_owned(),
            "episodes to one wall".to_owned(),
            format!(
                "R ≥ {} reached in {} episodes",
                evaluation.trained_rate, evaluation.confirm_episodes
            ),
            "after episodes".to_owned(),
            "steps".to_owned(),
            "updates".to_owned(),
            "time".to_owned(),
        ];
        header.extend(names);
        TitledTable {
            title: format!(
                "Learning: episodes until the average of {window} reached one wall; \
                     when R ≥ {} was first confirmed, in {} evaluation episodes on {}; \
                     the last {window} training episodes",
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

    fn steadiness(&self) -> TitledTable {
        let measures: [RunMeasure; 4] = [
            RunResult::level,
            RunResult::volatility,
            RunResult::dispersion_across_time,
            RunResult::largest_drawdown,
        ];
        let mut rows = Vec::new();
        for (number, arm) in self.experiment.arms.iter().enumerate() {
            let mut row = self.head(number, arm).to_vec();
            row.extend(self.measured(number, &measures));
            rows.push(row);
        }
        for (number, head) in self.differences() {
            let mut row = head.to_vec();
            row.extend(self.measured_differences(number, &measures));
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
        TitledTable {
            title: "Steadiness of the walls passed in training: \
                        at the same level, smaller is steadier"
                .to_owned(),
            table: grid(header.map(str::to_owned).to_vec(), rows, 1),
        }
    }

    /// Returns the cells of `measures` of the runs of an arm.
    fn measured(&self, arm: usize, measures: &[RunMeasure]) -> Vec<String> {
        let cell = |of_run: &RunMeasure| {
            let estimate = self.estimate(arm, of_run);
            estimate.map_or(NOTHING.to_owned(), |estimate| {
                with_interval(estimate, |value| format!("{value:.2}"))
            })
        };
        measures.iter().map(cell).collect()
    }

    /// Returns the cells of the differences in `measures` between an arm and the first.
    fn measured_differences(&self, arm: usize, measures: &[RunMeasure]) -> Vec<String> {
        let cell = |of_run: &RunMeasure| {
            let difference = self.difference(arm, of_run);
            difference.map_or(NOTHING.to_owned(), |estimate| {
                with_interval(estimate, |value| {
                    signed(value, &|size| format!("{size:.2}"))
                })
            })
        };
        measures.iter().map(cell).collect()
    }

    /// Returns the cell for the time `at` which the runs of an arm were trained.
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

    /// Returns the cell for the time at which the runs of an arm `reached` something. A run that
    /// never did counts with its `whole` length, a lower bound.
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

    fn cost(&self) -> TitledTable {
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
        TitledTable {
            title: "Cost of a run, with other runs beside it".to_owned(),
            table: grid(header.map(str::to_owned).to_vec(), rows, 1),
        }
    }

    /// Returns the first cells of an arm's row: its label and the number of its complete runs.
    fn head(&self, number: usize, arm: &Arm) -> [String; 2] {
        let (complete, planned) = (self.of_arm(number).count() as u64, self.plan.seeds);
        let seeds = match complete == planned {
            true => planned.to_string(),
            false => format!("{complete} of {planned}"),
        };
        [arm.label.clone(), seeds]
    }

    /// Returns each arm but the first, with the first cells of the row of its difference to it:
    /// what is compared, and the number of seeds that both have completed.
    fn differences(&self) -> Vec<(usize, [String; 2])> {
        let Some(first) = self.experiment.arms.first() else {
            return Vec::new();
        };
        let arms = self.experiment.arms.iter().enumerate().skip(1);
        arms.map(|(number, arm)| {
            let label = format!("{}, difference to {}", arm.label, first.label);
            let (pairs, planned) = (self.paired_runs(number).count() as u64, self.plan.seeds);
            let seeds = match pairs == planned {
                true => planned.to_string(),
                false => format!("{pairs} of {planned}"),
            };
            (number, [label, seeds])
        })
        .collect()
    }

    /// Returns the complete runs of an arm, each with the first arm's run of the same seed.
    fn paired_runs(&self, arm: usize) -> impl Iterator<Item = (&RunResult, &RunResult)> {
        self.of_arm(arm).filter_map(|run| {
            let reference = self.of_arm(0).find(|other| other.seed == run.seed)?;
            Some((run, reference))
        })
    }

    /// Returns the values of `of_run` for the paired runs of an arm, and those of the first arm;
    /// `None` if a run has no value.
    fn pairs(
        &self,
        arm: usize,
        of_run: impl Fn(&RunResult) -> Option<f64>,
    ) -> Option<(Vec<f64>, Vec<f64>)> {
        self.paired_runs(arm)
            .map(|(run, reference)| Some((of_run(run)?, of_run(reference)?)))
            .collect()
    }

    /// Returns the estimate of `of_run` for an arm minus that for the first arm, seed by seed;
    /// `None` if a run has no value.
    fn difference(
        &self,
        arm: usize,
        of_run: impl Fn(&RunResult) -> Option<f64>,
    ) -> Option<Estimate> {
        let (values, reference) = self.pairs(arm, of_run)?;
        Bootstrap::new(values.len(), RESAMPLES).difference(&values, &reference)
    }

    /// Returns the estimate of `of_run` over the complete runs of an arm; `None` if a run has no
    /// value.
    pub(super) fn estimate(
        &self,
        arm: usize,
        of_run: impl Fn(&RunResult) -> Option<f64>,
    ) -> Option<Estimate> {
        self.bootstrap(arm, RESAMPLES)
            .interquartile_mean(&self.values(arm, of_run)?)
    }

    /// Returns the value of `of_run` for each complete run of an arm; `None` if a run has no value.
    fn values(&self, arm: usize, of_run: impl Fn(&RunResult) -> Option<f64>) -> Option<Vec<f64>> {
        self.of_arm(arm).map(of_run).collect()
    }

    /// Returns the names of the evaluation courses.
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

/// Returns a difference of rates.
fn rate_difference(estimate: Estimate) -> String {
    with_interval(estimate, |value| {
        signed(value, &|size| format!("{size:.3}"))
    })
}

/// Returns a difference of shares, in percentage points.
fn points(estimate: Estimate) -> String {
    let numbers = with_interval(estimate, |value| {
        signed(value, &|size| format!("{:.1}", 100.0 * size))
    });
    format!("{numbers} points")
}

/// Returns a difference with its sign; `show` shows its size.
fn signed(value: f64, show: &dyn Fn(f64) -> String) -> String {
    let size = show(value.abs());
    // What is shown as zero has no direction.
    let sign = if value < 0.0 && size != show(0.0) {
        '-'
    } else {
        '+'
    };
    format!("{sign}{size}")
}

fn share(value: f64) -> String {
    format!("{:.1} %", 100.0 * value)
}

/// Returns `value [low, high]`.
fn with_interval(estimate: Estimate, show: impl Fn(f64) -> String) -> String {
    let value = show(estimate.value);
    match estimate.interval {
        None => value,
        Some((low, high)) => format!("{value} [{}, {}]", show(low), show(high)),
    }
}

/// Returns a Markdown table with its first `left` columns aligned left and all others right.
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
    // Markdown renderers read the alignment only from the line below the header.
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
    fn numeric_columns_are_aligned_right_in_text_and_when_rendered() {
        let row = |cells: [&str; 3]| cells.map(str::to_owned).to_vec();
        let text = grid(
            row(["arm", "seeds", "R"]),
            vec![row(["one", "3", "0.5 [0.4, 0.6]"])],
            1,
        );
        assert_eq!(
            text,
            "| arm | seeds |              R |\n|-----|------:|---------------:|\n| one |     3 | \
             0.5 [0.4, 0.6] |"
        );
    }

    #[test]
    fn a_difference_has_a_sign_unless_it_is_shown_as_zero() {
        let show = |value: f64| signed(value, &|size| format!("{size:.1}"));
        assert_eq!(
            [0.26, -0.26, -1e-9, 0.0].map(show),
            ["+0.3", "-0.3", "+0.0", "+0.0"]
        );
        let late = signed(-75.0, &|secs| Clock(secs).to_string());
        assert_eq!(late, "-1:15");
    }

    #[test]
    fn an_interval_is_shown_if_it_exists() {
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
