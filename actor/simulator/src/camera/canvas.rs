//! Fills outlines with planes and keeps the nearest plane of each pixel.
//!
//! The depth of a plane is not affine over the image, but its inverse is: `1 / depth = a column + b
//! row + c`. So a surface is drawn without a division or a texture, and the nearer of two surfaces
//! has the larger inverse.
//!
//! Parity decides which pixels lie inside an outline. Each edge flips every pixel to its right, in
//! a row of 128 bits at once, so that holes and inward corners need no triangles. Two surfaces that
//! share an edge compute the same pixel for it, so no crack opens between them.
//!
//! An obstacle has many small convex faces. Such a face has one run of pixels in each row, between
//! the same edges, which costs a fraction of that.

use super::settings::MIDDLE_PX;
use super::{IMAGE_HEIGHT, IMAGE_PIXELS, IMAGE_WIDTH};

/// Point of the image, in pixels from its left and upper border. It may lie far outside.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ImagePoint {
    pub column: f32,
    pub row: f32,
}

/// Range over depth as an affine function of the image, relative to the image's middle: 1 at the
/// range, more when nearer.
#[derive(Debug, Clone, Copy)]
pub(super) struct Nearness {
    pub per_column: f32,
    pub per_row: f32,
    pub in_middle: f32,
}

/// Bit mask of the pixels from a column to the right border, by column; empty beyond the border.
const FROM_COLUMN: [u128; IMAGE_WIDTH + 1] = {
    let mut masks = [0; IMAGE_WIDTH + 1];
    let mut column = 0;
    while column < IMAGE_WIDTH {
        masks[column] = u128::MAX << column;
        column += 1;
    }
    masks
};

/// Distance in columns from the image's middle to the middle of each pixel.
const FROM_MIDDLE: [f32; IMAGE_WIDTH] = {
    let mut columns = [0.0; IMAGE_WIDTH];
    let mut column = 0;
    while column < IMAGE_WIDTH {
        columns[column] = column as f32 + 0.5 - MIDDLE_PX[0];
        column += 1;
    }
    columns
};

const _: () = assert!(
    IMAGE_WIDTH == u128::BITS as usize,
    "a row of pixels fills the bits of a u128"
);

/// Pixels of a short run, which are raised all at once.
const SHORT: usize = 16;

/// Image being drawn.
pub(super) struct DepthCanvas {
    nearness: Box<[[f32; IMAGE_WIDTH]; IMAGE_HEIGHT]>,
    /// Pixels inside the current outline, as set bits. All clear between outlines.
    inside: [u128; IMAGE_HEIGHT],
    /// First row that the outline touches.
    first_row: usize,
    end_row: usize,
    /// Where the edges of a convex face cross the middle of each row, columns: the first crossing
    /// and the last one. Meaningful only within [`Self::fill_convex`].
    left: [f32; IMAGE_HEIGHT],
    right: [f32; IMAGE_HEIGHT],
    /// The same, as the first pixel of each row in the face and the first behind it.
    runs: [[u32; IMAGE_HEIGHT]; 2],
}

impl DepthCanvas {
    pub(super) fn new() -> Self {
        Self {
            nearness: Box::new([[1.0; IMAGE_WIDTH]; IMAGE_HEIGHT]),
            inside: [0; IMAGE_HEIGHT],
            first_row: IMAGE_HEIGHT,
            end_row: 0,
            left: [0.0; IMAGE_HEIGHT],
            right: [0.0; IMAGE_HEIGHT],
            runs: [[0; IMAGE_HEIGHT]; 2],
        }
    }

    /// Clears the canvas: nothing in range anywhere.
    #[inline(always)]
    pub(super) fn clear(&mut self) {
        self.nearness.as_flattened_mut().fill(1.0);
    }

    /// Adds an edge to the outline. The edges of an outline form closed loops; their direction does
    /// not matter.
    #[inline(always)]
    pub(super) fn add_edge(&mut self, a: ImagePoint, b: ImagePoint) {
        // Always from the upper end: surfaces on both sides of the edge must compute the same.
        let (upper, lower) = if a.row < b.row { (a, b) } else { (b, a) };
        let first = first_at_or_after(upper.row, IMAGE_HEIGHT);
        let end = first_at_or_after(lower.row, IMAGE_HEIGHT);
        if first >= end {
            return;
        }
        self.first_row = self.first_row.min(first);
        self.end_row = self.end_row.max(end);
        let slope = (lower.column - upper.column) / (lower.row - upper.row);
        for (row, inside) in (first..end).zip(&mut self.inside[first..end]) {
            let crossing = upper.column + (row as f32 + 0.5 - upper.row) * slope;
            *inside ^= FROM_COLUMN[first_at_or_after(crossing, IMAGE_WIDTH)];
        }
    }

    /// Draws a plane into the outline where it is the nearest so far, and starts a new outline.
    #[inline(always)]
    pub(super) fn fill(&mut self, plane: Nearness) {
        for row in self.first_row..self.end_row {
            let mut left = std::mem::take(&mut self.inside[row]);
            let at_row = plane.in_middle + (row as f32 + 0.5 - MIDDLE_PX[1]) * plane.per_row;
            while left != 0 {
                let start = left.trailing_zeros() as usize;
                let end = start + (!(left >> start)).trailing_zeros() as usize;
                left &= FROM_COLUMN[end];
                let pixels = &mut self.nearness[row][start..end];
                raise(pixels, &FROM_MIDDLE[start..end], at_row, plane.per_column);
            }
        }
        self.first_row = IMAGE_HEIGHT;
        self.end_row = 0;
    }

    /// Draws a plane into a convex outline where it is the nearest so far. `plane` is asked for
    /// only if a row is met.
    #[inline(always)]
    pub(super) fn fill_convex(&mut self, corners: &[ImagePoint], plane: impl Fn() -> Nearness) {
        let Some(&last) = corners.last() else { return };
        let (mut least, mut most) = (last, last);
        for corner in corners {
            least.row = least.row.min(corner.row);
            least.column = least.column.min(corner.column);
            most.row = most.row.max(corner.row);
            most.column = most.column.max(corner.column);
        }
        let first = first_at_or_after(least.row, IMAGE_HEIGHT);
        let end = first_at_or_after(most.row, IMAGE_HEIGHT);
        let columns = [least, most].map(|corner| first_at_or_after(corner.column, IMAGE_WIDTH));
        // Most triangles of a fine mesh lie between the middles of pixels.
        if first >= end || columns[0] >= columns[1] {
            return;
        }
        self.left[first..end].fill(f32::INFINITY);
        self.right[first..end].fill(f32::NEG_INFINITY);
        let mut from = last;
        for &to in corners {
            self.cross_rows(from, to);
            from = to;
        }
        // All rows at once, before any of them is drawn.
        for (run, sides) in self.runs.iter_mut().zip([&self.left, &self.right]) {
            for (pixel, side) in run[first..end].iter_mut().zip(&sides[first..end]) {
                *pixel = first_at_or_after(*side, IMAGE_WIDTH) as u32;
            }
        }
        let plane = plane();
        for row in first..end {
            let [start, end] = [0, 1].map(|side| self.runs[side][row] as usize);
            let at_row = plane.in_middle + (row as f32 + 0.5 - MIDDLE_PX[1]) * plane.per_row;
            let pixels = &mut self.nearness[row];
            match end.saturating_sub(start) {
                0 => {}
                1..=SHORT => raise_short(pixels, start..end, at_row, plane.per_column),
                _ => raise(
                    &mut pixels[start..end],
                    &FROM_MIDDLE[start..end],
                    at_row,
                    plane.per_column,
                ),
            }
        }
    }

    /// Notes where an edge of a convex face crosses the middles of rows.
    #[inline(always)]
    fn cross_rows(&mut self, a: ImagePoint, b: ImagePoint) {
        // As in `add_edge`: surfaces on both sides of the edge must compute the same.
        let (upper, lower) = if a.row < b.row { (a, b) } else { (b, a) };
        let first = first_at_or_after(upper.row, IMAGE_HEIGHT);
        let end = first_at_or_after(lower.row, IMAGE_HEIGHT);
        if first >= end {
            return;
        }
        let slope = (lower.column - upper.column) / (lower.row - upper.row);
        let sides = self.left[first..end]
            .iter_mut()
            .zip(&mut self.right[first..end]);
        for (row, (left, right)) in (first..end).zip(sides) {
            let crossing = upper.column + (row as f32 + 0.5 - upper.row) * slope;
            *left = if crossing < *left { crossing } else { *left };
            *right = if crossing > *right { crossing } else { *right };
        }
    }

    /// Returns the drawn image as range over depth, 1 at the range or farther.
    #[inline(always)]
    pub(super) fn nearness(&self) -> &[[f32; IMAGE_WIDTH]; IMAGE_HEIGHT] {
        &self.nearness
    }

    /// Writes the image as grey levels: 0 at the lens, 255 at the range or farther.
    #[inline(always)]
    pub(super) fn write(&self, image: &mut [u8; IMAGE_PIXELS]) {
        for (pixel, nearness) in image.iter_mut().zip(self.nearness.as_flattened()) {
            *pixel = rounded(255.0 / nearness);
        }
    }
}

/// Rounds a grey level between 0 and 255 to the nearest integer.
#[inline(always)]
pub(super) fn rounded(level: f32) -> u8 {
    /// Added to a small number, it leaves the rounded number in the lowest bits of the sum.
    const ROUNDER: f32 = 8_388_608.0;
    (level + ROUNDER).to_bits() as u8
}

/// Raises each pixel of a run to the plane where the plane is nearer.
#[inline(always)]
fn raise(pixels: &mut [f32], columns: &[f32], at_row: f32, per_column: f32) {
    for (pixel, column) in pixels.iter_mut().zip(columns) {
        let plane = at_row + column * per_column;
        *pixel = if plane > *pixel { plane } else { *pixel };
    }
}

/// Raises a run of at most [`SHORT`] pixels of a row, like [`raise`].
#[inline(always)]
fn raise_short(
    row: &mut [f32; IMAGE_WIDTH],
    run: std::ops::Range<usize>,
    at_row: f32,
    per_column: f32,
) {
    let from = run.start.min(IMAGE_WIDTH - SHORT);
    let (least, most) = (FROM_MIDDLE[run.start], FROM_MIDDLE[run.end - 1]);
    let columns = &FROM_MIDDLE[from..from + SHORT];
    for (pixel, column) in row[from..from + SHORT].iter_mut().zip(columns) {
        let plane = at_row + column * per_column;
        let is_raised = (*column >= least) & (*column <= most) & (plane > *pixel);
        *pixel = if is_raised { plane } else { *pixel };
    }
}

/// Returns the first pixel whose middle lies at or after `position`, at most `count`.
#[inline(always)]
fn first_at_or_after(position: f32, count: usize) -> usize {
    let (from_start, count_px) = (position - 0.5, count as f32);
    // Written so that a NaN becomes 0.
    let at_least_0 = if from_start > 0.0 { from_start } else { 0.0 };
    let within = if at_least_0 < count_px {
        at_least_0
    } else {
        count_px
    };
    // Equals `ceil` without its call: truncation rounds down, and counted from the far end, up.
    let from_end = count_px + 1.0 - within;
    // SAFETY: it lies between 1 and `count` + 1. A conversion that checks costs several times as
    // much.
    count + 1 - unsafe { from_end.to_int_unchecked::<i32>() } as usize
}
