//! Polyak average of the policy over its latest updates, which flies in the policy's place.
//!
//! Every update follows its own minibatch, so the policy keeps fluctuating after it stops
//! improving, and snapshots differ in quality by chance. The average of many policies is steadier
//! than any one of them.

use crate::algorithm::Algorithm;
use crate::state::{StatePart, Stateful};

/// Number of first updates over which the average forgets faster, because an untrained policy is
/// not worth remembering.
const BEGINNING: f32 = 10.0;

/// A moving average of a policy's parameters.
#[derive(Debug)]
pub(crate) struct PolicyAverage {
    /// Weight of the latest policy.
    weight: f32,
    values: Vec<f32>,
    latest: Vec<f32>,
}

impl PolicyAverage {
    /// Starts as the policy of `algorithm`; averages exponentially over about `updates` updates.
    pub(crate) fn new(updates: usize, algorithm: &dyn Algorithm) -> Self {
        let mut values = vec![0.0; algorithm.policy_layout().len()];
        algorithm.publish(&mut values);
        Self {
            weight: 1.0 / updates as f32,
            latest: values.clone(),
            values,
        }
    }

    /// Takes in the policy as an update left it.
    pub(crate) fn take_in(&mut self, algorithm: &dyn Algorithm) {
        algorithm.publish(&mut self.latest);
        let weight = self
            .weight
            .max(BEGINNING / (BEGINNING + algorithm.updates() as f32));
        for (average, latest) in self.values.iter_mut().zip(&self.latest) {
            *average += weight * (latest - *average);
        }
    }

    /// Copies the average, in the snapshot layout's order.
    ///
    /// # Panics
    /// When `into` is not as long as the policy's part of a snapshot.
    pub(crate) fn publish(&self, into: &mut [f32]) {
        into.copy_from_slice(&self.values);
    }
}

impl Stateful for PolicyAverage {
    fn parts(&mut self) -> Vec<(String, StatePart<'_>)> {
        vec![(
            "policy_average".to_owned(),
            StatePart::Numbers(&mut self.values),
        )]
    }
}
