//! An actor's side of the agreement with one incarnation of the learner: which tickets it holds,
//! which it can fly, and when and why it disconnects.
//!
//! Deliberately absent: clock and transport. Time and messages are passed in, so that a simulation
//! drives the same code as the process.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use skein_protocol::config::{Config, TransportSection};
use skein_protocol::ids::{ActorId, ActorIncarnation, RunId};
use skein_protocol::snapshot::Snapshot;
use skein_protocol::ticket::{Control, ControlMessage, Ticket};
use tracing::warn;

use crate::snapshot_cache::SnapshotCache;

/// State of an actor that has joined a learner.
#[derive(Debug)]
pub struct Session {
    run: RunId,
    actor: ActorId,
    incarnation: ActorIncarnation,
    weights: SnapshotCache,
    tickets: VecDeque<QueuedTicket>,
    limits: SessionLimits,
    /// Detected reason to disconnect.
    disconnect_reason: Option<DisconnectReason>,
    last_heard: Instant,
    /// Time of the last heartbeat sent; a long gap means that this process was suspended.
    last_heartbeat: Instant,
    /// `true` once the learner was notified of the present idle time.
    reported_idle: bool,
}

#[derive(Debug)]
struct QueuedTicket {
    arrived: Instant,
    ticket: Ticket,
}

/// Deadlines and limits, from the `[transport]` section.
#[derive(Debug)]
struct SessionLimits {
    heartbeat: Duration,
    ticket_lifetime: Duration,
    actor_silence: Duration,
    learner_silence: Duration,
    tickets: usize,
}

/// Reason why an actor exits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ExitReason {
    /// The learner reported the end of the run.
    Stopped,
    /// This process received a signal, or has another reason of its own.
    Signalled,
    /// No learner of this run sent a heartbeat for `transport.learner_silence_secs`.
    LearnerSilent,
}

/// Reason why an actor disconnects from a learner.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DisconnectReason {
    /// The actor exits.
    Exit(ExitReason),
    /// The learner is dead, or its next incarnation has begun.
    LearnerGone,
    /// This process was suspended for so long that the learner issued its tickets to others.
    Suspended,
    /// The learner receives none of this actor's records.
    RejoinRequested,
}

impl SessionLimits {
    fn of(transport: &TransportSection) -> Self {
        Self {
            heartbeat: transport.heartbeat(),
            ticket_lifetime: Duration::from_secs_f64(transport.episode_deadline_secs),
            actor_silence: Duration::from_secs_f64(transport.actor_silence_secs),
            learner_silence: Duration::from_secs_f64(transport.learner_silence_secs),
            tickets: transport.tickets_per_actor,
        }
    }
}

impl Session {
    /// Begins the session of this `incarnation` of `actor` at `now`. It starts empty: nothing is
    /// kept from an earlier incarnation, except when a learner was `last_heard`.
    pub fn begin(
        run: RunId,
        config: &Config,
        (actor, incarnation): (ActorId, ActorIncarnation),
        last_heard: Instant,
        now: Instant,
    ) -> Self {
        Self {
            run,
            actor,
            incarnation,
            weights: SnapshotCache::of_run(config),
            tickets: VecDeque::new(),
            limits: SessionLimits::of(&config.transport),
            disconnect_reason: None,
            last_heard,
            last_heartbeat: now,
            reported_idle: false,
        }
    }

    /// Identity of the actor in this session.
    pub fn identity(&self) -> (ActorId, ActorIncarnation) {
        (self.actor, self.incarnation)
    }

    /// Snapshots received.
    pub fn weights(&self) -> &SnapshotCache {
        &self.weights
    }

    /// Snapshots received, to prepare one for flying.
    pub fn weights_mut(&mut self) -> &mut SnapshotCache {
        &mut self.weights
    }

    /// Time of the learner's last message.
    pub fn last_heard(&self) -> Instant {
        self.last_heard
    }

    /// Reason to disconnect at `now`, if there is one. `exit_requested`: asked only if the session
    /// itself has none.
    pub fn disconnect_reason(
        &self,
        now: Instant,
        exit_requested: impl FnOnce() -> bool,
    ) -> Option<DisconnectReason> {
        if self.disconnect_reason.is_some() {
            self.disconnect_reason
        } else if exit_requested() {
            Some(DisconnectReason::Exit(ExitReason::Signalled))
        } else if now.saturating_duration_since(self.last_heard) > self.limits.learner_silence {
            Some(DisconnectReason::Exit(ExitReason::LearnerSilent))
        } else {
            None
        }
    }

    /// Takes a message of the learner.
    pub fn on_message(&mut self, message: &ControlMessage, now: Instant) {
        match message.read(self.run) {
            Ok(control) => {
                self.last_heard = now;
                if message.is_for(self.actor, self.incarnation) {
                    self.handle(control, now);
                }
            }
            Err(fault) => warn!(%fault, "control record refused"),
        }
    }

    fn handle(&mut self, control: Control, now: Instant) {
        match control {
            Control::Heartbeat => {}
            Control::Rejoin => {
                self.disconnect_reason
                    .get_or_insert(DisconnectReason::RejoinRequested);
            }
            Control::Stop => {
                self.disconnect_reason = Some(DisconnectReason::Exit(ExitReason::Stopped))
            }
            Control::Fly(ticket) => self.take(ticket, now),
        }
    }

    fn take(&mut self, ticket: Ticket, now: Instant) {
        // A reissued episode replaces its earlier ticket.
        self.tickets
            .retain(|queued| queued.ticket.episode != ticket.episode);
        if self.tickets.len() >= self.limits.tickets {
            warn!(
                episode = %ticket.episode,
                limit = self.limits.tickets,
                "more tickets than transport.tickets_per_actor; the oldest is dropped"
            );
            self.tickets.pop_front();
        }
        self.tickets.push_back(QueuedTicket {
            arrived: now,
            ticket,
        });
    }

    /// Takes a snapshot of the learner.
    pub fn on_snapshot(&mut self, snapshot: Snapshot) {
        self.weights.insert(snapshot);
    }

    /// Drops expired tickets.
    pub fn on_time(&mut self, now: Instant) {
        let lifetime = self.limits.ticket_lifetime;
        self.tickets.retain(|queued| {
            let alive = now.saturating_duration_since(queued.arrived) < lifetime;
            if !alive {
                warn!(
                    episode = %queued.ticket.episode,
                    policy = %queued.ticket.policy_version,
                    "ticket expired"
                );
            }
            alive
        });
    }

    /// Returns `true` if a heartbeat is due at `now`; the caller checks the learner, sends it, and
    /// says so to [`Session::has_beaten`]. A session that has been silent for so long that its
    /// tickets were given away ends instead.
    pub fn is_heartbeat_due(&mut self, now: Instant) -> bool {
        let silence = now.saturating_duration_since(self.last_heartbeat);
        if silence > self.limits.actor_silence {
            self.disconnect_reason
                .get_or_insert(DisconnectReason::Suspended);
            return false;
        }
        silence >= self.limits.heartbeat
    }

    /// Notes that a heartbeat is sent at `now`.
    pub fn has_beaten(&mut self, now: Instant) {
        self.last_heartbeat = now;
    }

    /// Notes that the joined learner is dead, or its next incarnation has begun.
    pub fn learner_is_gone(&mut self) {
        self.disconnect_reason
            .get_or_insert(DisconnectReason::LearnerGone);
    }

    /// Returns the first ticket whose snapshot is available.
    pub fn take_ticket(&mut self) -> Option<Ticket> {
        let ready = self
            .tickets
            .iter()
            .position(|queued| self.weights.holds(queued.ticket.policy_version))?;
        self.reported_idle = false;
        Some(self.tickets.remove(ready)?.ticket)
    }

    /// Returns `true` if the learner must be notified before this actor waits: it wakes actors only
    /// for what an idle one would miss.
    pub fn begins_to_wait(&mut self) -> bool {
        !std::mem::replace(&mut self.reported_idle, true)
    }

    /// Longest wait at `now`: until the next heartbeat.
    pub fn patience(&self, now: Instant) -> Duration {
        let silence = now.saturating_duration_since(self.last_heartbeat);
        self.limits.heartbeat.saturating_sub(silence)
    }
}
