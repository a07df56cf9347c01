//! Twin delayed deep deterministic policy gradient (TD3; Fujimoto et al. 2018, arXiv:1802.09477),
//! which the paper compares SAC with (its Fig. 11).
//!
//! It is a comparison, so it has one engine: libtorch, which also learns from images. The critic is
//! that of SAC, with as many networks, so that the algorithms differ in nothing else. By default
//! that is one network with two estimates; the second one only steadies the targets. Equation
//! numbers are those of the article.

use skein_kernels::Team;
use skein_protocol::config::Td3Section;
use skein_protocol::seeds::{Purpose, derive};
use tch::{Device, Tensor, no_grad_guard};

use crate::algorithm::{Algorithm, Columns, Inputs};
use crate::batch::TensorBatch;
use crate::error::{UpdateError, finite};
use crate::metrics::Scalar;
use crate::networks::{CriticNetwork, Layout, Parameters, PolicyNetwork};
use crate::noise::Noise;
use crate::optimizer::Adam;
use crate::perception::{NextStateEncoder, Perception};
use crate::sac::losses::critic_loss;
use crate::state::{StatePart, Stateful};

/// Policy and critic, their target networks, and their optimizers.
#[derive(Debug)]
pub(crate) struct Td3 {
    inputs: Inputs,
    settings: Td3Section,
    device: Device,
    policy: PolicyNetwork,
    policy_parameters: Parameters,
    policy_optimizer: Adam,
    target_policy: Parameters,
    /// Encoder trained end to end, if there is one: its parameters lie before the critic's.
    perception: Option<Perception>,
    critic: CriticNetwork,
    critic_parameters: Parameters,
    critic_optimizer: Adam,
    target_critic: Parameters,
}

impl Td3 {
    /// Returns untrained networks; their parameters depend on the run's seed alone.
    pub(crate) fn new(section: &Td3Section, inputs: Inputs, run_seed: u64, device: Device) -> Self {
        let width = section.hidden_width as i64;
        let mut layout = Layout::default();
        let policy =
            PolicyNetwork::with_outputs(&mut layout, inputs, width, inputs.action.numbers());
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
        Self {
            inputs,
            settings: section.clone(),
            device,
            policy,
            policy_optimizer: Adam::new(policy_parameters.flat(), section.policy_learning_rate),
            target_policy: policy_parameters.duplicate(),
            policy_parameters,
            perception,
            critic,
            critic_optimizer: Adam::new(critic_parameters.flat(), section.critic_learning_rate),
            target_critic: critic_parameters.duplicate(),
            critic_parameters,
        }
    }

    /// Bellman targets, `[n]` (eq. 14 and 15): r + γ (1 - terminated) min Q̄(s', a').
    ///
    /// a' is the target policy's action plus clipped noise.
    fn targets(&self, batch: &TensorBatch, noise: &mut Noise) -> Tensor {
        let Td3Section {
            discount,
            target_noise,
            target_noise_bound: bound,
            ..
        } = self.settings;
        let _guard = no_grad_guard();
        let actions = self
            .policy
            .output(&self.target_policy, &batch.next_observations)
            .tanh();
        let drawn = noise.normal(&actions.size(), self.device);
        let actions = (actions + (drawn * target_noise).clamp(-bound, bound)).clamp(-1.0, 1.0);
        let values = self
            .critic
            .smaller(&self.target_critic, &batch.next_states, &actions);
        let continues: Tensor = 1.0 - &batch.terminated;
        &batch.rewards + continues * values * discount
    }

    /// Policy loss, a scalar: the mean of -Q₁ of the policy's actions (eq. 1).
    fn policy_loss(&self, batch: &TensorBatch) -> Tensor {
        let actions = self
            .policy
            .output(&self.policy_parameters, &batch.observations)
            .tanh();
        let states = batch.states.detach();
        let values = self
            .critic
            .forward(&self.critic_parameters, &states, &actions);
        -values.select(1, 0).mean(None)
    }
}

impl Algorithm for Td3 {
    /// One step of the critic, and every `td3.policy_period` steps one of the policy and of both
    /// targets. Both gradients are computed before any parameter moves. libtorch has its own
    /// threads and does not use `team`.
    ///
    /// Source: arXiv:1802.09477, algorithm 1, which moves the critic before it computes the
    /// policy's gradient.
    fn update(
        &mut self,
        _team: &mut Team,
        columns: Columns<'_>,
        noise: &mut Noise,
    ) -> Result<Vec<(Scalar, f32)>, UpdateError> {
        let number = self.updates() + 1;
        let mut batch = TensorBatch::new(columns, self.inputs, self.device);
        if let Some(perception) = &self.perception {
            let (critic, target) = (&self.critic_parameters, &self.target_critic);
            perception.encode(&mut batch, critic, target, NextStateEncoder::Target);
        }

        let targets = self.targets(&batch, noise);
        let values = self
            .critic
            .forward(&self.critic_parameters, &batch.states, &batch.actions);
        let critic_loss = critic_loss(&values, &targets);
        let critic_gradient = self.critic_parameters.gradient(&critic_loss);
        let [critic_loss, mean_value] = finite(
            number,
            [
                ("critic loss", &critic_loss),
                ("mean value", &values.amin(1, false).mean(None)),
            ],
            [("critic gradient", &critic_gradient)],
        )?;

        let mut policy_gradient = None;
        if number.is_multiple_of(self.settings.policy_period) {
            let loss = self.policy_loss(&batch);
            let gradient = self.policy_parameters.gradient(&loss);
            finite(
                number,
                [("policy loss", &loss)],
                [("policy gradient", &gradient)],
            )?;
            policy_gradient = Some(gradient);
        }

        self.critic_optimizer
            .step(self.critic_parameters.flat_mut(), &critic_gradient);
        if let Some(gradient) = policy_gradient {
            let rate = self.settings.target_rate;
            self.policy_optimizer
                .step(self.policy_parameters.flat_mut(), &gradient);
            self.target_policy.follow(&self.policy_parameters, rate);
            self.target_critic.follow(&self.critic_parameters, rate);
        }
        Ok(vec![
            (Scalar::CriticLoss, critic_loss),
            (Scalar::MeanValue, mean_value),
        ])
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

impl Stateful for Td3 {
    fn parts(&mut self) -> Vec<(String, StatePart<'_>)> {
        let own = [
            ("td3.policy.parameters", &self.policy_parameters),
            ("td3.critic.parameters", &self.critic_parameters),
            ("td3.target_policy.parameters", &self.target_policy),
            ("td3.target_critic.parameters", &self.target_critic),
        ];
        let own = own.map(|(name, parameters)| {
            (
                name.to_owned(),
                StatePart::Tensor(parameters.flat().shallow_clone()),
            )
        });
        let mut parts = Vec::from(own);
        parts.extend(self.policy_optimizer.parts("td3.policy.adam"));
        parts.extend(self.critic_optimizer.parts("td3.critic.adam"));
        parts
    }
}

#[cfg(test)]
mod tests;
