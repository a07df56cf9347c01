//! Failed episodes, the actors that failed them, and which episodes no actor can fly.
//!
//! An episode is a function of its ticket, so one that is itself at fault fails with every actor.
//! But a single actor may be broken. So the run fails only if two actors failed the episode, or if
//! one did and no other is attached.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use skein_protocol::ids::{ActorId, EpisodeId};

/// Number of times an episode may fail, in the simulator or by invalid records.
pub(super) const MOST_FAILURES: usize = 3;
/// Time after its last heartbeat in which an actor may come back and fly what another has failed.
/// It is longer than any pause before a dead actor is started again.
const OTHERS_RETURN: Duration = Duration::from_secs(30);

/// An episode that no actor can fly.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "episode {episode} failed {failures} times, at last because {why}; \
     see the logs of learner and actors"
)]
pub struct HopelessEpisode {
    /// Number of the episode.
    pub episode: EpisodeId,
    /// Number of its failures.
    pub failures: usize,
    /// Reason of the last failure.
    pub why: String,
}

/// Failed episodes, and actors that could fly them.
#[derive(Debug, Default)]
pub(super) struct EpisodeFailures {
    by_episode: BTreeMap<EpisodeId, Failure>,
    /// Time of the last heartbeat, for actors that may come back.
    heard: BTreeMap<ActorId, Instant>,
}

#[derive(Debug)]
struct Failure {
    times: usize,
    first_by: ActorId,
    by_others: bool,
}

impl EpisodeFailures {
    /// Records an actor's heartbeat.
    pub(super) fn heard(&mut self, actor: ActorId, now: Instant) {
        self.heard.insert(actor, now);
    }

    /// Forgets actors that will not come back.
    pub(super) fn on_time(&mut self, now: Instant) {
        self.heard
            .retain(|_, heard| now.saturating_duration_since(*heard) < OTHERS_RETURN);
    }

    /// Forgets the failures of an episode that was flown after all.
    pub(super) fn flown(&mut self, episode: EpisodeId) {
        self.by_episode.remove(&episode);
    }

    /// Records that `actor` failed `episode`.
    ///
    /// # Errors
    /// [`HopelessEpisode`] when no other actor can try.
    pub(super) fn failed(
        &mut self,
        episode: EpisodeId,
        actor: ActorId,
        why: &str,
    ) -> Result<(), HopelessEpisode> {
        let others_may_try = self.heard.keys().any(|other| *other != actor);
        let failure = self.by_episode.entry(episode).or_insert(Failure {
            times: 0,
            first_by: actor,
            by_others: false,
        });
        failure.times += 1;
        failure.by_others |= failure.first_by != actor;
        if failure.times < MOST_FAILURES || (others_may_try && !failure.by_others) {
            return Ok(());
        }
        Err(HopelessEpisode {
            episode,
            failures: failure.times,
            why: why.to_owned(),
        })
    }
}
