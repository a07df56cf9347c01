//! One SAC update with libtorch's automatic gradients, in reading order: the reference, and the way to a CUDA device.

use skein_protocol::ACTION;
use skein_protocol::config::SacSection;
use skein_protocol::seeds::{Purpose, derive};
use tch::{Device, Tensor, no_grad_guard};

use super::SacMetrics;
use super::losses::{critic_loss, policy_loss, soft_targets, temperature_loss};
use crate::algorithm::{Columns, Inputs};
use crate::batch::Batch;
use crate::error::{UpdateError, finite};
use crate::networks::{Critic, Layout, Parameters, Policy};
use crate::noise::Noise;
use crate::optimizer::Adam;
use crate::perception::{LooksAhead, Perception};
use crate::state::{Part, Stateful};

/// Policy, critic, target critic and temperature, each with its optimizer.
#[derive(Debug)]
pub struct TorchSac {
    inputs: Inputs,
    policy: Policy,
    policy_parameters: Parameters,
    policy_optimizer: Adam,
    /// Where the encoder is trained end to end: its parameters lie before the critic's.
    perception: Option<Perception>,
    critic: Critic,
    critic_parameters: Parameters,
    critic_optimizer: Adam,
    /// A critic that follows the learned one slowly, and steadies the targets.
    target_parameters: Parameters,
    /// log α, `[1]`.
    log_temperature: Tensor,
    temperature_optimizer: Adam,
    discount: f64,
    target_rate: f64,
    target_entropy: f64,
}

impl TorchSac {
    /// Untrained networks whose parameters depend on the run's seed alone.
    pub fn new(section: &SacSection, inputs: Inputs, run_seed: u64, device: Device) -> Self {
        let width = section.hidden_width as i64;
        let mut layout = Layout::default();
        let policy = Policy::describe(&mut layout, inputs.policy as i64, width);
        let policy_parameters = Parameters::initialise(layout, derive(run_seed, Purpose::PolicyParameters, 0), device);
        let mut layout = Layout::default();
        let perception = inputs
            .from_image
            .map(|latent| Perception::describe(&mut layout, latent));
        let critic = Critic::describe(&mut layout, inputs.critic as i64, width, section.critic_networks);
        let critic_parameters = Parameters::initialise(layout, derive(run_seed, Purpose::PolicyParameters, 1), device);
        let log_temperature = Tensor::from_slice(&[section.initial_temperature.ln() as f32])
            .to_device(device)
            .set_requires_grad(true);
        Self {
            inputs,
            policy,
            policy_optimizer: Adam::new(policy_parameters.flat(), section.policy_learning_rate),
            policy_parameters,
            perception,
            critic,
            critic_optimizer: Adam::new(critic_parameters.flat(), section.critic_learning_rate),
            target_parameters: critic_parameters.duplicate(),
            critic_parameters,
            temperature_optimizer: Adam::new(&log_temperature, section.temperature_learning_rate),
            log_temperature,
            discount: section.discount,
            target_rate: section.target_rate,
            target_entropy: section.target_entropy.value(),
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
    pub fn update(&mut self, columns: Columns<'_>, noise: &mut Noise) -> Result<SacMetrics, UpdateError> {
        let mut batch = Batch::new(columns, self.inputs, self.log_temperature.device());
        if let Some(perception) = &self.perception {
            let (critic, target) = (&self.critic_parameters, &self.target_parameters);
            perception.look(&mut batch, critic, target, LooksAhead::Learned);
        }
        let action_shape = [batch.rows(), ACTION as i64];
        let mut normal = || noise.normal(&action_shape, self.log_temperature.device());
        let temperature = self.log_temperature.detach().exp();

        // What the state after the action is worth, by the slow critic and under the present policy (eq. 3).
        let targets = {
            let _guard = no_grad_guard();
            let next = self
                .policy
                .sample(&self.policy_parameters, &batch.next_observations, &normal());
            let next_values = self
                .critic
                .smaller(&self.target_parameters, &batch.next_states, &next.actions);
            let Batch {
                rewards, terminated, ..
            } = &batch;
            soft_targets(
                rewards,
                terminated,
                &next_values,
                &next.log_prob,
                &temperature,
                self.discount,
            )
        };

        // Both estimates are drawn towards it (eq. 5).
        let values = self
            .critic
            .forward(&self.critic_parameters, &batch.states, &batch.actions);
        let critic_loss = critic_loss(&values, &targets);
        let critic_gradient = self.critic_parameters.gradient(&critic_loss);

        // The policy moves towards actions of higher value, as far as its entropy is worth less (eq. 7).
        let drawn = self
            .policy
            .sample(&self.policy_parameters, &batch.observations, &normal());
        let drawn_values = self
            .critic
            .smaller(&self.critic_parameters, &batch.states.detach(), &drawn.actions);
        let policy_loss = policy_loss(&drawn.log_prob, &drawn_values, &temperature);
        let policy_gradient = self.policy_parameters.gradient(&policy_loss);

        // The temperature rises while the policy is more certain than asked for, and falls otherwise (eq. 18).
        let log_prob = drawn.log_prob.detach();
        let temperature_loss = temperature_loss(&self.log_temperature, &log_prob, self.target_entropy);
        let temperature_gradient =
            Tensor::run_backward(&[&temperature_loss], &[&self.log_temperature], false, false).remove(0);

        let [critic_loss, policy_loss, temperature, entropy, mean_value] = finite(
            self.updates() + 1,
            [
                ("critic loss", &critic_loss),
                ("policy loss", &policy_loss),
                ("temperature", &temperature.squeeze()),
                ("entropy", &-log_prob.mean(None)),
                ("mean value", &values.amin(1, false).mean(None)),
            ],
            [
                ("critic gradient", &critic_gradient),
                ("policy gradient", &policy_gradient),
                ("temperature gradient", &temperature_gradient),
            ],
        )?;
        self.critic_optimizer
            .step(self.critic_parameters.flat_mut(), &critic_gradient);
        self.policy_optimizer
            .step(self.policy_parameters.flat_mut(), &policy_gradient);
        self.temperature_optimizer
            .step(&mut self.log_temperature, &temperature_gradient);
        self.target_parameters.follow(&self.critic_parameters, self.target_rate);
        Ok(SacMetrics {
            critic_loss,
            policy_loss,
            temperature,
            entropy,
            mean_value,
        })
    }

    /// The policy's action without noise, `[n, 2]`. `observations`: `[n, observation]`.
    pub fn mode(&self, observations: &[f32]) -> Vec<f32> {
        let _guard = no_grad_guard();
        let observations = Tensor::from_slice(observations).view([-1, self.inputs.policy as i64]);
        let device = self.log_temperature.device();
        let actions = self
            .policy
            .mode(&self.policy_parameters, &observations.to_device(device));
        Vec::try_from(actions.to_device(Device::Cpu).reshape([-1])).expect("actions are f32")
    }

    /// Names and shapes of what [`TorchSac::publish`] copies.
    pub fn policy_layout(&self) -> &Layout {
        self.policy_parameters.layout()
    }

    /// Copies the policy's part of a snapshot, in the snapshot layout's order.
    ///
    /// # Panics
    /// When `into` is not as long as the layout.
    pub fn publish(&self, into: &mut [f32]) {
        self.policy_parameters.copy_range(0..self.policy_layout().len(), into);
    }

    /// Copies the encoder's part of a snapshot, if the critic trains one.
    ///
    /// # Panics
    /// When `into` is not as long as the encoder.
    pub fn publish_encoder(&self, into: &mut [f32]) {
        if let Some(perception) = &self.perception {
            perception.publish(&self.critic_parameters, into);
        }
    }

    /// Updates done so far.
    pub fn updates(&self) -> u64 {
        self.critic_optimizer.steps()
    }
}

impl Stateful for TorchSac {
    fn parts(&mut self) -> Vec<(String, Part<'_>)> {
        let own = [
            ("sac.policy.parameters", self.policy_parameters.flat().shallow_clone()),
            ("sac.critic.parameters", self.critic_parameters.flat().shallow_clone()),
            ("sac.target.parameters", self.target_parameters.flat().shallow_clone()),
            ("sac.log_temperature", self.log_temperature.detach()),
        ];
        let own = own.map(|(name, tensor)| (name.to_owned(), Part::Tensor(tensor)));
        let mut parts = Vec::from(own);
        parts.extend(self.policy_optimizer.parts("sac.policy.adam"));
        parts.extend(self.critic_optimizer.parts("sac.critic.adam"));
        parts.extend(self.temperature_optimizer.parts("sac.temperature.adam"));
        parts
    }
}
