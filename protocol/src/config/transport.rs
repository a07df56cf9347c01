//! The `[transport]` section.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::{InvalidValue, require};

/// The `[transport]` section: limits and deadlines between the processes. Nothing here influences
/// learning.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TransportSection {
    /// Most actors attached at one time, 1 to 1024. Default 64.
    pub max_actors: usize,
    /// Records of the longest possible episode, its steps and the closing record; 2 to 65,536. It
    /// bounds the shared memory of an actor, 9.4 KiB a record. Default 256.
    pub max_records_per_episode: usize,
    /// Tickets an actor holds at one time, 1 to 16. With 2 it stays busy while the learner commits
    /// an episode. Default 2.
    pub tickets_per_actor: usize,
    /// Seconds without a record or a heartbeat after which an actor's tickets are issued again, 0.1
    /// to 86,400. Default 5.
    pub actor_silence_secs: f64,
    /// Seconds after which an unfinished ticket is issued again, 0.1 to 86,400. Default 60.
    pub episode_deadline_secs: f64,
    /// Seconds without a heartbeat from the learner after which an actor exits, 0.1 to 86,400.
    /// Default 30.
    pub learner_silence_secs: f64,
}

impl Default for TransportSection {
    fn default() -> Self {
        Self {
            max_actors: 64,
            max_records_per_episode: 256,
            tickets_per_actor: 2,
            actor_silence_secs: 5.0,
            episode_deadline_secs: 60.0,
            learner_silence_secs: 30.0,
        }
    }
}

impl TransportSection {
    /// Returns the interval of the heartbeats of both sides: well below either silence limit, and
    /// at most two seconds, because all periodic work is done at heartbeats.
    pub fn heartbeat(&self) -> Duration {
        Duration::from_secs_f64(
            (self.actor_silence_secs.min(self.learner_silence_secs) / 8.0).min(2.0),
        )
    }

    pub(super) fn validate(&self) -> Result<(), InvalidValue> {
        require(
            (1..=1024).contains(&self.max_actors),
            "transport.max_actors",
            self.max_actors,
            "is outside 1..=1024: each actor takes a slot in every shared-memory service",
        )?;
        require(
            (2..=65_536).contains(&self.max_records_per_episode),
            "transport.max_records_per_episode",
            self.max_records_per_episode,
            "is outside 2..=65536: an episode has at least one step and its closing record",
        )?;
        require(
            (1..=16).contains(&self.tickets_per_actor),
            "transport.tickets_per_actor",
            self.tickets_per_actor,
            "is outside 1..=16: the subscriber's buffer holds as many whole episodes of every \
            actor",
        )?;
        for (key, secs) in [
            ("transport.actor_silence_secs", self.actor_silence_secs),
            (
                "transport.episode_deadline_secs",
                self.episode_deadline_secs,
            ),
            ("transport.learner_silence_secs", self.learner_silence_secs),
        ] {
            require(
                (0.1..=86_400.0).contains(&secs),
                key,
                secs,
                "is outside [0.1, 86400]: a silent peer would be dropped at once, or never",
            )?;
        }
        Ok(())
    }
}
