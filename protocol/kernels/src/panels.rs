//! The right operand of a product, packed so that the inner loop reads it from the first byte to
//! the last.
//!
//! Columns are gathered in panels as wide as a tile, and each panel is laid out term by term.
//! Unpacked, a matrix whose rows are a power of two apart would fall into a few sets of the cache.

use std::ops::Range;

use crate::isa::Isa;

/// Matrix seen in either direction: element (row, column) lies at `row · row_stride + column ·
/// column_stride`.
#[derive(Debug, Clone, Copy)]
pub struct Matrix<'a> {
    data: &'a [f32],
    rows: usize,
    columns: usize,
    row_stride: usize,
    column_stride: usize,
}

impl<'a> Matrix<'a> {
    /// `data` as rows of `columns` numbers.
    ///
    /// # Panics
    /// If `data` is not whole rows.
    pub fn of_rows(data: &'a [f32], columns: usize) -> Self {
        assert!(
            columns > 0 && data.len().is_multiple_of(columns),
            "{} numbers are not whole rows of {columns}",
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

    /// The transposed matrix.
    pub fn transposed(self) -> Self {
        Self {
            rows: self.columns,
            columns: self.rows,
            row_stride: self.column_stride,
            column_stride: self.row_stride,
            ..self
        }
    }

    /// The matrix of these columns.
    ///
    /// # Panics
    /// If the matrix has fewer columns.
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

    /// A row whose columns lie side by side.
    ///
    /// # Panics
    /// If they do not, or the matrix has no such row.
    pub(crate) fn row(&self, row: usize) -> &'a [f32] {
        assert_eq!(self.column_stride, 1, "a matrix seen along its rows");
        &self.data[row * self.row_stride..][..self.columns]
    }

    /// Number of rows.
    pub(crate) fn rows(&self) -> usize {
        self.rows
    }

    /// Number of columns.
    pub(crate) fn columns(&self) -> usize {
        self.columns
    }
}

/// Numbers in a cache line.
const LINE: usize = 16;

/// Numbers that fill a cache line.
#[derive(Debug, Clone, Copy)]
#[repr(C, align(64))]
struct CacheLine([f32; LINE]);

/// Memory that starts at a cache line and is kept from use to use.
#[derive(Debug, Default)]
pub(crate) struct Aligned {
    lines: Vec<CacheLine>,
}

impl Aligned {
    /// Returns `len` numbers of unspecified value.
    pub(crate) fn of_len(&mut self, len: usize) -> &mut [f32] {
        let lines = len.div_ceil(LINE);
        if self.lines.len() < lines {
            self.lines.resize(lines, CacheLine([0.0; LINE]));
        }
        // SAFETY: a line consists of sixteen numbers, so `lines` of them are at least `len` numbers
        // side by side, borrowed from `self`.
        unsafe { std::slice::from_raw_parts_mut(self.lines.as_mut_ptr().cast(), len) }
    }

    fn as_ptr(&self) -> *const f32 {
        self.lines.as_ptr().cast()
    }
}

/// Packed right operand of a product: [`Panels::terms`] rows, [`Panels::columns`] columns.
#[derive(Debug)]
pub struct Panels {
    isa: Isa,
    terms: usize,
    columns: usize,
    data: Aligned,
}

/// One panel, or full ones side by side.
#[derive(Clone, Copy)]
pub(crate) struct Panel {
    /// The first column.
    pub(crate) first: usize,
    /// Columns that exist.
    pub(crate) columns: usize,
    /// Columns in memory, a multiple of a register; those behind the last one hold zeros.
    pub(crate) width: usize,
}

impl Panels {
    /// Empty panels for products with these instructions.
    pub fn new(isa: Isa) -> Self {
        Self {
            isa,
            terms: 0,
            columns: 0,
            data: Aligned::default(),
        }
    }

    /// Packs a matrix, `[terms, columns]`; memory is reused.
    pub fn pack(&mut self, matrix: Matrix<'_>) {
        (self.terms, self.columns) = (matrix.rows, matrix.columns);
        let (isa, terms) = (self.isa, self.terms);
        let data = self.data.of_len(padded(isa, matrix.columns) * terms);
        for panel in panels(isa, matrix.columns) {
            let into = &mut data[panel.first * terms..][..panel.width * terms];
            pack_panel(isa, matrix, panel, into);
        }
    }

    /// [`Panels::pack`] for products with other instructions.
    pub(crate) fn repack(&mut self, isa: Isa, matrix: Matrix<'_>) {
        self.isa = isa;
        self.pack(matrix);
    }

    /// Panels that hold this matrix, `[terms, columns]`.
    pub fn of(isa: Isa, matrix: Matrix<'_>) -> Self {
        let mut panels = Self::new(isa);
        panels.pack(matrix);
        panels
    }

    /// Terms of each sum.
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

    /// The panels: groups of `size` full ones first, then the rest one by one.
    pub(crate) fn groups(&self, size: usize) -> impl Iterator<Item = Panel> + use<> {
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

    /// Address of `panel` at `term`.
    pub(crate) fn at(&self, panel: Panel, term: usize) -> *const f32 {
        debug_assert!(term < self.terms.max(1));
        // Inside the allocation: `pack` has laid out all terms of all panels. Of grouped panels
        // only term 0 is asked for.
        self.data
            .as_ptr()
            .wrapping_add(panel.first * self.terms + term * panel.width)
    }
}

/// The panels of `columns` columns.
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

/// Columns in memory, with those behind the last one.
fn padded(isa: Isa, columns: usize) -> usize {
    panels(isa, columns)
        .last()
        .map_or(0, |last| last.first + last.width)
}

fn pack_panel(isa: Isa, matrix: Matrix<'_>, panel: Panel, into: &mut [f32]) {
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
            row[panel.columns..].fill(0.0);
        }
        return;
    }
    // The numbers of a column lie side by side. Eight columns at a time, so that cache lines are
    // written whole.
    for first in (0..panel.width).step_by(EIGHT) {
        let columns = panel.columns.saturating_sub(first).min(EIGHT);
        let column = |index: usize| &data[(panel.first + first + index) * column_stride..];
        if columns == EIGHT && row_stride == 1 {
            let columns = std::array::from_fn(|index| &column(index)[..matrix.rows]);
            interleave(isa, columns, into, first, panel.width);
            continue;
        }
        for (term, row) in into.chunks_exact_mut(panel.width).enumerate() {
            let row = &mut row[first..first + EIGHT];
            for (index, number) in row.iter_mut().enumerate() {
                *number = if index < columns {
                    column(index)[term * row_stride]
                } else {
                    0.0
                };
            }
        }
    }
}

/// Columns that are interleaved at a time; a panel's width is a multiple of it.
const EIGHT: usize = 8;

/// Writes eight columns of equal length side by side into the rows of `into`, from its column
/// `first` on.
fn interleave(isa: Isa, columns: [&[f32]; EIGHT], into: &mut [f32], first: usize, width: usize) {
    let terms = columns[0].len();
    assert!(
        columns.iter().all(|column| column.len() == terms),
        "columns of equal length"
    );
    assert!(
        into.len() == terms * width && first + EIGHT <= width,
        "a row for each term"
    );
    let mut done = 0;
    #[cfg(target_arch = "x86_64")]
    if isa >= Isa::Avx2 && isa.is_available() {
        done = terms / EIGHT * EIGHT;
        // SAFETY: the instructions are available. Each column has `terms` numbers and `into` has as
        // many rows, as asserted above.
        unsafe {
            let columns = columns.map(<[f32]>::as_ptr);
            crate::isa::x86::interleave(columns, done, into[first..].as_mut_ptr(), width);
        }
    }
    let _ = isa;
    for term in done..terms {
        for (index, column) in columns.iter().enumerate() {
            into[term * width + first + index] = column[term];
        }
    }
}
