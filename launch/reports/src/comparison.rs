//! Comparison of arms: one line each, with a band for the uncertainty over seeds.

use std::path::Path;

use plotters::prelude::*;

use super::ReportError;
use super::canvas::{Area, Canvas, GRID, INK, REFERENCE, STRONG, font, px};
use super::curves::{padded_range, thick_line};
use super::growth::brief;
use super::head::{LegendEntry, draw_head};

/// Largest number of lines that can be distinguished in one picture.
pub const MOST_LINES: usize = 8;

const WIDTH: u32 = 1280;
const HEIGHT: u32 = 640;

/// Colour of the reference level, which is not an arm.
const LEVEL: RGBColor = RGBColor(0x99, 0x9c, 0xa0);
/// Colours of the lines, distinguishable as far as possible for colour-blind readers (after Okabe
/// and Ito).
const COLOURS: [RGBColor; MOST_LINES] = [
    STRONG,
    REFERENCE,
    RGBColor(0x2f, 0x8f, 0x6b),
    RGBColor(0x8a, 0x5a, 0xa8),
    RGBColor(0xd3, 0x9a, 0x1e),
    RGBColor(0x55, 0xa5, 0xd9),
    RGBColor(0xb8, 0x3b, 0x6b),
    RGBColor(0x5d, 0x63, 0x6b),
];

/// Picture that compares arms.
#[derive(Debug)]
pub struct Comparison<'a> {
    /// Title above the picture.
    pub title: String,
    /// Label of the x axis.
    pub x: &'a str,
    /// Label of the y axis.
    pub y: &'static str,
    /// Reference level and its label.
    pub level: Option<(f64, String)>,
    /// Lines, [`MOST_LINES`] at most.
    pub lines: Vec<ComparedLine<'a>>,
}

/// Line of a comparison.
#[derive(Debug)]
pub struct ComparedLine<'a> {
    /// Label in the legend.
    pub label: &'a str,
    /// Points in the order of their x.
    pub points: Vec<BandPoint>,
}

/// A point of a line, with the band around it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BandPoint {
    /// Position on the x axis.
    pub x: f64,
    /// Position of the line on the y axis.
    pub value: f64,
    /// Lower and upper end of the band; `None` without a band.
    pub interval: Option<(f64, f64)>,
}

impl Comparison<'_> {
    /// Draws the picture to `path`. Returns `false` if there was nothing to draw.
    ///
    /// # Errors
    /// Returns [`ReportError`] if the picture cannot be drawn or written.
    pub fn draw(&self, path: &Path) -> Result<bool, ReportError> {
        if self.lines.iter().all(|line| line.points.len() < 2) {
            return Ok(false);
        }
        let mut canvas = Canvas::new(WIDTH, HEIGHT);
        canvas.draw(|area| self.draw_lines(area))?;
        canvas.save(path)?;
        Ok(true)
    }

    fn draw_lines(&self, area: &Area<'_>) -> Result<(), Box<dyn std::error::Error>> {
        let (xs, ys) = self.ranges();
        let arms = self.lines.iter().zip(COLOURS);
        let mut entries: Vec<_> = arms
            .map(|(line, colour)| LegendEntry::line(line.label, colour))
            .collect();
        if let Some((_, label)) = &self.level {
            entries.push(LegendEntry::line(label, LEVEL));
        }
        let below = draw_head(area, &self.title, 22, &entries)?;
        let mut chart = ChartBuilder::on(&below)
            .margin(px(16))
            .margin_right(px(28))
            .x_label_area_size(px(48))
            .y_label_area_size(px(64))
            .build_cartesian_2d(xs, ys)?;
        chart
            .configure_mesh()
            .label_style(font(16))
            .axis_desc_style(font(18))
            .axis_style(INK.mix(0.4).stroke_width(px(1)))
            .bold_line_style(GRID.stroke_width(px(1)))
            .light_line_style(TRANSPARENT)
            .x_labels(9)
            .y_labels(7)
            .x_label_formatter(&|x| brief(*x))
            .y_label_formatter(&|y| format!("{}", (y * 100.0).round() / 100.0))
            .x_desc(self.x)
            .y_desc(self.y)
            .draw()?;
        // Bands come first, so that no band hides another arm's line.
        for (line, colour) in self.lines.iter().zip(COLOURS) {
            chart.draw_series(
                band(line)
                    .into_iter()
                    .map(|corners| Polygon::new(corners, colour.mix(0.16).filled())),
            )?;
        }
        if let Some((level, _)) = &self.level {
            let ends = [(0.0, *level), (self.furthest(), *level)];
            chart.draw_series(DashedLineSeries::new(
                ends,
                px(8),
                px(6),
                LEVEL.stroke_width(px(2)),
            ))?;
        }
        for (line, colour) in self.lines.iter().zip(COLOURS) {
            let points: Vec<_> = line
                .points
                .iter()
                .map(|point| (point.x, point.value))
                .collect();
            chart.draw_series(thick_line(&points, colour, px(2)))?;
        }
        Ok(())
    }

    fn furthest(&self) -> f64 {
        let last = |line: &ComparedLine<'_>| line.points.last().map(|point| point.x);
        self.lines.iter().filter_map(last).fold(0.0, f64::max)
    }

    fn ranges(&self) -> (std::ops::Range<f64>, std::ops::Range<f64>) {
        let mut values: Vec<f64> = self.level.iter().map(|level| level.0).collect();
        for point in self.lines.iter().flat_map(|line| &line.points) {
            let (low, high) = point.interval.unwrap_or((point.value, point.value));
            values.extend([low, high]);
        }
        let (low, high) = padded_range(&values);
        // Values that are never negative get an axis from zero.
        let is_negative = values.iter().any(|value| *value < 0.0);
        (
            0.0..self.furthest().max(1.0),
            if is_negative { low } else { 0.0 }..high,
        )
    }
}

/// Returns the corners of a line's band: along the upper ends of its intervals, and back along the
/// lower ends. `None` without intervals.
fn band(line: &ComparedLine<'_>) -> Option<Vec<(f64, f64)>> {
    let ends: Option<Vec<_>> = line
        .points
        .iter()
        .map(|point| {
            let (low, high) = point.interval?;
            Some(((point.x, low), (point.x, high)))
        })
        .collect();
    let (low, high): (Vec<_>, Vec<_>) = ends?.into_iter().unzip();
    (!low.is_empty()).then(|| high.into_iter().chain(low.into_iter().rev()).collect())
}
