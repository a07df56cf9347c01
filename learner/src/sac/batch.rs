//! A minibatch, from the replay's slices to tensors.

use skein_protocol::ACTION;
use tch::{Device, Tensor};

/// A minibatch as the replay gathers it: one f32 slice for each column, rows back to back.
#[derive(Debug, Clone, Copy)]
pub struct Columns<'a> {
    /// `[n, observation]`.
    pub observations: &'a [f32],
    /// `[n, 2]`.
    pub actions: &'a [f32],
    /// `[n]`.
    pub rewards: &'a [f32],
    /// `[n, observation]`: what was seen after the action, also where the flight ended there.
    pub next_observations: &'a [f32],
    /// `[n]`: 1 where the state after the action ends the task (a crash, the end wall), 0 elsewhere. A flight cut off by its step limit is not terminated.
    pub terminated: &'a [f32],
}

/// A minibatch on the learner's device; see [`Columns`] for the columns.
#[derive(Debug)]
pub struct Batch {
    pub(super) observations: Tensor,
    pub(super) actions: Tensor,
    pub(super) rewards: Tensor,
    pub(super) next_observations: Tensor,
    pub(super) terminated: Tensor,
}

impl Batch {
    /// Copies the columns to the device, once each.
    ///
    /// # Panics
    /// When the columns have different numbers of rows, or none.
    pub fn new(columns: Columns<'_>, device: Device) -> Self {
        let rows = columns.rewards.len();
        assert!(rows > 0, "a minibatch has at least one transition");
        let column = |values: &[f32], width: usize| {
            assert_eq!(
                values.len(),
                rows * width,
                "every column of a minibatch has one row for each transition"
            );
            Tensor::from_slice(values)
                .view([rows as i64, width as i64])
                .to_device(device)
        };
        let observation = columns.observations.len() / rows;
        Self {
            observations: column(columns.observations, observation),
            actions: column(columns.actions, ACTION),
            rewards: column(columns.rewards, 1).view([-1]),
            next_observations: column(columns.next_observations, observation),
            terminated: column(columns.terminated, 1).view([-1]),
        }
    }

    /// Transitions in the batch.
    pub fn rows(&self) -> i64 {
        self.rewards.size()[0]
    }
}
