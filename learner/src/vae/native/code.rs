//! The latent code between encoder and decoder: sampling, divergence, and the gradient through
//! both.

use skein_kernels::{Isa, exp};
use skein_protocol::MAX_LATENT;

use crate::networks::LOG_VARIANCE_BOUND;

const BOUND: f32 = LOG_VARIANCE_BOUND as f32;

/// Samples codes as mean + std · noise (arXiv:1312.6114, section 2.4), `[n, latent]`. `heads`:
/// means and unbounded log-variances side by side, `[n, 2 latent]`; `noise`: standard normal,
/// `[n, latent]`. Returns the sum of the divergences from the standard normal, in nats (appendix
/// B).
pub(super) fn sample(
    isa: Isa,
    latent: usize,
    heads: &[f32],
    noise: &[f32],
    codes: &mut [f32],
) -> f64 {
    let mut total = 0.0;
    let terms = &mut [0.0_f32; MAX_LATENT][..latent];
    let rows = heads
        .chunks_exact(2 * latent)
        .zip(noise.chunks_exact(latent));
    for ((heads, noise), codes) in rows.zip(codes.chunks_exact_mut(latent)) {
        let (means, log_variances) = heads.split_at(latent);
        isa.vectorised(
            #[inline(always)]
            || {
                for place in 0..latent {
                    let (mean, log_variance) =
                        (means[place], log_variances[place].clamp(-BOUND, BOUND));
                    codes[place] = exp(0.5 * log_variance).mul_add(noise[place], mean);
                    terms[place] = mean * mean + exp(log_variance) - log_variance - 1.0;
                }
            },
        );
        total += terms.iter().map(|&term| f64::from(term)).sum::<f64>();
    }
    0.5 * total
}

/// Computes the gradient with respect to the heads, `[n, 2 latent]`, from the gradient with respect
/// to the codes, `[n, latent]`, and from the divergence, weighted by `divergence_weight`.
pub(super) fn backward(
    isa: Isa,
    latent: usize,
    heads: &[f32],
    noise: &[f32],
    codes_grad: &[f32],
    divergence_weight: f32,
    heads_grad: &mut [f32],
) {
    let rows = heads
        .chunks_exact(2 * latent)
        .zip(noise.chunks_exact(latent));
    let grads = codes_grad
        .chunks_exact(latent)
        .zip(heads_grad.chunks_exact_mut(2 * latent));
    for ((heads, noise), (grad, into)) in rows.zip(grads) {
        let (means, log_variances) = heads.split_at(latent);
        let (mean_grad, log_variance_grad) = into.split_at_mut(latent);
        isa.vectorised(
            #[inline(always)]
            || {
                for place in 0..latent {
                    let (mean, unbounded) = (means[place], log_variances[place]);
                    let log_variance = unbounded.clamp(-BOUND, BOUND);
                    mean_grad[place] = divergence_weight.mul_add(mean, grad[place]);
                    let drawn = 0.5 * grad[place] * noise[place] * exp(0.5 * log_variance);
                    let gradient =
                        (0.5 * divergence_weight).mul_add(exp(log_variance) - 1.0, drawn);
                    // The log-variance has no effect outside its bounds.
                    log_variance_grad[place] = if (-BOUND..=BOUND).contains(&unbounded) {
                        gradient
                    } else {
                        0.0
                    };
                }
            },
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LATENT: usize = 16;

    #[test]
    fn divergence_matches_hand_calculation() {
        let mut heads = [0.0; 4 * LATENT];
        // ½ (1 + (2 - ln 2 - 1)) for the first code, 0 for the second, which is the prior.
        (heads[0], heads[LATENT + 1]) = (1.0, 2.0_f32.ln());
        let mut codes = [0.0; 2 * LATENT];
        let found = sample(Isa::best(), LATENT, &heads, &[0.5; 2 * LATENT], &mut codes);
        let expected = 0.5 * (1.0 + 1.0 - std::f64::consts::LN_2);
        assert!((found - expected).abs() < 1e-6, "{found} is not {expected}");
        assert_eq!((codes[0], codes[2], codes[LATENT]), (1.5, 0.5, 0.5));
        assert!((codes[1] - 0.5 * 2.0_f32.sqrt()).abs() < 1e-6);
    }

    #[test]
    fn the_gradient_is_the_slope_of_the_sampled_loss() {
        let mut heads: [f32; 2 * LATENT] =
            std::array::from_fn(|place| (place as f32 * 0.7).sin() * 2.0);
        // Two log-variances out of bounds.
        (heads[LATENT + 3], heads[LATENT + 4]) = (11.0, -12.0);
        let noise: [f32; LATENT] = std::array::from_fn(|place| (place as f32 * 1.3).cos());
        let grad: [f32; LATENT] = std::array::from_fn(|place| (place as f32 * 0.4).cos());
        // The loss is Σ grad · code + weight · divergence.
        let weight = 0.3;
        let loss = |heads: &[f32]| {
            let mut codes = [0.0; LATENT];
            let divergence = sample(Isa::best(), LATENT, heads, &noise, &mut codes);
            let linear: f64 = codes
                .iter()
                .zip(&grad)
                .map(|(code, flow)| f64::from(code * flow))
                .sum();
            linear + f64::from(weight) * divergence
        };
        let mut found = [0.0; 2 * LATENT];
        backward(
            Isa::best(),
            LATENT,
            &heads,
            &noise,
            &grad,
            weight,
            &mut found,
        );
        for place in 0..2 * LATENT {
            let at = |moved: f32| {
                let mut heads = heads;
                heads[place] += moved;
                loss(&heads)
            };
            let slope = (at(0.02) - at(-0.02)) / 0.04;
            let error = (f64::from(found[place]) - slope).abs();
            assert!(
                error < 2e-3 * (1.0 + slope.abs()),
                "{place}: {} is not {slope}",
                found[place]
            );
        }
    }
}
