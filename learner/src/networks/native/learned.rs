//! A learned vector: its values, their gradient, and Adam's two moments.

use skein_kernels::{AdamStep, Isa, Team};

use crate::state::StatePart;

/// A network's parameters, or log α, with the state of its optimizer.
#[derive(Debug)]
pub struct Learned {
    /// Present values.
    pub values: Vec<f32>,
    /// Gradient for the next step.
    pub gradient: Vec<f32>,
    first_moment: Vec<f32>,
    second_moment: Vec<f32>,
    steps: u64,
    learning_rate: f64,
}

impl Learned {
    /// Returns the vector before its first step.
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

    /// Number of steps done so far.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// Sets the learning rate of the next steps.
    pub fn set_learning_rate(&mut self, learning_rate: f64) {
        self.learning_rate = learning_rate;
    }

    /// Makes one step of Adam against the gradient.
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
    pub fn parts(&mut self, name: &str, adam: &str) -> Vec<(String, StatePart<'_>)> {
        vec![
            (name.to_owned(), StatePart::Numbers(&mut self.values)),
            (
                format!("{adam}.first_moment"),
                StatePart::Numbers(&mut self.first_moment),
            ),
            (
                format!("{adam}.second_moment"),
                StatePart::Numbers(&mut self.second_moment),
            ),
            (format!("{adam}.steps"), StatePart::Count(&mut self.steps)),
        ]
    }
}

/// Squared norm of a gradient. It is not finite if an element is not, or if it overflows. Sixteen
/// partial sums keep the order of addition equal with every instruction set.
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
