//! Disturbances of an episode: a noisy depth camera, gusts, late commands, a different mass.
//!
//! Each can be switched on alone. All are off by default, and then they change no bit of an
//! episode. All random draws come from the generator given to
//! [`Simulator::reset`](crate::simulator::Simulator::reset), so that a disturbed episode is as
//! repeatable as a calm one. Draws do not shift each other: the mass of an episode is the same with
//! and without gusts.

mod delay;
mod gust;
mod normal;
mod settings;
#[cfg(test)]
mod tests;

use rand::{Rng, RngExt};

pub(crate) use delay::CommandDelay;
pub(crate) use gust::Gust;
pub(crate) use normal::{mix, scrambled, standard_normal};
pub use settings::{
    DepthModel, DepthNoiseSettings, DisturbanceSettings, DisturbanceSettingsError, GustSettings,
};

/// Disturbances drawn for one episode.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct DrawnDisturbances {
    /// `false` if the episode is calm.
    pub(crate) disturbed: bool,
    /// Mass and inertia of the body relative to their nominal values.
    pub(crate) mass_factor: f32,
    /// Seed of the gusts.
    pub(crate) gust_seed: u64,
    /// Seed of the camera's errors.
    pub(crate) depth_seed: u64,
}

impl DrawnDisturbances {
    /// Draws for one episode: always the same number of values in the same order.
    pub(crate) fn draw(settings: &DisturbanceSettings, rng: &mut impl Rng) -> Self {
        let deviation: f32 = rng.random_range(-1.0..=1.0);
        let [gust_seed, depth_seed] = [rng.random(), rng.random()];
        let disturbed = rng.random::<f32>() < settings.share;
        Self {
            disturbed,
            mass_factor: if disturbed {
                1.0 + settings.mass_spread * deviation
            } else {
                1.0
            },
            gust_seed,
            depth_seed,
        }
    }
}
