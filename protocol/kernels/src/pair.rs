//! Halves: products of 16-bit numbers, at twice the rate where the processor has instructions for
//! them.
//!
//! A bfloat16 is the upper half of an f32: its range, and eight bits of its precision. Two of them
//! are one term of a product, multiplied pair by pair and summed in f32. What this costs in
//! accuracy is the rounding of the operands to eight bits; sums are as exact as those of f32.

use crate::isa::{Isa, Scalar8, Simd};

/// Two bfloat16 side by side, the first in the lower bits: one term of a product.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
#[repr(transparent)]
pub struct Pair(u32);

impl Pair {
    /// Both numbers rounded to the nearest, ties to the even one. Not a number stays not a number.
    #[inline(always)]
    pub fn of(first: f32, second: f32) -> Self {
        Self(rounded(first) >> 16 | rounded(second) & 0xffff_0000)
    }

    /// The two numbers.
    pub fn numbers(self) -> [f32; 2] {
        [
            f32::from_bits(self.0 << 16),
            f32::from_bits(self.0 & 0xffff_0000),
        ]
    }

    /// The same bits, in the type that registers are filled with.
    #[inline(always)]
    pub(crate) fn as_bits_of_a_number(self) -> f32 {
        f32::from_bits(self.0)
    }

    /// The pairs of `numbers`, an even count, into `pairs`.
    ///
    /// # Panics
    /// When a number is left over.
    pub fn all_of(isa: Isa, numbers: &[f32], pairs: &mut Vec<Self>) {
        assert!(
            numbers.len().is_multiple_of(2),
            "{} numbers are no pairs",
            numbers.len()
        );
        pairs.resize(numbers.len() / 2, Self::default());
        isa.vectorised(
            #[inline(always)]
            || {
                for (pair, numbers) in pairs.iter_mut().zip(numbers.chunks_exact(2)) {
                    *pair = Self::of(numbers[0], numbers[1]);
                }
            },
        );
    }
}

/// Bits of which the upper half is the nearest bfloat16.
#[inline(always)]
fn rounded(number: f32) -> u32 {
    let bits = number.to_bits();
    if number.is_nan() {
        // Quiet, so that no bit of the lower half is needed to tell it from infinity.
        bits | 0x0040_0000
    } else {
        bits + 0x7fff + (bits >> 16 & 1)
    }
}

/// Registers whose pairs are taken apart: for processors without instructions for pairs.
pub trait Halves: Simd<Term = f32> {
    /// The first and the second number of each pair.
    ///
    /// # Safety
    /// The processor has the instructions.
    unsafe fn halves(pairs: Self::Vector) -> [Self::Vector; 2];
}

impl Halves for Scalar8 {
    #[inline(always)]
    unsafe fn halves(pairs: Self::Vector) -> [Self::Vector; 2] {
        let numbers = pairs.map(|bits| Pair(bits.to_bits()).numbers());
        [0, 1].map(|half| numbers.map(|numbers| numbers[half]))
    }
}

/// `S` for pairs. The second of a pair is added first, and each product rounds, as the instruction
/// made for it does. (That one takes numbers below 1.2e-38 for zero.)
pub struct Apart<S>(S);

impl<S: Halves> Simd for Apart<S> {
    type Term = Pair;
    type Vector = S::Vector;
    const LANES: usize = S::LANES;
    const ROWS: usize = S::ROWS;

    #[inline(always)]
    unsafe fn zero() -> S::Vector {
        // SAFETY: the caller vouches for the instructions, here and below.
        unsafe { S::zero() }
    }

    #[inline(always)]
    unsafe fn splat(term: Pair) -> S::Vector {
        // SAFETY: as for `zero`.
        unsafe { S::splat(term.as_bits_of_a_number()) }
    }

    #[inline(always)]
    unsafe fn load_terms(from: *const Pair) -> S::Vector {
        // SAFETY: the caller vouches for instructions and memory, here and below; a pair is as
        // large as a number.
        unsafe { S::load(from.cast()) }
    }

    #[inline(always)]
    unsafe fn load(from: *const f32) -> S::Vector {
        // SAFETY: as for `load_terms`.
        unsafe { S::load(from) }
    }

    #[inline(always)]
    unsafe fn store(to: *mut f32, vector: S::Vector) {
        // SAFETY: as for `load_terms`.
        unsafe { S::store(to, vector) }
    }

    #[inline(always)]
    unsafe fn fetch(from: *const f32) {
        // SAFETY: as for `zero`.
        unsafe { S::fetch(from) }
    }

    #[inline(always)]
    unsafe fn fused(a: S::Vector, b: S::Vector, c: S::Vector) -> S::Vector {
        // SAFETY: as for `zero`.
        unsafe {
            let ([a_first, a_second], [b_first, b_second]) = (S::halves(a), S::halves(b));
            S::fused(a_first, b_first, S::fused(a_second, b_second, c))
        }
    }

    #[inline(always)]
    unsafe fn rectified(vector: S::Vector) -> S::Vector {
        // SAFETY: as for `zero`.
        unsafe { S::rectified(vector) }
    }

    #[inline(always)]
    unsafe fn gated(vector: S::Vector, by: S::Vector) -> S::Vector {
        // SAFETY: as for `zero`.
        unsafe { S::gated(vector, by) }
    }
}

/// What can be multiplied, and in which registers.
pub trait Term: sealed::Registers {}

impl Term for f32 {}
impl Term for Pair {}

pub(crate) mod sealed {
    //! Which registers hold terms, kept from whoever would add a kind of term.

    use super::{Apart, Pair, Scalar8, Simd};
    #[cfg(target_arch = "x86_64")]
    use crate::isa::x86;

    pub trait Registers: Copy + Default {
        type Portable: Simd<Term = Self>;
        #[cfg(target_arch = "x86_64")]
        type Avx2: Simd<Term = Self>;
        #[cfg(target_arch = "x86_64")]
        type Avx512: Simd<Term = Self>;
        #[cfg(target_arch = "x86_64")]
        type Avx512Bf16: Simd<Term = Self>;
    }

    impl Registers for f32 {
        type Portable = Scalar8;
        #[cfg(target_arch = "x86_64")]
        type Avx2 = x86::Avx2;
        #[cfg(target_arch = "x86_64")]
        type Avx512 = x86::Avx512;
        #[cfg(target_arch = "x86_64")]
        type Avx512Bf16 = x86::Avx512;
    }

    impl Registers for Pair {
        type Portable = Apart<Scalar8>;
        #[cfg(target_arch = "x86_64")]
        type Avx2 = Apart<x86::Avx2>;
        #[cfg(target_arch = "x86_64")]
        type Avx512 = Apart<x86::Avx512>;
        #[cfg(target_arch = "x86_64")]
        type Avx512Bf16 = x86::Avx512Bf16;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_is_rounded_to_the_nearest_and_ties_to_even() {
        // Of eight bits: 1 + 1/128 is the next after 1.
        for (number, nearest) in [
            (1.0, 1.0),
            (1.0 + 1.0 / 256.0, 1.0),
            (1.0 + 3.0 / 256.0, 1.0 + 2.0 / 128.0),
            (1.0 + 1.001 / 256.0, 1.0 + 1.0 / 128.0),
            (3.0e38, 3.004_055_3e38),
            (f32::MAX, f32::INFINITY),
            (0.0, 0.0),
        ] {
            assert_eq!(
                Pair::of(number, -number).numbers(),
                [nearest, -nearest],
                "{number}"
            );
        }
        assert!(Pair::of(f32::from_bits(0x7f80_0001), 0.0).numbers()[0].is_nan());
    }

    #[test]
    fn pairs_are_the_same_bits_with_all_instructions() {
        let numbers: Vec<f32> = (0..1000)
            .map(|index| (index as f32 * 0.7133).sin() * 10.0)
            .collect();
        let mut expected = Vec::new();
        Pair::all_of(Isa::Portable, &numbers, &mut expected);
        assert_eq!(expected[3], Pair::of(numbers[6], numbers[7]));
        for isa in Isa::ALL.into_iter().filter(|isa| isa.is_available()) {
            let mut found = Vec::new();
            Pair::all_of(isa, &numbers, &mut found);
            assert_eq!(found, expected, "{isa}");
        }
    }
}
