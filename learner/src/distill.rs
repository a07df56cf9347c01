//! Distillation: regression of the policy on the teacher's actions, in the states that the policy
//! itself visits (DAgger, arXiv:1011.0686).
//!
//! There is no critic and no reward. The loss is the squared distance between the policy's mode
//! and the teacher's action; the standard deviation before tanh is held at
//! `distill.exploration`, so that a snapshot flies like one of SAC. One engine: the native
//! kernels, whose bits depend neither on the instruction set nor on the number of threads.

use skein_kernels::{Isa, Team};
use skein_protocol::config::DistillSection;
use skein_protocol::seeds::{Purpose, derive};

use crate::algorithm::{Algorithm, Columns, Inputs};
use crate::error::{UpdateError, must_be_finite};
use crate::imitation::imitate;
use crate::metrics::Scalar;
use crate::networks::native::{Dense, Layers, Learned, output, output_mut, squared_norm};
use crate::networks::{Layout, PolicyNetwork};
use crate::noise::Noise;
use crate::state::{StatePart, Stateful};

/// The policy and its optimizer.
#[derive(Debug)]
pub(crate) struct Distill {
    isa: Isa,
    inputs: Inputs,
    layout: Layout,
    policy: Dense,
    parameters: Learned,
    /// Logarithm of the standard deviation of training episodes.
    log_std: f32,
    rows: usize,
    /// Policy activations, `[rows, width]` per layer.
    activations: Layers,
    /// Gradient of the loss with respect to them.
    grad: Layers,
}

impl Distill {
    /// Returns an untrained policy; its parameters depend on the run's seed alone.
    ///
    /// # Panics
    /// The first update panics when this machine lacks the instructions of `isa`.
    pub(crate) fn new(section: &DistillSection, inputs: Inputs, run_seed: u64, isa: Isa) -> Self {
        let mut layout = Layout::default();
        PolicyNetwork::describe(&mut layout, inputs, section.hidden_width as i64);
        let values = layout.initial_values(derive(run_seed, Purpose::PolicyParameters, 0));
        Self {
            isa,
            inputs,
            policy: Dense::new(isa, layout.tensors()),
            layout,
            parameters: Learned::new(values, section.learning_rate),
            log_std: section.exploration.ln() as f32,
            rows: 0,
            activations: Layers::new(),
            grad: Layers::new(),
        }
    }
}

impl Algorithm for Distill {
    /// Makes one step on |tanh μ - a*|² + |ln σ - ln `exploration`|², each summed over the action
    /// and averaged over the minibatch.
    ///
    /// # Panics
    /// When the columns have no teacher's actions.
    fn update(
        &mut self,
        team: &mut Team,
        columns: Columns<'_>,
        _noise: &mut Noise,
    ) -> Result<Vec<(Scalar, f32)>, UpdateError> {
        let rows = columns.check(self.inputs);
        let teacher = columns.teacher_actions.expect("distillation has a teacher");
        if self.rows != rows {
            self.activations = self.policy.allocate(rows);
            self.grad = self.policy.allocate(rows);
            self.rows = rows;
        }
        let (policy, parameters) = (&self.policy, &mut self.parameters);
        let observations = columns.observations;
        policy.forward(
            team,
            &parameters.values,
            observations,
            &mut self.activations,
        );
        let outputs = output(&self.activations);
        let grad = output_mut(&mut self.grad);
        let action = self.inputs.action.numbers();
        for (grad, output) in grad.iter_mut().zip(outputs) {
            *grad = 2.0 * (output - self.log_std) / rows as f32;
        }
        for row in grad.chunks_exact_mut(2 * action) {
            row[..action].fill(0.0);
        }
        let distance = imitate(outputs, teacher, action, 1.0, grad);
        policy.backward(team, &parameters.values, &self.activations, &mut self.grad);
        policy.gradient(
            team,
            observations,
            &self.activations,
            &self.grad,
            &mut parameters.gradient,
        );
        must_be_finite(
            parameters.steps() + 1,
            [
                ("distance to the teacher", distance),
                (
                    "policy gradient",
                    squared_norm(self.isa, &parameters.gradient),
                ),
            ],
        )?;
        parameters.step(team, self.isa);
        Ok(vec![(Scalar::TeacherDistance, distance)])
    }

    fn updates(&self) -> u64 {
        self.parameters.steps()
    }

    fn policy_layout(&self) -> &Layout {
        &self.layout
    }

    fn start_from(&mut self, policy: &[f32]) {
        self.parameters.values.copy_from_slice(policy);
    }

    fn publish(&self, into: &mut [f32]) {
        into.copy_from_slice(&self.parameters.values);
    }

    fn publish_encoder(&self, _into: &mut [f32]) {}
}

impl Stateful for Distill {
    fn parts(&mut self) -> Vec<(String, StatePart<'_>)> {
        self.parameters
            .parts("distill.policy.parameters", "distill.policy.adam")
    }
}

#[cfg(test)]
mod tests;
