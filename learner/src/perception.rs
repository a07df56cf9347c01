//! Eyes that are trained end to end: one convolutional encoder for critic and policy, which the
//! critic's loss trains.
//!
//! The alternative to the VAE (`learning.encoder = "end-to-end"`), after arXiv:1910.01741 and
//! arXiv:2004.13649, without the former's reconstruction and the latter's shifted images. The
//! encoder is that of the VAE up to the code's mean, so that a snapshot is laid out the same and
//! actors do not know the difference. It lies in the critic's vector of parameters, before the
//! critic's own layers: one optimizer steps both, one target follows both, and a checkpoint needs
//! nothing more. The policy learns from what the critic sees and changes nothing in it: through an
//! encoder that both losses pull at, policies learn worse (arXiv:1910.01741, section 4).

use tch::{Tensor, no_grad_guard};

use crate::batch::Batch;
use crate::networks::{ImageEncoder, Layout, Parameters};

/// How much farther apart initial weights lie than PyTorch's defaults: what keeps the size of what
/// passes through layers with ReLU (He et al. 2015, arXiv:1502.01852, eq. 10). With the defaults,
/// four layers leave a thirtieth of what distinguishes two images, and a critic that has nothing to
/// see trains nothing. (arXiv:1910.01741 keeps the size by orthogonal weights.)
const WIDER: f32 = 2.449_489_7; // √6

/// The encoder in a critic's vector of parameters.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Perception {
    encoder: ImageEncoder,
    /// Length of the code.
    latent: i64,
    /// Parameters.
    len: usize,
}

/// With whose eyes the policy looks at the state after the action, when it says what it would do
/// there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum LooksAhead {
    /// Those that are learned: the policy that learns with them is asked (SAC).
    Learned,
    /// Those that follow slowly: a policy is asked that does as well (TD3).
    Target,
}

impl Perception {
    /// Describes an encoder that the critic trains and that makes codes of `latent` numbers. The
    /// critic's own layers come after it.
    pub(crate) fn describe(critic: &mut Layout, latent: usize) -> Self {
        let encoder = ImageEncoder::describe(critic, latent);
        critic.widen_weights(WIDER);
        Self {
            encoder,
            latent: latent as i64,
            len: critic.len(),
        }
    }

    /// Puts what is seen now into the places of the codes that actors saw when they flew.
    ///
    /// What the critic judges, `states`, carries the gradient; what the policy sees does not. The
    /// state after the action is judged by the `target` critic, with its own eyes.
    ///
    /// # Panics
    /// When the batch has no images.
    pub(crate) fn look(
        &self,
        batch: &mut Batch,
        critic: &Parameters,
        target: &Parameters,
        ahead: LooksAhead,
    ) {
        let images = batch.images.as_ref();
        let [now, next] = images.expect("what learns end to end is given images");
        batch.states = self.see(critic, now, &batch.observations);
        batch.observations = batch.states.detach();
        let _guard = no_grad_guard();
        batch.next_states = self.see(target, next, &batch.next_observations);
        batch.next_observations = match ahead {
            LooksAhead::Learned => self.see(critic, next, &batch.next_observations),
            LooksAhead::Target => batch.next_states.shallow_clone(),
        };
    }

    /// Observations with the features of `images` in the places of their codes, `[n, observation]`.
    fn see(&self, parameters: &Parameters, images: &Tensor, observations: &Tensor) -> Tensor {
        let beside = observations.narrow(1, self.latent, observations.size()[1] - self.latent);
        Tensor::cat(&[self.encoder.forward(parameters, images), beside], 1)
    }

    /// Copies the encoder's part of a snapshot from a critic's parameters.
    ///
    /// # Panics
    /// When `into` is of another length.
    pub(crate) fn publish(&self, critic: &Parameters, into: &mut [f32]) {
        critic.copy_range(0..self.len, into);
    }
}

#[cfg(test)]
mod tests;
