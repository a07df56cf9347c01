//! Where the time of a step goes, layer by layer.

use std::time::Instant;

/// The layers, in order.
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

/// What a layer does in a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pass {
    /// Its output.
    Forward,
    /// The gradient with respect to its input.
    Backward,
    /// The gradient with respect to its weights and biases.
    Gradient,
}

impl Pass {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Forward, Self::Backward, Self::Gradient];
}

/// Seconds of all members together, by layer and pass.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Spent {
    /// `[layer][pass]`, in the order of [`LAYERS`] and [`Pass::ALL`].
    pub layers: [[f64; 3]; 10],
    /// Adam and packing the weights for the next step.
    pub adam_and_packing: f64,
    /// Pixels, codes, losses, whether all is finite.
    pub rest: f64,
}

impl Spent {
    /// Adds another member's.
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

    /// All seconds.
    pub fn total(&self) -> f64 {
        self.layers.as_flattened().iter().sum::<f64>() + self.adam_and_packing + self.rest
    }
}

/// Attributes the time between two looks at it.
#[derive(Debug)]
pub(super) struct Stopwatch {
    last: Instant,
    pub(super) spent: Spent,
}

impl Default for Stopwatch {
    fn default() -> Self {
        Self {
            last: Instant::now(),
            spent: Spent::default(),
        }
    }
}

impl Stopwatch {
    /// From here on.
    pub(super) fn start(&mut self) {
        self.last = Instant::now();
    }

    /// What has passed since the last look was this layer's.
    pub(super) fn layer(&mut self, layer: usize, pass: Pass) {
        self.spent.layers[layer][pass as usize] += self.lap();
    }

    /// It was Adam's, or went into packing.
    pub(super) fn adam_and_packing(&mut self) {
        self.spent.adam_and_packing += self.lap();
    }

    /// It was something else's.
    pub(super) fn rest(&mut self) {
        self.spent.rest += self.lap();
    }

    fn lap(&mut self) -> f64 {
        let now = Instant::now();
        now.duration_since(std::mem::replace(&mut self.last, now))
            .as_secs_f64()
    }
}
