//! What is ordered of the actors.

use serde::{Deserialize, Serialize};
use skein_protocol::ids::Epoch;
use skein_protocol::ticket::Ticket;

/// An episode to be flown, or a segment of one.
#[derive(Debug, Clone, PartialEq)]
pub struct Order {
    /// What to fly.
    pub ticket: Ticket,
    /// The epoch it belongs to.
    pub epoch: Epoch,
    /// What is kept of it.
    pub keep: Keep,
    /// Who waits for it, and at which place among the episodes ordered together.
    pub place: Place,
}

/// What the learner wants of an episode, besides that it is flown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Keep {
    /// Latent codes and telemetry only.
    Latents,
    /// The depth images too: they are copied out of shared memory, once.
    Depth,
}

/// A place in a batch of episodes that were ordered together.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Place {
    /// The batch.
    pub batch: u64,
    /// The episode's position in it.
    pub index: usize,
}
