//! Windows on a channels-last image: what a convolution sees through its kernel.
//!
//! A window's numbers, row by row of the kernel, are runs of memory side by side in the image. Convolutions forward read them where they lie; what a
//! transposed convolution makes of a pixel is added back through the same windows. So one description serves all passes of both kinds of layer.

use std::ops::Range;

use crate::isa::Isa;
use crate::panels::Panels;
use crate::product::{Finish, Rows, Start, product_part};
use crate::tile::Run;

/// All positions of a kernel on an image `[height, width, channels]`, row by row, without padding.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Windows {
    image_len: usize,
    positions: [usize; 2],
    /// Where in the image each window begins.
    starts: Vec<usize>,
    /// The window's rows, from where it begins; together in the order [kernel row, kernel column, channel].
    runs: Vec<Run>,
    window_len: usize,
}

impl Windows {
    /// Windows of `kernel` (height, width) on an image of `size` (height, width) with `channels`, moved by `stride`.
    ///
    /// # Panics
    /// When the kernel does not fit into the image, or something is nought.
    pub fn new(size: [usize; 2], channels: usize, kernel: [usize; 2], stride: usize) -> Self {
        assert!(
            channels > 0 && stride > 0 && (0..2).all(|axis| (1..=size[axis]).contains(&kernel[axis])),
            "a kernel of {kernel:?} moved by {stride} has no place in an image of {size:?} with {channels} channels"
        );
        let positions = [0, 1].map(|axis| (size[axis] - kernel[axis]) / stride + 1);
        let row_len = size[1] * channels;
        let starts = (0..positions[0] * positions[1])
            .map(|window| (window / positions[1] * row_len + window % positions[1] * channels) * stride)
            .collect();
        let len = kernel[1] * channels;
        let runs = (0..kernel[0])
            .map(|row| Run {
                offset: row * row_len,
                len,
            })
            .collect();
        Self {
            image_len: size[0] * row_len,
            positions,
            starts,
            runs,
            window_len: kernel[0] * len,
        }
    }

    /// Numbers in an image.
    pub fn image_len(&self) -> usize {
        self.image_len
    }

    /// Numbers in a window.
    pub fn window_len(&self) -> usize {
        self.window_len
    }

    /// Windows.
    pub fn count(&self) -> usize {
        self.starts.len()
    }

    /// Rows and columns of windows: a convolution's output size.
    pub fn positions(&self) -> [usize; 2] {
        self.positions
    }

    pub(crate) fn starts(&self) -> &[usize] {
        &self.starts
    }

    pub(crate) fn runs(&self) -> &[Run] {
        &self.runs
    }

    /// The runs of memory that hold these numbers of a window, from where it begins.
    pub(crate) fn pieces(&self, numbers: Range<usize>) -> Vec<Run> {
        let row_len = self.runs[0].len;
        let mut pieces = Vec::new();
        let mut number = numbers.start;
        while number < numbers.end {
            let (row, inside) = (number / row_len, number % row_len);
            let len = (row_len - inside).min(numbers.end - number);
            let offset = self.runs[row].offset + inside;
            pieces.push(Run { offset, len });
            number += len;
        }
        pieces
    }

    /// Adds each window's numbers, `[windows, window_len]`, to where they belong in `image`. The adjoint of looking through the windows.
    ///
    /// # Panics
    /// When a length is off.
    pub fn add_back(&self, isa: Isa, numbers: &[f32], image: &mut [f32]) {
        self.add_back_part(isa, 0..self.count(), 0..self.runs.len(), numbers, image);
    }

    /// Adds some rows of some windows back, kernel row by kernel row. `numbers`: `[windows, kernel rows, numbers of a row]`.
    fn add_back_part(
        &self,
        isa: Isa,
        windows: Range<usize>,
        kernel_rows: Range<usize>,
        numbers: &[f32],
        image: &mut [f32],
    ) {
        let (starts, runs) = (&self.starts[windows], &self.runs[kernel_rows]);
        let (run_len, len) = (self.runs[0].len, self.runs[0].len * runs.len());
        assert_eq!(image.len(), self.image_len, "the image the windows are of");
        assert_eq!(numbers.len(), starts.len() * len, "all numbers of each window");
        isa.vectorised(
            #[inline(always)]
            || {
                for (row, run) in runs.iter().enumerate() {
                    for (&start, numbers) in starts.iter().zip(numbers.chunks_exact(len)) {
                        let from = &numbers[row * run_len..][..run_len];
                        let into = &mut image[start + run.offset..][..run_len];
                        for (into, from) in into.iter_mut().zip(from) {
                            *into += from;
                        }
                    }
                }
            },
        );
    }
}

/// Rows that a product is not done for fewer of, if there are: every panel that is fetched meets them all.
const ROWS_AT_ONCE: usize = 24;

/// Adds `rows · panels`, a window's numbers for each row, to where they belong in `image`: a transposed convolution forward, and what flows back through a
/// convolution. `scratch` is used again from call to call.
///
/// Some rows of windows and one row of the kernel at a time, so that what is made is added back from the first cache. An element of the image is the sum of what
/// it held, and then of its windows, by rows of windows in groups, by rows of the kernel, and from left to right.
///
/// # Panics
/// When lengths do not belong together.
pub fn spread(rows: &[f32], panels: &Panels, windows: &Windows, scratch: &mut Vec<f32>, image: &mut [f32]) {
    let (terms, kernel_rows, run_len) = (panels.terms(), windows.runs.len(), windows.runs[0].len);
    assert_eq!(
        panels.columns(),
        windows.window_len,
        "a column for each number of a window"
    );
    assert_eq!(rows.len(), windows.count() * terms, "a row for each window");
    let across = windows.positions[1];
    let at_once = across * ROWS_AT_ONCE.div_ceil(across);
    // By a rule that no instruction set changes: 32 columns are whole panels of all.
    let kernel_rows_at_once = if run_len.is_multiple_of(32) { 1 } else { kernel_rows };
    for first in (0..windows.count()).step_by(at_once) {
        let some = first..(first + at_once).min(windows.count());
        let left = Rows::Matrix(&rows[some.start * terms..some.end * terms]);
        for row in (0..kernel_rows).step_by(kernel_rows_at_once) {
            let runs = row..row + kernel_rows_at_once;
            let columns = runs.start * run_len..runs.end * run_len;
            scratch.resize(some.len() * columns.len(), 0.0);
            product_part(left, panels, columns, Start::Zero, Finish::Plain, scratch);
            windows.add_back_part(panels.isa(), some.clone(), runs, scratch, image);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_kernel_of_4_and_stride_2_gives_the_sizes_of_the_paper() {
        let sizes: Vec<_> = [[72, 128], [35, 63], [16, 30], [7, 14]]
            .map(|size| Windows::new(size, 3, [4, 4], 2).positions())
            .into();
        assert_eq!(sizes, [[35, 63], [16, 30], [7, 14], [2, 6]]);
    }

    #[test]
    fn what_is_added_back_lies_where_it_was_seen() {
        // 3 x 4 pixels, one channel, windows of 2 x 2 moved by 2: two of them, in the upper two rows.
        let windows = Windows::new([3, 4], 1, [2, 2], 2);
        let mut image = [0.5; 12];
        windows.add_back(Isa::best(), &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0], &mut image);
        assert_eq!(image, [1.5, 2.5, 5.5, 6.5, 3.5, 4.5, 7.5, 8.5, 0.5, 0.5, 0.5, 0.5]);
    }

    #[test]
    #[should_panic(expected = "has no place")]
    fn a_kernel_larger_than_the_image_is_refused() {
        let _ = Windows::new([3, 4], 1, [4, 4], 2);
    }
}
