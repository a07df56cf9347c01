//! Rows times packed panels: every forward pass, and what flows back to a layer's input.

use std::cell::RefCell;

use crate::isa::Isa;
use crate::pair::Term;
use crate::panels::{Matrix, Panels};
use crate::tile::{Begin, End, MOST_ROWS, ROW_PANELS, Run};
use crate::windows::Windows;
use crate::work::{Starts, TERMS_AT_ONCE, Work, do_work};

/// Rows that meet all panels before the next ones' turn, and numbers of a matrix's rows: they stay
/// in the second cache meanwhile.
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
    /// Zero where this matrix, `[rows, columns]`, is not above zero: the gradient through a ReLU
    /// whose output it is.
    Gated(&'a [f32]),
}

/// `output = finish(start + rows · panels)`, `[rows, columns]`; everything row-major.
///
/// Each element is the sum of its terms in order, one fused multiply-add each: the same bits for
/// every instruction set, and however the rows are parted. Of pairs ([`Pair`](crate::Pair)) the
/// second product is added before the first; the processor's instruction for them takes numbers
/// below 1.2e-38 for zero, the others do not.
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
    let columns = panels.columns();
    check_lens(rows, panels.terms(), columns, start, finish, output.len());
    let place = Place {
        stride: columns,
        first: 0,
    };
    multiply(rows, panels, place, start, finish, output);
}

thread_local! {
    static PANEL: RefCell<Panels> = RefCell::new(Panels::new(Isa::Portable));
}

/// [`product`] with a right operand that is packed panel by panel, each just before its turn. For
/// weights that change between any two products: packed at once and kept, they would be written to
/// memory and read back from there.
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
    check_lens(rows, right.rows(), columns, start, finish, output.len());
    PANEL.with_borrow_mut(|panels| {
        for panel in crate::panels::panels(isa, columns) {
            let own = panel.first..panel.first + panel.columns;
            panels.repack(isa, right.columns_of(own.clone()));
            let place = Place {
                stride: columns,
                first: own.start,
            };
            multiply(rows, panels, place, start, finish, output);
        }
    });
}

/// Where the first column of a product lies in its output.
#[derive(Clone, Copy)]
struct Place {
    /// Columns of the output.
    stride: usize,
    first: usize,
}

/// The product, all lengths looked at. A bias begins with that of the column at `place`.
fn multiply<T: Term>(
    rows: Rows<'_, T>,
    panels: &Panels<T>,
    place: Place,
    start: Start<'_>,
    finish: Finish<'_>,
    output: &mut [f32],
) {
    assert!(
        panels.isa().is_available(),
        "{} is not to be had here",
        panels.isa()
    );
    let count = rows.count(panels.terms());
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
    // A single row meets a number only once, and needs as many sums under way as there are
    // registers.
    let (terms_at_once, panels_at_once) = if count == 1 {
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
        for panel in panels.groups(panels_at_once) {
            let column = place.first + panel.first;
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
                        Start::Bias(bias) => Begin::Bias(bias[column..].as_ptr()),
                    },
                    end: match finish {
                        _ if index < last_block => End::Plain,
                        Finish::Plain => End::Plain,
                        Finish::Rectified => End::Rectified,
                        Finish::Gated(by) => End::Gated(by[column..].as_ptr()),
                    },
                    output: output[column..].as_mut_ptr(),
                    output_starts: Starts::Even(place.stride),
                };
                // SAFETY: `check_lens` has seen to it that every row has all terms, bias, gate and
                // output all columns of all rows; `panels` was packed for its instructions, which
                // `Isa` has looked for.
                unsafe { do_work(panels.isa(), &work) };
            }
        }
    }
}

/// Looks at all lengths.
fn check_lens<T: Term>(
    rows: Rows<'_, T>,
    terms: usize,
    columns: usize,
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
            assert_eq!(
                image.len(),
                windows.image_len(),
                "the image the windows are of"
            );
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
        assert_eq!(bias.len(), columns, "a bias for each column");
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
