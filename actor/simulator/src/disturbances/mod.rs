//! What an episode meets that the policy did not ask for: a noisy depth camera, gusts, late
//! commands, a drone of another mass.
//!
//! Each can be switched on alone, all are off by default, and off they change no bit of an episode.
//! What is drawn is drawn from a generator that
//! [`Simulator::reset`](crate::simulator::Simulator::reset) takes, so that a disturbed episode is
//! as repeatable as a calm one. Draws do not shift each other: the mass of an episode is the same
//! whether or not there are gusts.

mod delay;
mod gust;
mod normal;
mod settings;
#[cfg(test)]
mod tests;

use rand::{Rng, RngExt};

pub(crate) use delay::Delay;
pub(crate) use gust::Gust;
pub(crate) use normal::{mix, scrambled, standard_normal};
pub use settings::{
    DepthModel, DepthNoiseSettings, DisturbanceFault, DisturbanceSettings, GustSettings,
};

/// What was drawn for one episode.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Drawn {
    /// Whether it is disturbed at all.
    pub(crate) disturbed: bool,
    /// Mass and inertia of the body, as a share of what they nominally are.
    pub(crate) mass_factor: f32,
    /// Seed of its gusts.
    pub(crate) gust_seed: u64,
    /// Seed of what its camera gets wrong.
    pub(crate) depth_seed: u64,
}

impl Drawn {
    /// Draws for one episode, always as much and in the same order.
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
