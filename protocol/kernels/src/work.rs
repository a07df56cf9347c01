//! What a product is cut into: some rows, some terms, one panel; done with the instructions that
//! the panel was packed for.

use crate::isa::{Isa, Simd};
use crate::pair::Term;
use crate::panels::Panel;
use crate::tile::{
    Begin, End, InPlace, Output, ROW_PANELS, Run, of_height, panel_tile, row_of_panels,
};

/// Terms of a panel that all rows meet before the next ones' turn: they stay in the first cache
/// meanwhile.
pub(crate) const TERMS_AT_ONCE: usize = 256;

/// Where rows begin.
#[derive(Clone, Copy)]
pub(crate) enum Starts<'a> {
    /// So far apart.
    Even(usize),
    /// Here.
    Listed(&'a [usize]),
}

/// Some rows, some terms, one panel or several.
pub(crate) struct Work<'a, T> {
    pub(crate) left: *const T,
    pub(crate) starts: Starts<'a>,
    pub(crate) first: usize,
    pub(crate) rows: usize,
    pub(crate) runs: &'a [Run],
    pub(crate) right: *const T,
    /// All terms of the product: so far apart are the columns of one panel and the next.
    pub(crate) terms: usize,
    /// One panel, or as many full ones side by side as a single row meets at once.
    pub(crate) panel: Panel,
    pub(crate) begin: Begin,
    pub(crate) end: End,
    /// From where rows begin, at the panel's first column; a gate likewise.
    pub(crate) output: *mut f32,
    pub(crate) output_starts: Starts<'a>,
}

impl Starts<'_> {
    /// Where each row of a tile begins. Asked once for all of them: row by row, a tile of few terms
    /// would take longer to begin than to do.
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

/// # Safety
/// The instructions are there; pointers and numbers of `work` belong together.
pub(crate) unsafe fn do_work<T: Term>(isa: Isa, work: &Work<'_, T>) {
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
        let [start] = work.starts.of(work.first);
        let left = work.left.wrapping_add(start);
        let panels =
            std::array::from_fn(|panel| work.right.wrapping_add(panel * work.terms * 2 * S::LANES));
        // SAFETY: as the caller says: the panels lie one behind the other.
        return unsafe {
            row_of_panels::<S>(left, work.runs, panels, work.begin, work.end, work.output)
        };
    }
    let mut row = work.first;
    while row < work.first + work.rows {
        let rows = (work.first + work.rows - row).min(S::ROWS);
        // SAFETY: as the caller says.
        unsafe { of_height!(S, rows, tile_of(work, row)) };
        row += rows;
    }
}

#[inline(always)]
unsafe fn tile_of<S: Simd, const M: usize>(work: &Work<'_, S::Term>, row: usize) {
    let left = work
        .starts
        .of(row)
        .map(|start| work.left.wrapping_add(start));
    let output = Output {
        data: work.output,
        rows: work.output_starts.of(row),
    };
    // SAFETY: as the caller says.
    unsafe {
        panel_tile::<S, _, M>(
            InPlace::<S::Term, M>(left),
            work.runs,
            work.right,
            work.panel,
            work.begin,
            work.end,
            output,
        );
    }
}
