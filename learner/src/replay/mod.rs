//! The split replay buffer (the paper, section 3.5).
//!
//! Successful avoidance is rare at the beginning and would be lost among everything else. So it has
//! a part of its own, with a fixed share of every minibatch. (With a share of zero there is only
//! one part, the ordinary buffer.) Each part is a [`ring`] of self-contained rows.
//!
//! Whole episodes or their segments are inserted, in episode order. The only randomness is the
//! caller's seeded generator. So the content is a function of the episodes, and a minibatch is a
//! function of content and seed.
//!
//! While the VAE is trained, the depth [`images`] of stored transitions are kept, because the VAE
//! learns from them. Each row's latent code comes from the encoder of its time; when the VAE is
//! frozen, all codes are computed again with the final encoder, and the images are dropped. Where
//! the encoder is trained end to end, images stay as long as their transitions, and a minibatch
//! contains them.

mod images;
mod ring;
mod state;
mod success;
#[cfg(test)]
mod tests;

use std::sync::Arc;

use rand::{Rng, RngExt};
use skein_protocol::config::{Config, EncoderTraining, ObservationLayout, ReplaySection};
use skein_protocol::ids::EpisodeId;
use skein_protocol::{Action, IMAGE_PIXELS, LatentCode};

use crate::episode::{CommittedEpisode, MalformedEpisode};
use images::ImageStore;
use ring::{Ring, RowLayout};

pub use ring::RingState;
pub use state::{ReplayRestoreError, ReplayState};
use success::success_steps;

/// The split replay buffer.
#[derive(Debug)]
pub struct Replay {
    section: ReplaySection,
    view: ObservationLayout,
    success: Ring,
    regular: Ring,
    /// Depth images: kept until the VAE is frozen, or for the whole run where the policy learns
    /// from them; never where the run starts from a trained encoder.
    images: Option<ImageStore>,
    /// Training of the encoder, hence the use of the images.
    encoder: EncoderTraining,
    /// Number of images above which unneeded ones are searched for, where a policy learns from
    /// images.
    sweep_above: usize,
    /// Episode stored last and its number of steps so far, which a later segment must follow.
    /// Checkpoints do not contain it: they lie between episodes.
    last: Option<(EpisodeId, usize)>,
}

/// A minibatch of transitions in flat buffers that are reused from draw to draw.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Minibatch {
    /// Observations before the action, `[batch, observation]`.
    pub observations: Vec<f32>,
    /// Actions, `[batch, action]`.
    pub actions: Vec<f32>,
    /// The teacher's actions, `[batch, action]`; empty without a teacher.
    pub teacher_actions: Vec<f32>,
    /// Rewards, `[batch]`.
    pub rewards: Vec<f32>,
    /// Observations after the action, `[batch, observation]`.
    pub next_observations: Vec<f32>,
    /// Critic inputs before the action, `[batch, critic_state(action)]`; empty if the critic sees
    /// the observation.
    pub critic_states: Vec<f32>,
    /// Critic inputs after the action, likewise.
    pub next_critic_states: Vec<f32>,
    /// 1 where the episode ended in a state without a future, else 0; `[batch]`. The last step of a
    /// truncated episode has 0: it bootstraps.
    pub terminated: Vec<f32>,
    /// Depth images before the action, `[batch, 72, 128]`, where the encoder is trained end to end;
    /// else empty.
    pub images: Vec<u8>,
    /// Depth images after the action, likewise.
    pub next_images: Vec<u8>,
    /// Slots drawn before any row is read, so that the loads of many rows overlap.
    slots: Vec<usize>,
}

/// Reason why an episode cannot be stored. Nothing of it is stored then.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum InsertError {
    /// The episode's parts do not fit together.
    #[error(transparent)]
    Fault(#[from] MalformedEpisode),
    /// A segment does not follow what was stored last.
    #[error(
        "a segment of episode {episode} from its step {first_step} on \
         does not follow what was stored before it"
    )]
    OutOfPlace {
        /// Number of the episode.
        episode: EpisodeId,
        /// Steps of the episode before the segment.
        first_step: usize,
    },
    /// The episode has no depth images, but they are needed.
    #[error("episode {episode} has no depth images, but images are still learned from")]
    NoImages {
        /// Number of the episode.
        episode: EpisodeId,
    },
    /// The images exceed the store's limit.
    #[error(
        "episode {episode} brings {found} depth images to the {held} stored, \
         more than the {limit} that can ever be needed"
    )]
    TooManyImages {
        /// Number of the episode.
        episode: EpisodeId,
        /// Number of its images.
        found: usize,
        /// Number of images stored.
        held: usize,
        /// Number of images that may be stored.
        limit: usize,
    },
}

impl Replay {
    /// Creates an empty buffer for the run that `config` describes.
    pub fn new(config: &Config) -> Self {
        let view = config.observation_layout();
        let layout = RowLayout::of(config);
        let (success, regular) = capacities(&config.replay);
        Self {
            section: config.replay.clone(),
            view,
            success: Ring::new(success, layout),
            regular: Ring::new(regular, layout),
            images: config
                .vae
                .start_from
                .is_none()
                .then(|| ImageStore::new(image_limit(config))),
            encoder: config.learning.encoder,
            sweep_above: config.replay.capacity + config.replay.capacity / 4 + epoch_images(config),
            last: None,
        }
    }

    /// Number of transitions in both parts.
    pub fn len(&self) -> usize {
        self.success.len() + self.regular.len()
    }

    /// `true` if there is nothing to sample from.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Number of transitions in the success part.
    pub fn success_len(&self) -> usize {
        self.success.len()
    }

    /// Number of depth images stored; `None` once the VAE is frozen.
    pub fn image_count(&self) -> Option<usize> {
        self.images.as_ref().map(ImageStore::len)
    }

    /// Stores all transitions of `episode`, in order, each in the part that the success rule names.
    /// Takes over the depth images while they are learned from, and drops them later. A later
    /// segment's first image equals the last one of the segment before, and is not stored twice.
    ///
    /// # Errors
    /// [`InsertError`]; the buffer is unchanged then.
    pub fn insert(&mut self, mut episode: CommittedEpisode) -> Result<(), InsertError> {
        episode.check()?;
        self.check_place(&episode)?;
        let first_image = self.take_images(&mut episode)?;
        let success = success_steps(&episode.level_up, &self.section);
        let last = episode.steps() - 1;
        for (step, &success) in success.iter().enumerate() {
            let ring = if success {
                &mut self.success
            } else {
                &mut self.regular
            };
            let row = ring.claim(first_image.map(|first| first + step as u32));
            episode.write_observation(step, &self.view, row.observation);
            episode.write_observation(step + 1, &self.view, row.next_observation);
            let action = self.view.action;
            episode.write_critic_state(step, action, row.critic_state);
            episode.write_critic_state(step + 1, action, row.next_true_state);
            let copy = |into: &mut [f32], from: &Action| into.copy_from_slice(&from[..into.len()]);
            copy(row.action, &episode.actions[step]);
            copy(row.teacher_action, &episode.teacher_actions[step]);
            *row.reward = episode.rewards[step];
            *row.terminated = f32::from(step == last && episode.terminated());
        }
        self.last = Some((episode.episode, episode.first_step + episode.steps()));
        Ok(())
    }

    /// Checks that a later segment follows the one before it.
    fn check_place(&self, episode: &CommittedEpisode) -> Result<(), InsertError> {
        let CommittedEpisode {
            episode,
            first_step,
            ..
        } = *episode;
        match first_step == 0 || self.last == Some((episode, first_step)) {
            true => Ok(()),
            false => Err(InsertError::OutOfPlace {
                episode,
                first_step,
            }),
        }
    }

    /// Samples `count` transitions uniformly with replacement, from each part in the configured
    /// ratio. While one part is empty, all come from the other.
    ///
    /// # Panics
    /// When the buffer [is empty](Replay::is_empty): the warm-up ends before anything is sampled.
    pub fn sample(&self, rng: &mut impl Rng, count: usize, into: &mut Minibatch) {
        assert!(
            !self.is_empty(),
            "cannot sample from an empty replay buffer"
        );
        let from_success = match (self.success.len(), self.regular.len()) {
            (0, _) => 0,
            (_, 0) => count,
            _ => (count as f64 * self.section.success_share).round() as usize,
        };
        let images = match self.encoder {
            EncoderTraining::Vae => None,
            EncoderTraining::EndToEnd => self.images.as_ref(),
        };
        into.clear();
        into.gather(&self.success, images, rng, from_success);
        into.gather(&self.regular, images, rng, count - from_success);
    }

    /// Samples `count` depth images uniformly with replacement, `[count, 72, 128]`, for a VAE step.
    ///
    /// # Panics
    /// When there are no images: none were inserted yet, or the VAE is frozen.
    pub fn sample_images(&self, rng: &mut impl Rng, count: usize, into: &mut Vec<u8>) {
        let images = self.images.as_ref().filter(|images| images.len() > 0);
        images
            .expect("the VAE is trained only after episodes arrive and before it is frozen")
            .sample(rng, count, into);
    }

    /// Ends the VAE's training: codes stay as they are, and the images are dropped.
    pub fn freeze(&mut self) {
        self.images = None;
        self.success.forget_images();
        self.regular.forget_images();
    }

    /// Recomputes every stored latent code with `encode`, which maps up to `chunk` images,
    /// `[n, 72, 128]`, to as many codes. Does nothing once the VAE is frozen.
    ///
    /// # Errors
    /// The first error of `encode`; the buffer is unchanged then.
    pub fn recode_latents<E>(
        &mut self,
        chunk: usize,
        encode: impl FnMut(&[u8]) -> Result<Vec<LatentCode>, E>,
    ) -> Result<(), E> {
        if let Some(images) = &self.images {
            let latents = images.encode(chunk, encode)?;
            for ring in [&mut self.success, &mut self.regular] {
                ring.replace_latents(&self.view, &latents, |image| images.first_of_episode(image));
            }
        }
        Ok(())
    }

    /// Hands the episode's images to the store; returns the number of the first one, if images are
    /// stored.
    fn take_images(&mut self, episode: &mut CommittedEpisode) -> Result<Option<u32>, InsertError> {
        if self.images.is_none() {
            return Ok(None);
        }
        let id = episode.episode;
        let images = episode
            .depth
            .take()
            .ok_or(InsertError::NoImages { episode: id })?;
        let is_later_segment = episode.first_step > 0;
        let found = episode.steps() + usize::from(!is_later_segment);
        self.sweep_images(found);
        let Some(store) = &mut self.images else {
            return Ok(None);
        };
        if !store.has_room(found) {
            let (held, limit) = (store.len(), store.limit());
            return Err(InsertError::TooManyImages {
                episode: id,
                found,
                held,
                limit,
            });
        }
        Ok(Some(match is_later_segment {
            true => store.extend(&images[IMAGE_PIXELS..]),
            false => store.push(Arc::new(images)),
        }))
    }

    /// Drops the images of overwritten transitions, if a policy learns from images and `more` would
    /// exceed the threshold. The decision depends only on the number stored, so a buffer restored
    /// from a checkpoint decides alike. The newest transition's images stay: a segment may follow
    /// it.
    fn sweep_images(&mut self, more: usize) {
        let Some(store) = &mut self.images else {
            return;
        };
        if self.encoder == EncoderTraining::Vae || store.len() + more <= self.sweep_above {
            return;
        }
        let mut needed = vec![false; store.len()];
        for &image in self.success.images().iter().chain(self.regular.images()) {
            needed[image as usize..image as usize + 2].fill(true);
        }
        let numbers = store.keep_only(&needed);
        self.success.renumber_images(&numbers);
        self.regular.renumber_images(&numbers);
    }
}

impl Minibatch {
    fn clear(&mut self) {
        self.observations.clear();
        self.actions.clear();
        self.teacher_actions.clear();
        self.rewards.clear();
        self.next_observations.clear();
        self.critic_states.clear();
        self.next_critic_states.clear();
        self.terminated.clear();
        self.images.clear();
        self.next_images.clear();
    }

    /// Appends `count` rows drawn from `ring`, with their `images` if the policy learns from them.
    fn gather(
        &mut self,
        ring: &Ring,
        images: Option<&ImageStore>,
        rng: &mut impl Rng,
        count: usize,
    ) {
        self.slots.clear();
        self.slots
            .extend((0..count).map(|_| rng.random_range(0..ring.len())));
        for &slot in &self.slots {
            let row = ring.row(slot);
            self.observations.extend_from_slice(row.observation);
            self.next_observations
                .extend_from_slice(row.next_observation);
            self.critic_states.extend_from_slice(row.critic_state);
            self.next_critic_states
                .extend_from_slice(row.next_true_state);
            self.actions.extend_from_slice(row.action);
            self.teacher_actions.extend_from_slice(row.teacher_action);
            self.rewards.push(row.reward);
            self.terminated.push(row.terminated);
            if let Some(images) = images {
                let number = ring.images()[slot];
                self.images.extend_from_slice(images.image(number));
                self.next_images.extend_from_slice(images.image(number + 1));
            }
        }
    }
}

/// Capacities of the success and the regular part. Each has room for at least one transition,
/// unless the success share is zero.
fn capacities(section: &ReplaySection) -> (usize, usize) {
    if section.success_share == 0.0 {
        return (0, section.capacity);
    }
    let success = (section.capacity as f64 * section.success_share).round() as usize;
    let success = success.clamp(1, section.capacity - 1);
    (success, section.capacity - success)
}

/// Largest number of images that can be needed.
///
/// For the VAE: before the epoch that freezes it, fewer than `vae.train_steps` steps were flown,
/// with at most as many closing images; then the episodes of one epoch are added. For a policy: at
/// most two images per stored transition, and those of the arriving episodes. Mirror images are
/// counted too.
fn image_limit(config: &Config) -> usize {
    let steps = match config.learning.encoder {
        EncoderTraining::Vae => config.vae.train_steps,
        EncoderTraining::EndToEnd => config.replay.capacity,
    };
    2 * steps * config.learning.copies_per_transition() + epoch_images(config)
}

/// Largest number of images in an epoch's episodes.
fn epoch_images(config: &Config) -> usize {
    config.learning.episodes_per_epoch as usize
        * config.transport.max_records_per_episode
        * config.learning.copies_per_transition()
}
