//! Averages over the latest episodes.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

/// The mean of the latest values.
///
/// The sum is computed again at every call, oldest value first. A running sum would drift, and
/// would depend on where a run was resumed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MovingAverage {
    window: usize,
    values: VecDeque<f32>,
}

impl MovingAverage {
    /// Creates an empty average over `window` values, at least 1.
    pub fn new(window: usize) -> Self {
        Self {
            window: window.max(1),
            values: VecDeque::new(),
        }
    }

    /// Number of values that it is over, once it is full.
    pub fn window(&self) -> usize {
        self.window
    }

    /// `true` if it is over `window` values and holds no more than that. An average read from a
    /// file may be invalid.
    pub fn is_over(&self, window: usize) -> bool {
        self.window == window.max(1) && self.values.len() <= self.window
    }

    /// Adds the latest value; drops the oldest if the window is full.
    pub fn push(&mut self, value: f32) {
        if self.values.len() == self.window {
            self.values.pop_front();
        }
        self.values.push_back(value);
    }

    /// Mean of the values in the window; `None` while it is empty.
    pub fn mean(&self) -> Option<f64> {
        let sum: f64 = self.values.iter().map(|&value| f64::from(value)).sum();
        (!self.values.is_empty()).then(|| sum / self.values.len() as f64)
    }

    /// `true` if the window is full; before, the mean is over fewer values.
    pub fn is_full(&self) -> bool {
        self.values.len() == self.window
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_average_over_another_window_is_recognised() {
        let mut average = MovingAverage::new(3);
        (0..5).for_each(|value| average.push(value as f32));
        assert!(average.is_over(3) && !average.is_over(4));
        average.values.push_back(1.0);
        assert!(!average.is_over(3), "it holds more than its window");
    }

    #[test]
    fn the_mean_is_over_the_latest_values_only() {
        let mut average = MovingAverage::new(3);
        assert_eq!(average.mean(), None);
        average.push(100.0);
        assert_eq!((average.mean(), average.is_full()), (Some(100.0), false));
        for value in [1.0, 2.0, 6.0] {
            average.push(value);
        }
        assert_eq!((average.mean(), average.is_full()), (Some(3.0), true));
    }

    #[test]
    fn a_large_value_leaves_no_trace_behind() {
        let mut average = MovingAverage::new(2);
        for value in [1e30, 0.125, 0.25] {
            average.push(value);
        }
        assert_eq!(average.mean(), Some(0.1875));
    }
}
