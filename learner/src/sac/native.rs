//! One SAC update on the native kernels, forward and backward written out, in reading order.
//!
//! It computes the same update as [`super::TorchSac`], which stays as the reference: same
//! parameters in the same order, same noise, same metrics. Every sum has a fixed order, so its bits
//! depend neither on the instruction set nor on the number of threads. Equality across types of
//! processor is not promised: a few functions are the C library's (docs/reliability.md). Buffers
//! are allocated once per batch size and reused.
//!
//! Equation numbers and symbols are those of arXiv:1812.05905:
//! - s and s': states before and after the replayed action;
//! - a and a': actions drawn from the policy in s and s';
//! - Q and Q̄: critic and target critic, two estimates each;
//! - α and H̄: temperature and target entropy; γ: discount.

mod sample;

use skein_kernels::{Isa, Team, exp};
use skein_protocol::config::{SacSection, TeacherSection};
use skein_protocol::seeds::{Purpose, derive};

use self::sample::Sample;
use super::reported;
use crate::algorithm::{Algorithm, Columns, Inputs};
use crate::error::{UpdateError, must_be_finite};
use crate::imitation::imitate;
use crate::metrics::Scalar;
use crate::networks::native::{
    CriticLayers, Dense, ESTIMATES, Layers, Learned, NativeCritic, follow, join, output,
    output_mut, pair, smaller, squared_norm,
};
use crate::networks::{CriticNetwork, Layout, PolicyNetwork};
use crate::noise::Noise;
use crate::state::{StatePart, Stateful};

/// Policy, critic, target critic and temperature, each with its optimizer state.
#[derive(Debug)]
pub struct NativeSac {
    isa: Isa,
    inputs: Inputs,
    policy_layout: Layout,
    policy: Dense,
    policy_parameters: Learned,
    critic: NativeCritic,
    critic_parameters: Learned,
    /// Parameters of the target critic Q̄: a slowly following average of the critic's, which
    /// steadies the targets.
    target_parameters: Vec<f32>,
    /// log α, `[1]`.
    log_temperature: Learned,
    discount: f32,
    target_rate: f32,
    target_entropy: f32,
    teacher: TeacherSection,
    buffers: UpdateBuffers,
}

/// Buffers of one update, kept from update to update.
#[derive(Debug, Default)]
struct UpdateBuffers {
    rows: usize,
    /// Policy network outputs, `[2 rows, 2 · action]`: first for the next observations s', then for
    /// s.
    outputs: Vec<f32>,
    /// Actions drawn from those outputs, and their log-probabilities: rows of s' first, then of s.
    sample: Sample,
    /// Critic input, `[rows, critic input + action]`: states and actions side by side.
    joined: Vec<f32>,
    /// Target critic's two estimates of Q̄(s', a'), `[rows, 2]`.
    target_values: Vec<f32>,
    /// Critic activations: for the replayed actions, then overwritten by those for the drawn
    /// actions.
    critic: CriticLayers,
    /// Gradient of the critic loss with respect to the critic's activations, for the replayed
    /// actions.
    critic_grad: CriticLayers,
    /// Gradient of the policy loss with respect to the two estimates of Q(s, a), `[rows, 2]`.
    drawn_grad: Vec<f32>,
    /// Gradient of the policy loss with respect to the drawn actions, through Q,
    /// `[rows, action]`.
    action_grad: Vec<f32>,
    /// Policy activations for the current states s, `[rows, width]` per layer.
    policy: Layers,
    /// Gradient of the policy loss with respect to those activations.
    policy_grad: Layers,
}

impl NativeSac {
    /// Returns untrained networks; their parameters depend on the run's seed alone.
    ///
    /// # Panics
    /// The first update panics when this machine lacks the instructions of `isa`.
    pub fn new(section: &SacSection, inputs: Inputs, run_seed: u64, isa: Isa) -> Self {
        let width = section.hidden_width as i64;
        let mut policy_layout = Layout::default();
        PolicyNetwork::describe(&mut policy_layout, inputs, width);
        let policy_values =
            policy_layout.initial_values(derive(run_seed, Purpose::PolicyParameters, 0));
        let mut critic_layout = Layout::default();
        CriticNetwork::describe(&mut critic_layout, inputs, width, section.critic_networks);
        let critic_values =
            critic_layout.initial_values(derive(run_seed, Purpose::PolicyParameters, 1));
        let log_temperature = vec![section.initial_temperature.ln() as f32];
        Self {
            isa,
            inputs,
            policy: Dense::new(isa, policy_layout.tensors()),
            policy_layout,
            policy_parameters: Learned::new(policy_values, section.policy_learning_rate),
            critic: NativeCritic::new(isa, &critic_layout, section.critic_networks),
            target_parameters: critic_values.clone(),
            critic_parameters: Learned::new(critic_values, section.critic_learning_rate),
            log_temperature: Learned::new(log_temperature, section.temperature_learning_rate),
            discount: section.discount as f32,
            target_rate: section.target_rate as f32,
            target_entropy: section.target_entropy.value(inputs.action) as f32,
            teacher: TeacherSection::default(),
            buffers: UpdateBuffers::default(),
        }
    }

    /// Lets the actions of `teacher` attract the policy.
    #[must_use]
    pub fn with_teacher(mut self, teacher: &TeacherSection) -> Self {
        self.teacher = teacher.clone();
        self
    }

    /// Draws actions from the current policy: a' for the next observations, a for the observations.
    fn draw(&mut self, team: &mut Team, columns: Columns<'_>, noise: &mut Noise) {
        let policy = &self.policy_parameters.values;
        let action = self.inputs.action.numbers();
        let UpdateBuffers {
            rows,
            outputs,
            sample,
            policy: activations,
            ..
        } = &mut self.buffers;
        let (next_outputs, state_outputs) = outputs.split_at_mut(*rows * 2 * action);
        self.policy
            .forward_through(team, policy, columns.next_observations, next_outputs);
        self.policy
            .forward(team, policy, columns.observations, activations);
        state_outputs.copy_from_slice(output(activations));
        // Two draws, as the reference's: noise comes in pairs.
        let (next_noise, state_noise) = sample.noise.split_at_mut(*rows * action);
        noise.fill_normal(next_noise);
        noise.fill_normal(state_noise);
        sample.draw(self.isa, outputs);
    }

    /// Computes the critic's gradient: regresses both estimates on the soft Bellman target y.
    ///
    /// ```text
    /// y = r + γ (1 - terminated) (min Q̄(s', a') - α log π(a' | s'))      (eq. 3)
    /// loss = ½ Σ (Q(s, replayed action) - y)², mean over the batch       (eq. 5)
    /// ```
    ///
    /// Returns the loss, the mean of the smaller estimate, and the smallest and largest of all.
    fn critic_gradient(
        &mut self,
        team: &mut Team,
        columns: Columns<'_>,
        temperature: f32,
    ) -> [f32; 4] {
        let action = self.inputs.action.numbers();
        let UpdateBuffers {
            rows,
            sample,
            joined,
            target_values,
            critic: activations,
            critic_grad,
            ..
        } = &mut self.buffers;
        let (next_actions, next_log_prob) =
            (&sample.actions[..*rows * action], &sample.log_prob[..*rows]);
        join(columns.next_states, next_actions, action, joined);
        self.critic
            .forward_through(team, &self.target_parameters, joined, target_values);

        join(columns.states, columns.actions, action, joined);
        let critic = &self.critic_parameters.values;
        self.critic.forward(team, critic, joined, activations);
        let (mut loss, mut value) = (0.0, 0.0);
        let (mut smallest, mut largest) = (f32::INFINITY, f32::NEG_INFINITY);
        let share = 1.0 / *rows as f32;
        let grad = &mut critic_grad.values;
        for row in 0..*rows {
            let soft_value = smaller(pair(target_values, row)) - temperature * next_log_prob[row];
            let target =
                columns.rewards[row] + (1.0 - columns.terminated[row]) * soft_value * self.discount;
            let values = pair(&activations.values, row);
            for (value, grad) in values.iter().zip(&mut grad[row * ESTIMATES..]) {
                let error = value - target;
                loss += 0.5 * f64::from(error * error);
                *grad = error * share;
            }
            value += f64::from(smaller(values));
            smallest = values.iter().copied().fold(smallest, f32::min);
            largest = values.iter().copied().fold(largest, f32::max);
        }
        let into = &mut self.critic_parameters.gradient;
        self.critic
            .gradient(team, critic, joined, activations, critic_grad, into);
        let [loss, value] = [loss, value].map(|sum| (sum / *rows as f64) as f32);
        [loss, value, smallest, largest]
    }

    /// Computes the policy's gradient: makes actions of higher value likelier, at a price for lost
    /// entropy. With a teacher, its action a* attracts the policy's mode, with a weight λ that
    /// falls to zero.
    ///
    /// ```text
    /// loss = α log π(a | s) - min Q(s, a), mean over the batch           (eq. 7)
    ///        + λ |tanh μ(s) - a*|²
    /// ```
    ///
    /// Returns the loss without the teacher's term, the mean of log π, and the squared distance to
    /// the teacher.
    fn policy_gradient(
        &mut self,
        team: &mut Team,
        columns: Columns<'_>,
        temperature: f32,
    ) -> ([f32; 2], Option<f32>) {
        let weight = self.teacher.loss_weight_after(self.updates()) as f32;
        let numbers = self.inputs.action.numbers();
        let UpdateBuffers {
            rows,
            sample,
            joined,
            critic: activations,
            drawn_grad,
            action_grad,
            policy: policy_activations,
            policy_grad,
            ..
        } = &mut self.buffers;
        let (policy, critic) = (
            &self.policy_parameters.values,
            &self.critic_parameters.values,
        );
        let (actions, log_prob) = (
            &sample.actions[*rows * numbers..],
            &sample.log_prob[*rows..],
        );
        join(columns.states, actions, numbers, joined);
        self.critic.forward(team, critic, joined, activations);
        let (mut loss, mut log_prob_sum) = (0.0, 0.0);
        let share = 1.0 / *rows as f32;
        for (row, &log_prob) in log_prob.iter().enumerate() {
            let values = pair(&activations.values, row);
            log_prob_sum += f64::from(log_prob);
            loss += f64::from(temperature * log_prob - smaller(values));
            drawn_grad[row * ESTIMATES..][..ESTIMATES]
                .copy_from_slice(&share_of_smaller(values).map(|part| -share * part));
        }
        let action = self.inputs.critic..self.inputs.critic + numbers;
        self.critic
            .backward_through(team, critic, activations, drawn_grad, action, action_grad);
        // Back through the drawn actions, then through the policy.
        sample.backward(
            *rows,
            temperature * share,
            action_grad,
            output_mut(policy_grad),
        );
        let distance = columns.teacher_actions.map(|teacher| {
            let outputs = output(policy_activations);
            imitate(outputs, teacher, numbers, weight, output_mut(policy_grad))
        });
        self.policy
            .backward(team, policy, policy_activations, policy_grad);
        let into = &mut self.policy_parameters.gradient;
        self.policy.gradient(
            team,
            columns.observations,
            policy_activations,
            policy_grad,
            into,
        );
        let means = [loss, log_prob_sum].map(|sum| (sum / *rows as f64) as f32);
        (means, distance)
    }

    /// Allocates the buffers for an update of `rows` transitions.
    fn allocate(&self, rows: usize) -> UpdateBuffers {
        let numbers = |rows: usize, width: usize| vec![0.0; rows * width];
        let action = self.inputs.action.numbers();
        UpdateBuffers {
            rows,
            outputs: numbers(2 * rows, 2 * action),
            sample: Sample::allocate(2 * rows, action),
            joined: numbers(rows, self.inputs.critic + action),
            target_values: numbers(rows, ESTIMATES),
            critic: self.critic.allocate(rows),
            critic_grad: self.critic.allocate(rows),
            drawn_grad: numbers(rows, ESTIMATES),
            action_grad: numbers(rows, action),
            policy: self.policy.allocate(rows),
            policy_grad: self.policy.allocate(rows),
        }
    }

    /// Checks that the reported values and the gradients are finite; for a gradient, that its
    /// squared norm is. Returns the norms of the critic's and the policy's.
    fn check(&self, reported: [f32; 5]) -> Result<[f32; 2], UpdateError> {
        let [critic_loss, policy_loss, temperature, entropy, mean_value] = reported;
        let norm = |learned: &Learned| squared_norm(self.isa, &learned.gradient);
        let norms = [norm(&self.critic_parameters), norm(&self.policy_parameters)];
        let numbers = [
            ("critic loss", critic_loss),
            ("policy loss", policy_loss),
            ("temperature", temperature),
            ("entropy", entropy),
            ("mean value", mean_value),
            ("critic gradient", norms[0]),
            ("policy gradient", norms[1]),
            ("temperature gradient", norm(&self.log_temperature)),
        ];
        must_be_finite(self.updates() + 1, numbers)?;
        Ok(norms.map(f32::sqrt))
    }

    /// Returns the policy's action without noise, `[n, action]`. `observations`: `[n,
    /// observation]`.
    pub fn mode(&self, observations: &[f32]) -> Vec<f32> {
        let action = self.inputs.action.numbers();
        let mut outputs = vec![0.0; observations.len() / self.inputs.policy * 2 * action];
        let policy = &self.policy_parameters.values;
        self.policy
            .forward_through(&mut Team::new(1), policy, observations, &mut outputs);
        let means = outputs
            .chunks_exact(2 * action)
            .flat_map(|row| &row[..action]);
        means.map(|mean| mean.tanh()).collect()
    }
}

impl Algorithm for NativeSac {
    /// Makes one step of critic, policy and temperature, then moves the target critic.
    ///
    /// All three gradients are taken at the same parameters before any of them moves, so an update
    /// happens whole or not at all.
    ///
    /// Source: arXiv:1812.05905, algorithm 1.
    fn update(
        &mut self,
        team: &mut Team,
        columns: Columns<'_>,
        noise: &mut Noise,
    ) -> Result<Vec<(Scalar, f32)>, UpdateError> {
        let rows = columns.check(self.inputs);
        if self.buffers.rows != rows {
            self.buffers = self.allocate(rows);
        }
        let temperature = exp(self.log_temperature.values[0]);
        self.draw(team, columns, noise);
        let [critic_loss, mean_value, smallest, largest] =
            self.critic_gradient(team, columns, temperature);
        let ([policy_loss, log_prob], distance) = self.policy_gradient(team, columns, temperature);
        // The derivative of -α (log π + H̄) by log α is the expression itself (eq. 18). The
        // temperature rises while the entropy is below its target, and falls otherwise.
        self.log_temperature.gradient[0] = -temperature * (log_prob + self.target_entropy);

        let [critic_norm, policy_norm] =
            self.check([critic_loss, policy_loss, temperature, -log_prob, mean_value])?;
        let isa = self.isa;
        self.critic_parameters.step(team, isa);
        self.policy_parameters.step(team, isa);
        self.log_temperature.step(team, isa);
        let (target, critic) = (&mut self.target_parameters, &self.critic_parameters.values);
        follow(team, isa, target, critic, self.target_rate);
        let metrics = [
            critic_loss,
            policy_loss,
            temperature,
            -log_prob,
            mean_value,
            smallest,
            largest,
            critic_norm,
            policy_norm,
        ];
        Ok(reported(metrics, distance))
    }

    fn updates(&self) -> u64 {
        self.critic_parameters.steps()
    }

    fn policy_layout(&self) -> &Layout {
        &self.policy_layout
    }

    fn start_from(&mut self, policy: &[f32]) {
        self.policy_parameters.values.copy_from_slice(policy);
    }

    fn publish(&self, into: &mut [f32]) {
        into.copy_from_slice(&self.policy_parameters.values);
    }

    fn publish_encoder(&self, _into: &mut [f32]) {}
}

impl Stateful for NativeSac {
    fn parts(&mut self) -> Vec<(String, StatePart<'_>)> {
        let mut parts = self
            .policy_parameters
            .parts("sac.policy.parameters", "sac.policy.adam");
        parts.extend(
            self.critic_parameters
                .parts("sac.critic.parameters", "sac.critic.adam"),
        );
        parts.extend(
            self.log_temperature
                .parts("sac.log_temperature", "sac.temperature.adam"),
        );
        let target = StatePart::Numbers(&mut self.target_parameters);
        parts.push(("sac.target.parameters".to_owned(), target));
        parts
    }
}

/// Derivative of the smaller estimate by both estimates. Equal ones share it, as in libtorch.
fn share_of_smaller([one, other]: [f32; ESTIMATES]) -> [f32; ESTIMATES] {
    if one < other {
        [1.0, 0.0]
    } else if other < one {
        [0.0, 1.0]
    } else {
        [0.5, 0.5]
    }
}

#[cfg(test)]
mod tests;
