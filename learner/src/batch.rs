//! A minibatch as tensors: what algorithms on libtorch learn from.

use tch::{Device, Tensor};

use crate::algorithm::{Columns, Inputs};
use crate::networks::pixels;
use crate::vae::images_from_bytes;

/// A minibatch on the learner's device. [`Columns`] documents the columns and their shapes.
#[derive(Debug)]
pub(crate) struct TensorBatch {
    pub(crate) observations: Tensor,
    pub(crate) actions: Tensor,
    pub(crate) rewards: Tensor,
    pub(crate) next_observations: Tensor,
    pub(crate) states: Tensor,
    pub(crate) next_states: Tensor,
    pub(crate) terminated: Tensor,
    /// Depth images before and after the action, `[rows, 1, 72, 128]` each, in [0, 1]. Present only
    /// where the encoder is trained end to end.
    pub(crate) images: Option<[Tensor; 2]>,
    /// The teacher's actions. Present only where there is a teacher.
    pub(crate) teacher_actions: Option<Tensor>,
}

impl TensorBatch {
    /// Copies each column to the device.
    ///
    /// # Panics
    /// When the columns differ in their number of rows, or have none.
    pub(crate) fn new(columns: Columns<'_>, inputs: Inputs, device: Device) -> Self {
        let rows = columns.check(inputs) as i64;
        let column = |values: &[f32], shape: &[i64]| {
            Tensor::from_slice(values).view(shape).to_device(device)
        };
        let widths = [inputs.policy, inputs.critic, inputs.action.numbers()];
        let [observation, state, action] = widths.map(|width| width as i64);
        let seen = |bytes| pixels(&images_from_bytes(bytes).to_device(device));
        Self {
            observations: column(columns.observations, &[rows, observation]),
            actions: column(columns.actions, &[rows, action]),
            rewards: column(columns.rewards, &[rows]),
            next_observations: column(columns.next_observations, &[rows, observation]),
            states: column(columns.states, &[rows, state]),
            next_states: column(columns.next_states, &[rows, state]),
            terminated: column(columns.terminated, &[rows]),
            images: columns.images.map(|images| images.map(seen)),
            teacher_actions: columns
                .teacher_actions
                .map(|actions| column(actions, &[rows, action])),
        }
    }

    /// Number of transitions.
    pub(crate) fn rows(&self) -> i64 {
        self.rewards.size()[0]
    }
}
