//! A vector that is learned: its numbers, their gradient, and what Adam remembers of earlier ones.

use skein_kernels::{AdamStep, Isa, Team};

use crate::state::Part;

/// A network's parameters, or log α.
#[derive(Debug)]
pub struct Learned {
    /// Its numbers.
    pub values: Vec<f32>,
    /// What the next step goes against.
    pub gradient: Vec<f32>,
    first_moment: Vec<f32>,
    second_moment: Vec<f32>,
    steps: u64,
    learning_rate: f64,
}

impl Learned {
    /// Before its first step.
    pub fn new(values: Vec<f32>, learning_rate: f64) -> Self {
        let zeros = || vec![0.0; values.len()];
        Self {
            gradient: zeros(),
            first_moment: zeros(),
            second_moment: zeros(),
            steps: 0,
            learning_rate,
            values,
        }
    }

    /// Steps done so far.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// One step of Adam against the gradient.
    pub fn step(&mut self, team: &mut Team, isa: Isa) {
        self.steps += 1;
        let step = AdamStep {
            learning_rate: self.learning_rate,
            number: self.steps,
        };
        let moments = [&mut self.first_moment[..], &mut self.second_moment[..]];
        step.apply(team, isa, &mut self.values, &self.gradient, moments);
    }

    /// The values under `name`, and Adam's state under names that begin with `adam`.
    pub fn parts(&mut self, name: &str, adam: &str) -> Vec<(String, Part<'_>)> {
        vec![
            (name.to_owned(), Part::Numbers(&mut self.values)),
            (
                format!("{adam}.first_moment"),
                Part::Numbers(&mut self.first_moment),
            ),
            (
                format!("{adam}.second_moment"),
                Part::Numbers(&mut self.second_moment),
            ),
            (format!("{adam}.steps"), Part::Count(&mut self.steps)),
        ]
    }
}

/// Squared length of a gradient: infinite or not a number if one of its numbers is, or if it
/// overflows. Sixteen sums side by side, the same on every processor.
pub fn squared_norm(isa: Isa, gradient: &[f32]) -> f32 {
    isa.vectorised(
        #[inline(always)]
        || {
            let mut sums = [0.0_f32; 16];
            let mut whole = gradient.chunks_exact(sums.len());
            for numbers in &mut whole {
                for (sum, number) in sums.iter_mut().zip(numbers) {
                    *sum = number.mul_add(*number, *sum);
                }
            }
            let rest = whole.remainder().iter().map(|number| number * number);
            rest.chain(sums).sum()
        },
    )
}
