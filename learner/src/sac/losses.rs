//! The three objectives of soft actor-critic and the critic's targets, as plain functions.
//!
//! Equation numbers are those of arXiv:1812.05905. Every expectation is a mean over the batch.
//! Callers detach whatever must not be differentiated: targets, and the temperature outside its own
//! objective.

use tch::Tensor;

/// Soft Bellman targets, `[n]` (eq. 2 and 3), with a' drawn from the policy:
/// r + γ (1 - terminated) (min Q̄(s', a') - α log π(a' | s')).
///
/// A truncated episode is not terminated: its last state has a future, so its value is
/// bootstrapped. `rewards`, `terminated`, `next_values` (the smaller Q̄) and `next_log_prob`:
/// `[n]`; `temperature`: α, `[1]`.
pub fn soft_targets(
    rewards: &Tensor,
    terminated: &Tensor,
    next_values: &Tensor,
    next_log_prob: &Tensor,
    temperature: &Tensor,
    discount: f64,
) -> Tensor {
    let soft_values = next_values - temperature * next_log_prob;
    let continues: Tensor = 1.0 - terminated;
    rewards + continues * soft_values * discount
}

/// Half the squared error of both estimates against the target, summed over the two (eq. 5).
/// `values`: `[n, 2]`, `targets`: `[n]`.
pub fn critic_loss(values: &Tensor, targets: &Tensor) -> Tensor {
    (values - targets.unsqueeze(1)).square().sum(None) * (0.5 / targets.size()[0] as f64)
}

/// α log π(a | s) - min Q(s, a), with a drawn from the policy (eq. 7). `log_prob`, `values` (the
/// smaller Q): `[n]`; `temperature`: α, `[1]`.
pub fn policy_loss(log_prob: &Tensor, values: &Tensor, temperature: &Tensor) -> Tensor {
    (temperature * log_prob - values).mean(None)
}

/// -α (log π(a | s) + H̄), minimised over log α (eq. 18): the temperature rises while the policy's
/// entropy is below the target H̄. `log_temperature`: log α, `[1]`; `log_prob`: `[n]`, detached.
pub fn temperature_loss(
    log_temperature: &Tensor,
    log_prob: &Tensor,
    target_entropy: f64,
) -> Tensor {
    -(log_temperature.exp() * (log_prob + target_entropy)).mean(None)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn numbers(values: &[f32]) -> Tensor {
        Tensor::from_slice(values)
    }

    fn assert_close(found: &Tensor, expected: &[f32]) {
        let found = Vec::<f32>::try_from(found.reshape([-1])).unwrap();
        assert_eq!(found.len(), expected.len());
        for (found, expected) in found.iter().zip(expected) {
            assert!((found - expected).abs() < 1e-5, "{found} is not {expected}");
        }
    }

    #[test]
    fn targets_match_hand_calculation() {
        let targets = soft_targets(
            &numbers(&[1.0, -0.5]),
            &numbers(&[0.0, 0.0]),
            &numbers(&[2.0, 3.0]),
            &numbers(&[-1.0, 0.5]),
            &numbers(&[0.2]),
            0.9,
        );
        // 1 + 0.9 (2 + 0.2 · 1) and -0.5 + 0.9 (3 - 0.2 · 0.5)
        assert_close(&targets, &[2.98, 2.11]);
    }

    #[test]
    fn a_truncated_episode_still_bootstraps() {
        // The same last step twice: one episode crashed, the other was cut off by its step limit.
        // Only the crash has no future.
        let (crashed, truncated) = (1.0, 0.0);
        let targets = soft_targets(
            &numbers(&[-1.0, -1.0]),
            &numbers(&[crashed, truncated]),
            &numbers(&[5.0, 5.0]),
            &numbers(&[0.0, 0.0]),
            &numbers(&[0.2]),
            0.9,
        );
        assert_close(&targets, &[-1.0, 3.5]);
    }

    #[test]
    fn critic_loss_matches_hand_calculation() {
        let values = numbers(&[1.0, 2.0, 0.0, -1.0]).view([2, 2]);
        // ½ ((1 - 3)² + (2 - 3)² + (0 - 1)² + (-1 - 1)²) / 2
        assert_close(&critic_loss(&values, &numbers(&[3.0, 1.0])), &[2.5]);
    }

    #[test]
    fn policy_loss_matches_hand_calculation() {
        // ((0.5 · 2 - 3) + (0.5 · -1 - 1)) / 2
        assert_close(
            &policy_loss(
                &numbers(&[2.0, -1.0]),
                &numbers(&[3.0, 1.0]),
                &numbers(&[0.5]),
            ),
            &[-1.75],
        );
    }

    #[test]
    fn temperature_loss_and_its_gradient_match_hand_calculation() {
        let log_temperature = numbers(&[0.2_f32.ln()]).set_requires_grad(true);
        // -0.2 ((1 - 2) + (4 - 2)) / 2; its derivative by log α is itself.
        let loss = temperature_loss(&log_temperature, &numbers(&[1.0, 4.0]), -2.0);
        assert_close(&loss, &[-0.1]);
        let gradient = Tensor::run_backward(&[loss], &[&log_temperature], false, false);
        assert_close(&gradient[0], &[-0.1]);
    }
}
