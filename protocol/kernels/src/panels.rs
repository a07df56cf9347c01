//! The right operand of a product, packed so that the inner loop reads it from the first byte to
//! the last.
//!
//! Columns are gathered in panels as wide as a tile, and each panel is laid out term by term. Left
//! where it lies, a matrix whose rows are a power of two apart would fall into a few sets of the
//! cache.

use std::ops::Range;

use crate::isa::Isa;
use crate::pair::Term;

/// A matrix seen in either direction: element (row, column) lies at `row · row_stride + column ·
/// column_stride`.
#[derive(Debug, Clone, Copy)]
pub struct Matrix<'a, T = f32> {
    data: &'a [T],
    rows: usize,
    columns: usize,
    row_stride: usize,
    column_stride: usize,
}

impl<'a, T> Matrix<'a, T> {
    /// `data` as rows of `columns` numbers.
    ///
    /// # Panics
    /// When there are no whole rows.
    pub fn of_rows(data: &'a [T], columns: usize) -> Self {
        assert!(
            columns > 0 && data.len().is_multiple_of(columns),
            "{} numbers are no rows of {columns}",
            data.len()
        );
        Self {
            data,
            rows: data.len() / columns,
            columns,
            row_stride: columns,
            column_stride: 1,
        }
    }

    /// Rows and columns exchanged.
    pub fn transposed(self) -> Self {
        Self {
            rows: self.columns,
            columns: self.rows,
            row_stride: self.column_stride,
            column_stride: self.row_stride,
            ..self
        }
    }

    /// These columns alone.
    ///
    /// # Panics
    /// When there are not so many.
    pub fn columns_of(self, columns: Range<usize>) -> Self {
        assert!(
            columns.end <= self.columns,
            "columns {columns:?} of {}",
            self.columns
        );
        Self {
            data: &self.data[columns.start * self.column_stride..],
            columns: columns.len(),
            ..self
        }
    }

    /// A row, whose columns lie side by side.
    ///
    /// # Panics
    /// When they do not, or there is no such row.
    pub(crate) fn row(&self, row: usize) -> &'a [T] {
        assert_eq!(self.column_stride, 1, "a matrix seen along its rows");
        &self.data[row * self.row_stride..][..self.columns]
    }

    /// Number of rows.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Number of columns.
    pub fn columns(&self) -> usize {
        self.columns
    }
}

/// Numbers in a cache line.
const LINE: usize = 16;

/// Numbers that begin where a cache line does.
#[derive(Debug, Clone, Copy)]
#[repr(C, align(64))]
struct Line<T>([T; LINE]);

/// Memory for numbers or pairs, from the beginning of a cache line; kept from use to use.
#[derive(Debug, Default)]
pub(crate) struct Aligned<T> {
    lines: Vec<Line<T>>,
}

impl<T: Term> Aligned<T> {
    /// `len` numbers, whatever they are.
    pub(crate) fn of_len(&mut self, len: usize) -> &mut [T] {
        let lines = len.div_ceil(LINE);
        if self.lines.len() < lines {
            self.lines.resize(lines, Line([T::default(); LINE]));
        }
        // SAFETY: a line is sixteen numbers and nothing else, so `lines` of them are at least `len`
        // numbers side by side, borrowed from `self`.
        unsafe { std::slice::from_raw_parts_mut(self.lines.as_mut_ptr().cast(), len) }
    }

    fn as_ptr(&self) -> *const T {
        self.lines.as_ptr().cast()
    }
}

/// A packed right operand: [`Panels::terms`] rows, [`Panels::columns`] columns.
#[derive(Debug)]
pub struct Panels<T = f32> {
    isa: Isa,
    terms: usize,
    columns: usize,
    data: Aligned<T>,
}

/// One panel.
#[derive(Clone, Copy)]
pub(crate) struct Panel {
    /// The first column.
    pub(crate) first: usize,
    /// Columns that there are.
    pub(crate) columns: usize,
    /// Columns that are laid out, those behind the last one as noughts: one register or two.
    pub(crate) width: usize,
}

impl<T: Term> Panels<T> {
    /// Nothing yet, for products with these instructions.
    pub fn new(isa: Isa) -> Self {
        Self {
            isa,
            terms: 0,
            columns: 0,
            data: Aligned::default(),
        }
    }

    /// Takes over a matrix of terms by columns; memory is used again.
    pub fn pack(&mut self, matrix: Matrix<'_, T>) {
        (self.terms, self.columns) = (matrix.rows, matrix.columns);
        let (isa, terms) = (self.isa, self.terms);
        let data = self.data.of_len(padded(isa, matrix.columns) * terms);
        for panel in panels(isa, matrix.columns) {
            let into = &mut data[panel.first * terms..][..panel.width * terms];
            pack_panel(isa, matrix, panel, into);
        }
    }

    /// [`Panels::pack`] for products with other instructions.
    pub(crate) fn repack(&mut self, isa: Isa, matrix: Matrix<'_, T>) {
        self.isa = isa;
        self.pack(matrix);
    }

    /// [`Panels::new`] and [`Panels::pack`].
    pub fn of(isa: Isa, matrix: Matrix<'_, T>) -> Self {
        let mut panels = Self::new(isa);
        panels.pack(matrix);
        panels
    }

    /// Length of the sums.
    pub fn terms(&self) -> usize {
        self.terms
    }

    /// Columns of the product.
    pub fn columns(&self) -> usize {
        self.columns
    }

    pub(crate) fn isa(&self) -> Isa {
        self.isa
    }

    /// The panels, as many full ones at a time as asked for while there are.
    pub(crate) fn groups(&self, size: usize) -> impl Iterator<Item = Panel> + use<T> {
        let group = size * self.isa.panel_width();
        let grouped = self.columns / group * group;
        let groups = (0..grouped).step_by(group).map(move |first| Panel {
            first,
            columns: group,
            width: group,
        });
        let rest = panels(self.isa, self.columns - grouped);
        groups.chain(rest.map(move |panel| Panel {
            first: grouped + panel.first,
            ..panel
        }))
    }

    /// Where `panel` begins at `term`.
    pub(crate) fn at(&self, panel: Panel, term: usize) -> *const T {
        debug_assert!(term < self.terms.max(1));
        // Inside the allocation: `pack` has laid out all terms of all panels. Of several panels at
        // once all terms are taken.
        self.data
            .as_ptr()
            .wrapping_add(panel.first * self.terms + term * panel.width)
    }
}

/// The panels of so many columns.
pub(crate) fn panels(isa: Isa, columns: usize) -> impl Iterator<Item = Panel> + use<> {
    let full = isa.panel_width();
    (0..columns).step_by(full).map(move |first| {
        let columns = (columns - first).min(full);
        Panel {
            first,
            columns,
            // A register is half a panel.
            width: if columns <= full / 2 { full / 2 } else { full },
        }
    })
}

/// Columns with those laid out behind the last one.
fn padded(isa: Isa, columns: usize) -> usize {
    panels(isa, columns)
        .last()
        .map_or(0, |last| last.first + last.width)
}

fn pack_panel<T: Term>(isa: Isa, matrix: Matrix<'_, T>, panel: Panel, into: &mut [T]) {
    let Matrix {
        data,
        row_stride,
        column_stride,
        ..
    } = matrix;
    if column_stride == 1 {
        for (term, row) in into.chunks_exact_mut(panel.width).enumerate() {
            let from = &data[term * row_stride + panel.first..][..panel.columns];
            row[..panel.columns].copy_from_slice(from);
            row[panel.columns..].fill(T::default());
        }
        return;
    }
    // Along the columns, which lie side by side when the matrix is seen transposed; eight at a
    // time, so that lines are written whole.
    for first in (0..panel.width).step_by(EIGHT) {
        let columns = panel.columns.saturating_sub(first).min(EIGHT);
        let column = |index: usize| &data[(panel.first + first + index) * column_stride..];
        if columns == EIGHT && row_stride == 1 {
            let columns: [&[T]; EIGHT] = std::array::from_fn(|index| &column(index)[..matrix.rows]);
            interleave(isa, columns, into, first, panel.width);
            continue;
        }
        for (term, row) in into.chunks_exact_mut(panel.width).enumerate() {
            let row = &mut row[first..first + EIGHT];
            for (index, number) in row.iter_mut().enumerate() {
                *number = if index < columns {
                    column(index)[term * row_stride]
                } else {
                    T::default()
                };
            }
        }
    }
}

/// Columns that are interleaved at a time; a panel's width is a multiple of it.
const EIGHT: usize = 8;

/// Writes the numbers of eight columns, all of one length, side by side into the rows of `into`,
/// from its column `first` on.
fn interleave<T: Term>(
    isa: Isa,
    columns: [&[T]; EIGHT],
    into: &mut [T],
    first: usize,
    width: usize,
) {
    const { assert!(size_of::<T>() == 4, "pairs are moved as numbers are") };
    let terms = columns[0].len();
    assert!(
        columns.iter().all(|column| column.len() == terms),
        "columns of one length"
    );
    assert!(
        into.len() == terms * width && first + EIGHT <= width,
        "a row for each term"
    );
    let mut done = 0;
    #[cfg(target_arch = "x86_64")]
    if isa >= Isa::Avx2 && isa.is_available() {
        done = terms / EIGHT * EIGHT;
        // SAFETY: the instructions are there, as just asked; so are `terms` numbers of each column
        // and as many rows, as asserted above.
        unsafe {
            let columns = columns.map(|column| column.as_ptr().cast());
            crate::isa::x86::interleave(columns, done, into[first..].as_mut_ptr().cast(), width);
        }
    }
    let _ = isa;
    for term in done..terms {
        for (index, column) in columns.iter().enumerate() {
            into[term * width + first + index] = column[term];
        }
    }
}
