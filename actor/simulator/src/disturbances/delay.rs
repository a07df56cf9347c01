//! Commands that take effect late.

use std::collections::VecDeque;

use skein_action::{Action, MAX_ACTION};

/// Queue that delays each action by a number of control periods. Until the first action arrives,
/// all its numbers are zero.
#[derive(Debug, Clone)]
pub(crate) struct CommandDelay {
    pending: VecDeque<Action>,
}

impl CommandDelay {
    /// Returns a delay of `periods` control periods without pending actions.
    pub(crate) fn new(periods: u32) -> Self {
        let mut delay = Self {
            pending: VecDeque::with_capacity(periods as usize + 1),
        };
        delay.begin(periods);
        delay
    }

    /// Discards all pending actions and delays the following ones by `periods`.
    pub(crate) fn begin(&mut self, periods: u32) {
        self.pending.clear();
        self.pending.resize(periods as usize, [0.0; MAX_ACTION]);
    }

    /// Returns the number of control periods until a command takes effect.
    pub(crate) fn periods(&self) -> usize {
        self.pending.len()
    }

    /// Queues `action` and returns the action that takes effect now.
    pub(crate) fn pass(&mut self, action: Action) -> Action {
        self.pending.push_back(action);
        self.pending.pop_front().unwrap_or(action)
    }
}
