//! An encoder trained end to end by the critic's loss, and shared by critic and policy.
//!
//! This is the alternative to the VAE (`learning.encoder = "end-to-end"`), after arXiv:1910.01741
//! and arXiv:2004.13649, without the former's reconstruction loss and the latter's image shifts.
//! The architecture is the VAE's encoder up to the latent mean, so snapshots have the same layout
//! and actors see no difference.
//!
//! Its parameters lie in the critic's vector, before the critic's own layers. So one optimizer
//! steps both, one target network follows both, and a checkpoint needs nothing more. The policy's
//! gradient does not reach the encoder: policies learn worse through an encoder that both losses
//! train (arXiv:1910.01741, section 4).

use tch::{Tensor, no_grad_guard};

use crate::batch::TensorBatch;
use crate::networks::{ImageEncoder, Layout, Parameters, WIDER};

/// The encoder in a critic's parameter vector.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Perception {
    encoder: ImageEncoder,
    /// Length of the latent code.
    latent: i64,
    /// Number of parameters.
    len: usize,
}

/// Choice of the encoder that shows the policy the state after the action, where targets need the
/// policy's next action.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum NextStateEncoder {
    /// The learned encoder: SAC asks the learned policy.
    Learned,
    /// The target encoder: TD3 asks the target policy.
    Target,
}

impl Perception {
    /// Describes an encoder for latent codes of `latent` numbers. The critic's own layers come
    /// after it.
    pub(crate) fn describe(critic: &mut Layout, latent: usize) -> Self {
        let encoder = ImageEncoder::describe(critic, latent);
        // A critic that sees no difference trains nothing. (arXiv:1910.01741 uses orthogonal
        // weights.)
        critic.widen_weights(WIDER);
        Self {
            encoder,
            latent: latent as i64,
            len: critic.len(),
        }
    }

    /// Replaces the latent codes that actors flew with by those of the present encoder.
    ///
    /// The critic's input `states` carries the gradient; the policy's input does not. For the state
    /// after the action, the `target` critic uses its own encoder.
    ///
    /// # Panics
    /// When the batch has no images.
    pub(crate) fn encode(
        &self,
        batch: &mut TensorBatch,
        critic: &Parameters,
        target: &Parameters,
        ahead: NextStateEncoder,
    ) {
        let images = batch.images.as_ref();
        let [now, next] = images.expect("end-to-end training receives images");
        batch.states = self.with_features(critic, now, &batch.observations);
        batch.observations = batch.states.detach();
        let _guard = no_grad_guard();
        batch.next_states = self.with_features(target, next, &batch.next_observations);
        batch.next_observations = match ahead {
            NextStateEncoder::Learned => self.with_features(critic, next, &batch.next_observations),
            NextStateEncoder::Target => batch.next_states.shallow_clone(),
        };
    }

    /// Observations with their codes replaced by the features of `images`, `[n, observation]`.
    fn with_features(
        &self,
        parameters: &Parameters,
        images: &Tensor,
        observations: &Tensor,
    ) -> Tensor {
        let beside = observations.narrow(1, self.latent, observations.size()[1] - self.latent);
        Tensor::cat(&[self.encoder.forward(parameters, images), beside], 1)
    }

    /// Copies the encoder's part of a snapshot from a critic's parameters.
    ///
    /// # Panics
    /// When `into` has another length.
    pub(crate) fn publish(&self, critic: &Parameters, into: &mut [f32]) {
        critic.copy_range(0..self.len, into);
    }
}

#[cfg(test)]
mod tests;
