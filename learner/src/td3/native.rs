//! One TD3 update on the kernels, forward and backward written out; [`super::TorchTd3`] is the same
//! on libtorch. tanh is the C library's, as in actors: bits are equal on any processor with the
//! same one.

use skein_kernels::{Isa, Team};
use skein_protocol::ACTION;
use skein_protocol::config::Td3Section;
use skein_protocol::seeds::{Purpose, derive};

use crate::algorithm::{Algorithm, Columns, Inputs};
use crate::error::{UpdateError, must_be_finite};
use crate::metrics::Scalar;
use crate::networks::native::{
    CriticLayers, Dense, ESTIMATES, Layers, Learned, NativeCritic, follow, join, output,
    output_mut, pair, smaller, squared_norm,
};
use crate::networks::{Critic, Layout, Policy};
use crate::noise::Noise;
use crate::state::{StatePart, Stateful};

/// Policy and critic, the targets that follow them slowly, and their optimizers.
#[derive(Debug)]
pub struct NativeTd3 {
    isa: Isa,
    inputs: Inputs,
    settings: Td3Section,
    policy_layout: Layout,
    policy: Dense,
    policy_parameters: Learned,
    target_policy: Vec<f32>,
    critic: NativeCritic,
    critic_parameters: Learned,
    target_critic: Vec<f32>,
    work: Work,
}

/// Everything computed on the way, kept from update to update.
#[derive(Debug, Default)]
struct Work {
    rows: usize,
    /// `[rows, 2]`.
    noise: Vec<f32>,
    /// Of the target policy, then of the policy: `[rows, 2]`.
    actions: Vec<f32>,
    /// The critic's states and actions side by side, `[rows, state + 2]`.
    joined: Vec<f32>,
    /// `[rows, 2]`.
    target_values: Vec<f32>,
    critic: CriticLayers,
    critic_grad: CriticLayers,
    /// Of the values of the policy's actions, `[rows, 2]`.
    value_grad: Vec<f32>,
    policy: Layers,
    policy_grad: Layers,
}

impl NativeTd3 {
    /// Untrained networks whose parameters depend on the run's seed alone.
    pub fn new(section: &Td3Section, inputs: Inputs, run_seed: u64, isa: Isa) -> Self {
        let width = section.hidden_width as i64;
        let mut policy_layout = Layout::default();
        Policy::with_outputs(
            &mut policy_layout,
            inputs.policy as i64,
            width,
            ACTION as i64,
        );
        let policy = policy_layout.initial_values(derive(run_seed, Purpose::PolicyParameters, 0));
        let mut critic_layout = Layout::default();
        Critic::describe(
            &mut critic_layout,
            inputs.critic as i64,
            width,
            section.critic_networks,
        );
        let critic = critic_layout.initial_values(derive(run_seed, Purpose::PolicyParameters, 1));
        Self {
            isa,
            inputs,
            settings: section.clone(),
            policy: Dense::new(isa, policy_layout.tensors()),
            policy_layout,
            target_policy: policy.clone(),
            policy_parameters: Learned::new(policy, section.policy_learning_rate),
            critic: NativeCritic::new(isa, &critic_layout, section.critic_networks),
            target_critic: critic.clone(),
            critic_parameters: Learned::new(critic, section.critic_learning_rate),
            work: Work::default(),
        }
    }

    /// The critic's gradient: both estimates are drawn towards r + γ (1 - terminated) min Q̄(s',
    /// a'), where a' is what the target policy would do, give or take some noise (eq. 14 and 15).
    /// Returns the loss and the mean of the smaller estimate.
    fn critic_gradient(
        &mut self,
        team: &mut Team,
        columns: Columns<'_>,
        noise: &mut Noise,
    ) -> [f32; 2] {
        let Td3Section {
            discount,
            target_noise,
            target_noise_bound,
            ..
        } = self.settings;
        let (std, bound) = (target_noise as f32, target_noise_bound as f32);
        let Work {
            rows,
            noise: drawn,
            actions,
            joined,
            target_values,
            critic: given,
            critic_grad,
            ..
        } = &mut self.work;
        self.policy.forward_through(
            team,
            &self.target_policy,
            columns.next_observations,
            actions,
        );
        noise.fill_normal(drawn);
        for (action, noise) in actions.iter_mut().zip(drawn) {
            *action = (action.tanh() + (std * *noise).clamp(-bound, bound)).clamp(-1.0, 1.0);
        }
        join(columns.next_states, actions, joined);
        self.critic
            .forward_through(team, &self.target_critic, joined, target_values);

        join(columns.states, columns.actions, joined);
        let critic = &self.critic_parameters.values;
        self.critic.forward(team, critic, joined, given);
        let (mut loss, mut value) = (0.0, 0.0);
        let share = 1.0 / *rows as f32;
        let grad = &mut critic_grad.values;
        for row in 0..*rows {
            let next = (1.0 - columns.terminated[row]) * smaller(pair(target_values, row));
            let target = columns.rewards[row] + next * discount as f32;
            let values = pair(&given.values, row);
            for (value, grad) in values.iter().zip(&mut grad[row * ESTIMATES..]) {
                let error = value - target;
                loss += 0.5 * f64::from(error * error);
                *grad = error * share;
            }
            value += f64::from(smaller(values));
        }
        let into = &mut self.critic_parameters.gradient;
        self.critic
            .gradient(team, critic, joined, given, critic_grad, into);
        [loss, value].map(|sum| (sum / *rows as f64) as f32)
    }

    /// The policy's gradient: it moves towards actions of which the first estimate thinks more (the
    /// deterministic policy gradient, eq. 1). Returns its loss, -Q₁.
    fn policy_gradient(&mut self, team: &mut Team, columns: Columns<'_>) -> f32 {
        let Work {
            rows,
            actions,
            joined,
            critic: given,
            value_grad,
            policy: policy_given,
            policy_grad,
            ..
        } = &mut self.work;
        let (policy, critic) = (
            &self.policy_parameters.values,
            &self.critic_parameters.values,
        );
        self.policy
            .forward(team, policy, columns.observations, policy_given);
        for (action, given) in actions.iter_mut().zip(output(policy_given)) {
            *action = given.tanh();
        }
        join(columns.states, actions, joined);
        self.critic.forward(team, critic, joined, given);
        let share = 1.0 / *rows as f32;
        let mut loss = 0.0;
        for (row, grad) in value_grad.chunks_exact_mut(ESTIMATES).enumerate() {
            loss -= f64::from(pair(&given.values, row)[0]);
            grad.copy_from_slice(&[-share, 0.0]);
        }
        let (action, grad) = (
            self.inputs.critic..self.inputs.critic + ACTION,
            output_mut(policy_grad),
        );
        self.critic
            .backward_through(team, critic, given, value_grad, action, grad);
        for (grad, action) in grad.iter_mut().zip(actions) {
            *grad *= 1.0 - *action * *action;
        }
        self.policy
            .backward(team, policy, policy_given, policy_grad);
        let into = &mut self.policy_parameters.gradient;
        self.policy
            .gradient(team, columns.observations, policy_given, policy_grad, into);
        (loss / *rows as f64) as f32
    }

    /// Places for everything that an update of so many rows computes.
    fn places(&self, rows: usize) -> Work {
        let numbers = |rows: usize, width: usize| vec![0.0; rows * width];
        Work {
            rows,
            noise: numbers(rows, ACTION),
            actions: numbers(rows, ACTION),
            joined: numbers(rows, self.inputs.critic + ACTION),
            target_values: numbers(rows, ESTIMATES),
            critic: self.critic.allocate(rows),
            critic_grad: self.critic.allocate(rows),
            value_grad: numbers(rows, ESTIMATES),
            policy: self.policy.allocate(rows),
            policy_grad: self.policy.allocate(rows),
        }
    }

    /// The squared length of a gradient.
    fn norm(&self, learned: &Learned) -> f32 {
        squared_norm(self.isa, &learned.gradient)
    }
}

impl Algorithm for NativeTd3 {
    /// One step of the critic, and each `td3.policy_period` of them one of the policy and of both
    /// targets. Both gradients are taken before anything moves.
    ///
    /// Source: arXiv:1802.09477, algorithm 1, which moves the critic before it takes the policy's
    /// gradient.
    fn update(
        &mut self,
        team: &mut Team,
        columns: Columns<'_>,
        noise: &mut Noise,
    ) -> Result<Vec<(Scalar, f32)>, UpdateError> {
        let rows = columns.check(self.inputs);
        if self.work.rows != rows {
            self.work = self.places(rows);
        }
        let improves = (self.updates() + 1).is_multiple_of(self.settings.policy_period);
        let [critic_loss, value] = self.critic_gradient(team, columns, noise);
        let mut numbers = vec![
            ("critic loss", critic_loss),
            ("mean value", value),
            ("critic gradient", self.norm(&self.critic_parameters)),
        ];
        if improves {
            numbers.push(("policy loss", self.policy_gradient(team, columns)));
            numbers.push(("policy gradient", self.norm(&self.policy_parameters)));
        }
        must_be_finite(self.updates() + 1, numbers)?;
        let (isa, rate) = (self.isa, self.settings.target_rate as f32);
        self.critic_parameters.step(team, isa);
        if improves {
            self.policy_parameters.step(team, isa);
            follow(
                team,
                isa,
                &mut self.target_policy,
                &self.policy_parameters.values,
                rate,
            );
            follow(
                team,
                isa,
                &mut self.target_critic,
                &self.critic_parameters.values,
                rate,
            );
        }
        Ok(vec![
            (Scalar::CriticLoss, critic_loss),
            (Scalar::MeanValue, value),
        ])
    }

    fn updates(&self) -> u64 {
        self.critic_parameters.steps()
    }

    fn policy_layout(&self) -> &Layout {
        &self.policy_layout
    }

    fn publish(&self, into: &mut [f32]) {
        into.copy_from_slice(&self.policy_parameters.values);
    }

    fn publish_encoder(&self, _into: &mut [f32]) {}
}

impl Stateful for NativeTd3 {
    fn parts(&mut self) -> Vec<(String, StatePart<'_>)> {
        let mut parts = self
            .policy_parameters
            .parts("td3.policy.parameters", "td3.policy.adam");
        parts.extend(
            self.critic_parameters
                .parts("td3.critic.parameters", "td3.critic.adam"),
        );
        let targets = [
            ("td3.target_policy.parameters", &mut self.target_policy),
            ("td3.target_critic.parameters", &mut self.target_critic),
        ];
        parts.extend(targets.map(|(name, numbers)| (name.to_owned(), StatePart::Numbers(numbers))));
        parts
    }
}

#[cfg(test)]
mod tests;
