//! The curves of a run: every logged scalar, with its meaning.
//!
//! The parts of the return, `reward/NAME`, are not listed here: there is one for each name of
//! [`REWARD_TERM_NAMES`](skein_protocol::REWARD_TERM_NAMES).

macro_rules! scalars {
    ($($(#[$doc:meta])* $name:ident => $tag:literal),* $(,)?) => {
        /// A curve in the TensorBoard event files. Every curve's horizontal axis is the number of
        /// committed training episodes.
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        pub enum Scalar { $($(#[$doc])* $name),* }

        impl Scalar {
            /// Returns its name in TensorBoard, `group/name`.
            pub fn tag(self) -> &'static str {
                match self { $(Self::$name => $tag),* }
            }

            /// All curves.
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
    /// Return, averaged over the window.
    WindowReturn => "window/return",
    /// Walls passed, averaged over the window. The paper's Fig. 10.
    WindowWallsPassed => "window/walls_passed",
    /// Share of the window's episodes that reached the end.
    WindowSuccessRate => "window/success_rate",
    /// Half the squared error of the two Q outputs against their target. It rises with the returns:
    /// use it to detect divergence, not progress.
    CriticLoss => "policy/critic_loss",
    /// SAC: the policy's loss, temperature times log-probability minus Q.
    PolicyLoss => "policy/policy_loss",
    /// SAC: weight of the entropy against the reward.
    Temperature => "policy/temperature",
    /// SAC: the policy's entropy in nats, estimated on the minibatches. The temperature steers it
    /// towards the target entropy.
    Entropy => "policy/entropy",
    /// With a teacher: squared distance between the policy's mode and the teacher's action, summed
    /// over the action's two numbers.
    TeacherDistance => "policy/teacher_distance",
    /// Mean of the smaller Q output on the minibatches: the discounted return that the critic
    /// expects, with SAC including the entropy bonus.
    MeanValue => "policy/mean_value",
    /// SAC: smallest of both Q outputs on a minibatch. Values far below any return mean that the
    /// critic diverges.
    SmallestValue => "policy/smallest_value",
    /// SAC: largest of both Q outputs on a minibatch.
    LargestValue => "policy/largest_value",
    /// SAC: Euclidean norm of the critic's gradient.
    CriticGradient => "gradient_norm/critic",
    /// SAC: Euclidean norm of the policy's gradient.
    PolicyGradient => "gradient_norm/policy",
    /// The policy's learning rate.
    PolicyLearningRate => "learning_rate/policy",
    /// The critic's learning rate.
    CriticLearningRate => "learning_rate/critic",
    /// SAC: the temperature's learning rate.
    TemperatureLearningRate => "learning_rate/temperature",
    /// The VAE's learning rate.
    VaeLearningRate => "learning_rate/vae",
    /// The VAE's loss: squared error summed over an image's pixels, plus the weighted divergence.
    VaeLoss => "vae/loss",
    /// Mean squared error of a reconstructed pixel, depth in [0, 1].
    VaePixelError => "vae/pixel_error",
    /// Kullback-Leibler divergence of the latent code from the standard normal distribution, in
    /// nats: how much information the code carries.
    VaeDivergence => "vae/divergence",
    /// Number of transitions in the replay buffer.
    ReplayTransitions => "replay/transitions",
    /// Number of transitions in its success part.
    ReplaySuccess => "replay/success_transitions",
    /// Environment steps committed per second of wall time.
    StepsPerSec => "rate/steps_per_sec",
    /// Policy updates per second of wall time spent updating.
    UpdatesPerSec => "rate/updates_per_sec",
    /// Mean number of walls passed in the confirmation episodes of a candidate.
    EvaluationWallsPassed => "evaluation/walls_passed",
    /// Tickets issued again because a record of a later ticket came first, since the learner's
    /// start.
    ReissuedSkipped => "reissued/skipped",
    /// Tickets issued again because a record of their episode was lost.
    ReissuedHole => "reissued/hole",
    /// Tickets issued again because their records are invalid, or the simulator failed.
    ReissuedFailed => "reissued/failed",
    /// Tickets issued again because they took too long.
    ReissuedLate => "reissued/late",
    /// Tickets issued again because their actor sent nothing for too long.
    ReissuedSilent => "reissued/silent",
    /// Tickets issued again because their actor started another incarnation.
    ReissuedRestarted => "reissued/restarted",
    /// Tickets issued again because their actor left.
    ReissuedLeft => "reissued/left",
    /// Records refused because their sender is not an attached actor, since the learner's start.
    RefusedStranger => "refused/stranger",
    /// Records refused because their actor holds no ticket for them.
    RefusedNoTicket => "refused/no_ticket",
    /// Records refused because they do not follow the one before.
    RefusedOutOfOrder => "refused/out_of_order",
    /// Records refused because a field has a value that no episode produces.
    RefusedImpossible => "refused/impossible",
    /// Records refused because a number is infinite or NaN.
    RefusedNotFinite => "refused/not_finite",
    /// Records refused because a number, an action or the episode is too large.
    RefusedTooLarge => "refused/too_large",
    /// Records refused because they contradict themselves or those before.
    RefusedContradiction => "refused/contradiction",
    /// Heartbeats refused.
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
        assert!(tags.iter().all(|tag| !tag.starts_with("reward/")));
    }
}
