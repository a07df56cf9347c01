//! Windows on a channels-last image: what a convolution sees through its kernel.
//!
//! A window's numbers, row by row of the kernel, are runs of memory side by side in the image.
//! Convolutions forward read them where they lie; what a transposed convolution makes of a pixel is
//! added back through the same windows. So one description serves all passes of both kinds of
//! layer.

use std::ops::Range;

use crate::isa::Isa;
use crate::panels::Panels;
use crate::product::{Finish, Rows, Start, product};
use crate::tile::{Begin, End, Run};
use crate::work::{Starts, TERMS_AT_ONCE, Work, do_work};

/// All positions of a kernel on an image `[height, width, channels]`, row by row, without padding.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Windows {
    image_len: usize,
    channels: usize,
    positions: [usize; 2],
    /// Where in the image each window begins.
    starts: Vec<usize>,
    /// The window's rows, from where it begins; together in the order [kernel row, kernel column,
    /// channel].
    runs: Vec<Run>,
    window_len: usize,
}

impl Windows {
    /// Windows of `kernel` (height, width) on an image of `size` (height, width) with `channels`,
    /// moved by `stride`.
    ///
    /// # Panics
    /// When the kernel does not fit into the image, or something is zero.
    pub fn new(size: [usize; 2], channels: usize, kernel: [usize; 2], stride: usize) -> Self {
        assert!(
            channels > 0
                && stride > 0
                && (0..2).all(|axis| (1..=size[axis]).contains(&kernel[axis])),
            "a kernel of {kernel:?} moved by {stride} has no place in an image of {size:?} with {channels} channels"
        );
        let positions = [0, 1].map(|axis| (size[axis] - kernel[axis]) / stride + 1);
        let row_len = size[1] * channels;
        let starts = (0..positions[0] * positions[1])
            .map(|window| {
                (window / positions[1] * row_len + window % positions[1] * channels) * stride
            })
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
            channels,
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
            let len = (row_len - number % row_len).min(numbers.end - number);
            pieces.push(Run {
                offset: self.offset(number),
                len,
            });
            number += len;
        }
        pieces
    }

    /// Where a number of a window lies, from where it begins.
    fn offset(&self, number: usize) -> usize {
        let row_len = self.runs[0].len;
        self.runs[number / row_len].offset + number % row_len
    }

    /// Adds each window's numbers, `[windows, window_len]`, to where they belong in `image`. The
    /// adjoint of looking through the windows.
    ///
    /// # Panics
    /// When a length is off.
    pub fn add_back(&self, isa: Isa, numbers: &[f32], image: &mut [f32]) {
        self.add_back_part(isa, 0..self.count(), numbers, image);
    }

    /// Adds some windows back, kernel row by kernel row.
    fn add_back_part(&self, isa: Isa, windows: Range<usize>, numbers: &[f32], image: &mut [f32]) {
        let starts = &self.starts[windows];
        assert_eq!(image.len(), self.image_len, "the image the windows are of");
        assert_eq!(
            numbers.len(),
            starts.len() * self.window_len,
            "all numbers of each window"
        );
        isa.vectorised(
            #[inline(always)]
            || {
                for (row, run) in self.runs.iter().enumerate() {
                    for (&start, numbers) in
                        starts.iter().zip(numbers.chunks_exact(self.window_len))
                    {
                        let from = &numbers[row * run.len..][..run.len];
                        let into = &mut image[start + run.offset..][..run.len];
                        for (into, from) in into.iter_mut().zip(from) {
                            *into += from;
                        }
                    }
                }
            },
        );
    }
}

/// Adds `rows · panels`, a window's numbers for each row, to where they belong in `image`: a
/// transposed convolution forward, and what flows back through a convolution. `scratch` is used
/// again from call to call.
///
/// Where channels are a multiple of 32, an element of the image is what it held, to which each
/// window's terms are added, one fused multiply-add each; windows in the order of where they see
/// the element, by rows of the kernel and from left to right. With other channels it is the sum of
/// what it held and of its windows' sums, by rows of windows in groups, by rows of the kernel, and
/// by windows from left to right.
///
/// # Panics
/// When lengths do not belong together.
pub fn spread(
    rows: &[f32],
    panels: &Panels,
    windows: &Windows,
    scratch: &mut Vec<f32>,
    image: &mut [f32],
) {
    let terms = panels.terms();
    assert_eq!(
        panels.columns(),
        windows.window_len,
        "a column for each number of a window"
    );
    assert_eq!(rows.len(), windows.count() * terms, "a row for each window");
    assert_eq!(
        image.len(),
        windows.image_len,
        "the image the windows are of"
    );
    if windows.channels.is_multiple_of(WHOLE_PANELS) {
        spread_in_place(rows, panels, windows, image);
    } else {
        spread_by_scratch(rows, panels, windows, scratch, image);
    }
}

/// So many columns are whole panels of all instruction sets: what is added in which order depends
/// on none of them.
const WHOLE_PANELS: usize = 32;

/// Panel by panel, sums that begin with what is in the image. A panel's columns are channels of one
/// place in the kernel, where no two windows see the same pixel.
fn spread_in_place(rows: &[f32], panels: &Panels, windows: &Windows, image: &mut [f32]) {
    let (isa, terms) = (panels.isa(), panels.terms());
    assert!(isa.is_available(), "{isa} is not to be had here");
    for panel in panels.groups(1) {
        for first_term in (0..terms).step_by(TERMS_AT_ONCE) {
            let work = Work {
                left: rows.as_ptr(),
                starts: Starts::Even(terms),
                first: 0,
                rows: windows.count(),
                runs: &[Run {
                    offset: first_term,
                    len: (terms - first_term).min(TERMS_AT_ONCE),
                }],
                right: panels.at(panel, first_term),
                terms,
                panel,
                begin: Begin::Output,
                end: End::Plain,
                output: image[windows.offset(panel.first)..].as_mut_ptr(),
                output_starts: Starts::Listed(windows.starts()),
            };
            // SAFETY: the instructions are there; there is a row of all terms for each window, and
            // each window, seen from the panel's first number on, has the panel's columns side by
            // side, apart from those of the others.
            unsafe { do_work(isa, &work) };
        }
    }
}

/// Rows that a product is not done for fewer of, if there are: every panel that is fetched meets
/// them all.
const ROWS_AT_ONCE: usize = 24;

/// Some rows of windows at a time, so that what is made is added back from a near cache.
fn spread_by_scratch(
    rows: &[f32],
    panels: &Panels,
    windows: &Windows,
    scratch: &mut Vec<f32>,
    image: &mut [f32],
) {
    let terms = panels.terms();
    let across = windows.positions[1];
    let at_once = across * ROWS_AT_ONCE.div_ceil(across);
    for first in (0..windows.count()).step_by(at_once) {
        let some = first..(first + at_once).min(windows.count());
        let left = Rows::Matrix(&rows[some.start * terms..some.end * terms]);
        scratch.resize(some.len() * windows.window_len, 0.0);
        product(left, panels, Start::Zero, Finish::Plain, scratch);
        windows.add_back_part(panels.isa(), some, scratch, image);
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
        // 3 x 4 pixels, one channel, windows of 2 x 2 moved by 2: two of them, in the upper two
        // rows.
        let windows = Windows::new([3, 4], 1, [2, 2], 2);
        let mut image = [0.5; 12];
        windows.add_back(
            Isa::best(),
            &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0],
            &mut image,
        );
        assert_eq!(
            image,
            [1.5, 2.5, 5.5, 6.5, 3.5, 4.5, 7.5, 8.5, 0.5, 0.5, 0.5, 0.5]
        );
    }

    #[test]
    #[should_panic(expected = "has no place")]
    fn a_kernel_larger_than_the_image_is_refused() {
        let _ = Windows::new([3, 4], 1, [4, 4], 2);
    }
}
