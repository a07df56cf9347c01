//! Instruction sets: which one is used, chosen once at run time, and the vector operations that the
//! inner loops need.

use std::fmt;
use std::sync::OnceLock;

/// Set of vector instructions that the kernels are written for.
///
/// Every kernel does the same operations on every number in the same order with each of them. Only
/// the count of numbers in a register differs, so the results are equal bit for bit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Isa {
    /// Plain arithmetic, as the compiler translates it. Where the processor has no fused
    /// multiply-add, each is a library call: slow, with equal results.
    Portable,
    /// 256 bits: AVX2 and FMA.
    Avx2,
    /// 512 bits: AVX-512 F, VL, BW and DQ.
    Avx512,
}

impl Isa {
    /// All instruction sets, the widest last.
    pub const ALL: [Self; 3] = [Self::Portable, Self::Avx2, Self::Avx512];

    /// Returns the widest instruction set of this machine.
    pub fn best() -> Self {
        static BEST: OnceLock<Isa> = OnceLock::new();
        *BEST.get_or_init(|| {
            let mut all = Self::ALL.into_iter().rev();
            all.find(|isa| isa.is_available()).unwrap_or(Self::Portable)
        })
    }

    /// `true` if this machine has these instructions.
    pub fn is_available(self) -> bool {
        match self {
            Self::Portable => true,
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma"),
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => {
                Self::Avx2.is_available()
                    && is_x86_feature_detected!("avx512f")
                    && is_x86_feature_detected!("avx512vl")
                    && is_x86_feature_detected!("avx512bw")
                    && is_x86_feature_detected!("avx512dq")
            }
            #[cfg(not(target_arch = "x86_64"))]
            _ => false,
        }
    }

    /// # Panics
    /// If this machine does not have these instructions.
    pub(crate) fn require(self) {
        assert!(
            self.is_available(),
            "{self} instructions are not available on this machine"
        );
    }

    /// Columns of a panel: the numbers in two registers.
    pub(crate) fn panel_width(self) -> usize {
        match self {
            Self::Portable | Self::Avx2 => 16,
            Self::Avx512 => 32,
        }
    }
}

impl fmt::Display for Isa {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Portable => "portable",
            Self::Avx2 => "AVX2",
            Self::Avx512 => "AVX-512",
        })
    }
}

/// Vector registers of one width, with the operations that the inner loops need.
///
/// # Safety
/// Every function requires that the processor has the instructions. A function with a pointer also
/// requires [`Simd::LANES`] numbers there.
pub(crate) trait Simd {
    /// Contents of one register.
    type Vector: Copy;
    /// Numbers in a register.
    const LANES: usize;
    /// Rows of the tallest tile that the registers can hold.
    const ROWS: usize;

    /// Runs `work`, which is marked `#[inline(always)]`, in a function of its own that is compiled
    /// for these instructions.
    unsafe fn outlined(work: impl FnOnce());
    unsafe fn zero() -> Self::Vector;
    unsafe fn splat(number: f32) -> Self::Vector;
    unsafe fn load(from: *const f32) -> Self::Vector;
    unsafe fn store(to: *mut f32, vector: Self::Vector);
    /// Prefetches the cache line at an address, which need not be valid.
    unsafe fn fetch(from: *const f32);
    /// Returns a · b + c, rounded once.
    unsafe fn fused(a: Self::Vector, b: Self::Vector, c: Self::Vector) -> Self::Vector;
    /// Returns max(0, x); NaN stays NaN.
    unsafe fn rectified(vector: Self::Vector) -> Self::Vector;
    /// Returns `vector` where `by` is above zero, else zero.
    unsafe fn gated(vector: Self::Vector, by: Self::Vector) -> Self::Vector;
}

/// Eight numbers in plain arithmetic.
pub(crate) struct Scalar8;

impl Simd for Scalar8 {
    type Vector = [f32; 8];
    const LANES: usize = 8;
    const ROWS: usize = 4;

    #[inline(never)]
    unsafe fn outlined(work: impl FnOnce()) {
        work();
    }

    #[inline(always)]
    unsafe fn zero() -> Self::Vector {
        [0.0; 8]
    }

    #[inline(always)]
    unsafe fn splat(number: f32) -> Self::Vector {
        [number; 8]
    }

    #[inline(always)]
    unsafe fn load(from: *const f32) -> Self::Vector {
        // SAFETY: the caller guarantees eight numbers; an array has the alignment of its elements.
        unsafe { from.cast::<Self::Vector>().read() }
    }

    #[inline(always)]
    unsafe fn store(to: *mut f32, vector: Self::Vector) {
        // SAFETY: as for `load`.
        unsafe { to.cast::<Self::Vector>().write(vector) }
    }

    #[inline(always)]
    unsafe fn fetch(_: *const f32) {}

    #[inline(always)]
    unsafe fn fused(a: Self::Vector, b: Self::Vector, c: Self::Vector) -> Self::Vector {
        std::array::from_fn(|lane| a[lane].mul_add(b[lane], c[lane]))
    }

    #[inline(always)]
    unsafe fn rectified(vector: Self::Vector) -> Self::Vector {
        vector.map(|value| if value < 0.0 { 0.0 } else { value })
    }

    #[inline(always)]
    unsafe fn gated(vector: Self::Vector, by: Self::Vector) -> Self::Vector {
        std::array::from_fn(|lane| if by[lane] > 0.0 { vector[lane] } else { 0.0 })
    }
}

#[cfg(target_arch = "x86_64")]
pub(crate) mod x86 {
    //! Vector registers of x86-64.

    use std::arch::x86_64::*;

    use super::Simd;

    pub(crate) struct Avx2;

    // 6 x 2 accumulators, 2 registers for the panel's row, 1 for a broadcast: 15 of 16.
    impl Simd for Avx2 {
        type Vector = __m256;
        const LANES: usize = 8;
        const ROWS: usize = 6;

        #[target_feature(enable = "avx2,fma")]
        #[inline(never)]
        unsafe fn outlined(work: impl FnOnce()) {
            work();
        }

        #[inline(always)]
        unsafe fn zero() -> __m256 {
            // SAFETY: the caller guarantees the instruction.
            unsafe { _mm256_setzero_ps() }
        }

        #[inline(always)]
        unsafe fn splat(number: f32) -> __m256 {
            // SAFETY: as for `zero`.
            unsafe { _mm256_set1_ps(number) }
        }

        #[inline(always)]
        unsafe fn load(from: *const f32) -> __m256 {
            // SAFETY: the caller guarantees instruction and memory.
            unsafe { _mm256_loadu_ps(from) }
        }

        #[inline(always)]
        unsafe fn store(to: *mut f32, vector: __m256) {
            // SAFETY: as for `load`.
            unsafe { _mm256_storeu_ps(to, vector) }
        }

        #[inline(always)]
        unsafe fn fetch(from: *const f32) {
            // SAFETY: as for `zero`.
            unsafe { _mm_prefetch::<_MM_HINT_T0>(from.cast()) }
        }

        #[inline(always)]
        unsafe fn fused(a: __m256, b: __m256, c: __m256) -> __m256 {
            // SAFETY: as for `splat`.
            unsafe { _mm256_fmadd_ps(a, b, c) }
        }

        #[inline(always)]
        unsafe fn rectified(vector: __m256) -> __m256 {
            // SAFETY: as for `splat`. For NaN the instruction returns its second operand.
            unsafe { _mm256_max_ps(_mm256_setzero_ps(), vector) }
        }

        #[inline(always)]
        unsafe fn gated(vector: __m256, by: __m256) -> __m256 {
            // SAFETY: as for `splat`.
            unsafe { _mm256_and_ps(vector, _mm256_cmp_ps::<_CMP_GT_OQ>(by, _mm256_setzero_ps())) }
        }
    }

    pub(crate) struct Avx512;

    // 12 x 2 accumulators, 2 registers for the panel's row; broadcasts are operands in memory: 26
    // of 32.
    impl Simd for Avx512 {
        type Vector = __m512;
        const LANES: usize = 16;
        const ROWS: usize = 12;

        #[target_feature(enable = "avx2,fma,avx512f,avx512vl,avx512bw,avx512dq")]
        #[inline(never)]
        unsafe fn outlined(work: impl FnOnce()) {
            work();
        }

        #[inline(always)]
        unsafe fn zero() -> __m512 {
            // SAFETY: the caller guarantees the instruction.
            unsafe { _mm512_setzero_ps() }
        }

        #[inline(always)]
        unsafe fn splat(number: f32) -> __m512 {
            // SAFETY: as for `zero`.
            unsafe { _mm512_set1_ps(number) }
        }

        #[inline(always)]
        unsafe fn load(from: *const f32) -> __m512 {
            // SAFETY: the caller guarantees instruction and memory.
            unsafe { _mm512_loadu_ps(from) }
        }

        #[inline(always)]
        unsafe fn store(to: *mut f32, vector: __m512) {
            // SAFETY: as for `load`.
            unsafe { _mm512_storeu_ps(to, vector) }
        }

        #[inline(always)]
        unsafe fn fetch(from: *const f32) {
            // SAFETY: as for `zero`.
            unsafe { Avx2::fetch(from) }
        }

        #[inline(always)]
        unsafe fn fused(a: __m512, b: __m512, c: __m512) -> __m512 {
            // SAFETY: as for `splat`.
            unsafe { _mm512_fmadd_ps(a, b, c) }
        }

        #[inline(always)]
        unsafe fn rectified(vector: __m512) -> __m512 {
            // SAFETY: as for `splat`. For NaN the instruction returns its second operand.
            unsafe { _mm512_max_ps(_mm512_setzero_ps(), vector) }
        }

        #[inline(always)]
        unsafe fn gated(vector: __m512, by: __m512) -> __m512 {
            // SAFETY: as for `splat`.
            unsafe {
                _mm512_maskz_mov_ps(
                    _mm512_cmp_ps_mask::<_CMP_GT_OQ>(by, _mm512_setzero_ps()),
                    vector,
                )
            }
        }
    }

    /// Writes `terms` numbers of eight columns side by side into rows that lie `stride` apart;
    /// `terms` is a multiple of eight.
    ///
    /// # Safety
    /// The processor has AVX2. The columns have `terms` numbers; from `into` on, each row has room
    /// for eight.
    #[target_feature(enable = "avx2")]
    pub(crate) unsafe fn interleave(
        columns: [*const f32; 8],
        terms: usize,
        into: *mut f32,
        stride: usize,
    ) {
        for first in (0..terms).step_by(8) {
            // SAFETY: guaranteed by the caller.
            let rows = columns.map(|column| unsafe { _mm256_loadu_ps(column.add(first)) });
            // An 8 x 8 transposition: swap numbers, then pairs, then halves.
            let pairs: [__m256; 8] = std::array::from_fn(|row| {
                let (a, b) = (rows[row & !1], rows[row | 1]);
                if row & 1 == 0 {
                    _mm256_unpacklo_ps(a, b)
                } else {
                    _mm256_unpackhi_ps(a, b)
                }
            });
            let quads: [__m256; 8] = std::array::from_fn(|row| {
                let (a, b) = (
                    pairs[row & 4 | (row >> 1 & 1)],
                    pairs[row & 4 | 2 | (row >> 1 & 1)],
                );
                if row & 1 == 0 {
                    _mm256_shuffle_ps::<0x44>(a, b)
                } else {
                    _mm256_shuffle_ps::<0xee>(a, b)
                }
            });
            for term in 0..8 {
                let (a, b) = (quads[term & 3], quads[4 | term & 3]);
                let row = if term & 4 == 0 {
                    _mm256_permute2f128_ps::<0x20>(a, b)
                } else {
                    _mm256_permute2f128_ps::<0x31>(a, b)
                };
                // SAFETY: guaranteed by the caller.
                unsafe { _mm256_storeu_ps(into.add((first + term) * stride), row) };
            }
        }
    }
}
