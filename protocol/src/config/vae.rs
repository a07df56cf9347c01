//! The `[vae]` section.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::{Engine, InvalidValue, RunSection, require, require_learning_rate};
use crate::MAX_LATENT;

/// Allowed lengths of the latent code. Records have room for the longest; mean and log-variance of
/// the shortest fill the 16 lanes that the learner sums at a time.
const LATENTS: [usize; 4] = [8, 16, 32, MAX_LATENT];

/// The `[vae]` section: the variational auto-encoder (paper, section 3.3), trained together with
/// the agent and then frozen.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct VaeSection {
    /// Length of the latent code: 8, 16, 32 or 64. Default 32, as in the paper.
    pub latent: usize,
    /// File with an encoder to fly with from the first episode on, frozen: one that `skein encoder`
    /// wrote, or any snapshot. Requires `train_steps` = 0. The path is relative to the
    /// configuration file; with `--set`, to the working directory. Default: none, the VAE is
    /// trained along.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub start_from: Option<PathBuf>,
    /// Environment steps during which the VAE is trained, 1 to 200,000; 0 with `start_from`. Then
    /// it is frozen and stored latent codes are recomputed. Default 10000, as in the paper.
    pub train_steps: usize,
    /// Environment steps after which stored latent codes are recomputed while the VAE is still
    /// trained, so that a policy that learns meanwhile sees the codes of one encoder. 0 recomputes
    /// them only when the VAE is frozen, as in the paper. Default 0.
    pub recode_steps: usize,
    /// VAE updates per environment step, done at the end of the epoch; in (0, 10]. Default 0.1.
    pub updates_per_step: f64,
    /// Depth images in a minibatch, 1 to 4096. Default 32.
    pub batch_size: usize,
    /// Adam's step size, in (0, 1]. Default 1e-3.
    pub learning_rate: f64,
    /// Weight of the Kullback-Leibler term against the squared error summed over the image's
    /// pixels, at least 0. Default 1, the plain VAE.
    pub kl_weight: f64,
    /// Decoder, used in training only: `plain`, or `u-net`, which also sees the encoder's feature
    /// maps (arXiv:1505.04597). The flown encoder is the same. A U-Net is always trained on
    /// libtorch. Default `plain`, as in the paper.
    pub decoder: DecoderName,
}

impl Default for VaeSection {
    fn default() -> Self {
        Self {
            latent: 32,
            start_from: None,
            train_steps: 10_000,
            recode_steps: 0,
            updates_per_step: 0.1,
            batch_size: 32,
            learning_rate: 1e-3,
            kl_weight: 1.0,
            decoder: DecoderName::Plain,
        }
    }
}

impl VaeSection {
    /// Returns the engine of the VAE with these settings: the run's engine, except that a U-Net
    /// exists for libtorch only.
    pub fn engine(&self, run: &RunSection) -> Engine {
        match self.decoder {
            DecoderName::Plain => run.engine(),
            DecoderName::UNet => Engine::Libtorch,
        }
    }

    pub(super) fn validate(&self) -> Result<(), InvalidValue> {
        require(
            LATENTS.contains(&self.latent),
            "vae.latent",
            self.latent,
            format!(
                "is not one of {LATENTS:?}: records and networks have no layout for such a code; \
                set it to one of them (paper: 32)"
            ),
        )?;
        match &self.start_from {
            Some(file) => require(
                self.train_steps == 0,
                "vae.train_steps",
                self.train_steps,
                format!(
                    "does not go with vae.start_from = \"{}\": that encoder is frozen from the \
                    first episode on; set it to 0, or leave vae.start_from out",
                    file.display()
                ),
            ),
            None => require(
                self.train_steps >= 1,
                "vae.train_steps",
                self.train_steps,
                "is below 1: the policy would see the code of an untrained encoder; raise it, or \
                name a trained one in vae.start_from",
            ),
        }?;
        require(
            self.train_steps <= 200_000,
            "vae.train_steps",
            self.train_steps,
            "is above 200000: the depth images of all these steps are kept in memory, 9 KiB each",
        )?;
        require(
            self.updates_per_step > 0.0 && self.updates_per_step <= 10.0,
            "vae.updates_per_step",
            self.updates_per_step,
            "is outside (0, 10]",
        )?;
        require(
            (1..=4096).contains(&self.batch_size),
            "vae.batch_size",
            self.batch_size,
            "is outside 1..=4096",
        )?;
        require_learning_rate("vae.learning_rate", self.learning_rate)?;
        require(
            self.kl_weight >= 0.0 && self.kl_weight.is_finite(),
            "vae.kl_weight",
            self.kl_weight,
            "is negative or not finite: the latent code would be pushed apart without bound",
        )
    }
}

/// Input of the decoder.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DecoderName {
    /// The code alone.
    Plain,
    /// The code, and the encoder's feature maps.
    UNet,
}
