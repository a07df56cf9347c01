//! Adam on flat vectors.
//!
//! Skein has its own, because libtorch's optimizer does not expose its state, so a resumed run
//! could not continue bit for bit. On one flat vector, a step is a handful of tensor operations.

use tch::{Device, Kind, Tensor, no_grad_guard};

use crate::state::StatePart;

const BETA_1: f64 = 0.9;
const BETA_2: f64 = 0.999;
const EPSILON: f64 = 1e-8;

/// Adam with its usual constants, β₁ = 0.9, β₂ = 0.999, ε = 1e-8 (Kingma and Ba 2015,
/// arXiv:1412.6980, algorithm 1).
#[derive(Debug)]
pub(crate) struct Adam {
    learning_rate: f64,
    first_moment: Tensor,
    second_moment: Tensor,
    /// Steps done, one i64 on the CPU: a tensor like the rest of the state, so that it is stored
    /// and restored with it.
    steps: Tensor,
}

impl Adam {
    /// Starts an optimizer for a vector like `parameters`.
    pub(crate) fn new(parameters: &Tensor, learning_rate: f64) -> Self {
        let zeros = || parameters.zeros_like();
        Self {
            learning_rate,
            first_moment: zeros(),
            second_moment: zeros(),
            steps: Tensor::zeros([1], (Kind::Int64, Device::Cpu)),
        }
    }

    /// Number of steps done so far.
    pub(crate) fn steps(&self) -> u64 {
        self.steps.int64_value(&[0]).unsigned_abs()
    }

    /// Makes one step of `parameters` against `gradient`, both of the shape given to [`Adam::new`].
    pub(crate) fn step(&mut self, parameters: &mut Tensor, gradient: &Tensor) {
        let _guard = no_grad_guard();
        self.steps += 1;
        let steps = self.steps() as f64;
        // m ← β₁ m + (1 - β₁) g; v ← β₂ v + (1 - β₂) g²
        let _ = self.first_moment.lerp_(gradient, 1.0 - BETA_1);
        let _ = self.second_moment.lerp_(&gradient.square(), 1.0 - BETA_2);
        // θ ← θ - lr · m̂ / (√v̂ + ε), where m̂ = m / (1 - β₁ᵗ) and v̂ = v / (1 - β₂ᵗ). The
        // denominator takes up the scalar factors.
        let bias_1 = 1.0 - BETA_1.powf(steps);
        let bias_2 = 1.0 - BETA_2.powf(steps);
        let denominator = self
            .second_moment
            .sqrt()
            .divide_scalar_(bias_2.sqrt())
            .g_add_scalar_(EPSILON)
            .multiply_scalar_(-bias_1 / self.learning_rate);
        let _ = parameters.addcdiv_(&self.first_moment, &denominator);
    }

    /// The state, under names that begin with `prefix`.
    pub(crate) fn parts(&mut self, prefix: &str) -> Vec<(String, StatePart<'_>)> {
        [
            ("first_moment", &self.first_moment),
            ("second_moment", &self.second_moment),
            ("steps", &self.steps),
        ]
        .map(|(name, tensor)| {
            (
                format!("{prefix}.{name}"),
                StatePart::Tensor(tensor.shallow_clone()),
            )
        })
        .into()
    }
}

#[cfg(test)]
mod tests {
    use tch::nn::{self, OptimizerConfig};

    use super::*;
    use crate::noise::Noise;
    use crate::state::Stateful;

    impl Stateful for Adam {
        fn parts(&mut self) -> Vec<(String, StatePart<'_>)> {
            Adam::parts(self, "adam")
        }
    }

    #[test]
    fn two_steps_match_the_algorithm_done_by_hand() {
        let mut parameters = Tensor::from_slice(&[1.0_f32]);
        let mut adam = Adam::new(&parameters, 0.1);
        // First step: m̂ = g and v̂ = g², so the parameter moves by lr · sign(g).
        adam.step(&mut parameters, &Tensor::from_slice(&[0.5_f32]));
        assert!((parameters.double_value(&[0]) - 0.9).abs() < 1e-6);
        // Second step, g = -2: m = 0.9 · 0.05 - 0.2 = -0.155, v = 0.999 · 0.00025 + 0.004 =
        // 0.00424975.
        adam.step(&mut parameters, &Tensor::from_slice(&[-2.0_f32]));
        let (first, second): (f64, f64) = (-0.155 / (1.0 - 0.81), 0.004_249_75 / (1.0 - 0.998_001));
        let expected = 0.9 - 0.1 * first / (second.sqrt() + 1e-8);
        let found = parameters.double_value(&[0]);
        assert!((found - expected).abs() < 1e-6, "{found} is not {expected}");
        assert_eq!(adam.steps(), 2);
    }

    #[test]
    fn five_hundred_steps_match_the_librarys_adam() {
        let start = Noise::new(1).normal(&[50], Device::Cpu);
        let store = nn::VarStore::new(Device::Cpu);
        let mut library_parameters = store.root().zeros("x", &[50]);
        {
            let _guard = no_grad_guard();
            library_parameters.copy_(&start);
        }
        let mut library = nn::Adam::default().build(&store, 1e-2).unwrap();
        let mut parameters = start.copy();
        let mut adam = Adam::new(&parameters, 1e-2);
        let loss = |x: &Tensor| (x.square() * x.sin()).sum(None);
        for _ in 0..500 {
            library.backward_step(&loss(&library_parameters));
            let leaf = parameters.detach().copy().set_requires_grad(true);
            let gradient = Tensor::run_backward(&[loss(&leaf)], &[&leaf], false, false);
            adam.step(&mut parameters, &gradient[0]);
        }
        let difference = (&parameters - library_parameters.detach())
            .abs()
            .max()
            .double_value(&[]);
        assert!(difference < 1e-5, "they differ by {difference}");
        assert!(
            (&parameters - start).abs().max().double_value(&[]) > 0.5,
            "nothing moved: the comparison shows nothing"
        );
    }

    #[test]
    fn a_restored_optimizer_continues_bit_for_bit() {
        let mut noise = Noise::new(2);
        let gradients: Vec<Tensor> = (0..6).map(|_| noise.normal(&[20], Device::Cpu)).collect();
        let mut parameters = Tensor::ones([20], (Kind::Float, Device::Cpu));
        let mut adam = Adam::new(&parameters, 1e-2);
        gradients[..3]
            .iter()
            .for_each(|gradient| adam.step(&mut parameters, gradient));

        let mut resumed_parameters = parameters.copy();
        let mut resumed = Adam::new(&parameters, 1e-2);
        resumed.load_named(&adam.named_tensors()).unwrap();
        for gradient in &gradients[3..] {
            adam.step(&mut parameters, gradient);
            resumed.step(&mut resumed_parameters, gradient);
        }
        assert_eq!(parameters, resumed_parameters);
        assert_eq!(resumed.steps(), 6);
    }
}
