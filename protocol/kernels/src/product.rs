//! Rows times packed panels: every forward pass, and the gradient of a layer's input.

use std::cell::RefCell;

use crate::isa::Isa;
use crate::panel_work::{PanelWork, RowStarts, TERMS_AT_ONCE, do_panel};
use crate::panels::{Matrix, Panels};
use crate::tile::{Begin, End, MOST_ROWS, ROW_PANELS, Span};
use crate::windows::Windows;

/// Most rows that pass all panels before the next rows do, and most numbers in such rows: they stay
/// in the second-level cache meanwhile.
const ROWS_AT_ONCE: usize = 192;
const NUMBERS_AT_ONCE: usize = 80 << 10;

/// Left operand of a product: rows of numbers, read where they lie.
#[derive(Debug, Clone, Copy)]
pub enum Rows<'a> {
    /// Row-major matrix, `[rows, terms]`.
    Matrix(&'a [f32]),
    /// Contents of the windows on an image, one row each.
    Windows(&'a Windows, &'a [f32]),
}

/// Initial value of an element's sum.
#[derive(Debug, Clone, Copy)]
pub enum Start<'a> {
    /// Zero.
    Zero,
    /// Its column's bias, `[columns]`.
    Bias(&'a [f32]),
}

/// Last operation on a finished sum.
#[derive(Debug, Clone, Copy)]
pub enum Finish<'a> {
    /// None.
    Plain,
    /// ReLU: zero if the sum is below zero. NaN stays NaN.
    Rectified,
    /// Zero where this matrix, `[rows, columns]`, is not above zero: the gradient through a ReLU
    /// whose output it is.
    Gated(&'a [f32]),
}

/// Computes `output = finish(start + rows · panels)`, `[rows, columns]`; all matrices are
/// row-major.
///
/// Each element is the sum of its terms in order, each added by one fused multiply-add. The bits
/// depend neither on the instruction set nor on how rows are divided.
///
/// # Panics
/// If lengths do not match.
pub fn product(
    rows: Rows<'_>,
    panels: &Panels,
    start: Start<'_>,
    finish: Finish<'_>,
    output: &mut [f32],
) {
    let columns = panels.columns();
    check_lens(rows, panels.terms(), columns, start, finish, output.len());
    let place = OutputColumns {
        stride: columns,
        first: 0,
    };
    multiply(rows, panels, place, start, finish, output);
}

thread_local! {
    static PANEL: RefCell<Panels> = RefCell::new(Panels::new(Isa::Portable));
}

/// [`product`] with a right operand that is packed panel by panel, each just before its use.
///
/// For weights that change between any two products. Packed all at once, they would be written to
/// memory and read back.
///
/// # Panics
/// If lengths do not match.
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
            let place = OutputColumns {
                stride: columns,
                first: own.start,
            };
            multiply(rows, panels, place, start, finish, output);
        }
    });
}

/// Columns of the output that a product fills.
#[derive(Clone, Copy)]
struct OutputColumns {
    /// Columns of the whole output.
    stride: usize,
    /// The first column that is filled.
    first: usize,
}

/// Computes the product without checking lengths. Bias and gate are those of the whole output.
fn multiply(
    rows: Rows<'_>,
    panels: &Panels,
    place: OutputColumns,
    start: Start<'_>,
    finish: Finish<'_>,
    output: &mut [f32],
) {
    panels.isa().require();
    let count = rows.count(panels.terms());
    let single;
    let (data, starts, spans) = match rows {
        Rows::Matrix(data) => {
            single = [Span {
                offset: 0,
                len: panels.terms(),
            }];
            (data, RowStarts::Even(panels.terms()), &single[..])
        }
        Rows::Windows(windows, image) => {
            (image, RowStarts::Listed(windows.starts()), windows.spans())
        }
    };
    // A single row uses each number of the panels once, and needs as many sums in flight as there
    // are registers.
    let (terms_at_once, panels_at_once) = if count == 1 {
        (usize::MAX, ROW_PANELS)
    } else {
        (TERMS_AT_ONCE, 1)
    };
    let blocks = blocks(spans, terms_at_once);
    let last_block = blocks.len() - 1;
    let rows_at_once = match rows {
        Rows::Matrix(_) => (NUMBERS_AT_ONCE / panels.terms()).clamp(MOST_ROWS, ROWS_AT_ONCE),
        Rows::Windows(..) => ROWS_AT_ONCE,
    };
    for first in (0..count).step_by(rows_at_once) {
        for panel in panels.groups(panels_at_once) {
            let column = place.first + panel.first;
            for (index, block) in blocks.iter().enumerate() {
                let work = PanelWork {
                    left: data.as_ptr(),
                    starts,
                    first,
                    rows: (count - first).min(rows_at_once),
                    spans: &block.spans,
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
                    output_starts: RowStarts::Even(place.stride),
                };
                // SAFETY: `check_lens` has checked that every row has all terms, and that bias,
                // gate and output have all columns of all rows. The instructions that `panels` were
                // packed for are available, as required above.
                unsafe { do_panel(panels.isa(), &work) };
            }
        }
    }
}

/// Checks all lengths.
fn check_lens(
    rows: Rows<'_>,
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
            "{} numbers are not whole rows of {terms}",
            data.len()
        ),
        Rows::Windows(windows, image) => {
            windows.check_image(image);
            assert_eq!(windows.window_len(), terms, "a window has all terms");
        }
    }
    let count = rows.count(terms);
    assert_eq!(
        output,
        count * columns,
        "the output has {count} x {columns} elements"
    );
    if let Start::Bias(bias) = start {
        assert_eq!(bias.len(), columns, "a bias for each column");
    }
    if let Finish::Gated(by) = finish {
        assert_eq!(by.len(), output, "a gate for each element");
    }
}

impl Rows<'_> {
    /// Number of rows of `terms` terms.
    fn count(&self, terms: usize) -> usize {
        match self {
            Self::Matrix(data) => data.len() / terms,
            Self::Windows(windows, _) => windows.count(),
        }
    }
}

/// Consecutive terms of a product.
struct TermBlock {
    first_term: usize,
    spans: Vec<Span>,
}

/// Cuts the terms into blocks of at most `most`.
fn blocks(spans: &[Span], most: usize) -> Vec<TermBlock> {
    let mut blocks: Vec<TermBlock> = Vec::new();
    let (mut first_term, mut room) = (0, 0);
    for span in spans {
        let mut span = *span;
        while span.len > 0 {
            if room == 0 {
                room = most;
                let spans = Vec::new();
                blocks.push(TermBlock { first_term, spans });
            }
            let len = span.len.min(room);
            if let Some(block) = blocks.last_mut() {
                block.spans.push(Span { len, ..span });
            }
            span = Span {
                offset: span.offset + len,
                len: span.len - len,
            };
            first_term += len;
            room -= len;
        }
    }
    blocks
}
