//! Stores the buffer's content for a checkpoint, and restores it.

use std::sync::Arc;

use skein_protocol::IMAGE_PIXELS;
use skein_protocol::config::Config;

use super::images::ImageStore;
use super::ring::{Ring, RingState};
use super::{Replay, capacities};

/// Everything in a [`Replay`] that determines its future.
#[derive(Debug, Clone, PartialEq)]
pub struct ReplayState {
    /// The success part.
    pub success: RingState,
    /// The regular part.
    pub regular: RingState,
    /// Depth images, one block per episode, `[images, 72, 128]`; `None` once the VAE is frozen.
    /// Shared with the buffer, not copied.
    pub images: Option<Vec<Arc<Vec<u8>>>>,
}

/// Reason why a stored content does not fit the configured buffer.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("the replay buffer's {part} cannot be restored: {problem}")]
pub struct ReplayRestoreError {
    /// Name of the part: `success part`, `regular part` or `depth images`.
    pub part: &'static str,
    /// Description of what does not fit.
    pub problem: String,
}

impl Replay {
    /// Returns the content. Rows are copied, some 10 ms for 2^17 of them; images are shared.
    pub fn state(&self) -> ReplayState {
        ReplayState {
            success: self.success.state(),
            regular: self.regular.state(),
            images: self
                .images
                .as_ref()
                .map(|images| images.episodes().to_vec()),
        }
    }

    /// Restores the buffer as it was when [`Replay::state`] was called.
    ///
    /// # Errors
    /// [`ReplayRestoreError`] when the content does not fit `config`.
    pub fn restore(config: &Config, state: ReplayState) -> Result<Self, ReplayRestoreError> {
        let mut replay = Self::new(config);
        let layout = super::RowLayout::of(config);
        let (success, regular) = capacities(&config.replay);
        let fail = |part| move |problem| ReplayRestoreError { part, problem };
        replay.success =
            Ring::restore(success, layout, state.success).map_err(fail("success part"))?;
        replay.regular =
            Ring::restore(regular, layout, state.regular).map_err(fail("regular part"))?;
        match state.images {
            Some(blocks) => match &mut replay.images {
                Some(store) => fill(store, &blocks),
                None => Err("there are some, and nothing would learn from them".to_owned()),
            },
            None if config.learning.end_to_end() => {
                Err("there are none, and the policy learns from them".to_owned())
            }
            None => {
                replay.images = None;
                Ok(())
            }
        }
        .and_then(|()| check_rows(replay.images.as_ref(), [&replay.success, &replay.regular]))
        .map_err(fail("depth images"))?;
        Ok(replay)
    }
}

fn fill(store: &mut ImageStore, blocks: &[Arc<Vec<u8>>]) -> Result<(), String> {
    for block in blocks {
        let images = block.len() / IMAGE_PIXELS;
        if block.len() % IMAGE_PIXELS != 0 || !store.has_room(images) {
            return Err(format!(
                "an episode's {} bytes are not whole images of {IMAGE_PIXELS} bytes, \
                 or exceed the {} images that may be stored",
                block.len(),
                store.limit()
            ));
        }
        store.push(Arc::clone(block));
    }
    Ok(())
}

/// Checks that every row has a stored image, or, without a store, that none has.
fn check_rows(store: Option<&ImageStore>, rings: [&Ring; 2]) -> Result<(), String> {
    let stored = store.map_or(0, ImageStore::len);
    for ring in rings {
        let expected = if store.is_some() { ring.len() } else { 0 };
        if ring.images().len() != expected {
            return Err(format!(
                "{} transitions have an image where {expected} should",
                ring.images().len()
            ));
        }
        // The next observation's image follows.
        if let Some(last) = ring
            .images()
            .iter()
            .map(|&image| image as usize + 1)
            .max()
            .filter(|&last| last >= stored)
        {
            return Err(format!("a transition needs image {last} of {stored}"));
        }
    }
    Ok(())
}
