//! The inner loop of every product: a tile of the output, held in registers from its first term to
//! its last.
//!
//! An element of the output is the sum of its terms in the order of k, each added by one fused
//! multiply-add. Neither the width of a register nor the size of a tile changes that, so all
//! instruction sets give the same bits.

use crate::isa::Simd;
use crate::panels::Panel;

/// Terms that lie side by side in the left operand.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Run {
    /// From where a row begins.
    pub(crate) offset: usize,
    /// How many.
    pub(crate) len: usize,
}

/// What an element's sum begins with.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Begin {
    /// Nothing.
    Zero,
    /// What is in the output.
    Output,
    /// The column's bias, at this pointer for the tile's first column.
    Bias(*const f32),
}

/// What becomes of a finished sum.
#[derive(Debug, Clone, Copy)]
pub(crate) enum End {
    /// Nothing.
    Plain,
    /// Zero if it is below zero.
    Rectified,
    /// Zero where this matrix, laid out as the output and pointed at where the tile begins, is not
    /// above zero.
    Gated(*const f32),
}

/// How a tile reads the left operand.
pub(crate) trait LeftTile<T>: Copy {
    /// Term `k` of the run that begins at `offset`, in this row.
    ///
    /// # Safety
    /// The term exists.
    unsafe fn term(self, row: usize, offset: usize, k: usize) -> *const T;
}

/// Rows where they lie, each at a place of its own, terms of a run side by side.
#[derive(Clone, Copy)]
pub(crate) struct InPlace<T, const M: usize>(pub(crate) [*const T; M]);

impl<T: Copy, const M: usize> LeftTile<T> for InPlace<T, M> {
    #[inline(always)]
    unsafe fn term(self, row: usize, offset: usize, k: usize) -> *const T {
        // SAFETY: as the caller says.
        unsafe { self.0[row].add(offset + k) }
    }
}

/// Rows packed together: term by term, `stride` rows each.
#[derive(Clone, Copy)]
pub(crate) struct Packed {
    pub(crate) data: *const f32,
    pub(crate) stride: usize,
}

impl LeftTile<f32> for Packed {
    #[inline(always)]
    unsafe fn term(self, row: usize, offset: usize, k: usize) -> *const f32 {
        // SAFETY: as the caller says.
        unsafe { self.data.add((offset + k) * self.stride + row) }
    }
}

/// The place of a tile in the output.
#[derive(Clone, Copy)]
pub(crate) struct Output<const M: usize> {
    pub(crate) data: *mut f32,
    /// Where each row begins.
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

/// Full panels that a single row meets at once: eight sums under way hide that each term of one
/// waits for the one before.
pub(crate) const ROW_PANELS: usize = 4;

/// The tallest tile of any instruction set, and its columns.
pub(crate) const MOST_ROWS: usize = 12;
const MOST_COLUMNS: usize = 32;

/// Calls a function that is generic over instruction set and height with the height that is only
/// known now. No tile is made that the instruction set has no registers for: the guards are decided
/// when the code is compiled.
macro_rules! of_height {
    ($simd:ident, $rows:expr, $function:ident($($argument:expr),*)) => {
        of_height!(@ $simd, $rows, $function ($($argument),*) 1 2 3 4 5 6 7 8 9 10 11 12)
    };
    (@ $simd:ident, $rows:expr, $function:ident $arguments:tt $($height:literal)*) => {
        match $rows {
            $($height if $height <= $simd::ROWS => of_height!(# $function, $simd, $height, $arguments),)*
            _ => unreachable!("a tile has 1 to {} rows", $simd::ROWS),
        }
    };
    (# $function:ident, $simd:ident, $height:literal, ($($argument:expr),*)) => {
        $function::<$simd, $height>($($argument),*)
    };
}
pub(crate) use of_height;

/// A tile under `panel`, which may have fewer columns than it lays out.
///
/// # Safety
/// As for [`tile`], but that output, bias and gate need only have the columns that there are.
#[inline(always)]
pub(crate) unsafe fn panel_tile<S: Simd, L: LeftTile<S::Term>, const M: usize>(
    left: L,
    runs: &[Run],
    right: *const S::Term,
    panel: Panel,
    begin: Begin,
    end: End,
    output: Output<M>,
) {
    // SAFETY: as the caller says; where columns are missing, the tile works on memory of its own,
    // which has them all.
    unsafe {
        if panel.columns == panel.width {
            return if panel.width == S::LANES {
                tile::<S, L, M, 1>(left, runs, right, panel.width, begin, end, output)
            } else {
                tile::<S, L, M, 2>(left, runs, right, panel.width, begin, end, output)
            };
        }
        let mut whole = [0.0; MOST_ROWS * MOST_COLUMNS];
        let aside = Output::<M>::even(whole.as_mut_ptr(), panel.width);
        let row_of = |row: usize| output.data.add(output.rows[row]);
        let begin = match begin {
            Begin::Zero => Begin::Zero,
            Begin::Output => {
                for row in 0..M {
                    aside
                        .data
                        .add(aside.rows[row])
                        .copy_from(row_of(row), panel.columns);
                }
                Begin::Output
            }
            Begin::Bias(bias) => {
                for row in 0..M {
                    aside
                        .data
                        .add(aside.rows[row])
                        .copy_from(bias, panel.columns);
                }
                Begin::Output
            }
        };
        let (inner, gate) = match end {
            End::Gated(by) => (End::Plain, Some(by)),
            end => (end, None),
        };
        if panel.width == S::LANES {
            tile::<S, L, M, 1>(left, runs, right, panel.width, begin, inner, aside);
        } else {
            tile::<S, L, M, 2>(left, runs, right, panel.width, begin, inner, aside);
        }
        for row in 0..M {
            for column in 0..panel.columns {
                let open = gate.is_none_or(|by| *by.add(output.rows[row] + column) > 0.0);
                *row_of(row).add(column) = if open {
                    *aside.data.add(aside.rows[row] + column)
                } else {
                    0.0
                };
            }
        }
    }
}

/// A tile of `M` rows and `N` registers: output = end(begin + left · panel).
///
/// # Safety
/// `S`'s instructions are there. The left tile has `M` rows with all terms of `runs`; `panel` has
/// as many rows of `panel_width` numbers as the runs have terms; `output`, a bias and a gate have
/// `M` rows (a bias one) of `N · LANES` numbers. Nothing else touches the output meanwhile.
#[inline(always)]
pub(crate) unsafe fn tile<S: Simd, L: LeftTile<S::Term>, const M: usize, const N: usize>(
    left: L,
    runs: &[Run],
    panel: *const S::Term,
    panel_width: usize,
    begin: Begin,
    end: End,
    output: Output<M>,
) {
    // SAFETY: all pointers are offset within what the caller vouches for.
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
        for run in runs {
            for k in 0..run.len {
                let mut parts = [S::zero(); N];
                for (part, value) in parts.iter_mut().enumerate() {
                    *value = S::load_terms(right.add(part * S::LANES));
                }
                for (row, sums) in sums.iter_mut().enumerate() {
                    let term = S::splat(*left.term(row, run.offset, k));
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

/// Asks for the memory that a tile ends at, when it begins: it has often left the nearer caches,
/// and would be waited for when the sums are done.
#[inline(always)]
unsafe fn fetch_ahead<S: Simd, const M: usize, const N: usize>(end: End, output: Output<M>) {
    let places = |from: *const f32| {
        (0..M * N)
            .map(move |place| from.wrapping_add(output.rows[place / N] + place % N * S::LANES))
    };
    // SAFETY: any address may be asked for.
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

/// Stores finished sums, each as `finish` makes it of the sum and its place.
///
/// One short loop for each way to finish: in a long one, which the compiler does not unroll, the
/// sums would be indexed, and so live in memory from the first term on.
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

/// One row under [`ROW_PANELS`] full panels, `output` as wide as all of them.
///
/// # Safety
/// As for [`tile`].
#[inline(always)]
pub(crate) unsafe fn row_of_panels<S: Simd>(
    left: *const S::Term,
    runs: &[Run],
    panels: [*const S::Term; ROW_PANELS],
    begin: Begin,
    end: End,
    output: *mut f32,
) {
    // SAFETY: all pointers are offset within what the caller vouches for.
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
        for run in runs {
            for k in 0..run.len {
                let term = S::splat(*left.add(run.offset + k));
                for (panel, sums) in panels.iter().zip(&mut sums) {
                    for (part, sum) in sums.iter_mut().enumerate() {
                        *sum = S::fused(
                            term,
                            S::load_terms(panel.add(passed + part * S::LANES)),
                            *sum,
                        );
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
