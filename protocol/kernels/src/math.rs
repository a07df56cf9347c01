//! Functions of one number that vectorised loops can call, equal bit for bit on every processor;
//! and the compilation of such loops for an instruction set.

use crate::isa::Isa;

/// Returns eˣ within two units in the last place; infinity above 88.72, zero below -87.33, NaN for
/// NaN.
///
/// x = n ln 2 + r, |r| ≤ ½ ln 2; eʳ by its Taylor polynomial (degree 7: remainder below 1e-8), 2ⁿ
/// by its bits.
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    const LN_2_HIGH: f32 = 0.693_359_4;
    const LN_2_LOW: f32 = -2.121_944_4e-4;
    /// Added and subtracted again, it rounds to a whole number: f32 has no fractions up there.
    const ROUND: f32 = 12_582_912.0;
    const LARGEST: f32 = 88.722_83;
    const SMALLEST: f32 = -87.336_54;
    let bounded = x.clamp(SMALLEST, LARGEST);
    let n = bounded.mul_add(std::f32::consts::LOG2_E, ROUND) - ROUND;
    let r = n.mul_add(-LN_2_LOW, n.mul_add(-LN_2_HIGH, bounded));
    let mut sum = 1.0 / 5040.0;
    for factor in [
        1.0 / 720.0,
        1.0 / 120.0,
        1.0 / 24.0,
        1.0 / 6.0,
        0.5,
        1.0,
        1.0,
    ] {
        sum = r.mul_add(sum, factor);
    }
    // Two factors: 2ⁿ alone would overflow at n = 128, where eˣ does not yet.
    let half = (n * 0.5).floor();
    let power = |n: f32| f32::from_bits((((n as i32) + 127) << 23) as u32);
    let value = sum * power(half) * power(n - half);
    if x > LARGEST {
        f32::INFINITY
    } else if x < SMALLEST {
        0.0
    } else if x.is_nan() {
        x
    } else {
        value
    }
}

/// Returns 1 / (1 + e⁻ˣ).
#[inline(always)]
pub fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + exp(-x))
}

impl Isa {
    /// Runs `work` compiled for these instructions: its loops are vectorised with them, and
    /// `mul_add` is one instruction.
    ///
    /// `work` and everything it calls must be marked `#[inline(always)]`. Otherwise the compiler
    /// may keep a long closure outside, compiled for the baseline processor.
    ///
    /// # Panics
    /// If this machine does not have the instructions.
    #[inline]
    pub fn vectorised<R>(self, work: impl FnOnce() -> R) -> R {
        self.require();
        match self {
            // SAFETY: the instructions are available.
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => unsafe { avx512(work) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => unsafe { avx2(work) },
            _ => work(),
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma,avx512f,avx512vl,avx512bw,avx512dq")]
fn avx512<R>(work: impl FnOnce() -> R) -> R {
    work()
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn avx2<R>(work: impl FnOnce() -> R) -> R {
    work()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn range() -> impl Iterator<Item = f32> {
        (-880_000..=890_000).map(|step| step as f32 * 1e-4)
    }

    #[test]
    fn exp_is_within_two_units_in_the_last_place() {
        for x in range().filter(|x| (-87.3..88.7).contains(x)) {
            let (found, exact) = (exp(x), f64::from(x).exp());
            let error = (f64::from(found) - exact).abs() / exact;
            assert!(
                error < 2.4e-7,
                "exp({x}) = {found}, not {exact}: off by {error}"
            );
        }
    }

    #[test]
    fn exp_is_infinite_or_zero_outside_its_range() {
        assert_eq!(exp(0.0), 1.0);
        assert_eq!(exp(200.0), f32::INFINITY);
        assert_eq!(exp(f32::INFINITY), f32::INFINITY);
        assert_eq!(exp(-200.0), 0.0);
        assert_eq!(exp(f32::NEG_INFINITY), 0.0);
        assert!(exp(f32::NAN).is_nan());
    }

    #[test]
    fn loops_give_the_same_bits_with_all_instruction_sets() {
        let inputs: Vec<f32> = range().step_by(7).collect();
        let run = |isa: Isa| {
            let mut outputs = vec![0.0; inputs.len()];
            isa.vectorised(
                #[inline(always)]
                || {
                    for (output, input) in outputs.iter_mut().zip(&inputs) {
                        *output = sigmoid(*input) + exp(*input);
                    }
                },
            );
            outputs.into_iter().map(f32::to_bits).collect::<Vec<_>>()
        };
        let portable = run(Isa::Portable);
        for isa in Isa::ALL.into_iter().filter(|isa| isa.is_available()) {
            assert_eq!(run(isa), portable, "{isa}");
        }
    }
}
