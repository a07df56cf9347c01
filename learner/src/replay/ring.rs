//! One part of the replay: a ring of transition rows.
//!
//! A row holds everything an update needs of one transition, both observations included, contiguous
//! in memory. Cache misses limit the reading of random rows: a row costs one run of neighbouring
//! cache lines, where one table per quantity would cost one miss each.

use skein_protocol::config::{Config, CriticInput, ObservationLayout};
use skein_protocol::{LatentCode, critic_state};

/// Layout of a row: observation, next observation, true state, next true state, action, teacher's
/// action, reward, terminated, all `f32`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct RowLayout {
    /// Length of an observation vector.
    pub(super) observation: usize,
    /// Length of the critic's own input; 0 if the critic sees the observation.
    pub(super) critic_state: usize,
    /// Numbers of an action.
    pub(super) action: usize,
    /// Length of the teacher's action; 0 without a teacher.
    pub(super) teacher_action: usize,
}

/// Mutable view of one row.
pub(super) struct TransitionRowMut<'a> {
    pub(super) observation: &'a mut [f32],
    pub(super) next_observation: &'a mut [f32],
    pub(super) critic_state: &'a mut [f32],
    pub(super) next_true_state: &'a mut [f32],
    pub(super) action: &'a mut [f32],
    pub(super) teacher_action: &'a mut [f32],
    pub(super) reward: &'a mut f32,
    pub(super) terminated: &'a mut f32,
}

/// View of one row.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct TransitionRow<'a> {
    pub(super) observation: &'a [f32],
    pub(super) next_observation: &'a [f32],
    pub(super) critic_state: &'a [f32],
    pub(super) next_true_state: &'a [f32],
    pub(super) action: &'a [f32],
    pub(super) teacher_action: &'a [f32],
    pub(super) reward: f32,
    pub(super) terminated: f32,
}

impl RowLayout {
    /// Returns the layout for the run that `config` describes.
    pub(super) fn of(config: &Config) -> Self {
        let action = config.action_space();
        Self {
            observation: config.observation_layout().len(),
            critic_state: match config.learning.critic_input {
                CriticInput::Observation => 0,
                CriticInput::GroundTruth => critic_state(action),
            },
            action: action.numbers(),
            teacher_action: match config.teacher.is_configured() {
                true => action.numbers(),
                false => 0,
            },
        }
    }

    /// Number of values in a row.
    pub(super) fn width(self) -> usize {
        2 * (self.observation + self.critic_state) + self.action + self.teacher_action + 2
    }

    fn row(self, values: &[f32]) -> TransitionRow<'_> {
        let (observation, rest) = values.split_at(self.observation);
        let (next_observation, rest) = rest.split_at(self.observation);
        let (critic_state, rest) = rest.split_at(self.critic_state);
        let (next_true_state, rest) = rest.split_at(self.critic_state);
        let (action, rest) = rest.split_at(self.action);
        let (teacher_action, rest) = rest.split_at(self.teacher_action);
        TransitionRow {
            observation,
            next_observation,
            critic_state,
            next_true_state,
            action,
            teacher_action,
            reward: rest[0],
            terminated: rest[1],
        }
    }

    fn row_mut(self, values: &mut [f32]) -> TransitionRowMut<'_> {
        let (observation, rest) = values.split_at_mut(self.observation);
        let (next_observation, rest) = rest.split_at_mut(self.observation);
        let (critic_state, rest) = rest.split_at_mut(self.critic_state);
        let (next_true_state, rest) = rest.split_at_mut(self.critic_state);
        let (action, rest) = rest.split_at_mut(self.action);
        let (teacher_action, rest) = rest.split_at_mut(self.teacher_action);
        let (reward, terminated) = rest.split_at_mut(1);
        TransitionRowMut {
            observation,
            next_observation,
            critic_state,
            next_true_state,
            action,
            teacher_action,
            reward: &mut reward[0],
            terminated: &mut terminated[0],
        }
    }
}

/// More transitions than a run can commit. Below it, counting cannot overflow.
const MOST_INSERTED: u64 = 1 << 62;

/// A ring of rows; the oldest is overwritten when it is full.
#[derive(Debug)]
pub(super) struct Ring {
    layout: RowLayout,
    capacity: usize,
    /// Number of rows ever inserted; determines the next slot and the number of filled slots.
    inserted: u64,
    /// Rows in slot order, `[filled, width]`.
    rows: Vec<f32>,
    /// Number of the depth image of each row's observation, `[filled]`; the next observation's
    /// image follows it. Empty once the images are dropped.
    images: Vec<u32>,
}

impl Ring {
    /// Creates an empty ring. Memory for all rows is reserved at once, so growth never copies them;
    /// pages are touched only as rows fill.
    pub(super) fn new(capacity: usize, layout: RowLayout) -> Self {
        let rows = Vec::with_capacity(capacity * layout.width());
        Self {
            layout,
            capacity,
            inserted: 0,
            rows,
            images: Vec::new(),
        }
    }

    /// Restores a ring, or describes what is wrong with the state.
    pub(super) fn restore(
        capacity: usize,
        layout: RowLayout,
        state: RingState,
    ) -> Result<Self, String> {
        let RingState {
            inserted,
            rows,
            images,
        } = state;
        if inserted > MOST_INSERTED {
            return Err(format!(
                "{inserted} transitions are more than any run commits"
            ));
        }
        let mut ring = Self::new(capacity, layout);
        ring.inserted = inserted;
        if rows.len() != ring.len() * layout.width() {
            return Err(format!(
                "{inserted} transitions were inserted into a part for {capacity}, \
                 so {} values are expected, but {} are stored",
                ring.len() * layout.width(),
                rows.len()
            ));
        }
        ring.rows.extend_from_slice(&rows);
        ring.images = images;
        Ok(ring)
    }

    /// Returns everything that determines the ring's future.
    pub(super) fn state(&self) -> RingState {
        RingState {
            inserted: self.inserted,
            rows: self.rows.clone(),
            images: self.images.clone(),
        }
    }

    /// Number of filled rows.
    pub(super) fn len(&self) -> usize {
        usize::try_from(self.inserted)
            .unwrap_or(usize::MAX)
            .min(self.capacity)
    }

    /// Claims the next slot, the oldest row's if the ring is full. `image`: number of the
    /// observation's depth image, while images are stored.
    pub(super) fn claim(&mut self, image: Option<u32>) -> TransitionRowMut<'_> {
        let width = self.layout.width();
        let slot = (self.inserted % self.capacity as u64) as usize;
        if self.len() < self.capacity {
            self.rows.resize(self.rows.len() + width, 0.0);
            self.images.extend(image);
        } else if let Some(image) = image {
            self.images[slot] = image;
        }
        self.inserted += 1;
        self.layout
            .row_mut(&mut self.rows[slot * width..(slot + 1) * width])
    }

    /// The row in `slot`, below [`Ring::len`].
    pub(super) fn row(&self, slot: usize) -> TransitionRow<'_> {
        let width = self.layout.width();
        self.layout
            .row(&self.rows[slot * width..(slot + 1) * width])
    }

    /// Image number of every row, `[filled]`; empty once the images are dropped.
    pub(super) fn images(&self) -> &[u32] {
        &self.images
    }

    /// Replaces every image number by its new one. `numbers`: by old number.
    pub(super) fn renumber_images(&mut self, numbers: &[u32]) {
        for image in &mut self.images {
            *image = numbers[*image as usize];
        }
    }

    /// Drops the image numbers.
    pub(super) fn forget_images(&mut self) {
        self.images = Vec::new();
    }

    /// Rewrites the latent parts of both observations of every row from `latents`, one per image.
    /// `first_of_episode` returns the number of the first image of an image's episode.
    pub(super) fn replace_latents(
        &mut self,
        view: &ObservationLayout,
        latents: &[LatentCode],
        first_of_episode: impl Fn(u32) -> u32,
    ) {
        for (values, &image) in self
            .rows
            .chunks_exact_mut(self.layout.width())
            .zip(&self.images)
        {
            let row = self.layout.row_mut(values);
            let first = first_of_episode(image);
            let (episode, step) = (&latents[first as usize..], (image - first) as usize);
            for (step, observation) in [(step, row.observation), (step + 1, row.next_observation)] {
                let moments = observation.chunks_exact_mut(view.step_len());
                for (moment, seen) in view.seen_steps(step).zip(moments) {
                    view.write_code(&episode[moment], seen);
                }
            }
        }
    }
}

/// Content of a ring, for a checkpoint.
#[derive(Debug, Clone, PartialEq)]
pub struct RingState {
    /// Number of transitions ever inserted.
    pub inserted: u64,
    /// Rows in slot order, `[filled, width]`, laid out as observation, next observation, true
    /// state, next true state, action, teacher's action, reward, terminated.
    pub rows: Vec<f32>,
    /// Number of the depth image of each row's observation, `[filled]`; empty once no images are
    /// kept.
    pub images: Vec<u32>,
}
