//! Repeatable noise, computed for many pixels at once.
//!
//! A pixel's noise is a hash of its number and the image's key. No state passes from one pixel to
//! the next, so pixels can be computed side by side. Integers and sums give the same bits with any
//! instruction set.

/// Mean of the sum of eight bytes, each 0 to 255 with equal chance.
const MEAN: f32 = 8.0 * 127.5;

/// Inverse of that sum's standard deviation; each byte has the variance (256² − 1) / 12.
const PER_DEVIATION: f32 = 0.004_784_196;

/// Returns a 64-bit hash in which every input bit affects all output bits. Source: the finaliser of
/// SplitMix64 (Steele, Lea, Flood, OOPSLA 2014).
pub(crate) fn scrambled(mut bits: u64) -> u64 {
    bits = bits.wrapping_add(0x9E37_79B9_7F4A_7C15);
    bits = (bits ^ (bits >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    bits = (bits ^ (bits >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    bits ^ (bits >> 31)
}

/// Returns a 32-bit hash of the same kind, which vector registers compute for many inputs at once.
/// Source: hash-prospector (C. Wellons), its two-round hash of least bias.
#[inline(always)]
pub(crate) fn mix(mut bits: u32) -> u32 {
    bits = (bits ^ (bits >> 16)).wrapping_mul(0x21F0_AAAD);
    bits = (bits ^ (bits >> 15)).wrapping_mul(0x735A_2D97);
    bits ^ (bits >> 15)
}

/// Returns a number of mean 0 and variance 1 from 64 random bits: the standardised sum of their
/// eight bytes.
///
/// It is close to normal (excess kurtosis −0.15) up to three standard deviations and never exceeds
/// 4.9.
#[inline(always)]
pub(crate) fn standard_normal(low: u32, high: u32) -> f32 {
    const EVEN_BYTES: u32 = 0x00FF_00FF;
    let pairs = (low & EVEN_BYTES)
        + ((low >> 8) & EVEN_BYTES)
        + (high & EVEN_BYTES)
        + ((high >> 8) & EVEN_BYTES);
    let sum = (pairs & 0xFFFF) + (pairs >> 16);
    // At most 2040, so a signed conversion is right; an unsigned one is not one instruction
    // everywhere.
    (sum as i32 as f32 - MEAN) * PER_DEVIATION
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_of_consecutive_numbers_is_standard_normal_and_uncorrelated() {
        let draws: Vec<f64> = (0..1_000_000u32)
            .map(|number| {
                let low = mix(number ^ 0x1234_5678);
                f64::from(standard_normal(low, mix(low ^ 0x9ABC_DEF0)))
            })
            .collect();
        let mean_of =
            |f: &dyn Fn(usize) -> f64| (0..draws.len()).map(f).sum::<f64>() / draws.len() as f64;
        assert!(mean_of(&|i| draws[i]).abs() < 0.005);
        assert!((mean_of(&|i| draws[i].powi(2)) - 1.0).abs() < 0.01);
        assert!((mean_of(&|i| draws[i].powi(4)) - 2.85).abs() < 0.05);
        // Shares of a normal distribution within one, two and three standard deviations.
        for (deviations, share) in [(1.0, 0.683), (2.0, 0.954), (3.0, 0.997)] {
            let within = mean_of(&|i| f64::from(u8::from(draws[i].abs() <= deviations)));
            assert!((within - share).abs() < 0.01, "{deviations}: {within}");
        }
        // Neighbours in a row and in a column of an image.
        for lag in [1, 2, 127, 128, 129] {
            let correlation = mean_of(&|i| draws[i] * draws[(i + lag) % draws.len()]);
            assert!(correlation.abs() < 0.005, "lag {lag}: {correlation}");
        }
    }
}
