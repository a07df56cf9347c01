//! The line from an actor to the learner that it has joined.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use skein_protocol::ids::{ActorId, ActorIncarnation};
use skein_protocol::stages::{LapTimer, Stage};
use skein_protocol::status::{ActorState, ActorStatus, StatusRecord};
use skein_protocol::ticket::{Control, Ticket};
use skein_protocol::transition::RecordKind;
use skein_run::RunIdentity;
use skein_run::fault::{FaultPoint, pass};
use skein_transport::{ActorPorts, LoanedTransition, ServiceError};
use tracing::{debug, warn};

use super::{Ending, Parting, Service};
use crate::weights::Weights;
use skein_inference::Network;
use skein_rollout::environment_loop::{Directive, RecordLink};

/// The actor's end of the line to the learner: hears tickets, snapshots and the stop, sends records
/// and heartbeats.
pub(super) struct LearnerLine<'a> {
    ports: ActorPorts,
    identity: &'a RunIdentity,
    actor: ActorId,
    incarnation: ActorIncarnation,
    weights: Weights,
    tickets: VecDeque<QueuedTicket>,
    limits: Limits,
    told_to_end: &'a AtomicBool,
    /// What was found out and ends this line.
    parting: Option<Parting>,
    last_sign: Instant,
    /// When the last heartbeat was given: whoever missed some has been stopped.
    last_said: Instant,
    timer: LapTimer,
    /// Whether the learner was told that there is nothing to fly, since there was.
    has_told_of_waiting: bool,
    pub(super) episodes_flown: u64,
}

struct QueuedTicket {
    arrived: Instant,
    ticket: Ticket,
}

/// Deadlines and limits, from the `[transport]` section.
struct Limits {
    heartbeat: Duration,
    ticket_lifetime: Duration,
    actor_silence: Duration,
    learner_silence: Duration,
    tickets: usize,
}

impl<'a> LearnerLine<'a> {
    /// A line over `ports`, for the present incarnation of `service`. It begins with nothing: what
    /// an earlier incarnation knew is not taken over.
    pub(super) fn new(service: &Service<'a>, ports: ActorPorts) -> Self {
        let transport = &service.config.transport;
        Self {
            ports,
            identity: service.identity,
            actor: service.actor,
            incarnation: service.incarnation,
            weights: Weights::of_run(service.config),
            tickets: VecDeque::new(),
            limits: Limits {
                heartbeat: transport.heartbeat(),
                ticket_lifetime: Duration::from_secs_f64(transport.episode_deadline_secs),
                actor_silence: Duration::from_secs_f64(transport.actor_silence_secs),
                learner_silence: Duration::from_secs_f64(transport.learner_silence_secs),
                tickets: transport.tickets_per_actor,
            },
            told_to_end: service.told_to_end,
            parting: None,
            last_sign: service.last_sign,
            last_said: Instant::now(),
            timer: LapTimer::start(),
            has_told_of_waiting: false,
            episodes_flown: 0,
        }
    }

    /// When the learner last sent a heartbeat.
    pub(super) fn last_sign(&self) -> Instant {
        self.last_sign
    }

    /// Why to let go of the learner, if there is a reason.
    pub(super) fn parting(&self) -> Option<Parting> {
        if self.parting.is_some() {
            self.parting
        } else if self.told_to_end.load(Ordering::Relaxed) {
            Some(Parting::Leave(Ending::Signalled))
        } else if self.last_sign.elapsed() > self.limits.learner_silence {
            Some(Parting::Leave(Ending::LearnerSilent))
        } else {
            None
        }
    }

    /// Hears everything there is to hear, and sends a heartbeat when one is due.
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
        let incarnation = self.limits.ticket_lifetime;
        self.tickets.retain(|queued| {
            let alive = queued.arrived.elapsed() < incarnation;
            if !alive {
                warn!(episode = %queued.ticket.episode, policy = %queued.ticket.policy_version, "ticket expired");
            }
            alive
        });
        Ok(())
    }

    fn listen_for_control(&mut self) -> Result<(), ServiceError> {
        while let Some(message) = self.ports.receive_control()? {
            match message.read(self.ports.run()) {
                Ok(said) => {
                    self.last_sign = Instant::now();
                    if message.is_for(self.actor, self.incarnation) {
                        self.obey(said);
                    }
                }
                Err(fault) => warn!(%fault, "control record refused"),
            }
        }
        let unsaid = self.last_said.elapsed();
        if unsaid > self.limits.actor_silence {
            self.parting.get_or_insert(Parting::Overslept);
        } else if unsaid >= self.limits.heartbeat {
            self.look_at_learner();
            self.ports.maintain()?;
            self.last_said = Instant::now();
            self.report(ActorState::Serving)?;
        }
        Ok(())
    }

    /// Whether the learner that was joined is still the one that lives: a dead one falls silent
    /// too, but this is known at once.
    fn look_at_learner(&mut self) {
        match self.identity.present_incarnation() {
            Ok(Some(present)) if present.incarnation == self.ports.incarnation() => {}
            Ok(_) => {
                self.parting.get_or_insert(Parting::LearnerGone);
            }
            Err(error) => debug!(%error, "cannot look for the learner"),
        }
    }

    fn obey(&mut self, said: Control) {
        match said {
            Control::Heartbeat => {}
            Control::Rejoin => {
                self.parting.get_or_insert(Parting::AskedToRejoin);
            }
            Control::Stop => self.parting = Some(Parting::Leave(Ending::Stopped)),
            Control::Fly(ticket) => {
                // An episode issued again replaces its earlier ticket.
                self.tickets
                    .retain(|queued| queued.ticket.episode != ticket.episode);
                if self.tickets.len() >= self.limits.tickets {
                    warn!(episode = %ticket.episode, limit = self.limits.tickets, "more tickets than agreed; the oldest is dropped");
                    self.tickets.pop_front();
                }
                self.tickets.push_back(QueuedTicket {
                    arrived: Instant::now(),
                    ticket,
                });
            }
        }
    }

    /// The first ticket whose snapshot is here.
    pub(super) fn take_ticket(&mut self) -> Option<(Ticket, Arc<Network>)> {
        let ready = self
            .tickets
            .iter()
            .position(|queued| self.weights.holds(queued.ticket.policy_version))?;
        let ticket = self.tickets.remove(ready)?.ticket;
        let network = self.weights.network(ticket.policy_version)?;
        self.has_told_of_waiting = false;
        self.timer.lap(Stage::TakeSnapshot, 0);
        Some((ticket, network))
    }

    /// Waits for the learner, not longer than until the next heartbeat. The learner is told first:
    /// it wakes actors only to what one that waits would miss.
    pub(super) fn wait(&mut self) -> Result<(), ServiceError> {
        if !self.has_told_of_waiting {
            self.has_told_of_waiting = true;
            self.report(ActorState::Serving)?;
        }
        if let Err(error) = self.ports.wait(
            self.limits
                .heartbeat
                .saturating_sub(self.last_said.elapsed()),
        ) {
            // Anything lasting shows as silence, so there is no hurry.
            debug!(%error, "cannot wait for the learner");
            std::thread::sleep(Duration::from_millis(10));
        }
        self.timer.lap(Stage::ActorIdle, 1);
        Ok(())
    }

    /// Calls the learner to what was sent.
    pub(super) fn wake_learner(&self) -> Result<(), ServiceError> {
        self.ports.wake_learner()
    }

    /// Tells how this actor stands. It is no heartbeat: one that was missed is still found missing.
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

impl RecordLink for LearnerLine<'_> {
    type Loan = LoanedTransition;
    type Error = ServiceError;

    fn loan(&mut self) -> Result<LoanedTransition, ServiceError> {
        let loaned = self.ports.loan_transition();
        self.timer.lap(Stage::Send, 0);
        loaned
    }

    fn send(&mut self, record: LoanedTransition) -> Result<(), ServiceError> {
        let (step, kind) = (record.step, record.kind);
        pass(FaultPoint::ActorBeforeSend);
        self.ports.send_transition(record)?;
        self.timer.lap(Stage::Send, 1);
        if kind == RecordKind::Closing.code() {
            pass(FaultPoint::ActorAfterLastRecord);
        } else if step == 2 {
            pass(FaultPoint::ActorMidEpisode);
        }
        Ok(())
    }

    fn directive(&mut self) -> Result<Directive, ServiceError> {
        self.listen_for_control()?;
        self.timer.lap(Stage::ActorControl, 1);
        Ok(if self.parting().is_some() {
            Directive::Abandon
        } else {
            Directive::Continue
        })
    }

    fn lap(&mut self, stage: Stage) {
        self.timer.lap(stage, 1);
    }
}
