//! Return and walls passed over the training episodes, as in the paper's figures 9 and 10.

use std::path::Path;

use plotters::prelude::*;
use serde::Deserialize;

use super::ReportError;
use super::canvas::{Area, Canvas, FAINT, GRID, INK, REFERENCE, STRONG, font, px};
use super::complete_rows::{TornRow, complete_rows};
use super::head::{LegendEntry, Mark, draw_head};

const WIDTH: u32 = 1280;
const HEIGHT: u32 = 640;

/// Row of `episodes.csv`, with the columns that are plotted.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct PlottedEpisode {
    /// Environment steps of the episode.
    pub steps: u32,
    /// Walls passed in the episode.
    pub walls_passed: u32,
    /// Undiscounted sum of the episode's rewards.
    #[serde(rename = "return")]
    pub episode_return: f64,
}

/// Largest possible return: an episode has at most 65536 records, with rewards up to
/// `skein_protocol::transition::MAX_MAGNITUDE`. Dividing an axis much longer than any return would
/// take forever.
const LARGEST_RETURN: f64 = 1e12;

/// Reads the complete rows of `episodes.csv`; says so if the last one is cut off.
///
/// # Errors
/// [`ReportError::Malformed`] names the line.
pub fn read_episodes(path: &Path) -> Result<(Vec<PlottedEpisode>, Option<TornRow>), ReportError> {
    let malformed = |problem: String| ReportError::Malformed {
        path: path.to_owned(),
        problem,
    };
    let (text, torn) = complete_rows(path)?;
    let mut reader = csv::Reader::from_reader(&text[..]);
    // Otherwise an unreadable header would pass for a file without rows.
    reader
        .headers()
        .map_err(|error| malformed(error.to_string()))?;
    let mut rows = reader.into_deserialize();
    let mut episodes = Vec::new();
    while let Some(row) = rows.next() {
        let row: PlottedEpisode = row.map_err(|error| malformed(error.to_string()))?;
        if !(-LARGEST_RETURN..=LARGEST_RETURN).contains(&row.episode_return) {
            let (line, value) = (rows.reader().position().line() - 1, row.episode_return);
            return Err(malformed(format!(
                "line {line}: {value} is not a possible return"
            )));
        }
        episodes.push(row);
    }
    Ok((episodes, torn))
}

/// Draws the return of every episode and its moving average over `window` episodes (paper, figure
/// 9).
///
/// # Errors
/// Returns [`ReportError`] if the picture cannot be drawn or written.
pub(super) fn draw_return(
    episodes: &[PlottedEpisode],
    window: usize,
    path: &Path,
) -> Result<(), ReportError> {
    let values: Vec<f64> = episodes
        .iter()
        .map(|episode| episode.episode_return)
        .collect();
    EpisodeCurve {
        title: "Return of the training episodes".to_owned(),
        y_label: "return",
        range: padded_range(&values),
        values,
        window,
        raw: RawValues::Shown,
        level: None,
    }
    .save(path)
}

/// Draws the walls passed, averaged over `window` episodes (paper, figure 10). `ideal` is the
/// average of an agent that passes every wall: episodes start at each of the levels in turn. The
/// picture lacks this level if it is not known.
///
/// # Errors
/// Returns [`ReportError`] if the picture cannot be drawn or written.
pub(super) fn draw_walls_passed(
    episodes: &[PlottedEpisode],
    window: usize,
    ideal: Option<f64>,
    path: &Path,
) -> Result<(), ReportError> {
    let values: Vec<f64> = episodes
        .iter()
        .map(|episode| f64::from(episode.walls_passed))
        .collect();
    EpisodeCurve {
        title: format!("Walls passed, average over {window} episodes"),
        y_label: "walls passed",
        range: (
            0.0,
            ideal.map_or_else(|| padded_range(&values).1, |ideal| ideal * 1.15),
        ),
        values,
        window,
        raw: RawValues::Hidden,
        level: ideal.map(|ideal| (ideal, format!("all walls passed: {ideal}"))),
    }
    .save(path)
}

/// Returns the mean over the last `window` values at each position, or over fewer at the beginning.
///
/// Each sum is computed again, oldest value first. A running sum would drift: after a huge value
/// has left the window, its rounding error would stay.
pub fn trailing_mean(values: &[f64], window: usize) -> Vec<f64> {
    let window = window.max(1);
    (1..=values.len())
        .map(|end| {
            let latest = &values[end.saturating_sub(window)..end];
            latest.iter().sum::<f64>() / latest.len() as f64
        })
        .collect()
}

/// Visibility of the single values behind their average.
#[derive(Clone, Copy, PartialEq, Eq)]
enum RawValues {
    Shown,
    Hidden,
}

struct EpisodeCurve {
    title: String,
    y_label: &'static str,
    range: (f64, f64),
    values: Vec<f64>,
    window: usize,
    raw: RawValues,
    level: Option<(f64, String)>,
}

impl EpisodeCurve {
    fn save(&self, path: &Path) -> Result<(), ReportError> {
        let mut canvas = Canvas::new(WIDTH, HEIGHT);
        canvas.draw(|area| self.draw(area))?;
        canvas.save(path)
    }

    fn draw(&self, area: &Area<'_>) -> Result<(), Box<dyn std::error::Error>> {
        let episodes = self.values.len().max(2);
        let (low, high) = self.range;
        let average = format!("average over {} episodes", self.window);
        let mut entries = vec![LegendEntry::line(&average, STRONG)];
        if self.raw == RawValues::Shown {
            entries.push(LegendEntry {
                label: "one episode",
                colour: STRONG,
                mark: Mark::Dot,
            });
        }
        if let Some((_, label)) = &self.level {
            entries.push(LegendEntry::line(label, REFERENCE));
        }
        let below = draw_head(area, &self.title, 22, &entries)?;
        let mut chart = ChartBuilder::on(&below)
            .margin(px(16))
            .margin_right(px(28))
            .x_label_area_size(px(48))
            .y_label_area_size(px(64))
            .build_cartesian_2d(1.0..episodes as f64, low..high)?;
        chart
            .configure_mesh()
            .label_style(font(16))
            .axis_desc_style(font(18))
            .axis_style(INK.mix(0.4).stroke_width(px(1)))
            .bold_line_style(GRID.stroke_width(px(1)))
            .light_line_style(TRANSPARENT)
            .x_labels(9)
            .y_labels(7)
            .x_label_formatter(&|x| format!("{x:.0}"))
            .y_label_formatter(&|y| format!("{}", (y * 100.0).round() / 100.0))
            .x_desc("training episode")
            .y_desc(self.y_label)
            .draw()?;

        let at = |(i, &value): (usize, &f64)| ((i + 1) as f64, value);
        if self.raw == RawValues::Shown {
            chart.draw_series(
                self.values
                    .iter()
                    .enumerate()
                    .map(|point| Circle::new(at(point), px(2), STRONG.mix(0.28).filled())),
            )?;
        }
        if let Some((level, _)) = &self.level {
            let ends = [(1.0, *level), (episodes as f64, *level)];
            chart.draw_series(DashedLineSeries::new(
                ends,
                px(8),
                px(6),
                REFERENCE.stroke_width(px(2)),
            ))?;
        }
        // The average is faint until its window is full: those values are not comparable with the
        // rest.
        let mean = trailing_mean(&self.values, self.window);
        let filling = self.window.min(mean.len());
        let points: Vec<_> = mean.iter().enumerate().map(at).collect();
        chart.draw_series(thick_line(&points[..filling], FAINT, px(2)))?;
        let full = &points[filling.saturating_sub(1)..];
        chart.draw_series(thick_line(full, STRONG, px(2)))?;
        Ok(())
    }
}

/// Draws a line of `width` drawn pixels, one piece at a time: the library's own thick lines have
/// holes at sharp turns.
pub(super) fn thick_line(
    points: &[(f64, f64)],
    colour: RGBColor,
    width: u32,
) -> impl Iterator<Item = PathElement<(f64, f64)>> {
    points
        .windows(2)
        .map(move |ends| PathElement::new(ends.to_vec(), colour.stroke_width(width)))
}

/// Returns the range of the values with a margin, never empty.
pub(super) fn padded_range(values: &[f64]) -> (f64, f64) {
    let (low, high) = values
        .iter()
        .filter(|value| value.is_finite())
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), &value| {
            (low.min(value), high.max(value))
        });
    if low > high {
        return (-1.0, 1.0);
    }
    let margin = ((high - low) * 0.06).max(0.1);
    (low - margin, high + margin)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn trailing_mean_equals_the_mean_by_hand() {
        assert_eq!(
            trailing_mean(&[1.0, 3.0, 5.0, 1.0], 2),
            [1.0, 2.0, 4.0, 3.0]
        );
        assert_eq!(trailing_mean(&[2.0, 4.0], 50), [2.0, 3.0]);
        assert!(trailing_mean(&[], 50).is_empty());
        assert_eq!(trailing_mean(&[2.0, 4.0], 0), [2.0, 4.0]);
    }

    #[test]
    fn a_huge_value_leaves_no_trace_after_it_has_left_the_window() {
        let values = [1e30, 0.125, 0.25, 0.5];
        assert_eq!(trailing_mean(&values, 2)[2..], [0.1875, 0.375]);
    }

    #[test]
    fn a_range_is_never_empty() {
        for values in [vec![], vec![1.0], vec![f64::NAN], vec![-1.0, 8.0]] {
            let (low, high) = padded_range(&values);
            assert!(low < high, "{values:?}");
        }
    }

    #[test]
    fn a_damaged_row_is_named_by_its_line() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("episodes.csv");
        std::fs::write(
            &path,
            "episode,steps,walls_passed,return\n0,9,2,1.5\n1,9,two,1.5\n",
        )
        .unwrap();
        let error = read_episodes(&path).unwrap_err().to_string();
        assert!(
            error.contains("episodes.csv") && error.contains("line: 3"),
            "{error}"
        );
    }

    #[test]
    fn an_impossible_return_is_named_by_its_line() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("episodes.csv");
        for value in ["1e308", "-1e13", "inf", "nan"] {
            std::fs::write(
                &path,
                format!("episode,steps,walls_passed,return\n0,9,2,1.5\n1,9,2,{value}\n"),
            )
            .unwrap();
            let error = read_episodes(&path).unwrap_err().to_string();
            assert!(error.contains("line 3:"), "{error}");
        }
    }
}
