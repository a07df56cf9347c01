//! Connection of an actor to its learner.

use std::sync::Arc;
use std::time::{Duration, Instant};

use skein_protocol::stages::{LapTimer, Stage};
use skein_protocol::status::{ActorState, ActorStatus, StatusRecord};
use skein_protocol::ticket::Ticket;
use skein_protocol::transition::RecordKind;
use skein_run::RunIdentity;
use skein_run::fault::{FaultPoint, die_if_armed};
use skein_transport::{ActorPorts, LoanedTransition, ServiceError};
use tracing::{debug, warn};

use super::Service;
use crate::session::{DisconnectReason, Session};
use skein_inference::Network;
use skein_rollout::environment_loop::{Directive, RecordLink};

/// Connection to the learner: receives tickets, snapshots and the stop, sends records and
/// heartbeats.
pub(super) struct LearnerConnection<'a> {
    ports: ActorPorts,
    identity: &'a RunIdentity,
    session: Session,
    exit_requested: &'a dyn Fn() -> bool,
    timer: LapTimer,
    pub(super) episodes_flown: u64,
}

impl<'a> LearnerConnection<'a> {
    /// Creates the connection over `ports`, for the current incarnation of `service`. It starts
    /// empty: nothing is kept from an earlier incarnation.
    pub(super) fn new(service: &Service<'a>, ports: ActorPorts) -> Self {
        Self {
            ports,
            identity: service.identity,
            session: Session::begin(
                service.identity.run,
                service.config,
                (service.actor, service.incarnation),
                service.last_heard,
                Instant::now(),
            ),
            exit_requested: service.exit_requested,
            timer: LapTimer::start(),
            episodes_flown: 0,
        }
    }

    /// Returns the time of the learner's last heartbeat.
    pub(super) fn last_heard(&self) -> Instant {
        self.session.last_heard()
    }

    /// Returns the reason to disconnect, if there is one.
    pub(super) fn disconnect_reason(&self) -> Option<DisconnectReason> {
        self.session
            .disconnect_reason(Instant::now(), self.exit_requested)
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
                    self.session.on_snapshot(snapshot);
                }
                Err(error) => warn!(%error, "snapshot refused"),
            }
            self.timer.lap(Stage::TakeSnapshot, 1);
        }
        self.session.on_time(Instant::now());
        Ok(())
    }

    fn listen_for_control(&mut self) -> Result<(), ServiceError> {
        while let Some(message) = self.ports.receive_control()? {
            self.session.on_message(&message, Instant::now());
        }
        if self.session.is_heartbeat_due(Instant::now()) {
            self.check_learner();
            self.ports.maintain()?;
            self.session.has_beaten(Instant::now());
            self.report(ActorState::Serving)?;
        }
        Ok(())
    }

    /// Checks that the joined learner is still the living one. A dead learner also falls silent,
    /// but this is known at once.
    fn check_learner(&mut self) {
        match self.identity.current_incarnation() {
            Ok(Some(present)) if present.incarnation == self.ports.incarnation() => {}
            Ok(_) => self.session.learner_is_gone(),
            Err(error) => debug!(%error, "cannot check the learner"),
        }
    }

    /// Returns the first ticket whose snapshot is available, with its network.
    pub(super) fn take_ticket(&mut self) -> Option<(Ticket, Arc<Network>)> {
        let ticket = self.session.take_ticket()?;
        let weights = self.session.weights_mut();
        let network = weights.network(ticket.policy_version)?;
        self.timer.lap(Stage::TakeSnapshot, 0);
        Some((ticket, network))
    }

    /// Waits for the learner, at most until the next heartbeat.
    pub(super) fn wait(&mut self) -> Result<(), ServiceError> {
        if self.session.begins_to_wait() {
            self.report(ActorState::Serving)?;
        }
        let patience = self.session.patience(Instant::now());
        if let Err(error) = self.ports.wait(patience) {
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
        let (actor, incarnation) = self.session.identity();
        let status = ActorStatus {
            actor,
            incarnation,
            pid: std::process::id(),
            state,
            newest_policy: self.session.weights().newest(),
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
