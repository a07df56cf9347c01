//! Connection of an actor to its learner.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use skein_protocol::ids::{ActorId, ActorIncarnation};
use skein_protocol::stages::{LapTimer, Stage};
use skein_protocol::status::{ActorState, ActorStatus, StatusRecord};
use skein_protocol::ticket::{Control, Ticket};
use skein_protocol::transition::RecordKind;
use skein_run::RunIdentity;
use skein_run::fault::{FaultPoint, die_if_armed};
use skein_transport::{ActorPorts, LoanedTransition, ServiceError};
use tracing::{debug, warn};

use super::{DisconnectReason, ExitReason, Service};
use crate::snapshot_cache::SnapshotCache;
use skein_inference::Network;
use skein_rollout::environment_loop::{Directive, RecordLink};

/// Connection to the learner: receives tickets, snapshots and the stop, sends records and
/// heartbeats.
pub(super) struct LearnerConnection<'a> {
    ports: ActorPorts,
    identity: &'a RunIdentity,
    actor: ActorId,
    incarnation: ActorIncarnation,
    weights: SnapshotCache,
    tickets: VecDeque<QueuedTicket>,
    limits: ConnectionLimits,
    exit_requested: &'a dyn Fn() -> bool,
    /// Detected reason to disconnect.
    disconnect_reason: Option<DisconnectReason>,
    last_heard: Instant,
    /// Time of the last heartbeat sent; a long gap means that this process was suspended.
    last_heartbeat: Instant,
    timer: LapTimer,
    /// `true` once the learner was notified of the present idle time.
    reported_idle: bool,
    pub(super) episodes_flown: u64,
}

struct QueuedTicket {
    arrived: Instant,
    ticket: Ticket,
}

/// Deadlines and limits, from the `[transport]` section.
struct ConnectionLimits {
    heartbeat: Duration,
    ticket_lifetime: Duration,
    actor_silence: Duration,
    learner_silence: Duration,
    tickets: usize,
}

impl<'a> LearnerConnection<'a> {
    /// Creates the connection over `ports`, for the current incarnation of `service`. It starts
    /// empty: nothing is kept from an earlier incarnation.
    pub(super) fn new(service: &Service<'a>, ports: ActorPorts) -> Self {
        let transport = &service.config.transport;
        Self {
            ports,
            identity: service.identity,
            actor: service.actor,
            incarnation: service.incarnation,
            weights: SnapshotCache::of_run(service.config),
            tickets: VecDeque::new(),
            limits: ConnectionLimits {
                heartbeat: transport.heartbeat(),
                ticket_lifetime: Duration::from_secs_f64(transport.episode_deadline_secs),
                actor_silence: Duration::from_secs_f64(transport.actor_silence_secs),
                learner_silence: Duration::from_secs_f64(transport.learner_silence_secs),
                tickets: transport.tickets_per_actor,
            },
            exit_requested: service.exit_requested,
            disconnect_reason: None,
            last_heard: service.last_heard,
            last_heartbeat: Instant::now(),
            timer: LapTimer::start(),
            reported_idle: false,
            episodes_flown: 0,
        }
    }

    /// Returns the time of the learner's last heartbeat.
    pub(super) fn last_heard(&self) -> Instant {
        self.last_heard
    }

    /// Returns the reason to disconnect, if there is one.
    pub(super) fn disconnect_reason(&self) -> Option<DisconnectReason> {
        if self.disconnect_reason.is_some() {
            self.disconnect_reason
        } else if (self.exit_requested)() {
            Some(DisconnectReason::Exit(ExitReason::Signalled))
        } else if self.last_heard.elapsed() > self.limits.learner_silence {
            Some(DisconnectReason::Exit(ExitReason::LearnerSilent))
        } else {
            None
        }
    }

    /// Receives all messages and snapshots, drops expired tickets, and sends a heartbeat if one is
    /// due.
    pub(super) fn listen(&mut self) -> Result<(), ServiceError> {
        self.listen_for_control()?;
        self.timer.lap(Stage::ActorControl, 1);
        while let Some(received) = self.ports.receive_snapshot()? {
            match received {
                Ok(snapshot) => {
                    debug!(version = %snapshot.version, "snapshot received");
                    self.weights.insert(snapshot);
                }
                Err(error) => warn!(%error, "snapshot refused"),
            }
            self.timer.lap(Stage::TakeSnapshot, 1);
        }
        let lifetime = self.limits.ticket_lifetime;
        self.tickets.retain(|queued| {
            let alive = queued.arrived.elapsed() < lifetime;
            if !alive {
                warn!(
                    episode = %queued.ticket.episode,
                    policy = %queued.ticket.policy_version,
                    "ticket expired"
                );
            }
            alive
        });
        Ok(())
    }

    fn listen_for_control(&mut self) -> Result<(), ServiceError> {
        while let Some(message) = self.ports.receive_control()? {
            match message.read(self.ports.run()) {
                Ok(control) => {
                    self.last_heard = Instant::now();
                    if message.is_for(self.actor, self.incarnation) {
                        self.handle(control);
                    }
                }
                Err(fault) => warn!(%fault, "control record refused"),
            }
        }
        let silence = self.last_heartbeat.elapsed();
        if silence > self.limits.actor_silence {
            self.disconnect_reason
                .get_or_insert(DisconnectReason::Suspended);
        } else if silence >= self.limits.heartbeat {
            self.check_learner();
            self.ports.maintain()?;
            self.last_heartbeat = Instant::now();
            self.report(ActorState::Serving)?;
        }
        Ok(())
    }

    /// Checks that the joined learner is still the living one. A dead learner also falls silent,
    /// but this is known at once.
    fn check_learner(&mut self) {
        match self.identity.current_incarnation() {
            Ok(Some(present)) if present.incarnation == self.ports.incarnation() => {}
            Ok(_) => {
                self.disconnect_reason
                    .get_or_insert(DisconnectReason::LearnerGone);
            }
            Err(error) => debug!(%error, "cannot check the learner"),
        }
    }

    fn handle(&mut self, control: Control) {
        match control {
            Control::Heartbeat => {}
            Control::Rejoin => {
                self.disconnect_reason
                    .get_or_insert(DisconnectReason::RejoinRequested);
            }
            Control::Stop => {
                self.disconnect_reason = Some(DisconnectReason::Exit(ExitReason::Stopped))
            }
            Control::Fly(ticket) => {
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
                    arrived: Instant::now(),
                    ticket,
                });
            }
        }
    }

    /// Returns the first ticket whose snapshot is available, with its network.
    pub(super) fn take_ticket(&mut self) -> Option<(Ticket, Arc<Network>)> {
        let ready = self
            .tickets
            .iter()
            .position(|queued| self.weights.holds(queued.ticket.policy_version))?;
        let ticket = self.tickets.remove(ready)?.ticket;
        let network = self.weights.network(ticket.policy_version)?;
        self.reported_idle = false;
        self.timer.lap(Stage::TakeSnapshot, 0);
        Some((ticket, network))
    }

    /// Waits for the learner, at most until the next heartbeat. Reports to the learner first: it
    /// wakes actors only for what an idle one would miss.
    pub(super) fn wait(&mut self) -> Result<(), ServiceError> {
        if !self.reported_idle {
            self.reported_idle = true;
            self.report(ActorState::Serving)?;
        }
        if let Err(error) = self.ports.wait(
            self.limits
                .heartbeat
                .saturating_sub(self.last_heartbeat.elapsed()),
        ) {
            // A lasting failure shows as silence, so there is no hurry.
            debug!(%error, "cannot wait for the learner");
            std::thread::sleep(Duration::from_millis(10));
        }
        self.timer.lap(Stage::ActorIdle, 1);
        Ok(())
    }

    /// Wakes the learner to read the records sent.
    pub(super) fn wake_learner(&self) -> Result<(), ServiceError> {
        self.ports.wake_learner()
    }

    /// Sends this actor's status. It does not count as a heartbeat, so that a suspension is still
    /// detected.
    pub(super) fn report(&self, state: ActorState) -> Result<(), ServiceError> {
        let status = ActorStatus {
            actor: self.actor,
            incarnation: self.incarnation,
            pid: std::process::id(),
            state,
            newest_policy: self.weights.newest(),
            episodes_flown: self.episodes_flown,
            times: *self.timer.times(),
        };
        self.ports
            .send_status(StatusRecord::new(self.ports.run(), &status))?;
        self.ports.wake_learner()
    }
}

impl RecordLink for LearnerConnection<'_> {
    type Loan = LoanedTransition;
    type Error = ServiceError;

    fn loan(&mut self) -> Result<LoanedTransition, ServiceError> {
        let loaned = self.ports.loan_transition();
        self.timer.lap(Stage::Send, 0);
        loaned
    }

    fn send(&mut self, record: LoanedTransition) -> Result<(), ServiceError> {
        let (step, kind) = (record.step, record.kind);
        die_if_armed(FaultPoint::ActorBeforeSend);
        self.ports.send_transition(record)?;
        self.timer.lap(Stage::Send, 1);
        if kind == RecordKind::Closing.code() {
            die_if_armed(FaultPoint::ActorAfterLastRecord);
        } else if step == 2 {
            die_if_armed(FaultPoint::ActorMidEpisode);
        }
        Ok(())
    }

    fn directive(&mut self) -> Result<Directive, ServiceError> {
        self.listen_for_control()?;
        self.timer.lap(Stage::ActorControl, 1);
        Ok(if self.disconnect_reason().is_some() {
            Directive::Abandon
        } else {
            Directive::Continue
        })
    }

    fn lap(&mut self, stage: Stage) {
        self.timer.lap(stage, 1);
    }
}
