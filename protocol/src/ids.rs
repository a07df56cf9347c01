//! Typed ids: ids that must not be mixed up have different types.

use std::fmt;

use serde::{Deserialize, Serialize};

macro_rules! id {
    ($(#[$doc:meta])* $name:ident($inner:ty)) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
        #[serde(transparent)]
        pub struct $name(pub $inner);

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                fmt::Display::fmt(&self.0, f)
            }
        }
    };
}

id! {
    /// A training run. It distinguishes two runs of the same configuration; it appears in names of
    /// shared memory and in records, and never influences learning.
    RunId(u64)
}
id! {
    /// An episode. Training episodes count from 0 in the order of their commit; evaluation episodes
    /// start at [`EpisodeId::FIRST_EVALUATION`].
    EpisodeId(u64)
}
id! {
    /// A set of episodes flown with one frozen policy.
    Epoch(u64)
}
id! {
    /// Version of a policy snapshot: the number of epochs of updates behind it.
    PolicyVersion(u64)
}
id! {
    /// Number of an actor process of a run, used in the name of its log file.
    ActorId(u32)
}
id! {
    /// An incarnation of an actor: a restarted actor keeps its id and gets a new incarnation.
    ActorIncarnation(u64)
}
id! {
    /// Number of earlier issues of an episode's ticket. It distinguishes an episode flown again
    /// from a late copy.
    Attempt(u32)
}

impl EpisodeId {
    /// First evaluation episode; far above all training episodes.
    pub const FIRST_EVALUATION: Self = Self(1 << 63);
    /// Distance between the first episodes of two evaluations, so that no number occurs twice.
    pub const EVALUATION_STRIDE: u64 = 1 << 24;

    /// Returns the number of the evaluation, and the episode's number within it, each from 0;
    /// `None` for a training episode.
    pub fn in_evaluation(self) -> Option<(u64, u64)> {
        let number = self.0.checked_sub(Self::FIRST_EVALUATION.0)?;
        Some((
            number / Self::EVALUATION_STRIDE,
            number % Self::EVALUATION_STRIDE,
        ))
    }
}
