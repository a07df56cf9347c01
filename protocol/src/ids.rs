//! Typed numbers: what must not be mixed up has a type of its own.

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
    /// One start of a training: distinguishes two runs of one configuration. It names shared memory
    /// and records, and never influences learning.
    RunId(u64)
}
id! {
    /// An episode (episode). Training episodes count from 0 in the order of their commit;
    /// evaluation episodes lie above [`EpisodeId::FIRST_EVALUATION`].
    EpisodeId(u64)
}
id! {
    /// A set of episodes flown with one frozen policy.
    Epoch(u64)
}
id! {
    /// Number of a policy snapshot: the parameters after as many epochs of updates.
    PolicyVersion(u64)
}
id! {
    /// An actor process of a run; names its log file.
    ActorId(u32)
}
id! {
    /// One incarnation of an actor process: a restarted actor keeps its id and gets a new
    /// incarnation.
    ActorIncarnation(u64)
}
id! {
    /// How often an episode's ticket had been issued before: tells an episode flown again from its
    /// late twin.
    Attempt(u32)
}

impl EpisodeId {
    /// Evaluation episodes are numbered from here, so that they never collide with training
    /// episodes.
    pub const FIRST_EVALUATION: Self = Self(1 << 63);
}
