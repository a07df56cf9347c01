//! The matrix product under every layer: bounds checked here once, so that no layer needs `unsafe`.

use gemm::Parallelism;

/// `outputs[n, out] = inputs[n, in] · weights[in, out]`, all row-major; `n` follows from the lengths.
///
/// `outputs` is overwritten. `weights` is indexed input first, so that neighbouring outputs lie side by side and a vector register holds as many of them
/// as it can. One thread: an actor's cores are better used by more actors, and the sum's order stays the same.
///
/// # Panics
/// When the lengths are not whole multiples of `inputs_per_row` and `outputs_per_row`, or do not fit each other.
pub(super) fn multiply(
    inputs: &[f32],
    inputs_per_row: usize,
    weights: &[f32],
    outputs: &mut [f32],
    outputs_per_row: usize,
) {
    let rows = outputs.len() / outputs_per_row;
    assert_eq!(outputs.len(), rows * outputs_per_row, "outputs are whole rows");
    assert_eq!(
        inputs.len(),
        rows * inputs_per_row,
        "one row of inputs for each row of outputs"
    );
    assert_eq!(
        weights.len(),
        inputs_per_row * outputs_per_row,
        "a weight for each pair of input and output"
    );
    // SAFETY: the asserts above bound every access: `outputs` is `outputs_per_row` x `rows` with strides (1, outputs_per_row), `weights`
    // `outputs_per_row` x `inputs_per_row` with strides (1, outputs_per_row), `inputs` `inputs_per_row` x `rows` with strides (1, inputs_per_row).
    // `outputs` is borrowed mutably, so it overlaps neither of the others.
    unsafe {
        gemm::gemm(
            outputs_per_row,
            rows,
            inputs_per_row,
            outputs.as_mut_ptr(),
            outputs_per_row as isize,
            1,
            false,
            weights.as_ptr(),
            outputs_per_row as isize,
            1,
            inputs.as_ptr(),
            inputs_per_row as isize,
            1,
            0.0,
            1.0,
            false,
            false,
            false,
            Parallelism::None,
        );
    }
}

/// Adds `bias` `[out]` to every row of `values` `[n, out]` and cuts negative values to zero.
pub(super) fn add_bias_relu(values: &mut [f32], bias: &[f32]) {
    for row in values.chunks_exact_mut(bias.len()) {
        for (value, bias) in row.iter_mut().zip(bias) {
            let sum = *value + bias;
            // Unlike `max`, this lets through what is not a number: the simulator refuses it, where a silent zero would fly on.
            *value = if sum < 0.0 { 0.0 } else { sum };
        }
    }
}

/// Adds `bias` `[out]` to every row of `values` `[n, out]`.
pub(super) fn add_bias(values: &mut [f32], bias: &[f32]) {
    for row in values.chunks_exact_mut(bias.len()) {
        for (value, bias) in row.iter_mut().zip(bias) {
            *value += bias;
        }
    }
}

/// `[rows, columns]` row-major to `[columns, rows]`.
pub(super) fn transposed(matrix: &[f32], rows: usize, columns: usize) -> Vec<f32> {
    assert_eq!(matrix.len(), rows * columns, "the matrix has the stated shape");
    (0..columns)
        .flat_map(|column| (0..rows).map(move |row| matrix[row * columns + column]))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn product_is_the_textbooks() {
        let mut outputs = [9.0; 4];
        multiply(
            &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0],
            3,
            &[1.0, 10.0, 2.0, 20.0, 3.0, 30.0],
            &mut outputs,
            2,
        );
        assert_eq!(outputs, [14.0, 140.0, 32.0, 320.0]);
    }

    #[test]
    fn cutting_negatives_hides_no_fault() {
        let mut values = [-1.0, 2.0, f32::NAN, -3.0];
        add_bias_relu(&mut values, &[0.5, 0.5]);
        assert_eq!(values[..2], [0.0, 2.5]);
        assert!(values[2].is_nan() && values[3] == 0.0);
    }

    #[test]
    fn transposing_swaps_rows_and_columns() {
        assert_eq!(
            transposed(&[1.0, 2.0, 3.0, 4.0, 5.0, 6.0], 2, 3),
            [1.0, 4.0, 2.0, 5.0, 3.0, 6.0]
        );
    }
}
