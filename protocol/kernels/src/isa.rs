//! Which vector instructions are used, chosen once at run time, and what a product's inner loop
//! needs of them.

use std::fmt;
use std::sync::OnceLock;

/// A set of vector instructions that the kernels are written for.
///
/// Every kernel does the same operations on every number in the same order whichever is used: only
/// how many numbers are in a register differs. So the results are equal bit for bit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Isa {
    /// Whatever the compiler makes of plain arithmetic. Fused multiply-add is a call where the
    /// processor lacks it: slow, and equal.
    Portable,
    /// 256 bits: AVX2 and FMA.
    Avx2,
    /// 512 bits: AVX-512 F, VL, BW and DQ.
    Avx512,
    /// The same, and products of pairs of bfloat16.
    Avx512Bf16,
}

impl Isa {
    /// All of them, the widest last.
    pub const ALL: [Self; 4] = [Self::Portable, Self::Avx2, Self::Avx512, Self::Avx512Bf16];

    /// The widest that this machine has.
    pub fn best() -> Self {
        static BEST: OnceLock<Isa> = OnceLock::new();
        *BEST.get_or_init(|| {
            let mut all = Self::ALL.into_iter().rev();
            all.find(|isa| isa.is_available()).unwrap_or(Self::Portable)
        })
    }

    /// Whether this machine has it.
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
            #[cfg(target_arch = "x86_64")]
            Self::Avx512Bf16 => {
                Self::Avx512.is_available() && is_x86_feature_detected!("avx512bf16")
            }
            #[cfg(not(target_arch = "x86_64"))]
            _ => false,
        }
    }

    /// Columns of a panel: two registers.
    pub(crate) fn panel_width(self) -> usize {
        match self {
            Self::Portable | Self::Avx2 => 16,
            Self::Avx512 | Self::Avx512Bf16 => 32,
        }
    }
}

impl fmt::Display for Isa {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Portable => "portable",
            Self::Avx2 => "AVX2",
            Self::Avx512 => "AVX-512",
            Self::Avx512Bf16 => "AVX-512 with BF16",
        })
    }
}

/// Registers of one kind, as the inner loops need them.
///
/// # Safety
/// Every function asks for the processor to have the instructions, and those with a pointer for
/// [`Simd::LANES`] numbers or terms there.
pub trait Simd {
    /// What is multiplied: a number, or a pair of halves.
    type Term: Copy;
    /// A register, of numbers or of terms.
    type Vector: Copy;
    /// Numbers in it.
    const LANES: usize;
    /// Rows of the largest tile.
    const ROWS: usize;

    unsafe fn zero() -> Self::Vector;
    unsafe fn splat(term: Self::Term) -> Self::Vector;
    unsafe fn load_terms(from: *const Self::Term) -> Self::Vector;
    unsafe fn load(from: *const f32) -> Self::Vector;
    unsafe fn store(to: *mut f32, vector: Self::Vector);
    /// Asks for the cache line at an address, which need not be valid; does nothing else.
    unsafe fn fetch(from: *const f32);
    /// a · b + c for terms a and b: rounded once if they are numbers, after each product if they
    /// are pairs.
    unsafe fn fused(a: Self::Vector, b: Self::Vector, c: Self::Vector) -> Self::Vector;
    /// Zero for what is below zero. Not a number stays what it is.
    unsafe fn rectified(vector: Self::Vector) -> Self::Vector;
    /// `vector` where `by` is above zero, else zero.
    unsafe fn gated(vector: Self::Vector, by: Self::Vector) -> Self::Vector;
}

/// Eight numbers without any instruction of their own.
pub struct Scalar8;

impl Simd for Scalar8 {
    type Term = f32;
    type Vector = [f32; 8];
    const LANES: usize = 8;
    const ROWS: usize = 4;

    #[inline(always)]
    unsafe fn zero() -> Self::Vector {
        [0.0; 8]
    }

    #[inline(always)]
    unsafe fn splat(term: f32) -> Self::Vector {
        [term; 8]
    }

    #[inline(always)]
    unsafe fn load_terms(from: *const f32) -> Self::Vector {
        // SAFETY: as for `load`.
        unsafe { Self::load(from) }
    }

    #[inline(always)]
    unsafe fn load(from: *const f32) -> Self::Vector {
        // SAFETY: the caller vouches for eight numbers; an array of them needs no other alignment
        // than they do.
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
    //! The registers of x86-64.

    use std::arch::x86_64::*;

    use super::Simd;
    use crate::pair::{Halves, Pair};

    pub struct Avx2;

    // 6 x 2 accumulators, 2 registers for the panel's row, 1 for a broadcast: 15 of 16.
    impl Simd for Avx2 {
        type Term = f32;
        type Vector = __m256;
        const LANES: usize = 8;
        const ROWS: usize = 6;

        #[inline(always)]
        unsafe fn zero() -> __m256 {
            // SAFETY: the processor has the instruction, the caller says.
            unsafe { _mm256_setzero_ps() }
        }

        #[inline(always)]
        unsafe fn splat(term: f32) -> __m256 {
            // SAFETY: as for `zero`.
            unsafe { _mm256_set1_ps(term) }
        }

        #[inline(always)]
        unsafe fn load_terms(from: *const f32) -> __m256 {
            // SAFETY: as for `load`.
            unsafe { Self::load(from) }
        }

        #[inline(always)]
        unsafe fn load(from: *const f32) -> __m256 {
            // SAFETY: the caller vouches for instruction and memory.
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
            // SAFETY: as for `splat`. Where the two do not compare, the instruction gives its
            // second operand.
            unsafe { _mm256_max_ps(_mm256_setzero_ps(), vector) }
        }

        #[inline(always)]
        unsafe fn gated(vector: __m256, by: __m256) -> __m256 {
            // SAFETY: as for `splat`.
            unsafe { _mm256_and_ps(vector, _mm256_cmp_ps::<_CMP_GT_OQ>(by, _mm256_setzero_ps())) }
        }
    }

    pub struct Avx512;

    // 12 x 2 accumulators, 2 registers for the panel's row; broadcasts are operands in memory: 26
    // of 32.
    impl Simd for Avx512 {
        type Term = f32;
        type Vector = __m512;
        const LANES: usize = 16;
        const ROWS: usize = 12;

        #[inline(always)]
        unsafe fn zero() -> __m512 {
            // SAFETY: the processor has the instruction, the caller says.
            unsafe { _mm512_setzero_ps() }
        }

        #[inline(always)]
        unsafe fn splat(term: f32) -> __m512 {
            // SAFETY: as for `zero`.
            unsafe { _mm512_set1_ps(term) }
        }

        #[inline(always)]
        unsafe fn load_terms(from: *const f32) -> __m512 {
            // SAFETY: as for `load`.
            unsafe { Self::load(from) }
        }

        #[inline(always)]
        unsafe fn load(from: *const f32) -> __m512 {
            // SAFETY: the caller vouches for instruction and memory.
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
            // SAFETY: as for `splat`. Where the two do not compare, the instruction gives its
            // second operand.
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

    impl Halves for Avx2 {
        #[inline(always)]
        unsafe fn halves(pairs: __m256) -> [__m256; 2] {
            // SAFETY: as for `splat`.
            unsafe {
                let bits = _mm256_castps_si256(pairs);
                let second = _mm256_and_si256(bits, _mm256_set1_epi32(0xffff_0000_u32 as i32));
                [_mm256_slli_epi32::<16>(bits), second].map(|half| _mm256_castsi256_ps(half))
            }
        }
    }

    impl Halves for Avx512 {
        #[inline(always)]
        unsafe fn halves(pairs: __m512) -> [__m512; 2] {
            // SAFETY: as for `splat`.
            unsafe {
                let bits = _mm512_castps_si512(pairs);
                let second = _mm512_and_si512(bits, _mm512_set1_epi32(0xffff_0000_u32 as i32));
                [_mm512_slli_epi32::<16>(bits), second].map(|half| _mm512_castsi512_ps(half))
            }
        }
    }

    /// [`Avx512`] for pairs, by the instruction made for them.
    pub struct Avx512Bf16;

    impl Simd for Avx512Bf16 {
        type Term = Pair;
        type Vector = __m512;
        const LANES: usize = Avx512::LANES;
        const ROWS: usize = Avx512::ROWS;

        #[inline(always)]
        unsafe fn zero() -> __m512 {
            // SAFETY: the caller vouches for the instructions, here and below.
            unsafe { Avx512::zero() }
        }

        #[inline(always)]
        unsafe fn splat(term: Pair) -> __m512 {
            // SAFETY: as for `zero`.
            unsafe { Avx512::splat(term.as_bits_of_a_number()) }
        }

        #[inline(always)]
        unsafe fn load_terms(from: *const Pair) -> __m512 {
            // SAFETY: the caller vouches for instruction and memory, here and below.
            unsafe { Avx512::load(from.cast()) }
        }

        #[inline(always)]
        unsafe fn load(from: *const f32) -> __m512 {
            // SAFETY: as for `load_terms`.
            unsafe { Avx512::load(from) }
        }

        #[inline(always)]
        unsafe fn store(to: *mut f32, vector: __m512) {
            // SAFETY: as for `load_terms`.
            unsafe { Avx512::store(to, vector) }
        }

        #[inline(always)]
        unsafe fn fetch(from: *const f32) {
            // SAFETY: as for `zero`.
            unsafe { Avx512::fetch(from) }
        }

        #[inline(always)]
        unsafe fn fused(a: __m512, b: __m512, c: __m512) -> __m512 {
            // SAFETY: as for `zero`; the vectors are the same 512 bits under another name.
            unsafe {
                let pairs = |bits: __m512| std::mem::transmute::<__m512, __m512bh>(bits);
                _mm512_dpbf16_ps(c, pairs(a), pairs(b))
            }
        }

        #[inline(always)]
        unsafe fn rectified(vector: __m512) -> __m512 {
            // SAFETY: as for `zero`.
            unsafe { Avx512::rectified(vector) }
        }

        #[inline(always)]
        unsafe fn gated(vector: __m512, by: __m512) -> __m512 {
            // SAFETY: as for `zero`.
            unsafe { Avx512::gated(vector, by) }
        }
    }

    /// Writes `terms` numbers of eight columns side by side into rows that lie `stride` apart;
    /// `terms` is a multiple of eight.
    ///
    /// # Safety
    /// AVX2 is there; so are the numbers and, from `into` on, eight numbers in each row.
    #[target_feature(enable = "avx2")]
    pub(crate) unsafe fn interleave(
        columns: [*const f32; 8],
        terms: usize,
        into: *mut f32,
        stride: usize,
    ) {
        for first in (0..terms).step_by(8) {
            // SAFETY: as the caller says.
            let rows = columns.map(|column| unsafe { _mm256_loadu_ps(column.add(first)) });
            // Pairs of numbers, then of pairs, then of halves change places.
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
                // SAFETY: as the caller says.
                unsafe { _mm256_storeu_ps(into.add((first + term) * stride), row) };
            }
        }
    }
}
