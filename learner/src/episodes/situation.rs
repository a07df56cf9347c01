//! Location of all ordered episodes, which the watchdog reports when nothing moves.

use std::fmt;
use std::time::Duration;

use skein_protocol::ids::{ActorId, EpisodeId};

/// Largest number of episodes that are listed.
const NAMED: usize = 4;

/// Distribution of the ordered episodes.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Situation {
    /// Number of attached actors.
    pub actors: usize,
    /// Number of episodes without a ticket holder.
    pub waiting: usize,
    /// Episodes whose tickets are out, in order of their numbers.
    pub out: Vec<EpisodeOut>,
}

/// An episode whose ticket an actor holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EpisodeOut {
    /// Number of the episode.
    pub episode: EpisodeId,
    /// Actor that holds the ticket.
    pub actor: ActorId,
    /// Number of records that have arrived.
    pub records: usize,
    /// Time since the actor could begin it.
    pub issued: Duration,
    /// Time since anything was heard of the actor.
    pub unheard: Duration,
}

impl fmt::Display for Situation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self.actors, self.waiting) {
            (0, waiting) => {
                return write!(
                    f,
                    "no actor is attached; episodes that wait for one: {waiting}"
                );
            }
            (actors, 0) => write!(f, "actors: {actors}; episodes out: {}", self.out.len())?,
            (actors, waiting) => write!(
                f,
                "actors: {actors}; episodes out: {}, waiting: {waiting}",
                self.out.len()
            )?,
        }
        for out in self.out.iter().take(NAMED) {
            write!(
                f,
                "; episode {} with actor {} for {:.0} s, {} records, the actor heard {:.1} s ago",
                out.episode,
                out.actor,
                out.issued.as_secs_f64(),
                out.records,
                out.unheard.as_secs_f64()
            )?;
        }
        match self.out.len().saturating_sub(NAMED) {
            0 => Ok(()),
            more => write!(f, "; and {more} more"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_names_the_first_episodes_out_and_their_actors() {
        let out = |episode| EpisodeOut {
            episode: EpisodeId(episode),
            actor: ActorId(3),
            records: 12,
            issued: Duration::from_secs(31),
            unheard: Duration::from_millis(300),
        };
        let situation = Situation {
            actors: 2,
            waiting: 1,
            out: (7..12).map(out).collect(),
        };
        let text = situation.to_string();
        assert!(text.starts_with(
            "actors: 2; episodes out: 5, waiting: 1; \
             episode 7 with actor 3 for 31 s, 12 records, the actor heard 0.3 s ago"
        ));
        assert!(text.ends_with("; and 1 more"), "{text}");
        let no_actor = Situation {
            waiting: 5,
            ..Situation::default()
        };
        assert_eq!(
            no_actor.to_string(),
            "no actor is attached; episodes that wait for one: 5"
        );
    }
}
