//! The life of an actor process: take a ticket, fly it, until the run is over.
//!
//! Whatever happens on the way is survived by doing nothing about it: a flight that is lost is flown again on a new ticket, by this actor or another. Only
//! the end of the run, a signal, or a learner silent for too long end the process.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use skein_protocol::config::TransportSection;
use skein_protocol::ids::{ActorId, Incarnation};
use skein_protocol::services::{ActorPorts, LoanedTransition, ServiceError};
use skein_protocol::status::{ActorState, ActorStatus, StatusRecord};
use skein_protocol::ticket::{Control, Ticket};
use tracing::{debug, info, info_span, warn};

use crate::environment_loop::{Directive, FlightError, Pilot, RecordLink};
use crate::inference::Network;
use crate::weights::Weights;

/// Flies tickets as they come, until the run is over for this actor.
///
/// # Errors
/// [`ServiceError`] when the services of the run fail as such. A lost flight is none.
pub fn serve(pilot: &mut Pilot, line: &mut LearnerLine<'_>) -> Result<Ending, ServiceError> {
    line.report(ActorState::Serving)?;
    let ending = loop {
        line.listen()?;
        if let Some(ending) = line.ending() {
            break ending;
        }
        match line.take_ticket() {
            Some((ticket, network)) => fly(pilot, &ticket, &network, line)?,
            None => line.wait(),
        }
    };
    info!(?ending, flights = line.flights_flown, "leaving");
    line.report(ActorState::Leaving)?;
    Ok(ending)
}

/// Why an actor leaves.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ending {
    /// The learner said that the run is over.
    Stopped,
    /// This process was told to end.
    Signalled,
    /// Nothing was heard of the learner for `transport.learner_silence_secs`.
    LearnerSilent,
}

fn fly(pilot: &mut Pilot, ticket: &Ticket, network: &Network, line: &mut LearnerLine<'_>) -> Result<(), ServiceError> {
    let span =
        info_span!("flight", flight = %ticket.flight, attempt = %ticket.attempt, policy = %ticket.policy_version);
    let _entered = span.enter();
    match pilot.fly(ticket, network, line) {
        Ok(score) => {
            line.flights_flown += 1;
            debug!(
                walls = score.walls_passed,
                outcome = score.outcome.name(),
                reward = score.flight_return,
                "flown"
            );
        }
        Err(FlightError::Abandoned) => info!("flight abandoned"),
        Err(FlightError::Fault(fault)) => warn!(%fault, "flight failed"),
        // The ticket's deadline makes good for it.
        Err(FlightError::Link(error)) => warn!(%error, "flight lost"),
    }
    line.ports.wake_learner()
}

/// The actor's end of the line to the learner: hears tickets, snapshots and the stop, sends records and signs of life.
pub struct LearnerLine<'a> {
    ports: ActorPorts,
    actor: ActorId,
    incarnation: Incarnation,
    weights: Weights,
    tickets: VecDeque<QueuedTicket>,
    limits: Limits,
    told_to_end: &'a AtomicBool,
    stopped: Stop,
    last_heard: Instant,
    last_said: Instant,
    flights_flown: u64,
}

struct QueuedTicket {
    arrived: Instant,
    ticket: Ticket,
}

/// Deadlines and limits, from the `[transport]` section.
struct Limits {
    heartbeat: Duration,
    ticket_life: Duration,
    learner_silence: Duration,
    tickets: usize,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Stop {
    NotYet,
    Said,
}

impl<'a> LearnerLine<'a> {
    /// A line over `ports`. `told_to_end` is looked at between steps.
    pub fn new(
        ports: ActorPorts,
        actor: ActorId,
        incarnation: Incarnation,
        weights: Weights,
        transport: &TransportSection,
        told_to_end: &'a AtomicBool,
    ) -> Self {
        let now = Instant::now();
        Self {
            ports,
            actor,
            incarnation,
            weights,
            tickets: VecDeque::new(),
            limits: Limits {
                heartbeat: transport.heartbeat(),
                ticket_life: Duration::from_secs_f64(transport.flight_deadline_secs),
                learner_silence: Duration::from_secs_f64(transport.learner_silence_secs),
                tickets: transport.tickets_per_actor,
            },
            told_to_end,
            stopped: Stop::NotYet,
            last_heard: now,
            last_said: now,
            flights_flown: 0,
        }
    }

    /// Why to leave, if there is a reason.
    fn ending(&self) -> Option<Ending> {
        if self.stopped == Stop::Said {
            Some(Ending::Stopped)
        } else if self.told_to_end.load(Ordering::Relaxed) {
            Some(Ending::Signalled)
        } else if self.last_heard.elapsed() > self.limits.learner_silence {
            Some(Ending::LearnerSilent)
        } else {
            None
        }
    }

    /// Hears everything there is to hear, and gives a sign of life when one is due.
    fn listen(&mut self) -> Result<(), ServiceError> {
        self.listen_for_control()?;
        while let Some(received) = self.ports.receive_snapshot()? {
            match received {
                Ok(snapshot) => {
                    debug!(version = %snapshot.version, "snapshot received");
                    self.weights.insert(snapshot);
                }
                Err(error) => warn!(%error, "snapshot refused"),
            }
        }
        let life = self.limits.ticket_life;
        self.tickets.retain(|queued| {
            let alive = queued.arrived.elapsed() < life;
            if !alive {
                warn!(flight = %queued.ticket.flight, policy = %queued.ticket.policy_version, "ticket expired");
            }
            alive
        });
        Ok(())
    }

    fn listen_for_control(&mut self) -> Result<(), ServiceError> {
        while let Some(record) = self.ports.receive_control()? {
            match record.read(self.ports.run()) {
                Ok(said) => {
                    self.last_heard = Instant::now();
                    if record.is_for(self.actor, self.incarnation) {
                        self.obey(said);
                    }
                }
                Err(fault) => warn!(%fault, "control record refused"),
            }
        }
        if self.last_said.elapsed() >= self.limits.heartbeat {
            self.ports.maintain()?;
            self.report(ActorState::Serving)?;
        }
        Ok(())
    }

    fn obey(&mut self, said: Control) {
        match said {
            Control::Heartbeat => {}
            Control::Stop => self.stopped = Stop::Said,
            Control::Fly(ticket) => {
                // A flight issued again replaces its earlier ticket.
                self.tickets.retain(|queued| queued.ticket.flight != ticket.flight);
                if self.tickets.len() >= self.limits.tickets {
                    warn!(flight = %ticket.flight, limit = self.limits.tickets, "more tickets than agreed; the oldest is dropped");
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
    fn take_ticket(&mut self) -> Option<(Ticket, Arc<Network>)> {
        let ready = self
            .tickets
            .iter()
            .position(|queued| self.weights.holds(queued.ticket.policy_version))?;
        let ticket = self.tickets.remove(ready)?.ticket;
        let network = self.weights.network(ticket.policy_version)?;
        Some((ticket, network))
    }

    /// Waits for the learner, not longer than until the next sign of life.
    fn wait(&self) {
        if let Err(error) = self
            .ports
            .wait(self.limits.heartbeat.saturating_sub(self.last_said.elapsed()))
        {
            // Anything lasting shows as silence, so there is no hurry.
            debug!(%error, "cannot wait for the learner");
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    fn report(&mut self, state: ActorState) -> Result<(), ServiceError> {
        self.last_said = Instant::now();
        let status = ActorStatus {
            actor: self.actor,
            incarnation: self.incarnation,
            pid: std::process::id(),
            state,
            newest_policy: self.weights.newest(),
            flights_flown: self.flights_flown,
        };
        self.ports.send_status(StatusRecord::new(self.ports.run(), &status))?;
        self.ports.wake_learner()
    }
}

impl RecordLink for LearnerLine<'_> {
    type Loan = LoanedTransition;
    type Error = ServiceError;

    fn loan(&mut self) -> Result<LoanedTransition, ServiceError> {
        self.ports.loan_transition()
    }

    fn send(&mut self, record: LoanedTransition) -> Result<(), ServiceError> {
        self.ports.send_transition(record)
    }

    fn directive(&mut self) -> Result<Directive, ServiceError> {
        self.listen_for_control()?;
        Ok(if self.ending().is_some() {
            Directive::Abandon
        } else {
            Directive::Continue
        })
    }
}

#[cfg(test)]
mod tests;
