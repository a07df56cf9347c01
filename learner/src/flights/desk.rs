//! The ticket desk: who flies what, what has come of it, what must be flown again.
//!
//! Actors fly only against tickets and get another one only as a flight is taken in, so what is in flight is bounded and no buffer can overflow. A flight
//! that arrives with a hole, from a dead actor, or too late is discarded whole and its ticket issued again, with the next attempt number: exactly-once
//! commit from at-least-once flying. Which actor flies a ticket, and how often, changes nothing in the flight.
//!
//! Deliberately absent: clocks and transport. Time is passed in, messages are passed in and out, so that every path can be tested.

use std::collections::{BTreeMap, VecDeque};
use std::time::{Duration, Instant};

use skein_protocol::config::TransportSection;
use skein_protocol::ids::{ActorId, Attempt, Epoch, FlightId, Incarnation};
use skein_protocol::status::{ActorState, ActorStatus};
use skein_protocol::ticket::{ControlRecord, Ticket};
use skein_protocol::transition::{RecordFault, TransitionRecord};

use super::assembly::{Assembled, Assembly, Keep};
use crate::flight::CommittedFlight;

/// Times a flight may fail, in the simulator or by numbers that make no sense: it is a function of its ticket, so it will fail again.
const MOST_FAILURES: u32 = 3;

/// A flight to be flown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Order {
    /// What to fly.
    pub ticket: Ticket,
    /// The epoch it belongs to.
    pub epoch: Epoch,
    /// What is kept of it.
    pub keep: Keep,
    /// Who waits for it, and at which place among the flights ordered together.
    pub place: Place,
}

/// A place in a batch of flights that were ordered together.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Place {
    /// The batch.
    pub batch: u64,
    /// The flight's position in it.
    pub index: usize,
}

/// Counts of what went wrong and was made good.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Faults {
    /// Tickets issued again.
    pub reissued: u64,
    /// Records that belonged to no ticket, or made no sense.
    pub refused: u64,
}

/// A flight that no actor can fly.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("flight {flight} failed {failures} times, at last because {why}; the logs of learner and actors say more")]
pub struct HopelessFlight {
    /// The flight.
    pub flight: FlightId,
    /// Its failures.
    pub failures: u32,
    /// What went wrong the last time.
    pub why: String,
}

/// The book-keeping.
#[derive(Debug)]
pub struct Desk {
    limits: TransportSection,
    /// Orders without an actor, first to be flown first.
    waiting: VecDeque<Order>,
    actors: BTreeMap<ActorId, Actor>,
    failures: BTreeMap<FlightId, u32>,
    faults: Faults,
}

#[derive(Debug)]
struct Actor {
    incarnation: Incarnation,
    last_sign: Instant,
    /// Tickets it holds, in the order it flies them.
    tickets: VecDeque<Issued>,
}

#[derive(Debug)]
struct Issued {
    order: Order,
    since: Instant,
    assembly: Assembly,
}

impl Desk {
    /// A desk without orders and actors.
    pub fn new(limits: &TransportSection) -> Self {
        Self {
            limits: limits.clone(),
            waiting: VecDeque::new(),
            actors: BTreeMap::new(),
            failures: BTreeMap::new(),
            faults: Faults::default(),
        }
    }

    /// Actors that live, in ascending order.
    pub fn actors(&self) -> impl Iterator<Item = ActorId> {
        self.actors.keys().copied()
    }

    /// What went wrong so far.
    pub fn faults(&self) -> Faults {
        self.faults
    }

    /// Orders that are not committed yet.
    pub fn open_orders(&self) -> usize {
        self.waiting.len() + self.actors.values().map(|actor| actor.tickets.len()).sum::<usize>()
    }

    /// Takes an order; it is flown after those taken before.
    pub fn order(&mut self, order: Order) {
        self.waiting.push_back(order);
    }

    /// Takes an actor's sign of life: a new actor, or a new life of a known one, can be given tickets from now on.
    pub fn on_status(&mut self, status: &ActorStatus, now: Instant) {
        let known = self.actors.get(&status.actor).map(|actor| actor.incarnation);
        match status.state {
            ActorState::Leaving => {
                if known == Some(status.incarnation) {
                    self.dismiss(status.actor, "left");
                }
            }
            // An older life's late word is not believed: incarnations grow.
            ActorState::Serving if known.is_some_and(|known| known > status.incarnation) => {}
            ActorState::Serving => {
                if known.is_some_and(|known| known != status.incarnation) {
                    self.dismiss(status.actor, "restarted");
                }
                let actor = self.actors.entry(status.actor).or_insert_with(|| {
                    tracing::info!(actor = %status.actor, pid = status.pid, "actor attached");
                    Actor {
                        incarnation: status.incarnation,
                        last_sign: now,
                        tickets: VecDeque::new(),
                    }
                });
                actor.last_sign = now;
            }
        }
    }

    /// Takes a record; returns the flight it completes.
    ///
    /// # Errors
    /// [`HopelessFlight`] when a flight has failed too often.
    pub fn on_record(
        &mut self,
        record: &TransitionRecord,
        now: Instant,
    ) -> Result<Option<(Place, CommittedFlight)>, HopelessFlight> {
        let id = ActorId(record.actor);
        let Some(actor) = self
            .actors
            .get_mut(&id)
            .filter(|actor| actor.incarnation.0 == record.incarnation)
        else {
            self.faults.refused += 1;
            return Ok(None);
        };
        actor.last_sign = now;
        let is_of = |issued: &Issued| {
            issued.order.ticket.flight.0 == record.flight && issued.order.ticket.attempt.0 == record.attempt
        };
        let Some(position) = actor.tickets.iter().position(is_of) else {
            // The rest of a flight that was given up.
            self.faults.refused += 1;
            return Ok(None);
        };
        // Tickets are flown in order: those before this one never reached the actor, or their records never reached us.
        for _ in 0..position {
            self.reissue_first(id, "skipped");
        }
        self.advance(id, record, now)
    }

    /// Takes the record into the first flight of actor `id`.
    fn advance(
        &mut self,
        id: ActorId,
        record: &TransitionRecord,
        now: Instant,
    ) -> Result<Option<(Place, CommittedFlight)>, HopelessFlight> {
        let Some(issued) = self.actors.get_mut(&id).and_then(|actor| actor.tickets.front_mut()) else {
            return Ok(None);
        };
        match issued.assembly.push(record) {
            Ok(Assembled::Step) => Ok(None),
            Ok(Assembled::Whole(flight)) => {
                let place = issued.order.place;
                self.remove_first(id, now);
                self.failures.remove(&flight.flight);
                Ok(Some((place, *flight)))
            }
            Ok(Assembled::Failed) => {
                let flight = issued.order.ticket.flight;
                self.fail(id, flight, "the simulator broke down").map(|()| None)
            }
            Err(fault) => {
                let flight = issued.order.ticket.flight;
                self.refuse(id, flight, record, fault).map(|()| None)
            }
        }
    }

    fn refuse(
        &mut self,
        id: ActorId,
        flight: FlightId,
        record: &TransitionRecord,
        fault: RecordFault,
    ) -> Result<(), HopelessFlight> {
        tracing::warn!(actor = %id, %flight, step = record.step, %fault, "record refused");
        self.faults.refused += 1;
        match fault {
            // Something got lost on the way, which need not happen again.
            RecordFault::Mismatch { .. } => {
                self.reissue_first(id, "has a hole");
                Ok(())
            }
            // What an actor computed makes no sense, and a flight is a function of its ticket.
            fault => self.fail(id, flight, &fault.to_string()),
        }
    }

    /// Has the first flight of actor `id` flown again, but not for ever.
    fn fail(&mut self, id: ActorId, flight: FlightId, why: &str) -> Result<(), HopelessFlight> {
        let failures = self.failures.entry(flight).or_default();
        *failures += 1;
        if *failures >= MOST_FAILURES {
            return Err(HopelessFlight {
                flight,
                failures: *failures,
                why: why.to_owned(),
            });
        }
        self.reissue_first(id, "failed");
        Ok(())
    }

    /// Gives up actors that are silent and tickets that take too long.
    pub fn on_time(&mut self, now: Instant) {
        let silence = Duration::from_secs_f64(self.limits.actor_silence_secs);
        let deadline = Duration::from_secs_f64(self.limits.flight_deadline_secs);
        let ids: Vec<ActorId> = self.actors.keys().copied().collect();
        for id in ids {
            let actor = &self.actors[&id];
            if now.saturating_duration_since(actor.last_sign) > silence {
                self.dismiss(id, "is silent");
            } else if actor
                .tickets
                .front()
                .is_some_and(|issued| now.saturating_duration_since(issued.since) > deadline)
            {
                self.reissue_first(id, "took too long");
                self.restart_clock(id, now);
            }
        }
    }

    /// Hands out tickets as far as there are orders and actors with credit: each actor its first before any its second. Returns what to send.
    pub fn issue(&mut self, now: Instant) -> Vec<ControlRecord> {
        let mut messages = Vec::new();
        while !self.waiting.is_empty() {
            let credit = self.limits.tickets_per_actor;
            let with_credit = self.actors.iter_mut().filter(|(_, actor)| actor.tickets.len() < credit);
            let Some((&id, actor)) = with_credit.min_by_key(|(_, actor)| actor.tickets.len()) else {
                break;
            };
            let Some(order) = self.waiting.pop_front() else {
                break;
            };
            messages.push(ControlRecord::fly(&order.ticket, id, actor.incarnation));
            let longest = self.limits.max_records_per_flight;
            let assembly = Assembly::new(order.ticket, order.epoch, order.keep, longest, id, actor.incarnation);
            actor.tickets.push_back(Issued {
                order,
                since: now,
                assembly,
            });
        }
        messages
    }

    /// Forgets an actor; its tickets are issued again.
    fn dismiss(&mut self, id: ActorId, why: &str) {
        while self.actors.get(&id).is_some_and(|actor| !actor.tickets.is_empty()) {
            self.reissue_last(id, why);
        }
        if self.actors.remove(&id).is_some() {
            tracing::info!(actor = %id, "actor {why}");
        }
    }

    fn remove_first(&mut self, id: ActorId, now: Instant) -> Option<Issued> {
        let issued = self.actors.get_mut(&id)?.tickets.pop_front();
        self.restart_clock(id, now);
        issued
    }

    /// A ticket's time runs from when the actor could begin it.
    fn restart_clock(&mut self, id: ActorId, now: Instant) {
        if let Some(next) = self.actors.get_mut(&id).and_then(|actor| actor.tickets.front_mut()) {
            next.since = now;
        }
    }

    fn reissue_first(&mut self, id: ActorId, why: &str) {
        if let Some(issued) = self.actors.get_mut(&id).and_then(|actor| actor.tickets.pop_front()) {
            self.reissue(issued, id, why);
        }
    }

    fn reissue_last(&mut self, id: ActorId, why: &str) {
        if let Some(issued) = self.actors.get_mut(&id).and_then(|actor| actor.tickets.pop_back()) {
            self.reissue(issued, id, why);
        }
    }

    fn reissue(&mut self, issued: Issued, id: ActorId, why: &str) {
        let mut order = issued.order;
        tracing::warn!(actor = %id, flight = %order.ticket.flight, attempt = %order.ticket.attempt, "ticket issued again: it or its actor {why}");
        order.ticket.attempt = Attempt(order.ticket.attempt.0 + 1);
        self.faults.reissued += 1;
        // Others wait for the oldest flights: back to the front.
        self.waiting.push_front(order);
    }
}

#[cfg(test)]
#[path = "desk_tests.rs"]
mod tests;
