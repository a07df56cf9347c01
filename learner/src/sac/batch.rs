//! A minibatch, from the replay's slices to tensors.

use skein_protocol::ACTION;
use tch::{Device, Tensor};

use crate::algorithm::{Columns, Inputs};

/// A minibatch on the learner's device; see [`Columns`] for the columns.
#[derive(Debug)]
pub(super) struct Batch {
    pub(super) observations: Tensor,
    pub(super) actions: Tensor,
    pub(super) rewards: Tensor,
    pub(super) next_observations: Tensor,
    pub(super) states: Tensor,
    pub(super) next_states: Tensor,
    pub(super) terminated: Tensor,
}

impl Batch {
    /// Copies the columns to the device, once each.
    ///
    /// # Panics
    /// When the columns have different numbers of rows, or none.
    pub(super) fn new(columns: Columns<'_>, inputs: Inputs, device: Device) -> Self {
        let rows = columns.check(inputs) as i64;
        let column = |values: &[f32], shape: &[i64]| Tensor::from_slice(values).view(shape).to_device(device);
        let [observation, state] = [inputs.policy, inputs.critic].map(|width| width as i64);
        Self {
            observations: column(columns.observations, &[rows, observation]),
            actions: column(columns.actions, &[rows, ACTION as i64]),
            rewards: column(columns.rewards, &[rows]),
            next_observations: column(columns.next_observations, &[rows, observation]),
            states: column(columns.states, &[rows, state]),
            next_states: column(columns.next_states, &[rows, state]),
            terminated: column(columns.terminated, &[rows]),
        }
    }

    /// Transitions in the batch.
    pub(super) fn rows(&self) -> i64 {
        self.rewards.size()[0]
    }
}
