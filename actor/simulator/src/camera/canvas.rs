//! Fills outlines with planes and keeps the nearest plane of each pixel.
//!
//! The depth of a plane is not affine over the image, but its inverse is: `1 / depth = a column + b
//! row + c`. So a surface is drawn without a division or a texture, and the nearer of two surfaces
//! has the larger inverse.
//!
//! Parity decides which pixels lie inside an outline. Each edge flips every pixel to its right, in
//! a row of 128 bits at once, so that holes and inward corners need no triangles. Two surfaces that
//! share an edge compute the same pixel for it, so no crack opens between them.

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

/// Image being drawn.
pub(super) struct DepthCanvas {
    nearness: Box<[[f32; IMAGE_WIDTH]; IMAGE_HEIGHT]>,
    /// Pixels inside the current outline, as set bits. All clear between outlines.
    inside: [u128; IMAGE_HEIGHT],
    /// First row that the outline touches.
    first_row: usize,
    end_row: usize,
}

impl DepthCanvas {
    pub(super) fn new() -> Self {
        Self {
            nearness: Box::new([[1.0; IMAGE_WIDTH]; IMAGE_HEIGHT]),
            inside: [0; IMAGE_HEIGHT],
            first_row: IMAGE_HEIGHT,
            end_row: 0,
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

/// Returns the first pixel whose middle lies at or after `position`, at most `count`.
#[inline(always)]
fn first_at_or_after(position: f32, count: usize) -> usize {
    // Equals `ceil` without its call: truncation rounds down, and counted from the far end, up.
    let from_end = count as f32 + 1.0 - (position - 0.5).clamp(0.0, count as f32);
    count + 1 - from_end as usize
}
