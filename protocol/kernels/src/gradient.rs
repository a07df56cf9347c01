//! The gradient of a layer's weights: what came in, times what flows back, summed over everything
//! the weights were used for.

use std::cell::RefCell;
use std::ops::Range;

use crate::isa::{Isa, Scalar8, Simd};
use crate::panels::{Aligned, Matrix, Panel, panels};
use crate::team::{Shared, Team};
use crate::tile::{Begin, End, Output, Packed, Run, of_height, panel_tile};
use crate::windows::Windows;

/// Terms done before all elements are put back: both operands' parts then stay in the caches.
const TERMS_AT_ONCE: usize = 512;
/// Numbers between two tiles of the left operand: without them, all tiles would begin in the same
/// few sets of the cache.
const PADDING: usize = 16;

/// The right operand, a row for each term.
#[derive(Debug, Clone, Copy)]
pub enum Terms<'a> {
    /// A matrix, row by row.
    Matrix(&'a [f32], usize),
    /// What windows on images that lie one behind the other see, a row each.
    Windows(&'a Windows, &'a [f32]),
}

impl<'a> Terms<'a> {
    fn data(&self) -> &'a [f32] {
        match self {
            Self::Matrix(data, _) | Self::Windows(_, data) => data,
        }
    }

    /// Where the rows of these terms begin.
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

    /// The runs of memory that hold a panel's columns of a row.
    fn pieces(&self, panel: Panel) -> Vec<Run> {
        let columns = panel.first..panel.first + panel.columns;
        match self {
            Self::Matrix(..) => vec![Run {
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

    /// # Panics
    /// When there are no whole rows or images.
    fn count(&self) -> usize {
        let (data, len, rows) = match self {
            Self::Matrix(data, columns) => (data, *columns, 1),
            Self::Windows(windows, images) => (images, windows.image_len(), windows.count()),
        };
        assert!(
            data.len().is_multiple_of(len),
            "{} numbers are not whole terms",
            data.len()
        );
        data.len() / len * rows
    }
}

/// `output = leftᵀ · right`, `[left's columns, right's columns]`, row-major: the sum over terms, in
/// order, of one row of each.
///
/// Members of the team share the columns; no sum is split, so that the bits do not depend on how
/// many they are.
///
/// # Panics
/// When lengths do not belong together.
pub fn gradient(team: &mut Team, isa: Isa, left: Matrix<'_>, right: Terms<'_>, output: &mut [f32]) {
    assert!(isa.is_available(), "{isa} is not to be had here");
    let (rows, columns) = (left.columns(), right.columns());
    assert_eq!(left.rows(), right.count(), "as many terms left as right");
    assert_eq!(
        output.len(),
        rows * columns,
        "a place for each of {rows} x {columns} elements"
    );
    let shared = Shared::new(output);
    let width = isa.panel_width();
    team.split(columns.div_ceil(width), 1, |part| {
        let columns = part.start * width..(part.end * width).min(columns);
        let job = Job {
            isa,
            left,
            right,
            columns,
            output: shared.pointer(),
        };
        job.run();
    });
}

/// The columns of one member.
struct Job<'a> {
    isa: Isa,
    left: Matrix<'a>,
    right: Terms<'a>,
    columns: Range<usize>,
    output: *mut f32,
}

/// Memory of one thread, kept from product to product.
#[derive(Default)]
struct Scratch {
    left: Aligned<f32>,
    right: Aligned<f32>,
    /// Where each term's row of the right operand begins.
    starts: Vec<usize>,
}

thread_local! {
    static SCRATCH: RefCell<Scratch> = RefCell::default();
}

impl Job<'_> {
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
                // SAFETY: `gradient` has asked for the instructions and looked at all lengths; this
                // member alone writes its columns.
                unsafe { do_block(self, terms, scratch, begin) };
            }
        });
    }

    /// The sum of no terms.
    fn blank(&self) {
        for row in 0..self.left.columns() {
            for column in self.columns.clone() {
                // SAFETY: inside the output, in this member's columns.
                unsafe { *self.output.add(row * self.right.columns() + column) = 0.0 };
            }
        }
    }
}

/// # Safety
/// The instructions of `job` are there; the terms are; nobody else touches the job's columns of the
/// output.
unsafe fn do_block(job: &Job<'_>, terms: Range<usize>, scratch: &mut Scratch, begin: Begin) {
    // SAFETY: as the caller says.
    unsafe {
        match job.isa {
            #[cfg(target_arch = "x86_64")]
            Isa::Avx512 | Isa::Avx512Bf16 => avx512(job, terms, scratch, begin),
            #[cfg(target_arch = "x86_64")]
            Isa::Avx2 => avx2(job, terms, scratch, begin),
            _ => block::<Scalar8>(job, terms, scratch, begin),
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma,avx512f,avx512vl,avx512bw,avx512dq")]
unsafe fn avx512(job: &Job<'_>, terms: Range<usize>, scratch: &mut Scratch, begin: Begin) {
    // SAFETY: as the caller says.
    unsafe { block::<crate::isa::x86::Avx512>(job, terms, scratch, begin) }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
unsafe fn avx2(job: &Job<'_>, terms: Range<usize>, scratch: &mut Scratch, begin: Begin) {
    // SAFETY: as the caller says.
    unsafe { block::<crate::isa::x86::Avx2>(job, terms, scratch, begin) }
}

#[inline(always)]
unsafe fn block<S: Simd<Term = f32>>(
    job: &Job<'_>,
    terms: Range<usize>,
    scratch: &mut Scratch,
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
        // SAFETY: as the caller says; there is room for a whole panel.
        unsafe { pack_right::<S>(job.right, &scratch.starts, panel, right) };
        for row in (0..rows).step_by(S::ROWS) {
            let tile = Tile {
                left: Packed {
                    data: left[row / S::ROWS * apart..].as_ptr(),
                    stride: S::ROWS,
                },
                runs: [Run {
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
            // SAFETY: as the caller says.
            unsafe { of_height!(S, (rows - row).min(S::ROWS), tile_of(tile)) };
        }
    }
}

struct Tile {
    left: Packed,
    runs: [Run; 1],
    right: *const f32,
    panel: Panel,
    begin: Begin,
    output: *mut f32,
    stride: usize,
}

#[inline(always)]
unsafe fn tile_of<S: Simd<Term = f32>, const M: usize>(tile: Tile) {
    // SAFETY: as the caller says.
    unsafe {
        panel_tile::<S, _, M>(
            tile.left,
            &tile.runs,
            tile.right,
            tile.panel,
            tile.begin,
            End::Plain,
            Output::even(tile.output, tile.stride),
        );
    }
}

/// Lays out the left operand's columns as tiles that begin `apart` numbers from each other, term by
/// term. Behind the last column lies whatever was there.
#[inline(always)]
fn pack_left<S: Simd>(left: Matrix<'_>, terms: Range<usize>, apart: usize, into: &mut [f32]) {
    let (count, columns) = (terms.len(), left.columns());
    let whole = columns / S::ROWS;
    assert!(apart >= count * S::ROWS && into.len() >= columns.div_ceil(S::ROWS) * apart);
    for (index, term) in terms.enumerate() {
        let row = left.row(term);
        for tile in 0..whole {
            let (from, to) = (tile * S::ROWS, tile * apart + index * S::ROWS);
            // SAFETY: the row has `columns` numbers, `into` room for `count` terms of as many tiles
            // as they fill, as asserted.
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

/// Lays out the panel's columns of the right operand, term by term.
///
/// # Safety
/// The terms that begin at `starts` have the panel's columns; `into` has room for as many rows of
/// the panel's width.
#[inline(always)]
unsafe fn pack_right<S: Simd>(right: Terms<'_>, starts: &[usize], panel: Panel, into: &mut [f32]) {
    let data = right.data().as_ptr();
    let mut row = into.as_mut_ptr();
    let pieces = right.pieces(panel);
    // SAFETY: as the caller says.
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
