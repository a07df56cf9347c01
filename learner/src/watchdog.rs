//! Notices a stall and reports which thread or actor is waited for.

use std::time::{Duration, Instant};

use skein_protocol::progress::{LearnerPhase, ProgressReport};

use crate::episodes::situation::Situation;

/// Time without progress after which the reason is reported.
const PATIENCE: Duration = Duration::from_secs(20);
/// Time between two warnings about one stall.
const WARN_INTERVAL: Duration = Duration::from_secs(60);
/// Age of the receiving thread's heartbeat after which that thread counts as stuck.
const RECEIVER_PATIENCE: Duration = Duration::from_secs(20);

/// Examines every progress report.
#[derive(Debug)]
pub(crate) struct Watchdog {
    done: Option<HealthCounters>,
    /// Time at which this state was first seen.
    since: Instant,
    /// Time of the last warning about the present stall.
    warned: Option<Instant>,
}

/// All counters that a healthy run advances.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct HealthCounters {
    phase: LearnerPhase,
    episodes: u64,
    steps: u64,
    updates: u64,
    vae_updates: u64,
    evaluation_episodes: (u64, u64),
}

impl Watchdog {
    /// Starts at `now`, with nothing seen yet.
    pub(crate) fn new(now: Instant) -> Self {
        Self {
            done: None,
            since: now,
            warned: None,
        }
    }

    /// Returns what is waited for, if nothing has moved for a while. `obstacle`: a known obstacle
    /// to the training thread. `receiver`: age and content of the receiving thread's last
    /// heartbeat.
    pub(crate) fn look(
        &mut self,
        now: Instant,
        progress: &ProgressReport,
        obstacle: Option<String>,
        receiver: Option<(Duration, Situation)>,
    ) -> Option<String> {
        let done = HealthCounters {
            phase: progress.phase,
            episodes: progress.episodes,
            steps: progress.steps,
            updates: progress.updates,
            vae_updates: progress.vae_updates,
            evaluation_episodes: progress.evaluation_episodes,
        };
        if self.done != Some(done) {
            self.done = Some(done);
            self.since = now;
            self.warned = None;
        }
        let still = now.saturating_duration_since(self.since);
        // A full disk is known at once, and nothing moves until there is room.
        if still < PATIENCE && obstacle.is_none() {
            return None;
        }
        let waits = obstacle.unwrap_or_else(|| who_waits(progress.phase, still, receiver));
        if still >= PATIENCE
            && self
                .warned
                .is_none_or(|warned| now.saturating_duration_since(warned) >= WARN_INTERVAL)
        {
            self.warned = Some(now);
            tracing::warn!(still_secs = still.as_secs(), waits, "nothing moves");
        }
        Some(waits)
    }
}

fn who_waits(
    phase: LearnerPhase,
    still: Duration,
    receiver: Option<(Duration, Situation)>,
) -> String {
    let still = still.as_secs();
    let episodes = match phase {
        LearnerPhase::Flying => "episodes",
        LearnerPhase::Evaluating => "evaluation episodes",
        LearnerPhase::Learning => {
            return format!(
                "the training thread has been at one step of its updates for {still} s"
            );
        }
        LearnerPhase::Finishing => {
            return format!("the training thread has been writing the last files for {still} s");
        }
    };
    let waits = format!("the training thread has waited for {episodes} for {still} s");
    match receiver {
        None => format!("{waits}; the receiving thread has not started"),
        Some((ago, _)) if ago > RECEIVER_PATIENCE => {
            format!(
                "{waits}; the receiving thread has not responded for {} s",
                ago.as_secs()
            )
        }
        Some((_, situation)) => format!("{waits}; {situation}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn no_actor() -> Option<(Duration, Situation)> {
        let situation = Situation {
            waiting: 3,
            ..Situation::default()
        };
        Some((Duration::from_secs(1), situation))
    }

    #[test]
    fn a_stall_is_reported_after_a_while_and_until_something_moves() {
        let start = Instant::now();
        let at = |secs| start + Duration::from_secs(secs);
        let mut watchdog = Watchdog::new(start);
        let mut progress = ProgressReport::start(40);
        assert_eq!(watchdog.look(at(1), &progress, None, no_actor()), None);
        assert_eq!(watchdog.look(at(20), &progress, None, no_actor()), None);
        let stalled = watchdog.look(at(22), &progress, None, no_actor()).unwrap();
        assert_eq!(
            stalled,
            "the training thread has waited for episodes for 21 s; no actor is attached; \
             episodes that wait for one: 3"
        );
        progress.steps += 1;
        assert_eq!(watchdog.look(at(23), &progress, None, no_actor()), None);
        progress.phase = LearnerPhase::Learning;
        watchdog.look(at(24), &progress, None, no_actor());
        let stalled = watchdog.look(at(50), &progress, None, no_actor()).unwrap();
        assert!(
            stalled.contains("at one step of its updates for 26 s"),
            "{stalled}"
        );
    }

    #[test]
    fn a_receiving_thread_that_does_not_respond_is_named() {
        let start = Instant::now();
        let mut watchdog = Watchdog::new(start);
        let progress = ProgressReport::start(40);
        watchdog.look(start, &progress, None, None);
        let stale = no_actor().map(|(_, situation)| (Duration::from_secs(33), situation));
        let stalled = watchdog
            .look(start + PATIENCE, &progress, None, stale)
            .unwrap();
        assert!(
            stalled.ends_with("the receiving thread has not responded for 33 s"),
            "{stalled}"
        );
    }

    #[test]
    fn a_full_disk_is_reported_at_once() {
        let start = Instant::now();
        let mut watchdog = Watchdog::new(start);
        let full = "no room for the checkpoint".to_owned();
        let stalled = watchdog.look(
            start,
            &ProgressReport::start(40),
            Some(full.clone()),
            no_actor(),
        );
        assert_eq!(stalled, Some(full));
    }
}
