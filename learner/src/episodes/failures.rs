//! Which episodes failed, by whose doing, and which of them nobody can fly.
//!
//! An episode is a function of its ticket, so one that fails because of what it is fails with every
//! actor. But an actor may be broken, or lie: what it alone makes of an episode says nothing about
//! the episode. So an episode is given up, and the run with it, only when two actors have failed
//! it, or when the one that fails it is the only one there is and nobody is left who could tell
//! otherwise.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use skein_protocol::ids::{ActorId, EpisodeId};

/// Times an episode may fail, in the simulator or by records that make no sense.
pub(super) const MOST_FAILURES: usize = 3;
/// An actor that was heard within this time may come back, and fly what another has failed. Longer
/// than any pause before a dead actor is started again.
const OTHERS_RETURN: Duration = Duration::from_secs(30);

/// An episode that no actor can fly.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "episode {episode} failed {failures} times, at last because {why}; the logs of learner and actors say more"
)]
pub struct HopelessEpisode {
    /// The episode.
    pub episode: EpisodeId,
    /// Its failures.
    pub failures: usize,
    /// What went wrong the last time.
    pub why: String,
}

/// Episodes that failed, and actors that could fly them.
#[derive(Debug, Default)]
pub(super) struct Failures {
    by_episode: BTreeMap<EpisodeId, Failure>,
    /// When each actor was last heard, of those that may come back.
    heard: BTreeMap<ActorId, Instant>,
}

#[derive(Debug)]
struct Failure {
    times: usize,
    first_by: ActorId,
    by_others: bool,
}

impl Failures {
    /// Takes note that an actor incarnations.
    pub(super) fn heard(&mut self, actor: ActorId, now: Instant) {
        self.heard.insert(actor, now);
    }

    /// Forgets actors that will not come back.
    pub(super) fn on_time(&mut self, now: Instant) {
        self.heard
            .retain(|_, heard| now.saturating_duration_since(*heard) < OTHERS_RETURN);
    }

    /// Forgets what went wrong with an episode that was flown after all.
    pub(super) fn flown(&mut self, episode: EpisodeId) {
        self.by_episode.remove(&episode);
    }

    /// Takes note that `actor` failed `episode`.
    ///
    /// # Errors
    /// [`HopelessEpisode`] when there is nobody left to try.
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
