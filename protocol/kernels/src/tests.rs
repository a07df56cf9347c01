//! Products and gradients compared with their definition, bit for bit, for every instruction set.

use proptest::prelude::*;

use crate::*;

/// Pseudo-random numbers in [-1, 1).
fn numbers(len: usize, seed: u64) -> Vec<f32> {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    (0..len)
        .map(|_| {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 40) as f32 / (1 << 23) as f32 - 1.0
        })
        .collect()
}

fn available() -> impl Iterator<Item = Isa> {
    Isa::ALL.into_iter().filter(|isa| isa.is_available())
}

/// The definition of a product: each element's terms in order, one fused multiply-add each.
fn defined(
    rows: &[Vec<f32>],
    right: impl Fn(usize, usize) -> f32,
    columns: usize,
    start: impl Fn(usize) -> f32,
) -> Vec<f32> {
    let element = |row: &[f32], column: usize| {
        let terms = row.iter().enumerate();
        terms.fold(start(column), |sum, (term, left)| {
            left.mul_add(right(term, column), sum)
        })
    };
    let elements = |row: &Vec<f32>| {
        (0..columns)
            .map(|column| element(row, column))
            .collect::<Vec<f32>>()
    };
    rows.iter().flat_map(elements).collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(60))]

    #[test]
    fn a_product_is_its_definition_to_the_last_bit(
        count in 0_usize..40,
        terms in 1_usize..600,
        columns in 1_usize..70,
        way in 0..4,
        seed in 1_u64..1000,
    ) {
        let (left, right) = (numbers(count * terms, seed), numbers(terms * columns, seed + 1));
        let (bias, gate) = (numbers(columns, seed + 2), numbers(count * columns, seed + 3));
        let matrix = if way % 2 == 0 {
            Matrix::of_rows(&right, columns)
        } else {
            Matrix::of_rows(&right, terms).transposed()
        };
        let at = |term: usize, column: usize| match way % 2 {
            0 => right[term * columns + column],
            _ => right[column * terms + term],
        };
        let rows: Vec<Vec<f32>> = left.chunks(terms).map(<[f32]>::to_vec).collect();
        let (start, finish) = match way {
            0 => (Start::Zero, Finish::Plain),
            1 => (Start::Bias(&bias), Finish::Rectified),
            2 => (Start::Zero, Finish::Gated(&gate)),
            _ => (Start::Bias(&bias), Finish::Plain),
        };
        let begin = |column: usize| if way % 2 == 0 { 0.0 } else { bias[column] };
        let mut expected = defined(&rows, at, columns, begin);
        for (element, gate) in expected.iter_mut().zip(&gate) {
            if way == 1 && *element < 0.0 || way == 2 && *gate <= 0.0 {
                *element = 0.0;
            }
        }
        for isa in available() {
            let mut output = vec![f32::NAN; count * columns];
            product(Rows::Matrix(&left), &Panels::of(isa, matrix), start, finish, &mut output);
            prop_assert_eq!(&output, &expected, "{}", isa);
            output.fill(f32::NAN);
            product_once(isa, &left, matrix, start, finish, &mut output);
            prop_assert_eq!(&output, &expected, "{}", isa);
        }
    }

    #[test]
    fn a_convolution_is_its_definition_and_so_is_its_gradient(
        size in [1_usize..9, 1_usize..9],
        channels in 1_usize..20,
        kernel in [1_usize..4, 1_usize..4],
        stride in 1_usize..3,
        outputs in 1_usize..20,
        images in 1_usize..4,
        seed in 1_u64..1000,
    ) {
        prop_assume!(kernel[0] <= size[0] && kernel[1] <= size[1]);
        let windows = Windows::new(size, channels, kernel, stride);
        let input = numbers(images * windows.image_len(), seed);
        let weights = numbers(outputs * windows.window_len(), seed + 1);
        let grad = numbers(images * windows.count() * outputs, seed + 2);
        let [_, across] = windows.positions();
        let seen: Vec<Vec<f32>> = input
            .chunks(windows.image_len())
            .flat_map(|image| (0..windows.count()).map(move |window| (image, window)))
            .map(|(image, window)| {
                let (top, left) = (window / across * stride, window % across * stride);
                let places =
                    (0..kernel[0]).flat_map(|y| (0..kernel[1]).map(move |x| (top + y, left + x)));
                let pixel = |(y, x)| &image[(y * size[1] + x) * channels..][..channels];
                places.flat_map(pixel).copied().collect()
            })
            .collect();
        let len = windows.window_len();
        let weight = |term: usize, output: usize| weights[output * len + term];
        let expected = defined(&seen, weight, outputs, |_| 0.0);
        let grad_columns: Vec<Vec<f32>> = (0..outputs)
            .map(|output| grad.iter().skip(output).step_by(outputs).copied().collect())
            .collect();
        let number = |term: usize, number: usize| seen[term][number];
        let expected_gradient = defined(&grad_columns, number, len, |_| 0.0);
        for isa in available() {
            let panels = Panels::of(isa, Matrix::of_rows(&weights, len).transposed());
            let mut output = vec![f32::NAN; expected.len()];
            let output_len = windows.count() * outputs;
            let input_images = input.chunks(windows.image_len());
            for (image, output) in input_images.zip(output.chunks_mut(output_len)) {
                let rows = Rows::Windows(&windows, image);
                product(rows, &panels, Start::Zero, Finish::Plain, output);
            }
            prop_assert_eq!(&output, &expected, "{}", isa);
            let mut found = vec![f32::NAN; expected_gradient.len()];
            let grad = Matrix::of_rows(&grad, outputs);
            gradient(&mut Team::new(1), isa, grad, Terms::Windows(&windows, &input), &mut found);
            prop_assert_eq!(&found, &expected_gradient, "{}", isa);

            // `spread` equals product and `add_back` up to the order of sums, and has the same bits
            // with all instruction sets.
            let columns = defined(
                &output.chunks(outputs).map(<[f32]>::to_vec).collect::<Vec<_>>(),
                |term, number| weights[term * len + number],
                len,
                |_| 0.0,
            );
            let weights = Matrix::of_rows(&weights, len);
            let panels = [Isa::Portable, isa].map(|isa| Panels::of(isa, weights));
            let columns = columns.chunks(windows.count() * len);
            for (rows, columns) in output.chunks(output_len).zip(columns) {
                let mut added = vec![0.5; windows.image_len()];
                windows.add_back(isa, 0..windows.count(), columns, &mut added);
                let [portable, found] = panels.each_ref().map(|panels| {
                    let mut image = vec![0.5; windows.image_len()];
                    spread(rows, panels, &windows, &mut Vec::new(), &mut image);
                    image
                });
                prop_assert_eq!(&found, &portable, "{}", isa);
                for (found, added) in found.iter().zip(&added) {
                    let apart = (found - added).abs();
                    prop_assert!(apart <= 1e-4 * (1.0 + added.abs()), "{} is not {}", found, added);
                }
            }
        }
    }

    #[test]
    fn spread_in_place_is_its_definition_to_the_last_bit(
        size in [1_usize..8, 1_usize..9],
        kernel in [1_usize..4, 1_usize..5],
        stride in 1_usize..4,
        registers in 1_usize..3,
        terms in prop_oneof![1_usize..40, 250_usize..300],
        seed in 1_u64..1000,
    ) {
        prop_assume!(kernel[0] <= size[0] && kernel[1] <= size[1]);
        let channels = 32 * registers;
        let windows = Windows::new(size, channels, kernel, stride);
        let (len, [_, across]) = (windows.window_len(), windows.positions());
        let rows = numbers(windows.count() * terms, seed);
        let weights = numbers(terms * len, seed + 1);
        let held = numbers(windows.image_len(), seed + 2);
        // For each number of a window: the terms of all windows in turn, added to the image's
        // content.
        let mut expected = held.clone();
        for number in 0..len {
            let (y, x) = (number / channels / kernel[1], number / channels % kernel[1]);
            for (window, row) in rows.chunks(terms).enumerate() {
                let pixel = (window / across * stride + y) * size[1] + window % across * stride + x;
                let sum = &mut expected[pixel * channels + number % channels];
                let terms = row.iter().enumerate();
                *sum = terms.fold(*sum, |sum, (term, left)| {
                    left.mul_add(weights[term * len + number], sum)
                });
            }
        }
        for isa in available() {
            let mut image = held.clone();
            let panels = Panels::of(isa, Matrix::of_rows(&weights, len));
            spread(&rows, &panels, &windows, &mut Vec::new(), &mut image);
            prop_assert_eq!(&image, &expected, "{}", isa);
        }
    }
}

#[test]
fn a_single_row_below_grouped_panels_is_its_definition() {
    for (terms, columns) in [(5, 64), (300, 65), (7, 128), (256, 200), (600, 256)] {
        let (left, right) = (numbers(terms, 1), numbers(terms * columns, 2));
        let (bias, mut gate) = (numbers(columns, 3), numbers(columns, 4));
        // A ReLU with output zero has no gradient.
        gate[..3].fill(0.0);
        let at = |term: usize, column: usize| right[term * columns + column];
        let rows = [left.clone()];
        let biased = defined(&rows, at, columns, |column| bias[column]);
        let rectified: Vec<f32> = biased.iter().map(|value| value.max(0.0)).collect();
        let plain = defined(&rows, at, columns, |_| 0.0);
        let gated: Vec<f32> = plain
            .iter()
            .zip(&gate)
            .map(|(value, gate)| if *gate > 0.0 { *value } else { 0.0 })
            .collect();
        for isa in available() {
            let panels = Panels::of(isa, Matrix::of_rows(&right, columns));
            // One window on an image with one position is a single row, too.
            let windows = Windows::new([1, terms], 1, [1, terms], 1);
            for rows in [Rows::Matrix(&left), Rows::Windows(&windows, &left)] {
                for (start, finish, expected) in [
                    (Start::Bias(&bias), Finish::Rectified, &rectified),
                    (Start::Bias(&bias), Finish::Plain, &biased),
                    (Start::Zero, Finish::Gated(&gate), &gated),
                ] {
                    let mut output = vec![f32::NAN; columns];
                    product(rows, &panels, start, finish, &mut output);
                    assert_eq!(&output, expected, "{isa}, {terms} terms, {columns} columns");
                }
            }
        }
    }
}

#[test]
fn a_gradient_is_its_definition_for_any_number_of_members() {
    // More terms than one block, columns that fill no panel, rows that fill no tile.
    for (terms, rows, columns) in [(600, 7, 70), (1, 13, 4), (300, 64, 33), (0, 3, 5)] {
        let (left, right) = (numbers(terms * rows, 1), numbers(terms * columns, 2));
        let by_column: Vec<Vec<f32>> = (0..rows)
            .map(|row| left.iter().skip(row).step_by(rows).copied().collect())
            .collect();
        let expected = defined(
            &by_column,
            |term, column| right[term * columns + column],
            columns,
            |_| 0.0,
        );
        for isa in available() {
            for size in 1..=3 {
                let mut output = vec![f32::NAN; rows * columns];
                let left = Matrix::of_rows(&left, rows);
                gradient(
                    &mut Team::new(size),
                    isa,
                    left,
                    Terms::Matrix(&right, columns),
                    &mut output,
                );
                assert_eq!(output, expected, "{isa}, {size} members");
            }
        }
    }
}

#[test]
fn nan_stays_nan_through_a_relu() {
    let weights = numbers(4 * 20, 1);
    for isa in available() {
        let mut output = [0.0; 20];
        let left = [1.0, f32::NAN, 0.0, 0.0];
        let panels = Panels::of(isa, Matrix::of_rows(&weights, 20));
        product(
            Rows::Matrix(&left),
            &panels,
            Start::Zero,
            Finish::Rectified,
            &mut output,
        );
        assert!(
            output.iter().all(|value| value.is_nan()),
            "{isa}: {output:?}"
        );
    }
}

#[test]
#[should_panic(expected = "the output has")]
fn an_output_that_is_too_short_is_refused() {
    let panels = Panels::of(Isa::best(), Matrix::of_rows(&[1.0; 6], 3));
    product(
        Rows::Matrix(&[1.0; 4]),
        &panels,
        Start::Zero,
        Finish::Plain,
        &mut [0.0; 5],
    );
}

#[test]
#[should_panic(expected = "a bias for each column")]
fn a_bias_that_is_too_short_is_refused() {
    let panels = Panels::of(Isa::best(), Matrix::of_rows(&[1.0; 6], 3));
    product(
        Rows::Matrix(&[1.0; 2]),
        &panels,
        Start::Bias(&[1.0; 2]),
        Finish::Plain,
        &mut [0.0; 3],
    );
}

#[test]
#[should_panic(expected = "the image has the size that the windows are for")]
fn an_image_of_another_size_is_refused() {
    let windows = Windows::new([3, 3], 1, [2, 2], 1);
    let panels = Panels::of(Isa::best(), Matrix::of_rows(&[1.0; 4], 1));
    product(
        Rows::Windows(&windows, &[0.0; 8]),
        &panels,
        Start::Zero,
        Finish::Plain,
        &mut [0.0; 4],
    );
}
