//! Adam on flat vectors, in one pass over memory.

use crate::isa::Isa;
use crate::team::{Shared, Team};

const BETA_1: f32 = 0.9;
const BETA_2: f32 = 0.999;
const EPSILON: f32 = 1e-8;
/// Numbers that one member updates at least: whole cache lines.
const GRAIN: usize = 1024;

/// One step of Adam with its usual constants, β₁ = 0.9, β₂ = 0.999, ε = 1e-8 (Kingma and Ba 2015,
/// arXiv:1412.6980, algorithm 1).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdamStep {
    /// Learning rate.
    pub learning_rate: f64,
    /// Number of the step, from 1.
    pub number: u64,
}

impl AdamStep {
    /// Moves `parameters` against `gradient`; all vectors have the same length.
    ///
    /// # Panics
    /// If lengths differ.
    pub fn apply(
        self,
        team: &mut Team,
        isa: Isa,
        parameters: &mut [f32],
        gradient: &[f32],
        moments: [&mut [f32]; 2],
    ) {
        let len = parameters.len();
        let [first, second] = moments;
        assert!(
            [gradient.len(), first.len(), second.len()] == [len; 3],
            "parameters, gradient and moments have the same length"
        );
        // θ ← θ - lr · m̂ / (√v̂ + ε), where m̂ = m / (1 - β₁ᵗ) and v̂ = v / (1 - β₂ᵗ).
        let bias = |beta: f32| 1.0 - f64::from(beta).powf(self.number as f64);
        let rate = (-self.learning_rate / bias(BETA_1)) as f32;
        let root = (1.0 / bias(BETA_2).sqrt()) as f32;
        let (parameters, first, second) = (
            Shared::new(parameters),
            Shared::new(first),
            Shared::new(second),
        );
        team.split(len, GRAIN, |part| {
            // SAFETY: the parts of `split` do not overlap.
            let (parameters, first, second) = unsafe {
                (
                    parameters.part(part.clone()),
                    first.part(part.clone()),
                    second.part(part.clone()),
                )
            };
            let gradient = &gradient[part];
            isa.vectorised(
                #[inline(always)]
                || {
                    let moments = first.iter_mut().zip(second);
                    for ((parameter, gradient), (first, second)) in
                        parameters.iter_mut().zip(gradient).zip(moments)
                    {
                        // m ← β₁ m + (1 - β₁) g; v ← β₂ v + (1 - β₂) g²
                        *first = (gradient - *first).mul_add(1.0 - BETA_1, *first);
                        *second = gradient
                            .mul_add(*gradient, -*second)
                            .mul_add(1.0 - BETA_2, *second);
                        let spread = second.sqrt().mul_add(root, EPSILON);
                        *parameter = (*first / spread).mul_add(rate, *parameter);
                    }
                },
            );
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn step(team: &mut Team, isa: Isa, number: u64, gradient: &[f32], state: &mut [Vec<f32>; 3]) {
        let [parameters, first, second] = state;
        let learning_rate = 0.1;
        AdamStep {
            learning_rate,
            number,
        }
        .apply(team, isa, parameters, gradient, [first, second]);
    }

    #[test]
    fn two_steps_match_a_calculation_by_hand() {
        let mut state = [vec![1.0], vec![0.0], vec![0.0]];
        let mut team = Team::new(1);
        // First step: m̂ = g and v̂ = g², so the parameter moves by lr · sign(g).
        step(&mut team, Isa::best(), 1, &[0.5], &mut state);
        assert!((state[0][0] - 0.9).abs() < 1e-6);
        // Second step, g = -2: m = 0.9 · 0.05 - 0.2 = -0.155, v = 0.999 · 0.00025 + 0.004 =
        // 0.00424975.
        step(&mut team, Isa::best(), 2, &[-2.0], &mut state);
        let (first, second): (f64, f64) = (-0.155 / (1.0 - 0.81), 0.004_249_75 / (1.0 - 0.998_001));
        let expected = 0.9 - 0.1 * first / (second.sqrt() + 1e-8);
        let found = f64::from(state[0][0]);
        assert!((found - expected).abs() < 1e-6, "{found} is not {expected}");
    }

    #[test]
    fn instructions_and_members_do_not_change_a_bit() {
        let gradient: Vec<f32> = (0..5000).map(|index| (index as f32 * 0.37).sin()).collect();
        let run = |isa: Isa, members: usize| {
            let mut state = [vec![1.0; 5000], vec![0.0; 5000], vec![0.0; 5000]];
            let mut team = Team::new(members);
            for number in 1..4 {
                step(&mut team, isa, number, &gradient, &mut state);
            }
            state
        };
        let expected = run(Isa::Portable, 1);
        for isa in Isa::ALL.into_iter().filter(|isa| isa.is_available()) {
            for members in 1..=3 {
                assert_eq!(run(isa, members), expected, "{isa}, {members} members");
            }
        }
    }
}
