//! The unit that a product is cut into: some rows, some terms and one panel, computed with the
//! instructions that the panel was packed for.

#[cfg(target_arch = "x86_64")]
use crate::isa::x86::{Avx2, Avx512};
use crate::isa::{Isa, Scalar8, Simd};
use crate::panels::Panel;
use crate::tile::{
    Begin, End, InPlace, Output, ROW_PANELS, Span, of_height, panel_tile, row_of_panels,
};

/// Terms of a panel that all rows pass before the next terms do: they stay in the first-level cache
/// meanwhile.
pub(crate) const TERMS_AT_ONCE: usize = 256;

/// Offsets at which rows begin.
#[derive(Clone, Copy)]
pub(crate) enum RowStarts<'a> {
    /// Multiples of this distance.
    Even(usize),
    /// One offset for each row.
    Listed(&'a [usize]),
}

/// Some rows, some terms, and one panel or several.
pub(crate) struct PanelWork<'a> {
    pub(crate) left: *const f32,
    pub(crate) starts: RowStarts<'a>,
    pub(crate) first: usize,
    pub(crate) rows: usize,
    pub(crate) spans: &'a [Span],
    pub(crate) right: *const f32,
    /// Number of terms of the whole product. Consecutive panels lie `terms` times the panel's width
    /// apart.
    pub(crate) terms: usize,
    /// One panel; for a single row also [`ROW_PANELS`] full ones side by side.
    pub(crate) panel: Panel,
    pub(crate) begin: Begin,
    pub(crate) end: End,
    /// Address of the panel's first column in the output. `output_starts` are offsets from it, and
    /// from the gate's address.
    pub(crate) output: *mut f32,
    pub(crate) output_starts: RowStarts<'a>,
}

impl RowStarts<'_> {
    /// Offsets of the rows of a tile. One call for all of them: row by row, a tile of few terms
    /// would take longer to begin than to compute.
    #[inline(always)]
    fn of<const M: usize>(self, row: usize) -> [usize; M] {
        match self {
            Self::Even(stride) => std::array::from_fn(|index| (row + index) * stride),
            Self::Listed(starts) => {
                let starts = &starts[row..row + M];
                std::array::from_fn(|index| starts[index])
            }
        }
    }
}

/// Computes the rows' elements below the panel.
///
/// # Safety
/// The instructions are available; pointers and lengths in `work` match.
pub(crate) unsafe fn do_panel(isa: Isa, work: &PanelWork<'_>) {
    // SAFETY: guaranteed by the caller.
    unsafe {
        match isa {
            #[cfg(target_arch = "x86_64")]
            Isa::Avx512 => avx512(work),
            #[cfg(target_arch = "x86_64")]
            Isa::Avx2 => avx2(work),
            _ => all_tiles::<Scalar8>(work),
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma,avx512f,avx512vl,avx512bw,avx512dq")]
unsafe fn avx512(work: &PanelWork<'_>) {
    // SAFETY: guaranteed by the caller.
    unsafe { all_tiles::<Avx512>(work) }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
unsafe fn avx2(work: &PanelWork<'_>) {
    // SAFETY: guaranteed by the caller.
    unsafe { all_tiles::<Avx2>(work) }
}

#[inline(always)]
unsafe fn all_tiles<S: Simd>(work: &PanelWork<'_>) {
    if work.panel.width == ROW_PANELS * 2 * S::LANES {
        let [start] = work.starts.of(work.first);
        let left = work.left.wrapping_add(start);
        let panels =
            std::array::from_fn(|panel| work.right.wrapping_add(panel * work.terms * 2 * S::LANES));
        // SAFETY: guaranteed by the caller; the panels lie one behind the other.
        return unsafe {
            row_of_panels::<S>(left, work.spans, panels, work.begin, work.end, work.output)
        };
    }
    let mut row = work.first;
    while row < work.first + work.rows {
        let rows = (work.first + work.rows - row).min(S::ROWS);
        // SAFETY: guaranteed by the caller.
        unsafe { of_height!(S, rows, tile_of(work, row)) };
        row += rows;
    }
}

#[inline(always)]
unsafe fn tile_of<S: Simd, const M: usize>(work: &PanelWork<'_>, row: usize) {
    let left = work
        .starts
        .of(row)
        .map(|start| work.left.wrapping_add(start));
    let output = Output {
        data: work.output,
        rows: work.output_starts.of(row),
    };
    // SAFETY: guaranteed by the caller.
    unsafe {
        panel_tile::<S, _, M>(
            InPlace::<M>(left),
            work.spans,
            work.right,
            work.panel,
            work.begin,
            work.end,
            output,
        );
    }
}
