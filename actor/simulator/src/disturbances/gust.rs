//! Gusts: a random force that wanders, as air in motion does.

use nalgebra::Vector3;
use rand::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;

use super::{GustSettings, standard_normal};

/// The gusts of one episode: a first-order Gauss-Markov process along each axis of the world, which
/// is what Dryden's model of turbulence is along the direction of episode.
///
/// With φ = exp(−Δt / τ), a step is f ← φ f + rms √(1 − φ²) n: the force keeps its rms whatever the
/// step's length, and its correlation over a time t is exp(−t / τ). Source: MIL-F-8785C, section
/// 3.7; the discrete form is in every text on it.
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
    /// The gusts of the episode seeded `seed`, in the middle of which it begins; `None` in calm
    /// air.
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

    /// The force of the last physics step on the body's centre of mass, world frame, N.
    pub(crate) fn force_n(&self) -> Vector3<f32> {
        self.force_n
    }

    /// The force of the next physics step on the body's centre of mass, world frame, N.
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
    fn force_has_the_rms_and_the_correlation_time_asked_for() {
        // 2000 s at a correlation of 0.2 s are 10,000 independent draws.
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
            // After the correlation time, 1/e is left; after three times that, a twentieth.
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
    fn an_episode_begins_in_the_middle_of_a_gust() {
        // Over many episodes, the first force has the rms of all.
        let episodes = 4000;
        let sum: f32 = (0..episodes)
            .map(|seed| forces(0.3, 5.0, seed, 1)[0].norm_squared())
            .sum();
        let rms = (sum / (3 * episodes) as f32).sqrt();
        assert!((rms - 0.3).abs() < 0.01, "{rms}");
    }

    #[test]
    fn the_same_seed_is_the_same_gust() {
        assert_eq!(forces(0.3, 1.0, 3, 100), forces(0.3, 1.0, 3, 100));
        assert_ne!(forces(0.3, 1.0, 3, 100), forces(0.3, 1.0, 4, 100));
    }
}
