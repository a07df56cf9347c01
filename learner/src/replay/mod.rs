//! The split replay buffer (paper, section 3.5).
//!
//! Successful avoidance is rare in the beginning and would drown among everything else, so it has a
//! part of its own with a fixed share of every minibatch. (With a share of zero there is one part
//! for all, the ordinary buffer.) Each part is a [`ring`] of self-contained rows. Whole episodes go
//! in, in episode order, or their segments, and nothing here is random but what the caller's seeded
//! generator draws: the content is a function of the episodes, and a minibatch one of content and
//! seed.
//!
//! While the VAE is trained, the depth [`images`] of stored transitions are kept: the VAE learns
//! from them, and when it is frozen the latent codes of all rows, each made by the encoder of its
//! day, are made anew with the final one. Then the images go. Where the encoder is trained end to
//! end they stay: a minibatch then holds the images of its transitions, as long as the transitions
//! are stored.

mod images;
mod ring;
mod state;
mod success;
#[cfg(test)]
mod tests;

use std::sync::Arc;

use rand::{Rng, RngExt};
use skein_protocol::config::{Config, EncoderTraining, ReplaySection, View};
use skein_protocol::ids::EpisodeId;
use skein_protocol::{ACTION, IMAGE_PIXELS, LatentCode};

use crate::episode::{CommittedEpisode, EpisodeFault};
use images::ImageStore;
use ring::{Ring, RowLayout};

pub use ring::RingState;
pub use state::{ReplayState, RestoreError};
use success::success_steps;

/// The split replay buffer.
#[derive(Debug)]
pub struct Replay {
    section: ReplaySection,
    view: View,
    success: Ring,
    regular: Ring,
    /// Until the VAE is frozen; for ever where the policy learns from them.
    images: Option<ImageStore>,
    /// What learns from the images.
    encoder: EncoderTraining,
    /// Images from which on those that no transition needs are looked for, where a policy learns
    /// from them.
    sweep_above: usize,
    /// The episode that was stored last, and how many steps of it: what a later segment must
    /// follow. In no checkpoint, as those lie between episodes.
    last: Option<(EpisodeId, usize)>,
}

/// A minibatch of transitions in flat buffers that are reused from draw to draw.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Minibatch {
    /// `[batch, observation]`.
    pub observations: Vec<f32>,
    /// `[batch, 2]`.
    pub actions: Vec<f32>,
    /// `[batch]`.
    pub rewards: Vec<f32>,
    /// `[batch, observation]`.
    pub next_observations: Vec<f32>,
    /// What the critic alone sees, `[batch, TRUE_STATE]`; empty if that is the observation.
    pub true_states: Vec<f32>,
    /// The same after the action.
    pub next_true_states: Vec<f32>,
    /// `[batch]`: 1 where the episode ended in a state without a future, else 0. An episode's last
    /// step before the time limit is 0: it bootstraps.
    pub terminated: Vec<f32>,
    /// Depth images of the observations, `[batch, 72, 128]`, where the encoder is trained end to
    /// end; else empty.
    pub images: Vec<u8>,
    /// Those of the next observations.
    pub next_images: Vec<u8>,
    /// Slots drawn, before any row is touched: the loads of many rows are then under way at one
    /// time.
    slots: Vec<usize>,
}

/// Why an episode cannot be stored. Nothing of it is.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum InsertError {
    /// Its parts do not belong together.
    #[error(transparent)]
    Fault(#[from] EpisodeFault),
    /// It is a segment, and what was stored last is not what was flown before it.
    #[error(
        "a segment of episode {episode} from its step {first_step} on cannot follow what was stored before it"
    )]
    OutOfPlace {
        /// The episode.
        episode: EpisodeId,
        /// Steps flown before.
        first_step: usize,
    },
    /// It came without depth images while they are learned from.
    #[error("episode {episode} has no depth images, but images are still learned from")]
    NoImages {
        /// The episode.
        episode: EpisodeId,
    },
    /// The images have no room.
    #[error(
        "{found} depth images of episode {episode} exceed the {limit} that can be needed, {held} of them held"
    )]
    TooManyImages {
        /// The episode.
        episode: EpisodeId,
        /// Its images.
        found: usize,
        /// Images held.
        held: usize,
        /// Images that may be held.
        limit: usize,
    },
}

impl Replay {
    /// An empty buffer for the run configured by `config`.
    pub fn new(config: &Config) -> Self {
        let view = config.view();
        let layout = RowLayout::of(config);
        let (success, regular) = capacities(&config.replay);
        Self {
            section: config.replay.clone(),
            view,
            success: Ring::new(success, layout),
            regular: Ring::new(regular, layout),
            images: Some(ImageStore::new(image_limit(config))),
            encoder: config.learning.encoder,
            sweep_above: config.replay.capacity + config.replay.capacity / 4 + epoch_images(config),
            last: None,
        }
    }

    /// Transitions held in both parts.
    pub fn len(&self) -> usize {
        self.success.len() + self.regular.len()
    }

    /// Whether there is nothing to draw from.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Transitions held in the success part.
    pub fn success_len(&self) -> usize {
        self.success.len()
    }

    /// Depth images held; `None` once the VAE is frozen.
    pub fn image_count(&self) -> Option<usize> {
        self.images.as_ref().map(ImageStore::len)
    }

    /// Stores all transitions of `episode`, in order, each in the part the success rule says. Its
    /// depth images are taken over while they are learned from, and dropped after. Of a later
    /// segment the first image is the last one of the segment before, and is not stored twice.
    ///
    /// # Errors
    /// [`InsertError`]; the buffer is as before.
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
            episode.write_true_state(step, row.true_state);
            episode.write_true_state(step + 1, row.next_true_state);
            row.action.copy_from_slice(&episode.actions[step]);
            *row.reward = episode.rewards[step];
            *row.terminated = f32::from(step == last && episode.terminated());
        }
        self.last = Some((episode.episode, episode.first_step + episode.steps()));
        Ok(())
    }

    /// Whether a later segment follows the one before it.
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

    /// Draws `count` transitions uniformly with replacement from each part in the configured ratio;
    /// all from the other part while one is empty.
    ///
    /// # Panics
    /// When the buffer [is empty](Replay::is_empty): the warm-up is over before anything is drawn.
    pub fn sample(&self, rng: &mut impl Rng, count: usize, into: &mut Minibatch) {
        assert!(
            !self.is_empty(),
            "nothing can be drawn from an empty replay buffer"
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

    /// Draws `count` depth images uniformly with replacement, `[count, 72, 128]`, for a step of the
    /// VAE.
    ///
    /// # Panics
    /// When there are none: none were inserted yet, or the VAE is frozen.
    pub fn sample_images(&self, rng: &mut impl Rng, count: usize, into: &mut Vec<u8>) {
        let images = self.images.as_ref().filter(|images| images.len() > 0);
        images
            .expect("the VAE is trained only before it is frozen and after episodes came in")
            .sample(rng, count, into);
    }

    /// Ends the VAE's training: codes stay what they are, and the images are dropped.
    pub fn freeze(&mut self) {
        self.images = None;
        self.success.forget_images();
        self.regular.forget_images();
    }

    /// Makes every stored latent code anew by `encode`, which turns up to `chunk` images, `[n, 72,
    /// 128]`, into as many codes. Does nothing if the VAE is frozen already.
    ///
    /// # Errors
    /// The first that `encode` returns; the buffer is as before.
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

    /// Hands the episode's images to the store; the number of the first, if images are stored.
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

    /// Gives up the images of transitions that are overwritten, if a policy learns from images and
    /// there would be too many with so many more. When that is follows from how many are held, so
    /// that a buffer restored from a checkpoint does the same. The newest transition's images stay:
    /// a segment may follow it.
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
        self.rewards.clear();
        self.next_observations.clear();
        self.true_states.clear();
        self.next_true_states.clear();
        self.terminated.clear();
        self.images.clear();
        self.next_images.clear();
    }

    /// Appends `count` rows drawn from `ring`, with their `images` if there are any to be learned
    /// from.
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
        self.actions.reserve(count * ACTION);
        for &slot in &self.slots {
            let row = ring.row(slot);
            self.observations.extend_from_slice(row.observation);
            self.next_observations
                .extend_from_slice(row.next_observation);
            self.true_states.extend_from_slice(row.true_state);
            self.next_true_states.extend_from_slice(row.next_true_state);
            self.actions.extend_from_slice(row.action);
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

/// Capacities of the success and the regular part; each has room for one transition at least,
/// unless there is to be no success part.
fn capacities(section: &ReplaySection) -> (usize, usize) {
    if section.success_share == 0.0 {
        return (0, section.capacity);
    }
    let success = (section.capacity as f64 * section.success_share).round() as usize;
    let success = success.clamp(1, section.capacity - 1);
    (success, section.capacity - success)
}

/// Images that can be needed. The VAE's training can leave behind: before the epoch in which it is
/// frozen, fewer than `vae.train_steps` steps were flown, with at most as many closing images; then
/// come the episodes of one epoch. Their mirror images come on top. A policy needs those of the
/// transitions held, two each at most, and of the episode that comes in.
fn image_limit(config: &Config) -> usize {
    let steps = match config.learning.encoder {
        EncoderTraining::Vae => config.vae.train_steps,
        EncoderTraining::EndToEnd => config.replay.capacity,
    };
    2 * steps * config.learning.times_stored() + epoch_images(config)
}

/// Images of an epoch's episodes at most.
fn epoch_images(config: &Config) -> usize {
    config.learning.episodes_per_epoch as usize
        * config.transport.max_records_per_episode
        * config.learning.times_stored()
}
