//! Commands that take effect late.

use std::collections::VecDeque;

/// Holds each action back for a number of control periods. Until the first one arrives, nothing is
/// commanded sideways or up.
#[derive(Debug, Clone)]
pub(crate) struct Delay {
    on_the_way: VecDeque<[f32; 2]>,
}

impl Delay {
    /// A way of `periods` control periods on which nothing is yet.
    pub(crate) fn new(periods: u32) -> Self {
        let mut delay = Self {
            on_the_way: VecDeque::with_capacity(periods as usize + 1),
        };
        delay.begin(periods);
        delay
    }

    /// Forgets what was on the way, which takes `periods` from now on.
    pub(crate) fn begin(&mut self, periods: u32) {
        self.on_the_way.clear();
        self.on_the_way.resize(periods as usize, [0.0, 0.0]);
    }

    /// Control periods until a command takes effect.
    pub(crate) fn periods(&self) -> usize {
        self.on_the_way.len()
    }

    /// Takes `action` in and gives the one out that takes effect now.
    pub(crate) fn pass(&mut self, action: [f32; 2]) -> [f32; 2] {
        self.on_the_way.push_back(action);
        self.on_the_way.pop_front().unwrap_or(action)
    }
}
