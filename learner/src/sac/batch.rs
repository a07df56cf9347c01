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

impl Columns<'_> {
    /// Looks whether the columns belong together; returns the number of their rows.
    ///
    /// # Panics
    /// When they have different numbers of rows, or none.
    pub(super) fn check(&self, observation: usize) -> usize {
        let rows = self.rewards.len();
        assert!(rows > 0, "a minibatch has at least one transition");
        for (column, width) in [
            (self.observations, observation),
            (self.actions, ACTION),
            (self.next_observations, observation),
            (self.terminated, 1),
        ] {
            let len = column.len();
            assert_eq!(
                len,
                rows * width,
                "every column of a minibatch has one row for each transition"
            );
        }
        rows
    }
}

/// A minibatch on the learner's device; see [`Columns`] for the columns.
#[derive(Debug)]
pub(super) struct Batch {
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
    pub(super) fn new(columns: Columns<'_>, observation: usize, device: Device) -> Self {
        let rows = columns.check(observation) as i64;
        let column = |values: &[f32], shape: &[i64]| Tensor::from_slice(values).view(shape).to_device(device);
        let observation = observation as i64;
        Self {
            observations: column(columns.observations, &[rows, observation]),
            actions: column(columns.actions, &[rows, ACTION as i64]),
            rewards: column(columns.rewards, &[rows]),
            next_observations: column(columns.next_observations, &[rows, observation]),
            terminated: column(columns.terminated, &[rows]),
        }
    }

    /// Transitions in the batch.
    pub(super) fn rows(&self) -> i64 {
        self.rewards.size()[0]
    }
}
