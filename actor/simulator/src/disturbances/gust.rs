//! Gusts: a random force that changes gradually, like moving air.

use nalgebra::Vector3;
use rand::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;

use super::{GustSettings, standard_normal};

/// Gusts of one episode: a first-order Gauss-Markov process along each axis of the world. Dryden's
/// model of turbulence is the same process along the direction of flight.
///
/// With φ = exp(−Δt / τ) and a standard normal n, a step is f ← φ f + rms √(1 − φ²) n. So the rms
/// of the force does not depend on the step's length, and its correlation over a time t is
/// exp(−t / τ). Source: MIL-F-8785C, section 3.7; every text on the process gives the discrete
/// form.
#[derive(Debug, Clone)]
pub(crate) struct Gust {
    rng: Pcg64Mcg,
    force_n: Vector3<f32>,
    /// φ.
    kept: f32,
    /// rms √(1 − φ²), N.
    kick_n: f32,
}

impl Gust {
    /// Returns the gusts of the episode with this seed; `None` in calm air. The first force is
    /// drawn from the stationary distribution, so the episode starts in the middle of a gust.
    pub(crate) fn new(settings: &GustSettings, dt_secs: f32, seed: u64) -> Option<Self> {
        if settings.force_rms_n == 0.0 {
            return None;
        }
        let kept = (-dt_secs / settings.correlation_secs).exp();
        let mut gust = Self {
            rng: Pcg64Mcg::seed_from_u64(seed),
            force_n: Vector3::zeros(),
            kept,
            kick_n: settings.force_rms_n * (1.0 - kept * kept).sqrt(),
        };
        gust.force_n = gust.draw() * settings.force_rms_n;
        Some(gust)
    }

    /// Returns the force of the last physics step on the centre of mass, world frame, N.
    pub(crate) fn force_n(&self) -> Vector3<f32> {
        self.force_n
    }

    /// Returns the force of the next physics step on the centre of mass, world frame, N.
    pub(crate) fn advance(&mut self) -> Vector3<f32> {
        self.force_n = self.force_n * self.kept + self.draw() * self.kick_n;
        self.force_n
    }

    fn draw(&mut self) -> Vector3<f32> {
        Vector3::from_fn(|_, _| {
            let bits = self.rng.next_u64();
            standard_normal(bits as u32, (bits >> 32) as u32)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DT_SECS: f32 = 0.005;

    fn forces(
        force_rms_n: f32,
        correlation_secs: f32,
        seed: u64,
        steps: usize,
    ) -> Vec<Vector3<f32>> {
        let settings = GustSettings {
            force_rms_n,
            correlation_secs,
        };
        let mut gust = Gust::new(&settings, DT_SECS, seed).unwrap();
        (0..steps).map(|_| gust.advance()).collect()
    }

    #[test]
    fn force_has_the_configured_rms_and_correlation_time() {
        // 2000 s at a correlation time of 0.2 s hold 10,000 independent draws.
        let forces = forces(0.3, 0.2, 7, 400_000);
        let product = |lag: usize, axis: usize| {
            let pairs = forces.len() - lag;
            let sum: f64 = (0..pairs)
                .map(|i| f64::from(forces[i][axis]) * f64::from(forces[i + lag][axis]))
                .sum();
            sum / pairs as f64
        };
        for axis in 0..3 {
            let rms = product(0, axis).sqrt();
            assert!((rms - 0.3).abs() < 0.01, "axis {axis}: {rms}");
            // After the correlation time 1/e is left, after three times that a twentieth.
            for (secs, left) in [(0.2, 0.368), (0.6, 0.050)] {
                let correlation = product((secs / DT_SECS) as usize, axis) / product(0, axis);
                assert!(
                    (correlation - left).abs() < 0.05,
                    "axis {axis}, {secs} s: {correlation}"
                );
            }
        }
    }

    #[test]
    fn an_episode_starts_in_the_middle_of_a_gust() {
        // Over many episodes, the first force has the configured rms.
        let episodes = 4000;
        let sum: f32 = (0..episodes)
            .map(|seed| forces(0.3, 5.0, seed, 1)[0].norm_squared())
            .sum();
        let rms = (sum / (3 * episodes) as f32).sqrt();
        assert!((rms - 0.3).abs() < 0.01, "{rms}");
    }

    #[test]
    fn the_same_seed_gives_the_same_gust() {
        assert_eq!(forces(0.3, 1.0, 3, 100), forces(0.3, 1.0, 3, 100));
        assert_ne!(forces(0.3, 1.0, 3, 100), forces(0.3, 1.0, 4, 100));
    }
}
