//! Orders to the actors.

use serde::{Deserialize, Serialize};
use skein_protocol::ids::Epoch;
use skein_protocol::ticket::Ticket;

/// An episode to fly, or a segment of one.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodeOrder {
    /// Ticket to fly.
    pub ticket: Ticket,
    /// Epoch that the episode belongs to.
    pub epoch: Epoch,
    /// Data to keep of the episode.
    pub keep: KeptData,
    /// Batch that waits for the episode, and its position there.
    pub place: BatchPlace,
}

/// Data that the learner keeps of an episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum KeptData {
    /// Latent codes and telemetry only.
    Latents,
    /// Depth images too, copied once out of shared memory.
    Depth,
}

/// Position in a batch of episodes ordered together.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct BatchPlace {
    /// Number of the batch.
    pub batch: u64,
    /// Index of the episode in the batch.
    pub index: usize,
}
