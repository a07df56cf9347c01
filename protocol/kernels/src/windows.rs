//! Windows on a channels-last image: the inputs of a convolution's kernel at each position.
//!
//! Each kernel row of a window is one span of memory in the image. A convolution reads the spans
//! where they lie; a transposed convolution adds its results to the same spans. So one description
//! serves all passes of both kinds of layer.

use std::ops::Range;

use crate::isa::Isa;
use crate::panel_work::{PanelWork, RowStarts, TERMS_AT_ONCE, do_panel};
use crate::panels::Panels;
use crate::product::{Finish, Rows, Start, product};
use crate::tile::{Begin, End, Span};

/// All positions of a kernel on an image `[height, width, channels]`, row by row, without padding.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Windows {
    image_len: usize,
    channels: usize,
    positions: [usize; 2],
    /// Offset of each window in the image.
    starts: Vec<usize>,
    /// Kernel rows, relative to a window's beginning; together they are a window's numbers,
    /// `[kernel row, kernel column, channel]`.
    spans: Vec<Span>,
    window_len: usize,
}

impl Windows {
    /// Windows of `kernel` (height, width) on an image of `size` (height, width) with `channels`,
    /// moved by `stride`.
    ///
    /// # Panics
    /// If the kernel does not fit into the image, or an argument is zero.
    pub fn new(size: [usize; 2], channels: usize, kernel: [usize; 2], stride: usize) -> Self {
        assert!(
            channels > 0
                && stride > 0
                && (0..2).all(|axis| (1..=size[axis]).contains(&kernel[axis])),
            "a kernel of {kernel:?} with stride {stride} does not fit into an image of {size:?} \
             with {channels} channels"
        );
        let positions = [0, 1].map(|axis| (size[axis] - kernel[axis]) / stride + 1);
        let row_len = size[1] * channels;
        let starts = (0..positions[0] * positions[1])
            .map(|window| {
                (window / positions[1] * row_len + window % positions[1] * channels) * stride
            })
            .collect();
        let len = kernel[1] * channels;
        let spans = (0..kernel[0])
            .map(|row| Span {
                offset: row * row_len,
                len,
            })
            .collect();
        Self {
            image_len: size[0] * row_len,
            channels,
            positions,
            starts,
            spans,
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

    /// Number of windows.
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

    pub(crate) fn spans(&self) -> &[Span] {
        &self.spans
    }

    /// The spans of memory that hold these numbers of a window, relative to its beginning.
    pub(crate) fn pieces(&self, numbers: Range<usize>) -> Vec<Span> {
        let row_len = self.spans[0].len;
        let mut pieces = Vec::new();
        let mut number = numbers.start;
        while number < numbers.end {
            let len = (row_len - number % row_len).min(numbers.end - number);
            pieces.push(Span {
                offset: self.offset(number),
                len,
            });
            number += len;
        }
        pieces
    }

    /// Offset of a number of a window, relative to the window's beginning.
    fn offset(&self, number: usize) -> usize {
        let row_len = self.spans[0].len;
        self.spans[number / row_len].offset + number % row_len
    }

    /// Adds the numbers of some windows, `[windows, window_len]`, to their places in `image`,
    /// kernel row by kernel row. The adjoint of reading the windows.
    ///
    /// # Panics
    /// If a length does not match.
    pub(crate) fn add_back(
        &self,
        isa: Isa,
        windows: Range<usize>,
        numbers: &[f32],
        image: &mut [f32],
    ) {
        let starts = &self.starts[windows];
        self.check_image(image);
        assert_eq!(
            numbers.len(),
            starts.len() * self.window_len,
            "all numbers of each window"
        );
        isa.vectorised(
            #[inline(always)]
            || {
                for (row, span) in self.spans.iter().enumerate() {
                    for (&start, numbers) in
                        starts.iter().zip(numbers.chunks_exact(self.window_len))
                    {
                        let from = &numbers[row * span.len..][..span.len];
                        let into = &mut image[start + span.offset..][..span.len];
                        for (into, from) in into.iter_mut().zip(from) {
                            *into += from;
                        }
                    }
                }
            },
        );
    }

    /// # Panics
    /// If the image does not have the size that the windows are for.
    pub(crate) fn check_image(&self, image: &[f32]) {
        assert_eq!(
            image.len(),
            self.image_len,
            "the image has the size that the windows are for"
        );
    }
}

/// Adds `rows · panels`, a window's numbers for each row, to the windows' places in `image`: the
/// forward pass of a transposed convolution, and the gradient of a convolution's input. `scratch`
/// is memory reused from call to call.
///
/// If the channels are a multiple of 32, each window's terms are added to the element's present
/// value, one fused multiply-add each. The windows are ordered by the element's place in them: by
/// kernel row, then from left to right. With other channels, each window's sum is added: by groups
/// of window rows, by kernel row, then by windows from left to right.
///
/// # Panics
/// If lengths do not match.
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
    windows.check_image(image);
    if windows.channels.is_multiple_of(WHOLE_PANELS) {
        spread_in_place(rows, panels, windows, image);
    } else {
        spread_by_scratch(rows, panels, windows, scratch, image);
    }
}

/// Columns that are whole panels of all instruction sets, so that the order of additions does not
/// depend on the instruction set.
const WHOLE_PANELS: usize = 32;

/// Computes [`spread`] panel by panel, with sums that begin with the image's content. A panel's
/// columns are channels of one place in the kernel, at which no two windows have the same pixel.
fn spread_in_place(rows: &[f32], panels: &Panels, windows: &Windows, image: &mut [f32]) {
    let (isa, terms) = (panels.isa(), panels.terms());
    isa.require();
    for panel in panels.groups(1) {
        for first_term in (0..terms).step_by(TERMS_AT_ONCE) {
            let work = PanelWork {
                left: rows.as_ptr(),
                starts: RowStarts::Even(terms),
                first: 0,
                rows: windows.count(),
                spans: &[Span {
                    offset: first_term,
                    len: (terms - first_term).min(TERMS_AT_ONCE),
                }],
                right: panels.at(panel, first_term),
                terms,
                panel,
                begin: Begin::Output,
                end: End::Plain,
                output: image[windows.offset(panel.first)..].as_mut_ptr(),
                output_starts: RowStarts::Listed(windows.starts()),
            };
            // SAFETY: the instructions are available; there is a row of all terms for each window.
            // From the panel's first number on, each window has the panel's columns side by side,
            // and no other window has the same ones.
            unsafe { do_panel(isa, &work) };
        }
    }
}

/// Fewest rows of a product, if there are so many: all of them use every panel that is fetched.
const ROWS_AT_ONCE: usize = 24;

/// Computes [`spread`] for some rows of windows at a time, so that their numbers are added from a
/// near cache.
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
        windows.add_back(panels.isa(), some, scratch, image);
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
    fn numbers_are_added_to_the_places_they_were_read_from() {
        // 3 x 4 pixels, one channel, windows of 2 x 2 moved by 2: two of them, in the upper two
        // rows.
        let windows = Windows::new([3, 4], 1, [2, 2], 2);
        let mut image = [0.5; 12];
        windows.add_back(
            Isa::best(),
            0..2,
            &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0],
            &mut image,
        );
        assert_eq!(
            image,
            [1.5, 2.5, 5.5, 6.5, 3.5, 4.5, 7.5, 8.5, 0.5, 0.5, 0.5, 0.5]
        );
    }

    #[test]
    #[should_panic(expected = "does not fit")]
    fn a_kernel_larger_than_the_image_is_refused() {
        let _ = Windows::new([3, 4], 1, [4, 4], 2);
    }
}
