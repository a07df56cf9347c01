//! Growth of a cost with a size, on logarithmic axes, on which a power law is a straight line.

use std::path::Path;

use plotters::prelude::*;

use super::ReportError;
use super::canvas::{Area, Canvas, GRID, INK, REFERENCE, STRONG, font, px};
use super::head::{LegendEntry, draw_head};

const WIDTH: u32 = 760;
const HEIGHT: u32 = 420;

/// Colours of the lines; a picture has at most this many.
const COLOURS: [RGBColor; 4] = [
    STRONG,
    REFERENCE,
    RGBColor(0x3a, 0x8a, 0x5f),
    RGBColor(0x7a, 0x5a, 0xa8),
];

/// Picture of how a cost grows with a size.
#[derive(Debug)]
pub struct GrowthPicture<'a> {
    /// Title above the picture.
    pub title: &'a str,
    /// Label of the x axis: the size.
    pub x: &'a str,
    /// Label of the y axis: the cost, with its unit.
    pub y: &'a str,
    /// Lines; at most four are drawn.
    pub lines: Vec<GrowthLine<'a>>,
}

/// Line of a growth picture.
#[derive(Debug)]
pub struct GrowthLine<'a> {
    /// Label in the legend.
    pub label: &'a str,
    /// Points in the order of their x. Points without a place on logarithmic axes are left out.
    pub points: Vec<(f64, f64)>,
}

/// A line that can be drawn.
struct ColouredLine<'a> {
    label: &'a str,
    colour: RGBColor,
    points: Vec<(f64, f64)>,
}

impl GrowthPicture<'_> {
    /// Draws the picture to `path`. Returns `false` if there was nothing to draw.
    ///
    /// # Errors
    /// Returns [`ReportError`] if the picture cannot be drawn or written.
    pub fn draw(&self, path: &Path) -> Result<bool, ReportError> {
        let has_place = |&(x, y): &(f64, f64)| x > 0.0 && y > 0.0 && x.is_finite() && y.is_finite();
        let lines: Vec<ColouredLine<'_>> = self
            .lines
            .iter()
            .zip(COLOURS)
            .map(|(line, colour)| ColouredLine {
                label: line.label,
                colour,
                points: line.points.iter().copied().filter(has_place).collect(),
            })
            .filter(|line| line.points.len() > 1)
            .collect();
        if lines.is_empty() {
            return Ok(false);
        }
        let mut canvas = Canvas::new(WIDTH, HEIGHT);
        canvas.draw(|area| draw_lines(area, self, &lines))?;
        canvas.save(path)?;
        Ok(true)
    }
}

fn draw_lines(
    area: &Area<'_>,
    growth: &GrowthPicture<'_>,
    lines: &[ColouredLine<'_>],
) -> Result<(), Box<dyn std::error::Error>> {
    let xs = bounds(
        lines
            .iter()
            .flat_map(|line| line.points.iter().map(|point| point.0)),
    );
    let ys = bounds(
        lines
            .iter()
            .flat_map(|line| line.points.iter().map(|point| point.1)),
    );
    let entries: Vec<_> = lines
        .iter()
        .map(|line| LegendEntry::line(line.label, line.colour))
        .collect();
    let below = draw_head(area, growth.title, 20, &entries)?;
    let mut chart = ChartBuilder::on(&below)
        .margin(px(14))
        .margin_right(px(26))
        .x_label_area_size(px(46))
        .y_label_area_size(px(76))
        .build_cartesian_2d(
            (xs.0 / 1.15..xs.1 * 1.15).log_scale(),
            decades(ys).log_scale(),
        )?;
    chart
        .configure_mesh()
        .label_style(font(14))
        .axis_desc_style(font(16))
        .axis_style(INK.mix(0.4).stroke_width(px(1)))
        .bold_line_style(GRID.stroke_width(px(1)))
        .light_line_style(TRANSPARENT)
        // More labels would overlap below a power of ten.
        .x_labels(6)
        .x_label_formatter(&|x| brief(*x))
        .y_label_formatter(&|y| brief(*y))
        .x_desc(growth.x)
        .y_desc(growth.y)
        .draw()?;
    for line in lines {
        let colour = line.colour;
        let segments = line.points.windows(2);
        chart.draw_series(
            segments.map(|ends| PathElement::new(ends.to_vec(), colour.stroke_width(px(2)))),
        )?;
        chart.draw_series(
            line.points
                .iter()
                .map(|&at| Circle::new(at, px(4), colour.filled())),
        )?;
    }
    Ok(())
}

fn bounds(values: impl Iterator<Item = f64>) -> (f64, f64) {
    values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| {
        (low.min(value), high.max(value))
    })
}

/// Returns the range from the power of ten below to the one above, so that a flat line looks flat.
fn decades((low, high): (f64, f64)) -> std::ops::Range<f64> {
    10_f64.powf((low / 1.1).log10().floor())..10_f64.powf((high * 1.1).log10().ceil())
}

/// Returns a number short enough for an axis.
pub(super) fn brief(value: f64) -> String {
    let (value, suffix) = match value {
        value if value >= 1e6 => (value / 1e6, " M"),
        value if value >= 1e4 => (value / 1e3, " k"),
        value => (value, ""),
    };
    let digits = format!("{value:.6}");
    format!(
        "{}{suffix}",
        digits.trim_end_matches('0').trim_end_matches('.')
    )
}
