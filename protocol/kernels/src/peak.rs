//! Peak arithmetic rate of a core, which measured rates are compared with.

use std::hint::black_box;
use std::time::Instant;

use crate::isa::{Isa, Scalar8, Simd};

/// Independent sums: enough to hide that each operation waits for the one before.
const SUMS: usize = 12;
/// Rounds of one measurement: about a millisecond.
const ROUNDS: usize = 1 << 18;

/// Measures the floating-point operations per second that the calling thread reaches in registers
/// alone; a fused multiply-add counts as two. The result is the best of a hundred measurements, as
/// other processes may use the machine.
///
/// # Panics
/// If this machine does not have the instructions.
pub fn peak_flops(isa: Isa) -> f64 {
    isa.require();
    let operations = |lanes: usize| (2 * ROUNDS * SUMS * lanes) as f64;
    let mut best = 0.0_f64;
    for _ in 0..100 {
        let begun = Instant::now();
        // SAFETY: the instructions are available.
        let lanes = unsafe {
            match isa {
                #[cfg(target_arch = "x86_64")]
                Isa::Avx512 => avx512(),
                #[cfg(target_arch = "x86_64")]
                Isa::Avx2 => avx2(),
                _ => multiply_add::<Scalar8>(),
            }
        };
        best = best.max(operations(lanes) / begun.elapsed().as_secs_f64());
    }
    best
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma,avx512f,avx512vl,avx512bw,avx512dq")]
unsafe fn avx512() -> usize {
    // SAFETY: guaranteed by the caller.
    unsafe { multiply_add::<crate::isa::x86::Avx512>() }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
unsafe fn avx2() -> usize {
    // SAFETY: guaranteed by the caller.
    unsafe { multiply_add::<crate::isa::x86::Avx2>() }
}

/// Runs one measurement, and returns the count of numbers in a register.
#[inline(always)]
unsafe fn multiply_add<S: Simd>() -> usize {
    // SAFETY: guaranteed by the caller; `kept` has room for the widest register.
    unsafe {
        let (factor, mut sums) = (S::splat(black_box(0.5)), [S::splat(black_box(1.0)); SUMS]);
        for _ in 0..ROUNDS {
            for sum in &mut sums {
                *sum = S::fused(*sum, factor, factor);
            }
        }
        let mut kept = [0.0; 16];
        for sum in sums {
            S::store(kept.as_mut_ptr(), sum);
            black_box(&kept);
        }
    }
    S::LANES
}
