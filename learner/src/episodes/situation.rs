//! Who waits for whom: what the watchdog says when nothing moves.

use std::fmt;
use std::time::Duration;

use skein_protocol::ids::{ActorId, EpisodeId};

/// Episodes that are named at most.
const NAMED: usize = 4;

/// What of the episodes ordered is where.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Situation {
    /// Actors that live.
    pub actors: usize,
    /// Episodes that no actor holds a ticket for.
    pub waiting: usize,
    /// Episodes that an actor holds a ticket for, in order of their numbers.
    pub out: Vec<EpisodeOut>,
}

/// An episode in an actor's hands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EpisodeOut {
    /// The episode.
    pub episode: EpisodeId,
    /// Who has the ticket.
    pub actor: ActorId,
    /// Records that have arrived.
    pub records: usize,
    /// How long ago it could be begun.
    pub issued: Duration,
    /// How long ago anything was heard of the actor.
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
    fn it_names_the_first_episodes_out_and_who_has_them() {
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
        let told = situation.to_string();
        assert!(told.starts_with("actors: 2; episodes out: 5, waiting: 1; episode 7 with actor 3 for 31 s, 12 records, the actor heard 0.3 s ago"));
        assert!(told.ends_with("; and 1 more"), "{told}");
        let nobody = Situation {
            waiting: 5,
            ..Situation::default()
        };
        assert_eq!(
            nobody.to_string(),
            "no actor is attached; episodes that wait for one: 5"
        );
    }
}
