//! Windows on a channels-last image: what a convolution sees through its kernel.
//!
//! A window's numbers, row by row of the kernel, are runs of memory side by side in the image. Convolutions forward read them where they lie; what a
//! transposed convolution makes of a pixel is added back through the same windows. So one description serves all passes of both kinds of layer.

use std::ops::Range;

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

    /// Where these numbers of a window lie, from where it begins.
    pub(crate) fn offsets(&self, numbers: Range<usize>) -> Vec<usize> {
        let row_len = self.runs[0].len;
        numbers
            .map(|number| self.runs[number / row_len].offset + number % row_len)
            .collect()
    }

    /// Adds each window's numbers, `[windows, window_len]`, to where they belong in `image`, in order. The adjoint of looking through the windows.
    ///
    /// # Panics
    /// When a length is off.
    pub fn add_back(&self, numbers: &[f32], image: &mut [f32]) {
        assert_eq!(image.len(), self.image_len, "the image the windows are of");
        assert_eq!(
            numbers.len(),
            self.count() * self.window_len,
            "all numbers of each window"
        );
        for (&start, mut numbers) in self.starts.iter().zip(numbers.chunks_exact(self.window_len)) {
            for run in &self.runs {
                let (from, rest) = numbers.split_at(run.len);
                let into = &mut image[start + run.offset..][..run.len];
                for (into, from) in into.iter_mut().zip(from) {
                    *into += from;
                }
                numbers = rest;
            }
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
        windows.add_back(&[1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0], &mut image);
        assert_eq!(image, [1.5, 2.5, 5.5, 6.5, 3.5, 4.5, 7.5, 8.5, 0.5, 0.5, 0.5, 0.5]);
    }

    #[test]
    #[should_panic(expected = "has no place")]
    fn a_kernel_larger_than_the_image_is_refused() {
        let _ = Windows::new([3, 4], 1, [4, 4], 2);
    }
}
