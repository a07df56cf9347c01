//! What is ordered of the actors.

use serde::{Deserialize, Serialize};
use skein_protocol::ids::Epoch;
use skein_protocol::ticket::Ticket;

/// A flight to be flown, or a leg of one.
#[derive(Debug, Clone, PartialEq)]
pub struct Order {
    /// What to fly.
    pub ticket: Ticket,
    /// The epoch it belongs to.
    pub epoch: Epoch,
    /// What is kept of it.
    pub keep: Keep,
    /// Who waits for it, and at which place among the flights ordered together.
    pub place: Place,
}

/// What the learner wants of a flight, besides that it is flown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Keep {
    /// Latent codes and telemetry only.
    Latents,
    /// The depth images too: they are copied out of shared memory, once.
    Depth,
}

/// A place in a batch of flights that were ordered together.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Place {
    /// The batch.
    pub batch: u64,
    /// The flight's position in it.
    pub index: usize,
}
