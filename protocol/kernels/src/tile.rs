//! The inner loop of every product: a tile of the output that stays in registers from its first
//! term to its last.
//!
//! An element of the output is the sum of its terms in the order of k, each added by one fused
//! multiply-add. Neither the width of a register nor the size of a tile changes that, so all
//! instruction sets give the same bits.

use crate::isa::Simd;
use crate::panels::Panel;

/// Terms that lie side by side in the left operand.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Span {
    /// Distance of the first term from the beginning of its row.
    pub(crate) offset: usize,
    /// Number of terms.
    pub(crate) len: usize,
}

/// Initial value of an element's sum.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Begin {
    /// Zero.
    Zero,
    /// The output's present content.
    Output,
    /// The column's bias; the pointer is to that of the tile's first column.
    Bias(*const f32),
}

/// Last operation on a finished sum.
#[derive(Debug, Clone, Copy)]
pub(crate) enum End {
    /// None.
    Plain,
    /// max(0, sum).
    Rectified,
    /// Zero where this matrix is not above zero. It is laid out as the output is; the pointer is to
    /// the tile's first element.
    Gated(*const f32),
}

/// Rows of the left operand that a tile reads.
pub(crate) trait LeftTile: Copy {
    /// Returns the address of term `k` of the span that begins at `offset`, in this row.
    ///
    /// # Safety
    /// The term exists.
    unsafe fn term(self, row: usize, offset: usize, k: usize) -> *const f32;
}

/// Rows read where they lie: any address for each, the terms of a span side by side.
#[derive(Clone, Copy)]
pub(crate) struct InPlace<const M: usize>(pub(crate) [*const f32; M]);

impl<const M: usize> LeftTile for InPlace<M> {
    #[inline(always)]
    unsafe fn term(self, row: usize, offset: usize, k: usize) -> *const f32 {
        // SAFETY: guaranteed by the caller.
        unsafe { self.0[row].add(offset + k) }
    }
}

/// Rows packed together: term by term, `stride` rows each.
#[derive(Clone, Copy)]
pub(crate) struct Packed {
    pub(crate) data: *const f32,
    pub(crate) stride: usize,
}

impl LeftTile for Packed {
    #[inline(always)]
    unsafe fn term(self, row: usize, offset: usize, k: usize) -> *const f32 {
        // SAFETY: guaranteed by the caller.
        unsafe { self.data.add((offset + k) * self.stride + row) }
    }
}

/// Position of a tile in the output.
#[derive(Clone, Copy)]
pub(crate) struct Output<const M: usize> {
    pub(crate) data: *mut f32,
    /// Offset of each row.
    pub(crate) rows: [usize; M],
}

impl<const M: usize> Output<M> {
    /// Rows that begin `stride` numbers apart.
    #[inline(always)]
    pub(crate) fn even(data: *mut f32, stride: usize) -> Self {
        let rows = std::array::from_fn(|row| row * stride);
        Self { data, rows }
    }
}

/// Full panels that a single row is multiplied with at once. Each fused multiply-add waits for the
/// one before in its sum; eight sums in flight hide that.
pub(crate) const ROW_PANELS: usize = 4;

/// Rows and columns of the largest tile of any instruction set.
pub(crate) const MOST_ROWS: usize = 12;
const MOST_COLUMNS: usize = 32;

/// Calls a function that is generic over instruction set and height with a height known at run
/// time.
///
/// The guards are constants, so no tile is compiled that the registers cannot hold. Tiles below the
/// full height, which only the last rows need, are functions of their own: one function of all
/// tiles takes the compiler three times as long.
macro_rules! of_height {
    ($simd:ident, $rows:expr, $function:ident($($argument:expr),*)) => {
        of_height!(@ $simd, $rows, $function ($($argument),*) 1 2 3 4 5 6 7 8 9 10 11 12)
    };
    (@ $simd:ident, $rows:expr, $function:ident $arguments:tt $($height:literal)*) => {
        match $rows {
            $($height if $height == $simd::ROWS => {
                of_height!(# $function, $simd, $height, $arguments)
            })*
            $($height if $height < $simd::ROWS => $simd::outlined(
                #[inline(always)]
                || of_height!(# $function, $simd, $height, $arguments),
            ),)*
            _ => unreachable!("a tile has 1 to {} rows", $simd::ROWS),
        }
    };
    (# $function:ident, $simd:ident, $height:literal, ($($argument:expr),*)) => {
        $function::<$simd, $height>($($argument),*)
    };
}
pub(crate) use of_height;

/// Computes a tile of a panel that may be partly filled.
///
/// # Safety
/// As for [`tile`], but output, bias and gate need only have the columns that exist.
#[inline(always)]
pub(crate) unsafe fn panel_tile<S: Simd, L: LeftTile, const M: usize>(
    left: L,
    spans: &[Span],
    right: *const f32,
    panel: Panel,
    begin: Begin,
    end: End,
    output: Output<M>,
) {
    // SAFETY: guaranteed by the caller. Where columns are missing, the tile works on a copy that
    // has them all.
    unsafe {
        let mut whole;
        let is_whole = panel.columns == panel.width;
        let (tile_begin, tile_end, tile_output) = if is_whole {
            (begin, end, output)
        } else {
            whole = [0.0; MOST_ROWS * MOST_COLUMNS];
            let aside = Output::<M>::even(whole.as_mut_ptr(), panel.width);
            let begin = copy_in(begin, panel.columns, output, aside);
            let end = match end {
                End::Gated(_) => End::Plain,
                end => end,
            };
            (begin, end, aside)
        };
        let width = panel.width;
        if width == S::LANES {
            tile::<S, L, M, 1>(left, spans, right, width, tile_begin, tile_end, tile_output);
        } else {
            tile::<S, L, M, 2>(left, spans, right, width, tile_begin, tile_end, tile_output);
        }
        if !is_whole {
            copy_out(tile_output, panel.columns, end, output);
        }
    }
}

/// Copies a tile's initial values to memory that has all columns, and returns how the tile begins
/// there.
#[inline(always)]
unsafe fn copy_in<const M: usize>(
    begin: Begin,
    columns: usize,
    output: Output<M>,
    aside: Output<M>,
) -> Begin {
    for row in 0..M {
        // SAFETY: guaranteed by the caller of `panel_tile`.
        unsafe {
            let from = match begin {
                Begin::Zero => return Begin::Zero,
                Begin::Output => output.data.add(output.rows[row]).cast_const(),
                Begin::Bias(bias) => bias,
            };
            aside.data.add(aside.rows[row]).copy_from(from, columns);
        }
    }
    Begin::Output
}

/// Copies a finished tile's columns to the output, through its gate if it has one.
#[inline(always)]
unsafe fn copy_out<const M: usize>(aside: Output<M>, columns: usize, end: End, output: Output<M>) {
    for row in 0..M {
        for column in 0..columns {
            let at = output.rows[row] + column;
            // SAFETY: guaranteed by the caller of `panel_tile`.
            unsafe {
                let open = match end {
                    End::Gated(by) => *by.add(at) > 0.0,
                    End::Plain | End::Rectified => true,
                };
                *output.data.add(at) = if open {
                    *aside.data.add(aside.rows[row] + column)
                } else {
                    0.0
                };
            }
        }
    }
}

/// Computes a tile of `M` rows and `N` registers: output = end(begin + left · panel).
///
/// # Safety
/// The processor has the instructions of `S`. The left tile has `M` rows with all terms of `spans`;
/// `panel` has as many rows of `panel_width` numbers as the spans have terms. Output and gate have
/// `M` rows of `N · LANES` numbers, a bias has one. Nothing else accesses the output meanwhile.
#[inline(always)]
unsafe fn tile<S: Simd, L: LeftTile, const M: usize, const N: usize>(
    left: L,
    spans: &[Span],
    panel: *const f32,
    panel_width: usize,
    begin: Begin,
    end: End,
    output: Output<M>,
) {
    // SAFETY: all addresses are within what the caller guarantees.
    unsafe {
        fetch_ahead::<S, M, N>(end, output);
        let mut sums = [[S::zero(); N]; M];
        match begin {
            Begin::Zero => {}
            Begin::Output => {
                for (row, sums) in sums.iter_mut().enumerate() {
                    for (part, sum) in sums.iter_mut().enumerate() {
                        *sum = S::load(output.data.add(output.rows[row] + part * S::LANES));
                    }
                }
            }
            Begin::Bias(bias) => {
                for sums in &mut sums {
                    for (part, sum) in sums.iter_mut().enumerate() {
                        *sum = S::load(bias.add(part * S::LANES));
                    }
                }
            }
        }
        let mut right = panel;
        for span in spans {
            for k in 0..span.len {
                let mut parts = [S::zero(); N];
                for (part, value) in parts.iter_mut().enumerate() {
                    *value = S::load(right.add(part * S::LANES));
                }
                for (row, sums) in sums.iter_mut().enumerate() {
                    let term = S::splat(*left.term(row, span.offset, k));
                    for (sum, part) in sums.iter_mut().zip(parts) {
                        *sum = S::fused(term, part, *sum);
                    }
                }
                right = right.add(panel_width);
            }
        }
        match end {
            End::Plain => put::<S, M, N>(
                sums,
                output,
                #[inline(always)]
                |sum, _| sum,
            ),
            End::Rectified => put::<S, M, N>(
                sums,
                output,
                #[inline(always)]
                |sum, _| S::rectified(sum),
            ),
            End::Gated(by) => put::<S, M, N>(
                sums,
                output,
                #[inline(always)]
                |sum, at| S::gated(sum, S::load(by.add(at))),
            ),
        }
    }
}

/// Prefetches the memory that the finished tile needs. It has often left the nearer caches, and the
/// processor would wait for it at the end.
#[inline(always)]
unsafe fn fetch_ahead<S: Simd, const M: usize, const N: usize>(end: End, output: Output<M>) {
    let places = |from: *const f32| {
        (0..M * N)
            .map(move |place| from.wrapping_add(output.rows[place / N] + place % N * S::LANES))
    };
    // SAFETY: a prefetch accepts any address.
    unsafe {
        places(output.data).for_each(
            #[inline(always)]
            |place| S::fetch(place),
        );
        if let End::Gated(by) = end {
            places(by).for_each(
                #[inline(always)]
                |place| S::fetch(place),
            );
        }
    }
}

/// Stores finished sums. `finish` receives a sum and its offset, and returns the number to store.
///
/// Each way to finish has a short loop of its own: a long loop is not unrolled, and sums that it
/// indexes would live in memory from the first term on.
#[inline(always)]
unsafe fn put<S: Simd, const M: usize, const N: usize>(
    sums: [[S::Vector; N]; M],
    output: Output<M>,
    finish: impl Fn(S::Vector, usize) -> S::Vector,
) {
    for (row, sums) in sums.into_iter().enumerate() {
        for (part, sum) in sums.into_iter().enumerate() {
            let at = output.rows[row] + part * S::LANES;
            // SAFETY: the output has a place for each sum.
            unsafe { S::store(output.data.add(at), finish(sum, at)) };
        }
    }
}

/// Computes one row below [`ROW_PANELS`] full panels; `output` is as wide as all of them.
///
/// # Safety
/// As for [`tile`].
#[inline(always)]
pub(crate) unsafe fn row_of_panels<S: Simd>(
    left: *const f32,
    spans: &[Span],
    panels: [*const f32; ROW_PANELS],
    begin: Begin,
    end: End,
    output: *mut f32,
) {
    // SAFETY: all addresses are within what the caller guarantees.
    unsafe {
        let mut sums = [[S::zero(); 2]; ROW_PANELS];
        let at = |panel: usize, part: usize| (2 * panel + part) * S::LANES;
        for (panel, sums) in sums.iter_mut().enumerate() {
            for (part, sum) in sums.iter_mut().enumerate() {
                match begin {
                    Begin::Zero => {}
                    Begin::Output => *sum = S::load(output.add(at(panel, part))),
                    Begin::Bias(bias) => *sum = S::load(bias.add(at(panel, part))),
                }
            }
        }
        let mut passed = 0;
        for span in spans {
            for k in 0..span.len {
                let term = S::splat(*left.add(span.offset + k));
                for (panel, sums) in panels.iter().zip(&mut sums) {
                    for (part, sum) in sums.iter_mut().enumerate() {
                        let right = S::load(panel.add(passed + part * S::LANES));
                        *sum = S::fused(term, right, *sum);
                    }
                }
                passed += 2 * S::LANES;
            }
        }
        for (panel, sums) in sums.iter().enumerate() {
            for (part, sum) in sums.iter().enumerate() {
                let value = match end {
                    End::Plain => *sum,
                    End::Rectified => S::rectified(*sum),
                    End::Gated(by) => S::gated(*sum, S::load(by.add(at(panel, part)))),
                };
                S::store(output.add(at(panel, part)), value);
            }
        }
    }
}
