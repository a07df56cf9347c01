//! The curves of a run: every scalar that is logged, with its meaning.

macro_rules! scalars {
    ($($(#[$doc:meta])* $name:ident => $tag:literal),* $(,)?) => {
        /// A curve in the TensorBoard event files. Every curve's horizontal axis is the number of committed training flights.
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        pub enum Scalar { $($(#[$doc])* $name),* }

        impl Scalar {
            /// Its name in TensorBoard, `group/name`.
            pub fn tag(self) -> &'static str {
                match self { $(Self::$name => $tag),* }
            }

            /// All of them.
            pub const ALL: &[Self] = &[$(Self::$name),*];
        }
    };
}

scalars! {
    /// Sum of a flight's rewards. The paper's Fig. 9.
    Return => "flight/return",
    /// Walls passed in a flight.
    WallsPassed => "flight/walls_passed",
    /// Steps of a flight.
    Steps => "flight/steps",
    /// What collisions contributed to the return.
    RewardCollision => "reward/collision",
    /// What level-ups contributed to the return.
    RewardLevelUp => "reward/level_up",
    /// What the destination contributed to the return.
    RewardDestination => "reward/destination",
    /// What the action reward, a clear view ahead, contributed to the return.
    RewardAction => "reward/action",
    /// Return, averaged over the window.
    WindowReturn => "window/return",
    /// Walls passed, averaged over the window. The paper's Fig. 10.
    WindowWallsPassed => "window/walls_passed",
    /// Squared error of both Q outputs against the soft Bellman target. It rises as returns rise: watch it for explosions, not for progress.
    CriticLoss => "sac/critic_loss",
    /// What the policy minimises: temperature times log-probability, minus Q.
    PolicyLoss => "sac/policy_loss",
    /// What the temperature minimises; zero when the entropy is at its target.
    TemperatureLoss => "sac/temperature_loss",
    /// Weight of the entropy against the reward.
    Temperature => "sac/temperature",
    /// The policy's entropy in nats, estimated on the minibatches. Steered towards the target entropy.
    Entropy => "sac/entropy",
    /// Mean of the smaller Q output on the minibatches: the discounted soft return that the critic expects.
    MeanQ => "sac/mean_q",
    /// Squared error summed over the image's pixels, plus the weighted Kullback-Leibler term.
    VaeLoss => "vae/loss",
    /// Reconstruction error per pixel, depth in [0, 1].
    VaeReconstruction => "vae/reconstruction_error",
    /// Transitions in the replay buffer.
    ReplayTransitions => "replay/transitions",
    /// Transitions in its success part.
    ReplaySuccess => "replay/success_transitions",
    /// Environment steps committed per second of wall time.
    StepsPerSec => "rate/steps_per_sec",
    /// SAC updates per second of wall time spent updating.
    UpdatesPerSec => "rate/updates_per_sec",
    /// Walls passed in the flights that confirmed a candidate for the best snapshot, on average.
    EvaluationWallsPassed => "evaluation/walls_passed",
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_curve_has_a_name_of_its_own() {
        let mut tags: Vec<_> = Scalar::ALL.iter().map(|scalar| scalar.tag()).collect();
        tags.sort_unstable();
        let listed = tags.len();
        tags.dedup();
        assert_eq!(tags.len(), listed);
    }
}
