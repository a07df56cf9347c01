//! The gradient of a layer's weights: output gradients times inputs, summed over all rows that the
//! weights were applied to.

use std::cell::RefCell;
use std::ops::Range;

#[cfg(target_arch = "x86_64")]
use crate::isa::x86::{Avx2, Avx512};
use crate::isa::{Isa, Scalar8, Simd};
use crate::panels::{Aligned, Matrix, Panel, panels};
use crate::team::{Shared, Team};
use crate::tile::{Begin, End, Output, Packed, Span, of_height, panel_tile};
use crate::windows::Windows;

/// Terms added to all elements before the next terms are: both operands' parts then stay in the
/// caches.
const TERMS_AT_ONCE: usize = 512;
/// Numbers between two tiles of the left operand. Without them, all tiles would begin in the same
/// few sets of the cache.
const PADDING: usize = 16;

/// Right operand of a gradient, one row for each term.
#[derive(Debug, Clone, Copy)]
pub enum Terms<'a> {
    /// Row-major matrix, and its columns.
    Matrix(&'a [f32], usize),
    /// Contents of the windows on images that lie one behind the other, one row each.
    Windows(&'a Windows, &'a [f32]),
}

impl<'a> Terms<'a> {
    fn data(&self) -> &'a [f32] {
        match self {
            Self::Matrix(data, _) | Self::Windows(_, data) => data,
        }
    }

    /// Writes the offsets at which the rows of these terms begin.
    fn starts(&self, terms: Range<usize>, into: &mut Vec<usize>) {
        into.clear();
        match self {
            Self::Matrix(_, columns) => into.extend(terms.map(|term| term * columns)),
            Self::Windows(windows, _) => into.extend(terms.map(|term| {
                let (image, window) = (term / windows.count(), term % windows.count());
                image * windows.image_len() + windows.starts()[window]
            })),
        }
    }

    /// The spans of memory that hold a panel's columns of a row.
    fn pieces(&self, panel: Panel) -> Vec<Span> {
        let columns = panel.first..panel.first + panel.columns;
        match self {
            Self::Matrix(..) => vec![Span {
                offset: columns.start,
                len: columns.len(),
            }],
            Self::Windows(windows, _) => windows.pieces(columns),
        }
    }

    fn columns(&self) -> usize {
        match self {
            Self::Matrix(_, columns) => *columns,
            Self::Windows(windows, _) => windows.window_len(),
        }
    }

    /// Number of terms.
    ///
    /// # Panics
    /// If the data are not whole rows or images.
    fn count(&self) -> usize {
        let (data, len, rows) = match self {
            Self::Matrix(data, columns) => (data, *columns, 1),
            Self::Windows(windows, images) => (images, windows.image_len(), windows.count()),
        };
        assert!(
            data.len().is_multiple_of(len),
            "{} numbers are not whole rows or images of {len}",
            data.len()
        );
        data.len() / len * rows
    }
}

/// Computes `output = leftᵀ · right`, `[left's columns, right's columns]`, row-major: the sum over
/// terms, in order, of the products of one row of each.
///
/// Members of the team share the columns. No sum is divided, so the bits do not depend on their
/// number.
///
/// # Panics
/// If lengths do not match.
pub fn gradient(team: &mut Team, isa: Isa, left: Matrix<'_>, right: Terms<'_>, output: &mut [f32]) {
    isa.require();
    let (rows, columns) = (left.columns(), right.columns());
    assert_eq!(
        left.rows(),
        right.count(),
        "left and right operand have the same number of terms"
    );
    assert_eq!(
        output.len(),
        rows * columns,
        "the output has {rows} x {columns} elements"
    );
    let shared = Shared::new(output);
    let width = isa.panel_width();
    team.split(columns.div_ceil(width), 1, |part| {
        let columns = part.start * width..(part.end * width).min(columns);
        let job = GradientJob {
            isa,
            left,
            right,
            columns,
            output: shared.pointer(),
        };
        job.run();
    });
}

/// One member's share: some columns.
struct GradientJob<'a> {
    isa: Isa,
    left: Matrix<'a>,
    right: Terms<'a>,
    columns: Range<usize>,
    output: *mut f32,
}

/// Working memory of one thread, kept from call to call.
#[derive(Default)]
struct GradientScratch {
    left: Aligned,
    right: Aligned,
    /// Offset of each term's row in the right operand.
    starts: Vec<usize>,
}

thread_local! {
    static SCRATCH: RefCell<GradientScratch> = RefCell::default();
}

impl GradientJob<'_> {
    fn run(&self) {
        let terms = self.left.rows();
        if terms == 0 {
            return self.blank();
        }
        SCRATCH.with_borrow_mut(|scratch| {
            for first in (0..terms).step_by(TERMS_AT_ONCE) {
                let terms = first..(first + TERMS_AT_ONCE).min(terms);
                let begin = if first == 0 {
                    Begin::Zero
                } else {
                    Begin::Output
                };
                // SAFETY: `gradient` has checked the instructions and all lengths; this member
                // alone writes its columns.
                unsafe { do_block(self, terms, scratch, begin) };
            }
        });
    }

    /// Writes the sums of zero terms.
    fn blank(&self) {
        for row in 0..self.left.columns() {
            for column in self.columns.clone() {
                // SAFETY: within the output, in this member's columns.
                unsafe { *self.output.add(row * self.right.columns() + column) = 0.0 };
            }
        }
    }
}

/// Adds some terms to the job's elements.
///
/// # Safety
/// The instructions of `job` are available, and the terms exist. Nothing else accesses the job's
/// columns of the output.
unsafe fn do_block(
    job: &GradientJob<'_>,
    terms: Range<usize>,
    scratch: &mut GradientScratch,
    begin: Begin,
) {
    // SAFETY: guaranteed by the caller.
    unsafe {
        match job.isa {
            #[cfg(target_arch = "x86_64")]
            Isa::Avx512 => avx512(job, terms, scratch, begin),
            #[cfg(target_arch = "x86_64")]
            Isa::Avx2 => avx2(job, terms, scratch, begin),
            _ => block::<Scalar8>(job, terms, scratch, begin),
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma,avx512f,avx512vl,avx512bw,avx512dq")]
unsafe fn avx512(
    job: &GradientJob<'_>,
    terms: Range<usize>,
    scratch: &mut GradientScratch,
    begin: Begin,
) {
    // SAFETY: guaranteed by the caller.
    unsafe { block::<Avx512>(job, terms, scratch, begin) }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
unsafe fn avx2(
    job: &GradientJob<'_>,
    terms: Range<usize>,
    scratch: &mut GradientScratch,
    begin: Begin,
) {
    // SAFETY: guaranteed by the caller.
    unsafe { block::<Avx2>(job, terms, scratch, begin) }
}

#[inline(always)]
unsafe fn block<S: Simd>(
    job: &GradientJob<'_>,
    terms: Range<usize>,
    scratch: &mut GradientScratch,
    begin: Begin,
) {
    let (count, rows) = (terms.len(), job.left.columns());
    let apart = count * S::ROWS + PADDING;
    let left = scratch.left.of_len(rows.div_ceil(S::ROWS) * apart);
    pack_left::<S>(job.left, terms.clone(), apart, left);
    job.right.starts(terms, &mut scratch.starts);
    let right = scratch.right.of_len(2 * S::LANES * count);
    for panel in panels(job.isa, job.columns.len()) {
        let panel = Panel {
            first: job.columns.start + panel.first,
            ..panel
        };
        // SAFETY: guaranteed by the caller; there is room for a whole panel.
        unsafe { pack_right::<S>(job.right, &scratch.starts, panel, right) };
        for row in (0..rows).step_by(S::ROWS) {
            let tile = Tile {
                left: Packed {
                    data: left[row / S::ROWS * apart..].as_ptr(),
                    stride: S::ROWS,
                },
                spans: [Span {
                    offset: 0,
                    len: count,
                }],
                right: right.as_ptr(),
                panel,
                begin,
                output: job
                    .output
                    .wrapping_add(row * job.right.columns() + panel.first),
                stride: job.right.columns(),
            };
            // SAFETY: guaranteed by the caller.
            unsafe { of_height!(S, (rows - row).min(S::ROWS), tile_of(tile)) };
        }
    }
}

struct Tile {
    left: Packed,
    spans: [Span; 1],
    right: *const f32,
    panel: Panel,
    begin: Begin,
    output: *mut f32,
    stride: usize,
}

#[inline(always)]
unsafe fn tile_of<S: Simd, const M: usize>(tile: Tile) {
    // SAFETY: guaranteed by the caller.
    unsafe {
        panel_tile::<S, _, M>(
            tile.left,
            &tile.spans,
            tile.right,
            tile.panel,
            tile.begin,
            End::Plain,
            Output::even(tile.output, tile.stride),
        );
    }
}

/// Packs the left operand's columns in tiles, term by term. Tiles begin `apart` numbers from each
/// other; rows behind the last column keep unspecified values.
#[inline(always)]
fn pack_left<S: Simd>(left: Matrix<'_>, terms: Range<usize>, apart: usize, into: &mut [f32]) {
    let (count, columns) = (terms.len(), left.columns());
    let whole = columns / S::ROWS;
    assert!(apart >= count * S::ROWS && into.len() >= columns.div_ceil(S::ROWS) * apart);
    for (index, term) in terms.enumerate() {
        let row = left.row(term);
        for tile in 0..whole {
            let (from, to) = (tile * S::ROWS, tile * apart + index * S::ROWS);
            // SAFETY: the row has `columns` numbers, and `into` has room for `count` terms of all
            // tiles, as asserted.
            unsafe {
                into.as_mut_ptr()
                    .add(to)
                    .copy_from_nonoverlapping(row.as_ptr().add(from), S::ROWS)
            };
        }
        let rest = &row[whole * S::ROWS..];
        if !rest.is_empty() {
            into[whole * apart + index * S::ROWS..][..rest.len()].copy_from_slice(rest);
        }
    }
}

/// Packs the panel's columns of the right operand, term by term.
///
/// # Safety
/// The rows that begin at `starts` have the panel's columns; `into` has room for as many rows of
/// the panel's width.
#[inline(always)]
unsafe fn pack_right<S: Simd>(right: Terms<'_>, starts: &[usize], panel: Panel, into: &mut [f32]) {
    let data = right.data().as_ptr();
    let mut row = into.as_mut_ptr();
    let pieces = right.pieces(panel);
    // SAFETY: guaranteed by the caller.
    unsafe {
        match &pieces[..] {
            [piece] if piece.len == 2 * S::LANES => {
                for start in starts {
                    let from = data.add(start + piece.offset);
                    S::store(row, S::load(from));
                    S::store(row.add(S::LANES), S::load(from.add(S::LANES)));
                    row = row.add(2 * S::LANES);
                }
            }
            pieces => {
                for start in starts {
                    let mut to = row;
                    for piece in pieces {
                        let from = data.add(start + piece.offset);
                        for number in 0..piece.len {
                            *to.add(number) = *from.add(number);
                        }
                        to = to.add(piece.len);
                    }
                    row = row.add(panel.width);
                    while to < row {
                        *to = 0.0;
                        to = to.add(1);
                    }
                }
            }
        }
    }
}
