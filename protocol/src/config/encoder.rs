//! The `[encoder]` section.

use serde::{Deserialize, Serialize};

use super::{InvalidValue, require};

/// The `[encoder]` section: an encoder trained before any run, by `skein encoder`, on images from
/// random poses in generated courses. Runs ignore it. Length of the code, minibatch, learning rate
/// and weight of the divergence are those of `[vae]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EncoderSection {
    /// VAE steps, 1 to 10,000,000. Default 10000.
    pub steps: u64,
    /// Share of the steps, at the end, over which the learning rate falls linearly to zero; in
    /// (0, 1]. Default 0.5.
    pub decay_share: f64,
    /// Share of each minibatch that the decoder reproduces, in (0, 1]; at least one image. The
    /// decoder is 70 % of a step's work, and the second loss does without. Default 0.25.
    pub reproduced_share: f64,
    /// Factor of the second loss, at least 0: a small network finds distance, direction and
    /// clearance of the openings in sight from the code, with this factor of its squared error. The
    /// numbers are scaled to a standard deviation of about one. Default 100.
    pub geometry_weight: f64,
}

impl Default for EncoderSection {
    fn default() -> Self {
        Self {
            steps: 10_000,
            decay_share: 0.5,
            reproduced_share: 0.25,
            geometry_weight: 100.0,
        }
    }
}

impl EncoderSection {
    pub(super) fn validate(&self) -> Result<(), InvalidValue> {
        require(
            (1..=10_000_000).contains(&self.steps),
            "encoder.steps",
            self.steps,
            "is outside 1..=10000000",
        )?;
        require(
            self.decay_share > 0.0 && self.decay_share <= 1.0,
            "encoder.decay_share",
            self.decay_share,
            "is outside (0, 1]: it is a share of the steps",
        )?;
        require(
            self.reproduced_share > 0.0 && self.reproduced_share <= 1.0,
            "encoder.reproduced_share",
            self.reproduced_share,
            "is outside (0, 1]: it is a share of the images",
        )?;
        require(
            self.geometry_weight >= 0.0 && self.geometry_weight.is_finite(),
            "encoder.geometry_weight",
            self.geometry_weight,
            "is negative or not finite: the code would be made to hide the openings",
        )
    }
}
