//! Pictures of a report.

use std::collections::BTreeSet;
use std::path::Path;

use super::tables::course_of;
use super::{ExperimentReportError, Findings, Picture};
use crate::definition::{Axis, CurveSpec, Measure};
use crate::results::RunResult;
use crate::statistics::{Bootstrap, Estimate};
use skein_reports::comparison::{BandPoint, ComparedLine, Comparison};
use skein_reports::ideal_walls_passed;

/// Number of points of a curve; a picture has hardly more pixel columns.
const PLACES: usize = 400;
/// Number of resamples at each point: the edge of a band needs no higher precision.
const RESAMPLES: usize = 2000;

impl Findings<'_> {
    /// Draws every picture of the experiment into `folder`, and returns the reasons why others
    /// could not be drawn. A picture without lines, because the runs are shorter than the averaging
    /// window, is left out.
    pub(super) fn draw(&self, folder: &Path) -> (Vec<Picture>, Vec<ExperimentReportError>) {
        let (mut pictures, mut failures) = (Vec::new(), Vec::new());
        for &curve in &self.experiment.curves {
            match self.picture(curve, folder) {
                Ok(picture) => pictures.extend(picture),
                Err(error) => failures.push(error),
            }
        }
        for (number, line) in self.factor_lines().into_iter().enumerate() {
            match self.over_factor(number + 1, line, folder) {
                Ok(picture) => pictures.extend(picture),
                Err(error) => failures.push(error),
            }
        }
        (pictures, failures)
    }

    /// Returns the lines of the experiment's factor, each once, in the order of the arms.
    fn factor_lines(&self) -> Vec<&str> {
        let arms = self.experiment.arms.iter();
        let mut lines: Vec<_> = arms
            .filter_map(|arm| Some(&*arm.at.as_ref()?.line))
            .collect();
        let mut seen = BTreeSet::new();
        lines.retain(|line| seen.insert(*line));
        lines
    }

    /// Draws R on each course over the factor, for the arms of one line.
    fn over_factor(
        &self,
        number: usize,
        line: &str,
        folder: &Path,
    ) -> Result<Option<Picture>, ExperimentReportError> {
        let Some(factor) = &self.experiment.factor else {
            return Ok(None);
        };
        let courses = self.courses();
        let comparison = Comparison {
            title: format!("R of the best snapshot by course: {line}"),
            x: factor,
            y: "R, share of walls passed",
            level: None,
            lines: courses
                .iter()
                .map(|course| ComparedLine {
                    label: course,
                    points: self.course_over_factor(line, course),
                })
                .collect(),
        };
        let file = format!("r_over_factor_{number}.png");
        let is_drawn = comparison.draw(&folder.join(&file))?;
        let caption = format!("R by course over the {factor}: {line}");
        Ok(is_drawn.then_some(Picture { file, caption }))
    }

    pub(super) fn course_over_factor(&self, line: &str, course: &str) -> Vec<BandPoint> {
        let of_course = |result: &RunResult| course_of(result, course).map(|course| course.r);
        let arms = self.experiment.arms.iter().enumerate();
        let mut points: Vec<_> = arms
            .filter_map(|(number, arm)| {
                let at = arm.at.as_ref().filter(|at| at.line == line)?;
                let Estimate { value, interval } = self.estimate(number, of_course)?;
                let x = at.value;
                Some(BandPoint { x, value, interval })
            })
            .collect();
        points.sort_by(|one, other| one.x.total_cmp(&other.x));
        points
    }

    fn picture(
        &self,
        curve: CurveSpec,
        folder: &Path,
    ) -> Result<Option<Picture>, ExperimentReportError> {
        let file = format!(
            "{}_over_{}.png",
            measure_name(curve.measure),
            axis_name(curve.over)
        );
        let comparison = self.comparison(curve)?;
        if !comparison.draw(&folder.join(&file))? {
            return Ok(None);
        }
        let what = measure_title(curve.measure);
        let caption = format!("{what} per training episode over {}", comparison.x);
        Ok(Some(Picture { file, caption }))
    }

    fn comparison(&self, curve: CurveSpec) -> Result<Comparison<'_>, ExperimentReportError> {
        let arms = &self.experiment.arms;
        let window = arms[0].config.evaluation.window_episodes;
        let what = measure_title(curve.measure);
        let shortened = match self.experiment.shortened() {
            Some(_) => " (shortened runs)",
            None => "",
        };
        Ok(Comparison {
            title: format!(
                "{what} per training episode, average over {window} episodes{shortened}"
            ),
            x: match curve.over {
                Axis::Episodes => "training episodes",
                Axis::Steps => "environment steps",
                Axis::Updates => "updates of the agent",
            },
            y: match curve.measure {
                Measure::WallsPassed => "walls passed",
                Measure::Return => "return",
                Measure::Drawdown => "walls below the previous maximum average",
            },
            level: match curve.measure {
                Measure::WallsPassed => self.ideal()?,
                Measure::Return | Measure::Drawdown => None,
            },
            lines: arms
                .iter()
                .enumerate()
                .map(|(number, arm)| ComparedLine {
                    label: &arm.label,
                    points: self.line(number, curve),
                })
                .collect(),
        })
    }

    /// Returns the average of a perfect agent and its label, if it is the same for all arms.
    fn ideal(&self) -> Result<Option<(f64, String)>, ExperimentReportError> {
        let mut ideals = Vec::new();
        for arm in &self.experiment.arms {
            ideals.push(ideal_walls_passed(&arm.config)?);
        }
        let first = ideals[0];
        Ok(ideals
            .iter()
            .all(|ideal| *ideal == first)
            .then(|| (first, format!("all walls passed: {first}"))))
    }

    fn line(&self, arm: usize, curve: CurveSpec) -> Vec<BandPoint> {
        let curves: Vec<_> = self
            .of_arm(arm)
            .map(|result: &RunResult| result.curve(curve.measure, curve.over))
            .collect();
        let points = combined(&curves, &self.bootstrap(arm, RESAMPLES));
        let point = |(x, Estimate { value, interval })| BandPoint { x, value, interval };
        points.into_iter().map(point).collect()
    }
}

/// Combines `curves`, one per seed, into one, over the range that all of them cover.
fn combined(curves: &[Vec<(f64, f64)>], bootstrap: &Bootstrap) -> Vec<(f64, Estimate)> {
    let begin = curves
        .iter()
        .map(|curve| curve.first().map_or(f64::INFINITY, |point| point.0));
    let end = curves
        .iter()
        .map(|curve| curve.last().map_or(f64::NEG_INFINITY, |point| point.0));
    let (begin, end) = (begin.fold(0.0, f64::max), end.fold(f64::INFINITY, f64::min));
    if curves.is_empty() || begin > end || begin.is_infinite() {
        return Vec::new();
    }
    (0..PLACES)
        .map(|place| begin + (end - begin) * place as f64 / (PLACES - 1) as f64)
        .filter_map(|x| {
            let values: Vec<f64> = curves.iter().map(|curve| value_at(curve, x)).collect();
            Some((x, bootstrap.interquartile_mean(&values)?))
        })
        .collect()
}

/// Returns the newest value of a curve at or before `x`, where the curve begins at or before `x`.
fn value_at(curve: &[(f64, f64)], x: f64) -> f64 {
    let after = curve.partition_point(|point| point.0 <= x);
    curve[after.saturating_sub(1)].1
}

fn measure_title(measure: Measure) -> &'static str {
    match measure {
        Measure::WallsPassed => "Walls passed",
        Measure::Return => "Return",
        Measure::Drawdown => "Drawdown of the walls passed",
    }
}

pub(super) fn measure_name(measure: Measure) -> &'static str {
    match measure {
        Measure::WallsPassed => "walls_passed",
        Measure::Return => "return",
        Measure::Drawdown => "drawdown",
    }
}

pub(super) fn axis_name(axis: Axis) -> &'static str {
    match axis {
        Axis::Episodes => "episodes",
        Axis::Steps => "steps",
        Axis::Updates => "updates",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_combined_curve_covers_the_range_of_all_seeds() {
        let curves = [
            vec![(0.0, 1.0), (10.0, 2.0), (20.0, 3.0)],
            vec![(5.0, 1.0), (15.0, 4.0)],
        ];
        let line = combined(&curves, &Bootstrap::new(2, 100));
        assert_eq!((line[0].0, line[line.len() - 1].0), (5.0, 15.0));
        // At 5 the values are 1 and 1, at 15 they are 2 and 4.
        assert_eq!((line[0].1.value, line[line.len() - 1].1.value), (1.0, 3.0));
        assert!(combined(&[vec![], vec![(1.0, 1.0)]], &Bootstrap::new(2, 100)).is_empty());
        assert!(combined(&[], &Bootstrap::new(0, 100)).is_empty());
    }
}
