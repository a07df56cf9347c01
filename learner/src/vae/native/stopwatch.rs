//! Time of a VAE step by layer and pass.

use std::time::Instant;

/// Names of the layers, in order.
pub const LAYERS: [&str; 10] = [
    "encoder.conv1",
    "encoder.conv2",
    "encoder.conv3",
    "encoder.conv4",
    "encoder heads",
    "decoder.linear",
    "decoder.conv1",
    "decoder.conv2",
    "decoder.conv3",
    "decoder.conv4",
];

/// One of a layer's computations in a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pass {
    /// Computes the output.
    Forward,
    /// Computes the gradient with respect to the input.
    Backward,
    /// Computes the gradient with respect to weights and biases.
    Gradient,
}

impl Pass {
    /// All passes, in order.
    pub const ALL: [Self; 3] = [Self::Forward, Self::Backward, Self::Gradient];
}

/// Seconds by layer and pass, summed over all team members.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct LayerTimes {
    /// Seconds, `[layer][pass]`, in the order of [`LAYERS`] and [`Pass::ALL`].
    pub layers: [[f64; 3]; 10],
    /// Seconds spent on Adam and on packing the weights for the next step.
    pub adam_and_packing: f64,
    /// Seconds spent on pixels, codes, losses and the check for finite numbers.
    pub rest: f64,
}

impl LayerTimes {
    /// Adds the times of another member.
    pub(super) fn add(&mut self, other: &Self) {
        for (own, other) in self
            .layers
            .as_flattened_mut()
            .iter_mut()
            .zip(other.layers.as_flattened())
        {
            *own += other;
        }
        self.adam_and_packing += other.adam_and_packing;
        self.rest += other.rest;
    }

    /// Sum of all seconds.
    pub fn total(&self) -> f64 {
        self.layers.as_flattened().iter().sum::<f64>() + self.adam_and_packing + self.rest
    }
}

/// Books the time since the last lap under a layer or another heading.
#[derive(Debug)]
pub(super) struct Stopwatch {
    last: Instant,
    pub(super) times: LayerTimes,
}

impl Default for Stopwatch {
    fn default() -> Self {
        Self {
            last: Instant::now(),
            times: LayerTimes::default(),
        }
    }
}

impl Stopwatch {
    /// Starts a lap.
    pub(super) fn start(&mut self) {
        self.last = Instant::now();
    }

    /// Books the lap under a layer's pass.
    pub(super) fn layer(&mut self, layer: usize, pass: Pass) {
        self.times.layers[layer][pass as usize] += self.lap();
    }

    /// Books the lap under Adam and packing.
    pub(super) fn adam_and_packing(&mut self) {
        self.times.adam_and_packing += self.lap();
    }

    /// Books the lap under the rest.
    pub(super) fn rest(&mut self) {
        self.times.rest += self.lap();
    }

    fn lap(&mut self) -> f64 {
        let now = Instant::now();
        now.duration_since(std::mem::replace(&mut self.last, now))
            .as_secs_f64()
    }
}
