//! One SAC update with libtorch's automatic gradients, in reading order: the reference, and the
//! engine for CUDA devices.

use skein_kernels::Team;
use skein_protocol::config::{SacSection, TeacherSection};
use skein_protocol::seeds::{Purpose, derive};
use tch::{Device, Tensor, no_grad_guard};

use super::losses::{critic_loss, policy_loss, soft_targets, temperature_loss};
use super::reported;
use crate::algorithm::{Algorithm, Columns, Inputs};
use crate::batch::TensorBatch;
use crate::error::{UpdateError, finite};
use crate::metrics::Scalar;
use crate::networks::{CriticNetwork, Layout, Parameters, PolicyNetwork, PolicySample};
use crate::noise::Noise;
use crate::optimizer::Adam;
use crate::perception::{NextStateEncoder, Perception};
use crate::state::{StatePart, Stateful};

/// Policy, critic, target critic and temperature, each with its optimizer.
#[derive(Debug)]
pub struct TorchSac {
    inputs: Inputs,
    policy: PolicyNetwork,
    policy_parameters: Parameters,
    policy_optimizer: Adam,
    /// Encoder trained end to end, if there is one: its parameters lie before the critic's.
    perception: Option<Perception>,
    critic: CriticNetwork,
    critic_parameters: Parameters,
    critic_optimizer: Adam,
    /// Parameters of the target critic Q̄: a slowly following average of the critic's, which
    /// steadies the targets.
    target_parameters: Parameters,
    /// log α, `[1]`.
    log_temperature: Tensor,
    temperature_optimizer: Adam,
    discount: f64,
    target_rate: f64,
    target_entropy: f64,
    teacher: TeacherSection,
}

impl TorchSac {
    /// Returns untrained networks; their parameters depend on the run's seed alone.
    pub fn new(section: &SacSection, inputs: Inputs, run_seed: u64, device: Device) -> Self {
        let width = section.hidden_width as i64;
        let mut layout = Layout::default();
        let policy = PolicyNetwork::describe(&mut layout, inputs, width);
        let policy_parameters = Parameters::initialise(
            layout,
            derive(run_seed, Purpose::PolicyParameters, 0),
            device,
        );
        let mut layout = Layout::default();
        let perception = inputs
            .from_image
            .map(|latent| Perception::describe(&mut layout, latent));
        let critic = CriticNetwork::describe(&mut layout, inputs, width, section.critic_networks);
        let critic_parameters = Parameters::initialise(
            layout,
            derive(run_seed, Purpose::PolicyParameters, 1),
            device,
        );
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
            target_entropy: section.target_entropy.value(inputs.action),
            teacher: TeacherSection::default(),
        }
    }

    /// Lets the actions of `teacher` attract the policy.
    #[must_use]
    pub fn with_teacher(mut self, teacher: &TeacherSection) -> Self {
        self.teacher = teacher.clone();
        self
    }

    /// Draws actions from the current policy, with their log-probabilities.
    fn draw(&self, observations: &Tensor, noise: &mut Noise) -> PolicySample {
        let noise = noise.normal(
            &[observations.size()[0], self.inputs.action.numbers() as i64],
            self.log_temperature.device(),
        );
        self.policy
            .sample(&self.policy_parameters, observations, &noise)
    }

    /// Soft Bellman targets, `[n]` (eq. 3), with a' drawn from the current policy:
    /// r + γ (1 - terminated) (min Q̄(s', a') - α log π(a' | s')).
    fn targets(&self, batch: &TensorBatch, temperature: &Tensor, noise: &mut Noise) -> Tensor {
        let _guard = no_grad_guard();
        let next = self.draw(&batch.next_observations, noise);
        let next_values =
            self.critic
                .smaller(&self.target_parameters, &batch.next_states, &next.actions);
        soft_targets(
            &batch.rewards,
            &batch.terminated,
            &next_values,
            &next.log_prob,
            temperature,
            self.discount,
        )
    }

    /// Returns the policy's action without noise, `[n, action]`. `observations`: `[n,
    /// observation]`.
    pub fn mode(&self, observations: &[f32]) -> Vec<f32> {
        let _guard = no_grad_guard();
        let observations = Tensor::from_slice(observations).view([-1, self.inputs.policy as i64]);
        let device = self.log_temperature.device();
        let actions = self
            .policy
            .mode(&self.policy_parameters, &observations.to_device(device));
        Vec::try_from(actions.to_device(Device::Cpu).reshape([-1])).expect("actions are f32")
    }
}

impl Algorithm for TorchSac {
    /// Same update as [`super::NativeSac`]'s. libtorch has its own threads and leaves `team` alone.
    fn update(
        &mut self,
        _team: &mut Team,
        columns: Columns<'_>,
        noise: &mut Noise,
    ) -> Result<Vec<(Scalar, f32)>, UpdateError> {
        let mut batch = TensorBatch::new(columns, self.inputs, self.log_temperature.device());
        if let Some(perception) = &self.perception {
            let (critic, target) = (&self.critic_parameters, &self.target_parameters);
            perception.encode(&mut batch, critic, target, NextStateEncoder::Learned);
        }
        let temperature = self.log_temperature.detach().exp();

        // Critic: regress both estimates on their target (eq. 5).
        let targets = self.targets(&batch, &temperature, noise);
        let values = self
            .critic
            .forward(&self.critic_parameters, &batch.states, &batch.actions);
        let critic_loss = critic_loss(&values, &targets);
        let critic_gradient = self.critic_parameters.gradient(&critic_loss);

        // Policy: minimise α log π(a | s) - min Q(s, a) (eq. 7), and a teacher's term.
        let drawn = self.draw(&batch.observations, noise);
        let drawn_values = self.critic.smaller(
            &self.critic_parameters,
            &batch.states.detach(),
            &drawn.actions,
        );
        let policy_loss = policy_loss(&drawn.log_prob, &drawn_values, &temperature);
        let distance = batch.teacher_actions.as_ref().map(|teacher| {
            let mode = self
                .policy
                .mode(&self.policy_parameters, &batch.observations);
            (mode - teacher).square().sum(None) / batch.rows() as f64
        });
        let weight = self.teacher.loss_weight_after(self.updates());
        let policy_gradient = self.policy_parameters.gradient(&match &distance {
            Some(distance) => &policy_loss + weight * distance,
            None => policy_loss.shallow_clone(),
        });

        // Temperature: rises while the entropy is below its target, falls otherwise (eq. 18).
        let log_prob = drawn.log_prob.detach();
        let temperature_loss =
            temperature_loss(&self.log_temperature, &log_prob, self.target_entropy);
        let temperature_gradient =
            Tensor::run_backward(&[&temperature_loss], &[&self.log_temperature], false, false)
                .remove(0);

        let metrics = finite(
            self.updates() + 1,
            [
                ("critic loss", &critic_loss),
                ("policy loss", &policy_loss),
                ("temperature", &temperature.squeeze()),
                ("entropy", &-log_prob.mean(None)),
                ("mean value", &values.amin(1, false).mean(None)),
                ("smallest value", &values.min()),
                ("largest value", &values.max()),
                ("critic gradient", &critic_gradient.norm()),
                ("policy gradient", &policy_gradient.norm()),
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
        self.target_parameters
            .follow(&self.critic_parameters, self.target_rate);
        let distance = distance.map(|distance| distance.double_value(&[]) as f32);
        Ok(reported(metrics, distance))
    }

    fn updates(&self) -> u64 {
        self.critic_optimizer.steps()
    }

    fn policy_layout(&self) -> &Layout {
        self.policy_parameters.layout()
    }

    fn start_from(&mut self, policy: &[f32]) {
        self.policy_parameters.replace(policy);
    }

    fn publish(&self, into: &mut [f32]) {
        self.policy_parameters
            .copy_range(0..self.policy_layout().len(), into);
    }

    fn publish_encoder(&self, into: &mut [f32]) {
        if let Some(perception) = &self.perception {
            perception.publish(&self.critic_parameters, into);
        }
    }
}

impl Stateful for TorchSac {
    fn parts(&mut self) -> Vec<(String, StatePart<'_>)> {
        let own = [
            (
                "sac.policy.parameters",
                self.policy_parameters.flat().shallow_clone(),
            ),
            (
                "sac.critic.parameters",
                self.critic_parameters.flat().shallow_clone(),
            ),
            (
                "sac.target.parameters",
                self.target_parameters.flat().shallow_clone(),
            ),
            ("sac.log_temperature", self.log_temperature.detach()),
        ];
        let own = own.map(|(name, tensor)| (name.to_owned(), StatePart::Tensor(tensor)));
        let mut parts = Vec::from(own);
        parts.extend(self.policy_optimizer.parts("sac.policy.adam"));
        parts.extend(self.critic_optimizer.parts("sac.critic.adam"));
        parts.extend(self.temperature_optimizer.parts("sac.temperature.adam"));
        parts
    }
}
