//! Table of figures with their targets and baselines.

use comfy_table::presets::{ASCII_MARKDOWN, UTF8_FULL_CONDENSED};
use comfy_table::{Cell, CellAlignment, Table as Grid};
use serde::Serialize;
use skein_run::tables::fit;

use super::catalogue::{BenchmarkRow, Show, per_second};
use super::figures::{BenchmarkFigures, Figure};

/// Rows with verdicts.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Table {
    lines: Vec<JudgedRow>,
}

/// BenchmarkRow with its numbers.
#[derive(Debug, Clone, PartialEq, Serialize)]
struct JudgedRow {
    stage: String,
    unit: String,
    /// Value in `unit`.
    figure: Option<f64>,
    /// Value by the median of its samples, if it was timed.
    median: Option<f64>,
    /// Share of the core's f32 peak.
    peak_share: Option<f64>,
    target: String,
    baseline: Option<Compared>,
    /// Improvement over the baseline, as a factor.
    ratio: Option<f64>,
    verdict: RowVerdict,
}

/// Baseline of a figure, with its value in the row's unit.
#[derive(Debug, Clone, PartialEq, Serialize)]
struct Compared {
    what: String,
    figure: f64,
}

/// Verdict on a row.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
enum RowVerdict {
    Met,
    Missed,
    NothingAsked,
    NotMeasured,
}

/// Meaning of the measured times.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Judging {
    /// Times are meaningful.
    Times,
    /// A trial run: nothing is judged.
    Nothing,
}

impl Table {
    /// Builds the table of `rows` with their `figures`, for a core with `f32_flops`.
    pub fn new(rows: &[BenchmarkRow], figures: &BenchmarkFigures, f32_flops: f64) -> Self {
        Self {
            lines: rows
                .iter()
                .map(|row| JudgedRow::new(row, figures, f32_flops))
                .collect(),
        }
    }

    /// Returns the table for a terminal of this width, at most 130 columns.
    pub fn to_terminal(&self, judging: Judging, columns: usize) -> String {
        let mut grid = self.grid(judging);
        grid.load_preset(UTF8_FULL_CONDENSED);
        fit(grid, columns.min(130))
    }

    /// Returns the table for a document.
    pub fn to_markdown(&self, judging: Judging) -> String {
        let mut grid = self.grid(judging);
        grid.load_preset(ASCII_MARKDOWN);
        grid.to_string()
    }

    fn grid(&self, judging: Judging) -> Grid {
        let mut grid = Grid::new();
        grid.set_header([
            "stage", "figure", "median", "target", "baseline", "ratio", "met",
        ]);
        for line in &self.lines {
            let right = |text: String| Cell::new(text).set_alignment(CellAlignment::Right);
            grid.add_row([
                Cell::new(&line.stage),
                right(line.figure_text()),
                right(line.median.map(number).unwrap_or_default()),
                right(line.target.clone()),
                Cell::new(line.baseline_text()),
                right(
                    line.ratio
                        .map(|ratio| format!("{} ×", number(ratio)))
                        .unwrap_or_default(),
                ),
                Cell::new(match (judging, line.verdict) {
                    (Judging::Times, RowVerdict::Met) => "yes",
                    (Judging::Times, RowVerdict::Missed) => "NO",
                    (Judging::Nothing, _)
                    | (_, RowVerdict::NothingAsked | RowVerdict::NotMeasured) => "",
                }),
            ]);
        }
        grid
    }
}

impl JudgedRow {
    fn new(row: &BenchmarkRow, figures: &BenchmarkFigures, f32_flops: f64) -> Self {
        let measured = figures.get(&row.figure);
        let shown = |figure: &Figure| figure.shown(row.show, &row.unit, row.scale).ok();
        let figure = measured.and_then(shown);
        let peak_share = match (row.show, measured) {
            (Show::PeakShare, Some(Figure::Timed { secs, elements, .. })) => {
                Some(elements / secs / f32_flops)
            }
            _ => None,
        };
        let baseline = measured.and_then(|measured| compared(row, measured, figures));
        let ratio =
            figure
                .zip(baseline.as_ref())
                .map(|(figure, baseline)| match less_is_better(row) {
                    true => baseline.figure / figure,
                    false => figure / baseline.figure,
                });
        Self {
            stage: row.stage.clone(),
            unit: row.unit.clone(),
            figure,
            median: measured
                .and_then(Figure::at_median)
                .as_ref()
                .and_then(shown),
            peak_share,
            target: target(row),
            verdict: judge(row, figure, peak_share, ratio),
            baseline,
            ratio,
        }
    }

    fn figure_text(&self) -> String {
        match (self.figure, self.peak_share) {
            (None, _) => "not measured".to_owned(),
            (Some(figure), None) => format!("{} {}", number(figure), self.unit),
            (Some(figure), Some(share)) => {
                format!("{} {}, {}", number(figure), self.unit, of_peak(share))
            }
        }
    }

    fn baseline_text(&self) -> String {
        let text = |baseline: &Compared| format!("{}: {}", baseline.what, number(baseline.figure));
        self.baseline.as_ref().map(text).unwrap_or_default()
    }
}

/// Returns `true` for times and for figures with an upper limit.
fn less_is_better(row: &BenchmarkRow) -> bool {
    match row.show {
        Show::Rate => false,
        Show::Time | Show::PeakShare => true,
        Show::Value => row.at_most.is_some(),
    }
}

/// Returns the baseline of `measured`, if it was measured too.
fn compared(row: &BenchmarkRow, measured: &Figure, figures: &BenchmarkFigures) -> Option<Compared> {
    let Some(baseline) = &row.baseline else {
        return match measured {
            Figure::Printed(printed) => Some(Compared {
                what: printed.baseline.clone()?,
                figure: printed.baseline_figure? * row.scale,
            }),
            Figure::Timed { .. } => None,
        };
    };
    let (show, unit) = row.part_shown();
    let parts = baseline
        .of
        .iter()
        .map(|of| figures.get(of)?.shown(show, unit, 1.0).ok());
    let sum: f64 = parts.sum::<Option<f64>>()?;
    let figure = match row.show {
        Show::Rate => 1.0 / sum,
        Show::Time | Show::PeakShare => sum * per_second(&row.unit)?,
        Show::Value => sum,
    };
    Some(Compared {
        what: baseline.what.clone(),
        figure: figure * row.scale,
    })
}

fn target(row: &BenchmarkRow) -> String {
    let figure = match (row.show, row.at_least, row.at_most) {
        (Show::PeakShare, Some(share), _) => Some(format!("≥ {}", of_peak(share))),
        (_, Some(least), _) => Some(format!("≥ {}", number(least))),
        (_, _, Some(most)) => Some(format!("≤ {}", number(most))),
        (_, None, None) => None,
    };
    let ratio = row
        .ratio_at_least
        .map(|ratio| format!("≥ {} ×", number(ratio)));
    [figure, ratio]
        .into_iter()
        .flatten()
        .collect::<Vec<_>>()
        .join(", ")
}

fn judge(
    row: &BenchmarkRow,
    figure: Option<f64>,
    peak_share: Option<f64>,
    ratio: Option<f64>,
) -> RowVerdict {
    let Some(figure) = figure else {
        return RowVerdict::NotMeasured;
    };
    let reached = [
        row.at_least
            .map(|least| peak_share.unwrap_or(figure) >= least),
        row.at_most.map(|most| figure <= most),
        row.ratio_at_least
            .map(|least| ratio.is_some_and(|ratio| ratio >= least)),
    ];
    let mut reached = reached.into_iter().flatten().peekable();
    if reached.peek().is_none() {
        RowVerdict::NothingAsked
    } else if reached.all(|reached| reached) {
        RowVerdict::Met
    } else {
        RowVerdict::Missed
    }
}

fn of_peak(share: f64) -> String {
    format!("{:.0} % of peak", 100.0 * share)
}

/// Returns the number with three significant digits and separated thousands.
pub(super) fn number(value: f64) -> String {
    if value == 0.0 || !value.is_finite() {
        return value.to_string();
    }
    let magnitude = value.abs().log10().floor() as i32;
    let unit = 10_f64.powi(magnitude - 2);
    let rounded = (value / unit).round() * unit;
    let decimals = (2 - rounded.abs().log10().floor() as i32).max(0) as usize;
    let text = format!("{rounded:.decimals$}");
    let (whole, fraction) = text.split_once('.').unwrap_or((&text, ""));
    let fraction = fraction.trim_end_matches('0');
    let mut grouped = String::new();
    for (index, digit) in whole.chars().enumerate() {
        let left = whole.len() - index;
        if index > 0 && left % 3 == 0 && whole.len() > 4 {
            grouped.push(',');
        }
        grouped.push(digit);
    }
    if fraction.is_empty() {
        grouped
    } else {
        format!("{grouped}.{fraction}")
    }
}

#[cfg(test)]
mod tests {
    use super::super::catalogue::Baseline;
    use super::super::figures::tests::timed;
    use super::*;

    fn row(show: Show, unit: &str) -> BenchmarkRow {
        BenchmarkRow {
            stage: "a stage".to_owned(),
            figure: "a/figure".to_owned(),
            show,
            unit: unit.to_owned(),
            scale: 1.0,
            at_least: None,
            at_most: None,
            baseline: None,
            ratio_at_least: None,
        }
    }

    fn line(row: &BenchmarkRow, figures: &BenchmarkFigures) -> JudgedRow {
        JudgedRow::new(row, figures, 1e9)
    }

    #[test]
    fn numbers_have_three_digits_and_rounding_may_carry() {
        let shown = [
            (151_325.0, "151,000"),
            (5746.0, "5750"),
            (0.36149, "0.361"),
            (9.996, "10"),
            (99.96, "100"),
            (50.0, "50"),
            (1.1, "1.1"),
            (0.0, "0"),
        ];
        for (value, text) in shown {
            assert_eq!(number(value), text);
        }
    }

    #[test]
    fn the_parts_of_a_baseline_add_up_by_their_times() {
        let figures = timed(&[
            ("a/figure", 100.0, 10.0),
            ("a/one", 300.0, 10.0),
            ("a/two", 100.0, 5.0),
        ]);
        let compared = BenchmarkRow {
            baseline: Some(Baseline {
                what: "both".to_owned(),
                of: vec!["a/one".to_owned(), "a/two".to_owned()],
            }),
            at_least: Some(5e7),
            ratio_at_least: Some(5.1),
            ..row(Show::Rate, "frames/s")
        };
        let found = line(&compared, &figures);
        // 10 ns per element, and 30 + 20 ns.
        assert!(
            (found.figure.unwrap() / 1e8 - 1.0).abs() < 1e-9,
            "{found:?}"
        );
        assert!(
            (found.baseline.as_ref().unwrap().figure / 2e7 - 1.0).abs() < 1e-9,
            "{found:?}"
        );
        assert!((found.ratio.unwrap() - 5.0).abs() < 1e-9, "{found:?}");
        assert_eq!(found.verdict, RowVerdict::Missed, "the ratio falls short");
        let met = BenchmarkRow {
            ratio_at_least: Some(4.9),
            ..compared
        };
        assert_eq!(line(&met, &figures).verdict, RowVerdict::Met);
    }

    #[test]
    fn a_share_of_the_peak_is_judged_by_the_share() {
        // 600 operations in 1000 ns, of the 1000 that the core could do.
        let figures = timed(&[("a/figure", 1000.0, 600.0)]);
        let asked = |share| BenchmarkRow {
            at_least: Some(share),
            ..row(Show::PeakShare, "µs")
        };
        let found = line(&asked(0.8), &figures);
        assert_eq!(found.figure_text(), "1 µs, 60 % of peak");
        assert_eq!(found.target, "≥ 80 % of peak");
        assert_eq!(found.verdict, RowVerdict::Missed);
        assert_eq!(line(&asked(0.5), &figures).verdict, RowVerdict::Met);
    }

    #[test]
    fn a_target_without_measurement_is_not_met() {
        let asked = BenchmarkRow {
            at_most: Some(1.0),
            ..row(Show::Value, "MB")
        };
        let found = line(&asked, &BenchmarkFigures::default());
        assert_eq!(
            (found.verdict, found.figure_text().as_str()),
            (RowVerdict::NotMeasured, "not measured")
        );
    }
}
