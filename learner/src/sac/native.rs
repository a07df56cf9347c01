//! One SAC update on the kernels, forward and backward written out, in reading order.
//!
//! The same update as that of [`super::TorchSac`], which stays beside it as the reference: same parameters in the same order, same noise, same metrics. Every sum has one
//! order, so the bits depend neither on the processor nor on how many threads there are. Memory is set aside once for a batch size and used again.

mod dense;
mod learned;
mod sample;

use skein_kernels::{Isa, Team, exp};
use skein_protocol::ACTION;
use skein_protocol::config::{Observation, SacSection};
use skein_protocol::seeds::{Purpose, derive};

use self::dense::{Dense, Input, Layers, output, output_mut, pack, rows_of};
use self::learned::{Learned, squared_norm};
use self::sample::Sample;
use super::{Columns, SacMetrics};
use crate::error::UpdateError;
use crate::networks::{Critic, Layout, Policy};
use crate::noise::Noise;
use crate::state::{Part, Stateful};

/// Q estimates of a critic.
const ESTIMATES: usize = 2;

/// Policy, critic, target critic and temperature, each with its optimizer.
#[derive(Debug)]
pub struct NativeSac {
    isa: Isa,
    observation: usize,
    policy_layout: Layout,
    policy: Dense,
    policy_parameters: Learned,
    critic: Dense,
    /// The way from the critic's value back to the action.
    critic_action: Input,
    critic_parameters: Learned,
    /// A critic that follows the learned one slowly, and steadies the targets.
    target: Dense,
    target_parameters: Vec<f32>,
    /// log α, `[1]`.
    log_temperature: Learned,
    discount: f32,
    target_rate: f32,
    target_entropy: f32,
    work: Work,
}

/// Everything computed on the way, kept from update to update.
#[derive(Debug, Default)]
struct Work {
    rows: usize,
    /// States after the actions, then states: `[2 rows, observation]`.
    policy_input: Vec<f32>,
    policy: Layers,
    sample: Sample,
    /// States after the actions with actions drawn there: `[rows, observation + 2]`.
    target_input: Vec<f32>,
    target: Layers,
    /// States with the actions replayed, then with actions drawn: `[2 rows, observation + 2]`.
    critic_input: Vec<f32>,
    critic: Layers,
    critic_flowing: Layers,
    /// `[rows, 2]`.
    action_gradient: Vec<f32>,
    /// Of the states alone.
    policy_flowing: Layers,
}

/// What is reported, before it is known to be finite.
#[derive(Default)]
struct Sums {
    critic_loss: f64,
    policy_loss: f64,
    log_prob: f64,
    value: f64,
}

impl NativeSac {
    /// Untrained networks whose parameters depend on the run's seed alone.
    ///
    /// # Panics
    /// At the first update, when this machine lacks the instructions.
    pub fn new(section: &SacSection, observation: Observation, run_seed: u64, isa: Isa) -> Self {
        let (inputs, width) = (observation.len() as i64, section.hidden_width as i64);
        let mut policy_layout = Layout::default();
        Policy::describe(&mut policy_layout, inputs, width);
        let policy_values = policy_layout.initial_values(derive(run_seed, Purpose::SacParameters, 0));
        let mut critic_layout = Layout::default();
        Critic::describe(&mut critic_layout, inputs, width);
        let critic_values = critic_layout.initial_values(derive(run_seed, Purpose::SacParameters, 1));
        let critic = Dense::new(isa, &critic_layout);
        let log_temperature = vec![section.initial_temperature.ln() as f32];
        Self {
            isa,
            observation: observation.len(),
            policy: Dense::new(isa, &policy_layout),
            policy_layout,
            policy_parameters: Learned::new(policy_values, section.policy_learning_rate),
            critic_action: Input::new(&critic, observation.len()..observation.len() + ACTION),
            critic,
            target: Dense::new(isa, &critic_layout),
            target_parameters: critic_values.clone(),
            critic_parameters: Learned::new(critic_values, section.critic_learning_rate),
            log_temperature: Learned::new(log_temperature, section.temperature_learning_rate),
            discount: section.discount as f32,
            target_rate: section.target_rate as f32,
            target_entropy: section.target_entropy.value() as f32,
            work: Work::default(),
        }
    }

    /// One step of critic, policy and temperature, and of the target behind them.
    ///
    /// All three gradients are taken at the same parameters before any of them moves: an update is done whole or not at all.
    ///
    /// # Errors
    /// [`UpdateError::NonFinite`] names what was not finite and the update's number; nothing was changed then.
    ///
    /// # Panics
    /// When the columns have different numbers of rows, or none.
    ///
    /// Source: arXiv:1812.05905, algorithm 1.
    pub fn update(
        &mut self,
        team: &mut Team,
        columns: Columns<'_>,
        noise: &mut Noise,
    ) -> Result<SacMetrics, UpdateError> {
        let rows = columns.check(self.observation);
        if self.work.rows != rows {
            self.work = self.places(rows);
        }
        let share = 1.0 / rows as f32;
        let temperature = exp(self.log_temperature.values[0]);
        self.pack(team);
        let Work {
            policy_input,
            policy: policy_given,
            sample,
            target_input,
            target: target_given,
            critic_input,
            critic: critic_given,
            critic_flowing,
            action_gradient,
            policy_flowing,
            ..
        } = &mut self.work;
        let Columns {
            observations,
            actions,
            next_observations,
            ..
        } = columns;

        // Actions drawn from the present policy: in the states after the replayed actions, and in the states themselves.
        policy_input[..next_observations.len()].copy_from_slice(next_observations);
        policy_input[next_observations.len()..].copy_from_slice(observations);
        self.policy
            .forward(team, &self.policy_parameters.values, policy_input, policy_given);
        noise.fill_normal(&mut sample.noise);
        sample.draw(self.isa, output(policy_given));

        // What the state after the action is worth, by the slow critic (eq. 3).
        let (next_actions, drawn_actions) = sample.actions.split_at(rows * ACTION);
        join(next_observations, next_actions, target_input);
        self.target
            .forward(team, &self.target_parameters, target_input, target_given);

        // What the critic says of the actions replayed, and of those drawn.
        let (replayed_input, drawn_input) = critic_input.split_at_mut(target_input.len());
        join(observations, actions, replayed_input);
        join(observations, drawn_actions, drawn_input);
        self.critic
            .forward(team, &self.critic_parameters.values, critic_input, critic_given);

        // Both estimates are drawn towards r + γ (1 - terminated) (min Q̄(s', a') - α log π(a' | s')) (eq. 5). The policy moves towards actions of higher value, as far as
        // its entropy is worth less: (α log π(a | s) - min Q(s, a)) is to fall (eq. 7).
        let mut sums = Sums::default();
        let target_values = output(target_given);
        let (values, drawn_values) = output(critic_given).split_at(rows * ESTIMATES);
        let (flowing, drawn_flowing) = output_mut(critic_flowing).split_at_mut(rows * ESTIMATES);
        for row in 0..rows {
            let pair = |values: &[f32]| [values[row * ESTIMATES], values[row * ESTIMATES + 1]];
            let soft_value = smaller(pair(target_values)) - temperature * sample.log_prob[row];
            let target = columns.rewards[row] + (1.0 - columns.terminated[row]) * soft_value * self.discount;
            for (value, flowing) in pair(values).iter().zip(&mut flowing[row * ESTIMATES..]) {
                let error = value - target;
                sums.critic_loss += 0.5 * f64::from(error * error);
                *flowing = error * share;
            }
            sums.value += f64::from(smaller(pair(values)));
            let log_prob = sample.log_prob[rows + row];
            sums.log_prob += f64::from(log_prob);
            sums.policy_loss += f64::from(temperature * log_prob - smaller(pair(drawn_values)));
            drawn_flowing[row * ESTIMATES..][..ESTIMATES]
                .copy_from_slice(&share_of_smaller(pair(drawn_values)).map(|part| -share * part));
        }
        // The temperature rises while the policy is more certain than asked for, and falls otherwise: the gradient of -α (log π + H̄) by log α is itself (eq. 18).
        let mean = |sum: f64| (sum / rows as f64) as f32;
        self.log_temperature.gradient[0] = -temperature * (mean(sums.log_prob) + self.target_entropy);

        // Back through the critic: to its parameters from the actions replayed, to the actions from those drawn.
        let given = rows_of(critic_given, 0..2 * rows, 2 * rows);
        self.critic.backward(team, &given, critic_flowing);
        let given = rows_of(critic_given, 0..rows, 2 * rows);
        let flowing = rows_of(critic_flowing, 0..rows, 2 * rows);
        let into = &mut self.critic_parameters.gradient;
        let replayed_input = &critic_input[..target_input.len()];
        self.critic.gradient(team, replayed_input, &given, &flowing, into);
        let flowing = rows_of(critic_flowing, rows..2 * rows, 2 * rows);
        self.critic_action.backward(team, flowing[0], action_gradient);

        // Back through the drawing and the policy.
        sample.backward(rows, temperature * share, action_gradient, output_mut(policy_flowing));
        let given = rows_of(policy_given, rows..2 * rows, 2 * rows);
        self.policy.backward(team, &given, policy_flowing);
        let flowing = rows_of(policy_flowing, 0..rows, rows);
        let into = &mut self.policy_parameters.gradient;
        self.policy.gradient(team, observations, &given, &flowing, into);

        let metrics = SacMetrics {
            critic_loss: mean(sums.critic_loss),
            policy_loss: mean(sums.policy_loss),
            temperature,
            entropy: -mean(sums.log_prob),
            mean_value: mean(sums.value),
        };
        self.must_be_finite(&metrics)?;
        let isa = self.isa;
        self.critic_parameters.step(team, isa);
        self.policy_parameters.step(team, isa);
        self.log_temperature.step(team, isa);
        self.follow(team);
        Ok(metrics)
    }

    /// Places for everything that an update of so many rows computes.
    fn places(&self, rows: usize) -> Work {
        let numbers = |rows: usize, width: usize| vec![0.0; rows * width];
        Work {
            rows,
            policy_input: numbers(2 * rows, self.observation),
            policy: self.policy.places(2 * rows),
            sample: Sample::places(2 * rows),
            target_input: numbers(rows, self.observation + ACTION),
            target: self.target.places(rows),
            critic_input: numbers(2 * rows, self.observation + ACTION),
            critic: self.critic.places(2 * rows),
            critic_flowing: self.critic.places(2 * rows),
            action_gradient: numbers(rows, ACTION),
            policy_flowing: self.policy.places(rows),
        }
    }

    /// Packs all weights for the products of one update, once for each direction.
    fn pack(&mut self, team: &mut Team) {
        let critic = &self.critic_parameters.values;
        let policy = self.policy.packings(&self.policy_parameters.values);
        let critics = self.critic.packings(critic);
        let targets = self.target.forward_packings(&self.target_parameters);
        let action = std::iter::once(self.critic_action.packing(critic));
        pack(team, policy.chain(critics).chain(targets).chain(action).collect());
    }

    fn must_be_finite(&self, metrics: &SacMetrics) -> Result<(), UpdateError> {
        let norm = |learned: &Learned| squared_norm(self.isa, &learned.gradient);
        let checks: [(&'static str, &dyn Fn() -> f32); 8] = [
            ("critic loss", &|| metrics.critic_loss),
            ("policy loss", &|| metrics.policy_loss),
            ("temperature", &|| metrics.temperature),
            ("entropy", &|| metrics.entropy),
            ("mean value", &|| metrics.mean_value),
            ("critic gradient", &|| norm(&self.critic_parameters)),
            ("policy gradient", &|| norm(&self.policy_parameters)),
            ("temperature gradient", &|| norm(&self.log_temperature)),
        ];
        let update = self.updates() + 1;
        for (tensor, number) in checks {
            if !number().is_finite() {
                return Err(UpdateError::NonFinite { tensor, update });
            }
        }
        Ok(())
    }

    /// Moves the target a little towards the critic.
    fn follow(&mut self, team: &mut Team) {
        /// Numbers that stay together: whole cache lines.
        const GRAIN: usize = 1024;
        let (leader, rate, isa) = (&self.critic_parameters.values, self.target_rate, self.isa);
        team.split_rows(&mut self.target_parameters, 1, GRAIN, |first, own| {
            isa.vectorised(
                #[inline(always)]
                || {
                    for (own, leader) in own.iter_mut().zip(&leader[first..]) {
                        *own = (leader - *own).mul_add(rate, *own);
                    }
                },
            );
        });
    }

    /// The policy's action without noise, `[n, 2]`. `observations`: `[n, observation]`.
    pub fn mode(&self, observations: &[f32]) -> Vec<f32> {
        let mut policy = Dense::new(self.isa, &self.policy_layout);
        let (mut team, parameters) = (Team::new(1), &self.policy_parameters.values);
        pack(&mut team, policy.forward_packings(parameters).collect());
        let mut given = policy.places(observations.len() / self.observation);
        policy.forward(&mut team, parameters, observations, &mut given);
        let means = output(&given).chunks_exact(2 * ACTION).flat_map(|row| &row[..ACTION]);
        means.map(|mean| mean.tanh()).collect()
    }

    /// Names and shapes of what [`NativeSac::publish`] copies.
    pub fn policy_layout(&self) -> &Layout {
        &self.policy_layout
    }

    /// Copies the policy's part of a snapshot, in the snapshot layout's order.
    ///
    /// # Panics
    /// When `into` is not as long as the layout.
    pub fn publish(&self, into: &mut [f32]) {
        into.copy_from_slice(&self.policy_parameters.values);
    }

    /// Updates done so far.
    pub fn updates(&self) -> u64 {
        self.critic_parameters.steps()
    }
}

impl Stateful for NativeSac {
    fn parts(&mut self) -> Vec<(String, Part<'_>)> {
        let mut parts = self.policy_parameters.parts("sac.policy.parameters", "sac.policy.adam");
        parts.extend(self.critic_parameters.parts("sac.critic.parameters", "sac.critic.adam"));
        parts.extend(
            self.log_temperature
                .parts("sac.log_temperature", "sac.temperature.adam"),
        );
        let target = Part::Numbers(&mut self.target_parameters);
        parts.push(("sac.target.parameters".to_owned(), target));
        parts
    }
}

/// Rows of observations and actions side by side.
fn join(observations: &[f32], actions: &[f32], into: &mut [f32]) {
    let rows = actions.len() / ACTION;
    let (observation, width) = (observations.len() / rows, into.len() / rows);
    for (row, into) in into.chunks_exact_mut(width).enumerate() {
        into[..observation].copy_from_slice(&observations[row * observation..][..observation]);
        into[observation..].copy_from_slice(&actions[row * ACTION..][..ACTION]);
    }
}

/// The smaller estimate; not a number if one of them is none.
fn smaller([one, other]: [f32; ESTIMATES]) -> f32 {
    if one < other || one.is_nan() { one } else { other }
}

/// Derivative of the smaller estimate by both: equal ones share it.
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
