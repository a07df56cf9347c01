//! What one core can do at best: floating-point operations and bytes copied a second, measured.
//!
//! A share of the peak says how much a kernel leaves on the table, whatever machine it runs on.

use std::hint::black_box;
use std::time::Instant;

/// Independent sums: enough to hide the latency of two multiply-adds a cycle, few enough for sixteen registers.
const SUMS: usize = 12;
/// Multiply-adds of each sum in a round: some milliseconds.
const LENGTH: usize = 1 << 20;
/// The best round counts: anything else on the machine only slows it down.
const ROUNDS: usize = 40;
/// Bytes copied a round, beyond any cache.
const COPIED: usize = 128 << 20;

/// f32 operations a second of the calling thread's core, by fused multiply-adds in the widest registers there are; each counts as two.
pub fn f32_flops() -> f64 {
    let (round, lanes) = widest();
    let operations = (2 * SUMS * LENGTH * lanes) as f64;
    operations / fastest(ROUNDS, round)
}

/// Bytes a second that one core copies from memory to memory; each is read once and written once.
pub fn copied_bytes_per_sec() -> f64 {
    let source = vec![1_u8; COPIED];
    let mut target = vec![2_u8; COPIED];
    let secs = fastest(8, || {
        target.copy_from_slice(black_box(&source));
        black_box(&target);
    });
    COPIED as f64 / secs
}

fn fastest(rounds: usize, mut work: impl FnMut()) -> f64 {
    (0..rounds)
        .map(|_| {
            let start = Instant::now();
            work();
            start.elapsed().as_secs_f64()
        })
        .fold(f64::INFINITY, f64::min)
}

/// A round, and how many numbers a register of it holds.
fn widest() -> (fn(), usize) {
    #[cfg(target_arch = "x86_64")]
    {
        if is_x86_feature_detected!("avx512f") {
            // SAFETY: the machine has the instructions, as just asked.
            return (|| unsafe { x86::round_512() }, 16);
        }
        if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
            // SAFETY: as above.
            return (|| unsafe { x86::round_256() }, 8);
        }
    }
    (round_plain, 4)
}

/// Multiplication and addition apart, in whatever registers every machine of this kind has.
fn round_plain() {
    let factor = black_box([0.999_f32; 4]);
    let mut sums = black_box([[1.0_f32; 4]; SUMS]);
    for _ in 0..LENGTH {
        for sum in &mut sums {
            for lane in 0..4 {
                sum[lane] = sum[lane] * factor[lane] + factor[lane];
            }
        }
    }
    black_box(sums);
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::{_mm256_fmadd_ps, _mm256_set1_ps, _mm512_fmadd_ps, _mm512_set1_ps};
    use std::hint::black_box;

    use super::{LENGTH, SUMS};

    #[target_feature(enable = "avx512f")]
    pub(super) fn round_512() {
        let factor = _mm512_set1_ps(black_box(0.999));
        let mut sums = [_mm512_set1_ps(black_box(1.0)); SUMS];
        for _ in 0..LENGTH {
            for sum in &mut sums {
                *sum = _mm512_fmadd_ps(*sum, factor, factor);
            }
        }
        black_box(sums);
    }

    #[target_feature(enable = "avx2,fma")]
    pub(super) fn round_256() {
        let factor = _mm256_set1_ps(black_box(0.999));
        let mut sums = [_mm256_set1_ps(black_box(1.0)); SUMS];
        for _ in 0..LENGTH {
            for sum in &mut sums {
                *sum = _mm256_fmadd_ps(*sum, factor, factor);
            }
        }
        black_box(sums);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_peak_is_that_of_registers_not_of_single_numbers() {
        let (round, lanes) = widest();
        let one_number = || {
            let factor = black_box(0.999_f32);
            let mut sum = black_box(1.0_f32);
            for _ in 0..LENGTH {
                sum = sum * factor + factor;
            }
            black_box(sum);
        };
        let peak = (2 * SUMS * LENGTH * lanes) as f64 / fastest(5, round);
        let single = 2.0 * LENGTH as f64 / fastest(5, one_number);
        assert!(peak > 4.0 * single, "{peak} {single}");
    }
}
