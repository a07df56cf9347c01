//! The curves of a run: every scalar that is logged, with its meaning.

macro_rules! scalars {
    ($($(#[$doc:meta])* $name:ident => $tag:literal),* $(,)?) => {
        /// A curve in the TensorBoard event files. Every curve's horizontal axis is the number of
        /// committed training episodes.
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
    /// Sum of an episode's rewards. The paper's Fig. 9.
    Return => "episode/return",
    /// Walls passed in an episode.
    WallsPassed => "episode/walls_passed",
    /// Steps of an episode.
    Steps => "episode/steps",
    /// What collisions contributed to the return.
    RewardCollision => "reward/collision",
    /// What level-ups contributed to the return.
    RewardLevelUp => "reward/level_up",
    /// What the destination contributed to the return.
    RewardDestination => "reward/destination",
    /// What the open-view term, a reward for looking into open space, contributed to the return.
    RewardOpenView => "reward/open_view",
    /// Return, averaged over the window.
    WindowReturn => "window/return",
    /// Walls passed, averaged over the window. The paper's Fig. 10.
    WindowWallsPassed => "window/walls_passed",
    /// Half the squared distance of the two Q outputs from their target. It rises with the returns:
    /// watch it for explosions, not for progress.
    CriticLoss => "policy/critic_loss",
    /// SAC: what the policy minimises, temperature times log-probability minus Q.
    PolicyLoss => "policy/policy_loss",
    /// SAC: weight of the entropy against the reward, the price of certainty.
    Temperature => "policy/temperature",
    /// SAC: the policy's entropy in nats, estimated on the minibatches. Steered towards the target
    /// entropy by the temperature.
    Entropy => "policy/entropy",
    /// The smaller Q output on the minibatches, on average: the discounted return that the critic
    /// expects, with SAC the entropy bonus included.
    MeanValue => "policy/mean_value",
    /// What the VAE minimises: squared error summed over an image's pixels, plus the weighted
    /// divergence.
    VaeLoss => "vae/loss",
    /// Squared error of a reconstructed pixel, depth in [0, 1].
    VaePixelError => "vae/pixel_error",
    /// Kullback-Leibler divergence of the code from the standard normal distribution in nats: how
    /// much the code tells of the image.
    VaeDivergence => "vae/divergence",
    /// Transitions in the replay buffer.
    ReplayTransitions => "replay/transitions",
    /// Transitions in its success part.
    ReplaySuccess => "replay/success_transitions",
    /// Environment steps committed per second of wall time.
    StepsPerSec => "rate/steps_per_sec",
    /// Policy updates per second of wall time spent updating.
    UpdatesPerSec => "rate/updates_per_sec",
    /// Walls passed in the episodes that confirmed a candidate for the best snapshot, on average.
    EvaluationWallsPassed => "evaluation/walls_passed",
    /// Tickets issued again because records of a later one came first, since the learner's start.
    ReissuedSkipped => "reissued/skipped",
    /// Tickets issued again because a record of their episode got lost.
    ReissuedHole => "reissued/hole",
    /// Tickets issued again because what came of them makes no sense, or the simulator broke down.
    ReissuedFailed => "reissued/failed",
    /// Tickets issued again because they took too long.
    ReissuedLate => "reissued/late",
    /// Tickets issued again because their actor fell silent.
    ReissuedSilent => "reissued/silent",
    /// Tickets issued again because their actor began another incarnation.
    ReissuedRestarted => "reissued/restarted",
    /// Tickets issued again because their actor left.
    ReissuedLeft => "reissued/left",
    /// Records refused because no living actor is their sender, since the learner's start.
    RefusedStranger => "refused/stranger",
    /// Records refused because their actor holds no ticket for them.
    RefusedNoTicket => "refused/no_ticket",
    /// Records refused because they do not follow the one before.
    RefusedOutOfOrder => "refused/out_of_order",
    /// Records refused because a field has a value that no episode gives it.
    RefusedImpossible => "refused/impossible",
    /// Records refused because a number is infinite or none.
    RefusedNotFinite => "refused/not_finite",
    /// Records refused because a number, an action or the episode is too large.
    RefusedTooLarge => "refused/too_large",
    /// Records refused because they contradict themselves or those before.
    RefusedContradiction => "refused/contradiction",
    /// Signs of incarnation refused.
    RefusedStatus => "refused/status",
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
