//! Rows times packed panels: every forward pass, and what flows back to a layer's input.

use std::cell::RefCell;
use std::ops::Range;

use crate::isa::{Isa, Simd};
use crate::pair::Term;
use crate::panels::{Matrix, Panel, Panels};
use crate::tile::{Begin, End, InPlace, MOST_ROWS, Output, ROW_PANELS, Run, of_height, panel_tile, row_of_panels};
use crate::windows::Windows;

/// Terms of a panel that all rows meet before the next ones' turn: they stay in the first cache meanwhile.
const TERMS_AT_ONCE: usize = 256;
/// Rows that meet all panels before the next ones' turn, and numbers of a matrix's rows: they stay in the second cache meanwhile.
const ROWS_AT_ONCE: usize = 192;
const NUMBERS_AT_ONCE: usize = 80 << 10;

/// The left operand: rows of numbers, read where they lie.
#[derive(Debug, Clone, Copy)]
pub enum Rows<'a, T = f32> {
    /// A matrix, row by row; as many numbers in a row as the product has terms.
    Matrix(&'a [T]),
    /// What windows on an image see, a row each.
    Windows(&'a Windows, &'a [T]),
}

/// What an element's sum begins with.
#[derive(Debug, Clone, Copy)]
pub enum Start<'a> {
    /// Nothing.
    Zero,
    /// Its column's bias, `[columns]`.
    Bias(&'a [f32]),
}

/// What becomes of a finished sum.
#[derive(Debug, Clone, Copy)]
pub enum Finish<'a> {
    /// Nothing.
    Plain,
    /// Zero if it is below zero (ReLU). Not a number stays what it is.
    Rectified,
    /// Zero where this matrix, `[rows, columns]`, is not above zero: the gradient through a ReLU whose output it is.
    Gated(&'a [f32]),
}

/// `output = finish(start + rows · panels)`, `[rows, columns]`; everything row-major.
///
/// Each element is the sum of its terms in order, one fused multiply-add each: the same bits for every instruction set, and however the rows are parted. Of pairs
/// ([`Pair`](crate::Pair)) the second product is added before the first.
///
/// # Panics
/// When lengths do not belong together.
pub fn product<T: Term>(
    rows: Rows<'_, T>,
    panels: &Panels<T>,
    start: Start<'_>,
    finish: Finish<'_>,
    output: &mut [f32],
) {
    product_part(rows, panels, 0..panels.columns(), start, finish, output);
}

thread_local! {
    static PANEL: RefCell<Panels> = RefCell::new(Panels::new(Isa::Portable));
}

/// [`product`] with a right operand that is packed panel by panel, each just before its turn. For weights that change between any two products: packed at once
/// and kept, they would be written to memory and read back from there.
///
/// # Panics
/// When lengths do not belong together.
pub fn product_once(
    isa: Isa,
    rows: &[f32],
    right: Matrix<'_>,
    start: Start<'_>,
    finish: Finish<'_>,
    output: &mut [f32],
) {
    let (rows, columns) = (Rows::Matrix(rows), right.columns());
    check_lens(rows, right.rows(), columns, columns, start, finish, output.len());
    PANEL.with_borrow_mut(|panels| {
        for panel in crate::panels::panels(isa, columns) {
            let own = panel.first..panel.first + panel.columns;
            panels.repack(isa, right.columns_of(own.clone()));
            let place = Place {
                stride: columns,
                first: own.start,
            };
            multiply(rows, panels, 0..own.len(), place, start, finish, output);
        }
    });
}

/// [`product`] for some columns only, from the first of a panel to the last of one: `output` and a gate hold these alone, a bias is that of all.
pub(crate) fn product_part<T: Term>(
    rows: Rows<'_, T>,
    panels: &Panels<T>,
    part: Range<usize>,
    start: Start<'_>,
    finish: Finish<'_>,
    output: &mut [f32],
) {
    let terms = panels.terms();
    assert!(
        part.end <= panels.columns() && (part == (0..panels.columns()) || panels.are_whole(&part)),
        "columns {part:?} are not those of whole panels"
    );
    check_lens(rows, terms, part.len(), panels.columns(), start, finish, output.len());
    let place = Place {
        stride: part.len(),
        first: 0,
    };
    multiply(rows, panels, part, place, start, finish, output);
}

/// Where the first column of a product lies in its output.
#[derive(Clone, Copy)]
struct Place {
    /// Columns of the output.
    stride: usize,
    first: usize,
}

/// The product for these columns of `panels`, all lengths looked at. A bias begins with that of the column at `place`, but for a part of the panels with that of their first.
fn multiply<T: Term>(
    rows: Rows<'_, T>,
    panels: &Panels<T>,
    part: Range<usize>,
    place: Place,
    start: Start<'_>,
    finish: Finish<'_>,
    output: &mut [f32],
) {
    assert!(panels.isa().is_available(), "{} is not to be had here", panels.isa());
    let (columns, count) = (part.len(), rows.count(panels.terms()));
    let single;
    let (data, starts, runs) = match rows {
        Rows::Matrix(data) => {
            single = [Run {
                offset: 0,
                len: panels.terms(),
            }];
            (data, Starts::Even(panels.terms()), &single[..])
        }
        Rows::Windows(windows, image) => (image, Starts::Listed(windows.starts()), windows.runs()),
    };
    // A single row meets a number only once, and needs as many sums under way as there are registers.
    let (terms_at_once, panels_at_once) = if count == 1 && columns == panels.columns() {
        (usize::MAX, ROW_PANELS)
    } else {
        (TERMS_AT_ONCE, 1)
    };
    let blocks = blocks(runs, terms_at_once);
    let last_block = blocks.len() - 1;
    let rows_at_once = match rows {
        Rows::Matrix(_) => (NUMBERS_AT_ONCE / panels.terms()).clamp(MOST_ROWS, ROWS_AT_ONCE),
        Rows::Windows(..) => ROWS_AT_ONCE,
    };
    for first in (0..count).step_by(rows_at_once) {
        for panel in panels
            .groups(panels_at_once)
            .filter(|panel| part.contains(&panel.first))
        {
            let corner = first * place.stride + place.first + panel.first - part.start;
            for (index, block) in blocks.iter().enumerate() {
                let work = Work {
                    left: data.as_ptr(),
                    starts,
                    first,
                    rows: (count - first).min(rows_at_once),
                    runs: &block.runs,
                    right: panels.at(panel, block.first_term),
                    terms: panels.terms(),
                    panel,
                    begin: match start {
                        _ if index > 0 => Begin::Output,
                        Start::Zero => Begin::Zero,
                        Start::Bias(bias) => Begin::Bias(bias[place.first + panel.first..].as_ptr()),
                    },
                    end: match finish {
                        _ if index < last_block => End::Plain,
                        Finish::Plain => End::Plain,
                        Finish::Rectified => End::Rectified,
                        Finish::Gated(by) => End::Gated(by[corner..].as_ptr()),
                    },
                    output: Output {
                        data: output[corner..].as_mut_ptr(),
                        stride: place.stride,
                    },
                };
                // SAFETY: `check` has seen to it that every row has all terms, bias, gate and output all columns of all rows; `panels` was packed for
                // its instructions, which `Isa` has looked for.
                unsafe { do_work(panels.isa(), &work) };
            }
        }
    }
}

/// Looks at all lengths: those of an output of `columns` columns, and of a bias for each of `all`.
fn check_lens<T: Term>(
    rows: Rows<'_, T>,
    terms: usize,
    columns: usize,
    all: usize,
    start: Start<'_>,
    finish: Finish<'_>,
    output: usize,
) {
    assert!(terms > 0 && columns > 0, "an empty product");
    match rows {
        Rows::Matrix(data) => assert!(
            data.len().is_multiple_of(terms),
            "{} numbers are no rows of {terms}",
            data.len()
        ),
        Rows::Windows(windows, image) => {
            assert_eq!(image.len(), windows.image_len(), "the image the windows are of");
            assert_eq!(windows.window_len(), terms, "a window has all terms");
        }
    }
    let count = rows.count(terms);
    assert_eq!(
        output,
        count * columns,
        "a place for each of {count} x {columns} elements"
    );
    if let Start::Bias(bias) = start {
        assert_eq!(bias.len(), all, "a bias for each column");
    }
    if let Finish::Gated(by) = finish {
        assert_eq!(by.len(), output, "a gate for each element");
    }
}

impl<T> Rows<'_, T> {
    /// Rows of so many terms.
    fn count(&self, terms: usize) -> usize {
        match self {
            Self::Matrix(data) => data.len() / terms,
            Self::Windows(windows, _) => windows.count(),
        }
    }
}

/// Some of a product's terms.
struct Block {
    first_term: usize,
    runs: Vec<Run>,
}

/// Cuts the terms into blocks of at most so many.
fn blocks(runs: &[Run], most: usize) -> Vec<Block> {
    let mut blocks: Vec<Block> = Vec::new();
    let (mut first_term, mut room) = (0, 0);
    for run in runs {
        let mut run = *run;
        while run.len > 0 {
            if room == 0 {
                room = most;
                let runs = Vec::new();
                blocks.push(Block { first_term, runs });
            }
            let len = run.len.min(room);
            if let Some(block) = blocks.last_mut() {
                block.runs.push(Run { len, ..run });
            }
            run = Run {
                offset: run.offset + len,
                len: run.len - len,
            };
            first_term += len;
            room -= len;
        }
    }
    blocks
}

/// Where rows begin.
#[derive(Clone, Copy)]
enum Starts<'a> {
    /// So far apart.
    Even(usize),
    /// Here.
    Listed(&'a [usize]),
}

/// Some rows, some terms, one panel or several.
struct Work<'a, T> {
    left: *const T,
    starts: Starts<'a>,
    first: usize,
    rows: usize,
    runs: &'a [Run],
    right: *const T,
    /// All terms of the product: so far apart are the columns of one panel and the next.
    terms: usize,
    /// One panel, or as many full ones side by side as a single row meets at once.
    panel: Panel,
    begin: Begin,
    end: End,
    /// Of the first row and the panel's first column; a gate likewise.
    output: Output,
}

impl<T> Work<'_, T> {
    /// Where a row begins.
    #[inline(always)]
    fn row(&self, row: usize) -> *const T {
        let row = self.first + row;
        self.left.wrapping_add(match self.starts {
            Starts::Even(stride) => row * stride,
            Starts::Listed(starts) => starts[row],
        })
    }
}

/// # Safety
/// The instructions are there; pointers and numbers of `work` belong together.
unsafe fn do_work<T: Term>(isa: Isa, work: &Work<'_, T>) {
    // SAFETY: as the caller says.
    unsafe {
        match isa {
            #[cfg(target_arch = "x86_64")]
            Isa::Avx512Bf16 => avx512_bf16::<T::Avx512Bf16>(work),
            #[cfg(target_arch = "x86_64")]
            Isa::Avx512 => avx512::<T::Avx512>(work),
            #[cfg(target_arch = "x86_64")]
            Isa::Avx2 => avx2::<T::Avx2>(work),
            _ => all_tiles::<T::Portable>(work),
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma,avx512f,avx512vl,avx512bw,avx512dq,avx512bf16")]
unsafe fn avx512_bf16<S: Simd>(work: &Work<'_, S::Term>) {
    // SAFETY: as the caller says.
    unsafe { all_tiles::<S>(work) }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma,avx512f,avx512vl,avx512bw,avx512dq")]
unsafe fn avx512<S: Simd>(work: &Work<'_, S::Term>) {
    // SAFETY: as the caller says.
    unsafe { all_tiles::<S>(work) }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
unsafe fn avx2<S: Simd>(work: &Work<'_, S::Term>) {
    // SAFETY: as the caller says.
    unsafe { all_tiles::<S>(work) }
}

#[inline(always)]
unsafe fn all_tiles<S: Simd>(work: &Work<'_, S::Term>) {
    if work.panel.width == ROW_PANELS * 2 * S::LANES {
        let panels = std::array::from_fn(|panel| work.right.wrapping_add(panel * work.terms * 2 * S::LANES));
        // SAFETY: as the caller says: the panels lie one behind the other.
        return unsafe { row_of_panels::<S>(work.row(0), work.runs, panels, work.begin, work.end, work.output) };
    }
    let mut row = 0;
    while row < work.rows {
        let rows = (work.rows - row).min(S::ROWS);
        // SAFETY: as the caller says.
        unsafe { of_height!(S, rows, tile_of(work, row)) };
        row += rows;
    }
}

#[inline(always)]
unsafe fn tile_of<S: Simd, const M: usize>(work: &Work<'_, S::Term>, row: usize) {
    let left = InPlace::<S::Term, M>(std::array::from_fn(|index| work.row(row + index)));
    let down = row * work.output.stride;
    // SAFETY: as the caller says.
    unsafe {
        panel_tile::<S, _, M>(
            left,
            work.runs,
            work.right,
            work.panel,
            work.begin,
            work.end.down(down),
            work.output.down(down),
        );
    }
}
