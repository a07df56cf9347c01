//! Title and legend above the axes of a plot, where they cover no line.

use std::error::Error;

use plotters::prelude::*;

use super::canvas::{Area, font, px};

/// Height of a row of the legend, in saved pixels.
const ROW: u32 = 24;
/// Space beside the rows.
const MARGIN: u32 = 28;
/// Length of a mark, with the space behind it.
const MARK: u32 = 32;
/// Space between two entries of a row.
const GAP: u32 = 24;
/// Space above the title.
const TOP: u32 = 12;

/// Entry of a legend.
#[derive(Debug, Clone, Copy)]
pub(super) struct LegendEntry<'t> {
    pub(super) label: &'t str,
    pub(super) colour: RGBColor,
    pub(super) mark: Mark,
}

/// Form of what an entry explains.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Mark {
    Line,
    Dot,
}

impl<'t> LegendEntry<'t> {
    pub(super) fn line(label: &'t str, colour: RGBColor) -> Self {
        Self {
            label,
            colour,
            mark: Mark::Line,
        }
    }
}

/// Draws `title`, `pixels` high, and the legend at the top of `area`; returns the area below.
///
/// # Errors
/// Errors of the plotting library.
pub(super) fn draw_head<'a>(
    area: &Area<'a>,
    title: &str,
    pixels: u32,
    entries: &[LegendEntry<'_>],
) -> Result<Area<'a>, Box<dyn Error>> {
    let (_, below) = area.split_vertically(px(TOP));
    let below = below.titled(title, font(pixels))?;
    let style = font(16);
    let mut widths = Vec::with_capacity(entries.len());
    for entry in entries {
        let (text, _) = below.estimate_text_size(entry.label, &style)?;
        widths.push(px(MARK) + text);
    }
    let places = places(&widths, below.dim_in_pixel().0);
    for (entry, &(x, row)) in entries.iter().zip(&places) {
        let (x, y) = (x as i32, px(row * ROW + ROW / 2) as i32);
        let colour = entry.colour;
        match entry.mark {
            Mark::Line => {
                let ends = [(x, y), (x + px(24) as i32, y)];
                below.draw(&PathElement::new(ends, colour.stroke_width(px(3))))?;
            }
            Mark::Dot => {
                let middle = (x + px(12) as i32, y);
                below.draw(&Circle::new(middle, px(3), colour.mix(0.4).filled()))?;
            }
        }
        below.draw_text(entry.label, &style, (x + px(MARK) as i32, y - px(5) as i32))?;
    }
    let rows = places.last().map_or(0, |(_, row)| row + 1);
    let (_, rest) = below.split_vertically(px(rows * ROW));
    Ok(rest)
}

/// Returns the left end and the row of entries of these `widths`, in an area of this `width`.
fn places(widths: &[u32], width: u32) -> Vec<(u32, u32)> {
    let (mut x, mut row) = (px(MARGIN), 0);
    widths
        .iter()
        .map(|&wide| {
            if x > px(MARGIN) && x + wide > width.saturating_sub(px(MARGIN)) {
                (x, row) = (px(MARGIN), row + 1);
            }
            let place = (x, row);
            x += wide + px(GAP);
            place
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_entry_without_room_begins_a_new_row() {
        let left = px(MARGIN);
        let wide = px(100);
        let step = wide + px(GAP);
        let two = 2 * left + step + wide;
        assert_eq!(
            places(&[wide; 3], two),
            [(left, 0), (left + step, 0), (left, 1)]
        );
        assert_eq!(places(&[wide; 2], two - 1), [(left, 0), (left, 1)]);
        assert_eq!(places(&[wide], 1), [(left, 0)], "no row is empty");
    }
}
