//! The gradient of a layer's weights: what came in, times what flows back, summed over everything the weights were used for.

use crate::isa::{Isa, Scalar8, Simd};
use crate::panels::{Aligned, Matrix, Panel, panels};
use crate::team::{Shared, Team};
use crate::tile::{Begin, End, Output, Packed, Run, of_height, panel_tile};
use crate::windows::Windows;

/// Terms done before all elements are put back: both operands' parts then stay in the caches.
const TERMS_AT_ONCE: usize = 256;

/// The right operand, a row for each term.
#[derive(Debug, Clone, Copy)]
pub enum Terms<'a> {
    /// A matrix, row by row.
    Matrix(&'a [f32], usize),
    /// What windows on images that lie one behind the other see, a row each.
    Windows(&'a Windows, &'a [f32]),
}

impl Terms<'_> {
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

/// `output = leftᵀ · right`, `[left's columns, right's columns]`, row-major: the sum over terms, in order, of one row of each.
///
/// Members of the team share the columns; no sum is split, so that the bits do not depend on how many they are.
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
            output: Output {
                data: shared.pointer(),
                stride: right.columns(),
            },
        };
        job.run();
    });
}

/// The columns of one member.
struct Job<'a> {
    isa: Isa,
    left: Matrix<'a>,
    right: Terms<'a>,
    columns: std::ops::Range<usize>,
    output: Output,
}

thread_local! {
    /// Packed operands, kept from product to product.
    static PACKED: std::cell::RefCell<[Aligned; 2]> = std::cell::RefCell::default();
}

impl Job<'_> {
    fn run(&self) {
        PACKED.with_borrow_mut(|[left, right]| {
            let terms = self.left.rows();
            if terms == 0 {
                return self.blank();
            }
            for first in (0..terms).step_by(TERMS_AT_ONCE) {
                let terms = (terms - first).min(TERMS_AT_ONCE);
                let tall = self.isa.tile_rows();
                let left = left.of_len(self.left.columns().div_ceil(tall) * tall * terms);
                let right = right.of_len(self.isa.panel_width() * terms);
                let begin = if first == 0 { Begin::Zero } else { Begin::Output };
                // SAFETY: the instructions were asked for; both buffers have room for all that is packed; this member alone writes its columns.
                unsafe { do_block(self, first..first + terms, left, right, begin) };
            }
        });
    }

    /// The sum of no terms.
    fn blank(&self) {
        for row in 0..self.left.columns() {
            for column in self.columns.clone() {
                // SAFETY: inside the output, in this member's columns.
                unsafe { *self.output.data.add(row * self.output.stride + column) = 0.0 };
            }
        }
    }
}

/// # Safety
/// The instructions of `job` are there; the buffers have room; nobody else touches the job's columns of the output.
unsafe fn do_block(job: &Job<'_>, terms: std::ops::Range<usize>, left: &mut [f32], right: &mut [f32], begin: Begin) {
    // SAFETY: as the caller says.
    unsafe {
        match job.isa {
            #[cfg(target_arch = "x86_64")]
            Isa::Avx512 => avx512(job, terms, left, right, begin),
            #[cfg(target_arch = "x86_64")]
            Isa::Avx2 => avx2(job, terms, left, right, begin),
            _ => block::<Scalar8>(job, terms, left, right, begin),
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma,avx512f,avx512vl,avx512bw,avx512dq")]
unsafe fn avx512(job: &Job<'_>, terms: std::ops::Range<usize>, left: &mut [f32], right: &mut [f32], begin: Begin) {
    // SAFETY: as the caller says.
    unsafe { block::<crate::isa::x86::Avx512>(job, terms, left, right, begin) }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
unsafe fn avx2(job: &Job<'_>, terms: std::ops::Range<usize>, left: &mut [f32], right: &mut [f32], begin: Begin) {
    // SAFETY: as the caller says.
    unsafe { block::<crate::isa::x86::Avx2>(job, terms, left, right, begin) }
}

#[inline(always)]
unsafe fn block<S: Simd>(
    job: &Job<'_>,
    terms: std::ops::Range<usize>,
    left: &mut [f32],
    right: &mut [f32],
    begin: Begin,
) {
    let count = terms.len();
    pack_left::<S>(job.left, terms.clone(), left);
    for panel in panels(job.isa, job.columns.len()) {
        let panel = Panel {
            first: job.columns.start + panel.first,
            ..panel
        };
        pack_right(job.right, terms.clone(), panel, &mut right[..count * panel.width]);
        for row in (0..job.left.columns()).step_by(S::ROWS) {
            let rows = (job.left.columns() - row).min(S::ROWS);
            let tile = Tile {
                left: Packed {
                    data: left[row * count..].as_ptr(),
                    stride: S::ROWS,
                },
                runs: [Run { offset: 0, len: count }],
                right: right.as_ptr(),
                panel,
                begin,
                output: job.output.down(row * job.output.stride + panel.first),
            };
            // SAFETY: as the caller says.
            unsafe { of_height!(S, rows, tile_of(tile)) };
        }
    }
}

struct Tile {
    left: Packed,
    runs: [Run; 1],
    right: *const f32,
    panel: Panel,
    begin: Begin,
    output: Output,
}

#[inline(always)]
unsafe fn tile_of<S: Simd, const M: usize>(tile: Tile) {
    // SAFETY: as the caller says.
    unsafe {
        panel_tile::<S, _, M>(
            tile.left,
            &tile.runs,
            tile.right,
            tile.panel,
            tile.begin,
            End::Plain,
            tile.output,
        );
    }
}

/// Lays out the left operand's columns as rows of tiles, term by term. Behind the last column lies whatever was there.
#[inline(always)]
fn pack_left<S: Simd>(left: Matrix<'_>, terms: std::ops::Range<usize>, into: &mut [f32]) {
    let count = terms.len();
    for (index, term) in terms.enumerate() {
        let row = left.row(term);
        let mut whole = row.chunks_exact(S::ROWS);
        let mut at = index * S::ROWS;
        for part in &mut whole {
            into[at..at + S::ROWS].copy_from_slice(part);
            at += count * S::ROWS;
        }
        let rest = whole.remainder();
        if !rest.is_empty() {
            into[at..at + rest.len()].copy_from_slice(rest);
        }
    }
}

/// Lays out the panel's columns of the right operand, term by term.
#[inline(always)]
fn pack_right(right: Terms<'_>, terms: std::ops::Range<usize>, panel: Panel, into: &mut [f32]) {
    let rows = terms.zip(into.chunks_exact_mut(panel.width));
    match right {
        Terms::Matrix(data, columns) => {
            for (term, row) in rows {
                let from = &data[term * columns + panel.first..][..panel.columns];
                fill_row(row, from);
            }
        }
        Terms::Windows(windows, images) => {
            let offsets = windows.offsets(panel.first..panel.first + panel.columns);
            let side_by_side = offsets.is_sorted_by(|a, b| a + 1 == *b);
            for (term, row) in rows {
                let (image, window) = (term / windows.count(), term % windows.count());
                let start = image * windows.image_len() + windows.starts()[window];
                if side_by_side {
                    fill_row(row, &images[start + offsets[0]..][..panel.columns]);
                } else {
                    for (into, offset) in row.iter_mut().zip(&offsets) {
                        *into = images[start + offset];
                    }
                    row[panel.columns..].fill(0.0);
                }
            }
        }
    }
}

#[inline(always)]
fn fill_row(row: &mut [f32], from: &[f32]) {
    let (there, missing) = row.split_at_mut(from.len());
    there.copy_from_slice(from);
    missing.fill(0.0);
}
