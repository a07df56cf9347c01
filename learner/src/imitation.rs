//! Distance between the policy's action and the teacher's, and its gradient.

use crate::networks::native::squash;

/// Returns |tanh μ - a*|², summed over the action and averaged over the rows. Adds `weight` times
/// its gradient with respect to the policy's `outputs` to `grad`; both are `[rows, 2 · action]`: in
/// each row the means, then the logarithms of the standard deviations. An action has `action`
/// numbers.
///
/// μ: the mean before tanh; a*: the teacher's action, `[rows, action]`. A means' gradient is
/// 2 (tanh μ - a*) (1 - tanh² μ) over the number of rows.
pub(crate) fn imitate(
    outputs: &[f32],
    teacher_actions: &[f32],
    action: usize,
    weight: f32,
    grad: &mut [f32],
) -> f32 {
    let rows = teacher_actions.len() / action;
    let share = weight / rows as f32;
    let mut distance = 0.0;
    let means = outputs
        .chunks_exact(2 * action)
        .zip(grad.chunks_exact_mut(2 * action));
    for ((outputs, grad), teacher) in means.zip(teacher_actions.chunks_exact(action)) {
        for ((&mean, grad), teacher) in outputs.iter().zip(grad).zip(teacher) {
            let [action, slope, _] = squash(mean);
            let error = action - teacher;
            distance += f64::from(error * error);
            *grad += 2.0 * share * error * slope;
        }
    }
    (distance / rows as f64) as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_gradient_is_the_slope_of_the_weighted_distance() {
        // Two rows of two numbers, then the same as one row of four.
        let outputs = [0.3, -0.7, 9.0, 9.0, -1.1, 0.2, 9.0, 9.0];
        let teacher = [1.0, -1.0, 0.25, 0.0];
        for action in [2, 4] {
            let mut grad = [0.5; 8];
            imitate(&outputs, &teacher, action, 3.0, &mut grad);
            for index in 0..outputs.len() {
                let distance = |step: f32| {
                    let mut moved = outputs;
                    moved[index] += step;
                    imitate(&moved, &teacher, action, 0.0, &mut [0.0; 8])
                };
                let slope = (distance(1e-2) - distance(-1e-2)) / 2e-2;
                let expected = 0.5 + 3.0 * slope;
                assert!(
                    (grad[index] - expected).abs() < 1e-3,
                    "{action}: output {index}"
                );
            }
        }
    }

    #[test]
    fn the_distance_is_zero_where_the_policy_does_as_the_teacher() {
        let outputs = [0.5_f32, -0.5, 0.0, 0.0];
        let teacher = [0.5_f32.tanh(), -0.5_f32.tanh()];
        assert!(imitate(&outputs, &teacher, 2, 1.0, &mut [0.0; 4]) < 1e-12);
    }
}
