//! Depth images of stored transitions, kept while the VAE is trained, or for the whole run where
//! the policy learns from them.
//!
//! An episode's images are taken over as the block they arrived in, without a copy. Images are
//! numbered in order of arrival, so the next observation's image has the following number, the
//! closing image included.
//!
//! For the VAE, nothing is dropped before the end. A transition that the ring overwrites leaves its
//! images behind as training material, and no row can ever point at another episode's image. The
//! store is bounded because the VAE is frozen after a configured number of steps. For a policy,
//! images that no row needs are [dropped](ImageStore::keep_only) now and then, and the others are
//! renumbered in the same order.

use std::sync::Arc;

use rand::{Rng, RngExt};
use skein_protocol::{IMAGE_PIXELS, LatentCode};

/// Images, by number.
#[derive(Debug)]
pub(super) struct ImageStore {
    /// One block per episode, shared with a checkpoint being written: `[steps + 1, 72, 128]`.
    episodes: Vec<Arc<Vec<u8>>>,
    /// Number of each block's first image.
    first: Vec<u32>,
    len: usize,
    limit: usize,
}

impl ImageStore {
    /// Creates an empty store for at most `limit` images.
    pub(super) fn new(limit: usize) -> Self {
        // Numbers are 32 bits; the configuration's largest limit is far below.
        Self {
            episodes: Vec::new(),
            first: Vec::new(),
            len: 0,
            limit: limit.min(u32::MAX as usize),
        }
    }

    /// Number of images stored.
    pub(super) fn len(&self) -> usize {
        self.len
    }

    /// Largest number of images.
    pub(super) fn limit(&self) -> usize {
        self.limit
    }

    /// `true` if there is room for `images` more.
    pub(super) fn has_room(&self, images: usize) -> bool {
        self.len + images <= self.limit
    }

    /// Takes over an episode's images; returns the number of the first one. The caller has checked
    /// [`ImageStore::has_room`].
    pub(super) fn push(&mut self, images: Arc<Vec<u8>>) -> u32 {
        let first = self.len as u32;
        self.len += images.len() / IMAGE_PIXELS;
        self.first.push(first);
        self.episodes.push(images);
        first
    }

    /// Appends images to the last episode's block; returns the number of the image before the first
    /// of them. The caller has checked [`ImageStore::has_room`], and that there is a block.
    pub(super) fn extend(&mut self, images: &[u8]) -> u32 {
        let before = self.len as u32 - 1;
        self.len += images.len() / IMAGE_PIXELS;
        if let Some(block) = self.episodes.last_mut() {
            let block = Arc::make_mut(block);
            block.reserve_exact(images.len());
            block.extend_from_slice(images);
        }
        before
    }

    /// Drops all images except those `needed`, `[len]`. Returns the new number of each image; for a
    /// dropped image it has no meaning.
    ///
    /// If an episode is needed in part, its needed images are copied into a new block. Neighbours
    /// that both stay remain neighbours.
    pub(super) fn keep_only(&mut self, needed: &[bool]) -> Vec<u32> {
        let mut numbers = Vec::with_capacity(needed.len());
        let (episodes, first) = (
            std::mem::take(&mut self.episodes),
            std::mem::take(&mut self.first),
        );
        self.len = 0;
        for (block, first) in episodes.into_iter().zip(first) {
            let needed = &needed[first as usize..][..block.len() / IMAGE_PIXELS];
            let before = self.len as u32;
            numbers.extend(needed.iter().scan(before, |next, &needed| {
                let number = *next;
                *next += u32::from(needed);
                Some(number)
            }));
            if needed.iter().all(|&needed| needed) {
                self.push(block);
            } else if needed.contains(&true) {
                let images = block.chunks_exact(IMAGE_PIXELS).zip(needed);
                let kept: Vec<_> = images
                    .filter(|(_, needed)| **needed)
                    .map(|(image, _)| image)
                    .collect();
                self.push(Arc::new(kept.concat()));
            }
        }
        numbers
    }

    /// The blocks, in order.
    pub(super) fn episodes(&self) -> &[Arc<Vec<u8>>] {
        &self.episodes
    }

    /// Samples `count` images uniformly with replacement into `into`, `[count, 72, 128]`.
    pub(super) fn sample(&self, rng: &mut impl Rng, count: usize, into: &mut Vec<u8>) {
        into.clear();
        for _ in 0..count {
            into.extend_from_slice(self.image(rng.random_range(0..self.len as u32)));
        }
    }

    /// Returns the latent code of every image, by number. `encode` receives `chunk` images at a
    /// time, whatever the episodes' lengths, and the rest last. So a store restored from a
    /// checkpoint is encoded in the same pieces.
    pub(super) fn encode<E>(
        &self,
        chunk: usize,
        mut encode: impl FnMut(&[u8]) -> Result<Vec<LatentCode>, E>,
    ) -> Result<Vec<LatentCode>, E> {
        let mut latents = Vec::with_capacity(self.len);
        let mut images = Vec::with_capacity(chunk.min(self.len) * IMAGE_PIXELS);
        let mut pending = self
            .episodes
            .iter()
            .flat_map(|episode| episode.chunks_exact(IMAGE_PIXELS))
            .peekable();
        while pending.peek().is_some() {
            images.clear();
            pending
                .by_ref()
                .take(chunk)
                .for_each(|image| images.extend_from_slice(image));
            let codes = encode(&images)?;
            assert_eq!(
                codes.len(),
                images.len() / IMAGE_PIXELS,
                "an encoder returns one code an image"
            );
            latents.extend(codes);
        }
        Ok(latents)
    }

    /// Number of the first image of the episode that image `number` belongs to.
    pub(super) fn first_of_episode(&self, number: u32) -> u32 {
        self.first[self.episode_of(number)]
    }

    fn episode_of(&self, number: u32) -> usize {
        self.first.partition_point(|&first| first <= number) - 1
    }

    /// The image of this number, `[72, 128]`.
    pub(super) fn image(&self, number: u32) -> &[u8] {
        let episode = self.episode_of(number);
        let start = (number - self.first[episode]) as usize * IMAGE_PIXELS;
        &self.episodes[episode][start..start + IMAGE_PIXELS]
    }
}
