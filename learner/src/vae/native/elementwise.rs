//! Elementwise operations between the matrix products.

use skein_kernels::{Isa, sigmoid};

/// Width of partial sums, which are then added in order. So the result does not depend on the
/// register width.
pub(super) const LANES: usize = 16;

/// Sets every pixel of `image`, `[pixels, channels]`, to `bias`, `[channels]`.
pub(super) fn fill(image: &mut [f32], bias: &[f32]) {
    if let [bias] = bias {
        return image.fill(*bias);
    }
    for pixel in image.chunks_exact_mut(bias.len()) {
        pixel.copy_from_slice(bias);
    }
}

/// Applies ReLU in place. NaN stays NaN.
pub(super) fn rectify(isa: Isa, values: &mut [f32]) {
    isa.vectorised(
        #[inline(always)]
        || {
            for value in values {
                *value = if *value < 0.0 { 0.0 } else { *value };
            }
        },
    );
}

/// Sets values to zero where `by` is not positive: the gradient through a ReLU with output `by`.
pub(super) fn gate(isa: Isa, values: &mut [f32], by: &[f32]) {
    isa.vectorised(
        #[inline(always)]
        || {
            for (value, by) in values.iter_mut().zip(by) {
                *value = if *by > 0.0 { *value } else { 0.0 };
            }
        },
    );
}

/// Sums the rows of `[rows, sums.len()]`, in order.
pub(super) fn column_sums(isa: Isa, rows: &[f32], sums: &mut [f32]) {
    let columns = sums.len();
    if columns < LANES {
        debug_assert_eq!(columns, 1, "a layer has one channel or many");
        let mut lanes = [0.0_f32; LANES];
        isa.vectorised(
            #[inline(always)]
            || {
                for values in rows.chunks_exact(LANES) {
                    for (sum, value) in lanes.iter_mut().zip(values) {
                        *sum += value;
                    }
                }
            },
        );
        sums[0] = lanes.iter().sum();
        return;
    }
    for (block, sums) in sums.chunks_exact_mut(LANES).enumerate() {
        let mut lanes = [0.0_f32; LANES];
        isa.vectorised(
            #[inline(always)]
            || {
                for row in rows.chunks_exact(columns) {
                    let values: &[f32; LANES] =
                        row[block * LANES..][..LANES].try_into().expect("so long");
                    for (sum, value) in lanes.iter_mut().zip(values) {
                        *sum += value;
                    }
                }
            },
        );
        sums.copy_from_slice(&lanes);
    }
}

/// Sum of squares, exact to the last bits of f32.
pub(super) fn squares(isa: Isa, values: &[f32]) -> f64 {
    let mut total = 0.0;
    // In stretches, so that no sum grows far beyond its terms.
    for stretch in values.chunks(1 << 14) {
        let mut lanes = [0.0_f32; 2 * LANES];
        let mut whole = stretch.chunks_exact(2 * LANES);
        isa.vectorised(
            #[inline(always)]
            || {
                for values in &mut whole {
                    for (sum, value) in lanes.iter_mut().zip(values) {
                        *sum = value.mul_add(*value, *sum);
                    }
                }
            },
        );
        for (sum, value) in lanes.iter_mut().zip(whole.remainder()) {
            *sum = value.mul_add(*value, *sum);
        }
        total += lanes.iter().map(|&lane| f64::from(lane)).sum::<f64>();
    }
    total
}

/// Converts depth bytes to pixels in [0, 1].
pub(super) fn scale(isa: Isa, bytes: &[u8], pixels: &mut [f32]) {
    isa.vectorised(
        #[inline(always)]
        || {
            for (pixel, byte) in pixels.iter_mut().zip(bytes) {
                *pixel = f32::from(*byte) * (1.0 / 255.0);
            }
        },
    );
}

/// Applies the sigmoid in place.
pub(super) fn sigmoids(isa: Isa, values: &mut [f32]) {
    isa.vectorised(
        #[inline(always)]
        || {
            for value in values {
                *value = sigmoid(*value);
            }
        },
    );
}

/// Replaces the inputs of the last sigmoid by `weight` times the gradient of half the squared error
/// in them. Returns the sum of squared errors between sigmoid and `pixels`.
pub(super) fn reconstruction_error(
    isa: Isa,
    values: &mut [f32],
    pixels: &[f32],
    weight: f32,
) -> f64 {
    let mut lanes = [0.0_f32; LANES];
    isa.vectorised(
        #[inline(always)]
        || {
            for (values, pixels) in values
                .chunks_exact_mut(LANES)
                .zip(pixels.chunks_exact(LANES))
            {
                for ((value, pixel), sum) in values.iter_mut().zip(pixels).zip(&mut lanes) {
                    let seen = sigmoid(*value);
                    let error = seen - pixel;
                    *sum = error.mul_add(error, *sum);
                    *value = weight * error * (seen * (1.0 - seen));
                }
            }
        },
    );
    lanes.iter().map(|&lane| f64::from(lane)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_summed_row_by_row() {
        let rows: Vec<f32> = (0..3 * 32).map(|number| number as f32).collect();
        let mut sums = [0.0; 32];
        column_sums(Isa::best(), &rows, &mut sums);
        let expected: [f32; 32] = std::array::from_fn(|column| 3.0 * column as f32 + 96.0);
        assert_eq!(sums, expected);
        let mut sum = [0.0];
        column_sums(Isa::best(), &rows, &mut sum);
        assert_eq!(sum, [(95 * 96 / 2) as f32]);
    }

    #[test]
    fn squares_are_summed_to_the_last_number() {
        let values: Vec<f32> = (0..(1 << 14) + 37)
            .map(|number| (number % 7) as f32)
            .collect();
        let expected: f32 = values.iter().map(|value| value * value).sum();
        assert_eq!(squares(Isa::best(), &values), f64::from(expected));
    }

    #[test]
    fn the_error_and_its_gradient_match_differences() {
        let (before, pixels) = ([0.3_f32; LANES], [0.9_f32; LANES]);
        let error =
            |before: f32| LANES as f64 * (1.0 / (1.0 + (-f64::from(before)).exp()) - 0.9).powi(2);
        let mut values = before;
        let found = reconstruction_error(Isa::best(), &mut values, &pixels, 2.0);
        assert!((found - error(0.3)).abs() < 1e-6);
        let slope = (error(0.3 + 1e-3) - error(0.3 - 1e-3)) / 2e-3 / LANES as f64;
        assert!(
            (f64::from(values[0]) - slope).abs() < 1e-5,
            "{} is not {slope}",
            values[0]
        );
    }
}
