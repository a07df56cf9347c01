//! The ticket dispatcher: which actor flies what, what has arrived, and what must be flown again.
//!
//! Actors fly only against tickets, and get a new one only when an episode is taken in. So the
//! number of outstanding tickets is bounded and no buffer can overflow. An episode is discarded
//! whole if it has a hole, comes from a dead actor, or is too late; its ticket is issued again,
//! with the next attempt number. So episodes are flown at least once but committed exactly once.
//! Neither the actor nor the number of attempts changes an episode.
//!
//! Deliberately absent: clocks and transport. Time and messages are passed in and out, so that
//! every path can be tested.

use std::collections::{BTreeMap, VecDeque};
use std::time::{Duration, Instant};

use skein_protocol::config::TransportSection;
use skein_protocol::ids::{ActorId, ActorIncarnation, Attempt, EpisodeId, RunId};
use skein_protocol::stages::StageTimes;
use skein_protocol::status::{ActorState, ActorStatus};
use skein_protocol::ticket::{ControlMessage, ControlRecord, Ticket};
use skein_protocol::transition::{RecordFault, RecordLengths, TransitionRecord};

use super::assembly::{Assembled, Assembly, SegmentEnd};
use super::failures::EpisodeFailures;
use super::situation::{EpisodeOut, Situation};
use crate::episode::CommittedEpisode;
use crate::faults::{Faults, Refusal, Reissue};

pub use super::failures::HopelessEpisode;
pub use super::order::{BatchPlace, EpisodeOrder};

/// Number of episodes an actor may spoil in a row before other actors are preferred to it.
const MOST_SPOILED: u32 = 3;

/// State of all tickets and actors.
#[derive(Debug)]
pub struct Dispatcher {
    run: RunId,
    limits: TransportSection,
    /// Lengths of what actors send.
    lengths: RecordLengths,
    /// Orders without an actor, in the order to fly them.
    waiting: VecDeque<EpisodeOrder>,
    actors: BTreeMap<ActorId, AttachedActor>,
    failures: EpisodeFailures,
    faults: Faults,
    /// Time by stage of actors that are gone.
    times_of_departed: StageTimes,
    /// Messages to actors other than tickets.
    control_messages: Vec<ControlMessage>,
    /// `true` if a message was sent to an actor that may be waiting to be woken.
    is_wake_due: bool,
    /// End of the last segment, if its episode continues.
    segment_end: Option<SegmentEnd>,
}

#[derive(Debug)]
struct AttachedActor {
    incarnation: ActorIncarnation,
    last_sign: Instant,
    /// Tickets that it holds, in the order it flies them.
    tickets: VecDeque<IssuedTicket>,
    /// Number of episodes it has spoiled since the last one committed.
    spoiled: u32,
    /// Stage times in its first heartbeat, subtracted later so that an actor that joins again is
    /// not counted twice.
    first_times: StageTimes,
    times: StageTimes,
    /// `true` if it may be waiting for a ticket: no record for a ticket issued after its last
    /// heartbeat has arrived.
    may_wait: bool,
}

impl AttachedActor {
    fn times_since_first_heard(&self) -> StageTimes {
        self.times.since(&self.first_times)
    }

    fn is_trusted(&self) -> bool {
        self.spoiled < MOST_SPOILED
    }
}

#[derive(Debug)]
struct IssuedTicket {
    since: Instant,
    assembly: Assembly,
    /// `true` if no heartbeat has come since the ticket was issued. A record for such a ticket
    /// shows that its actor is not waiting.
    no_heartbeat_since: bool,
}

impl IssuedTicket {
    fn ticket(&self) -> &Ticket {
        &self.assembly.order().ticket
    }
}

impl Dispatcher {
    /// Starts without orders and actors of `run`; records hold codes and actions of
    /// these `lengths`.
    pub fn new(run: RunId, limits: &TransportSection, lengths: RecordLengths) -> Self {
        Self {
            run,
            limits: limits.clone(),
            lengths,
            waiting: VecDeque::new(),
            actors: BTreeMap::new(),
            failures: EpisodeFailures::default(),
            faults: Faults::default(),
            times_of_departed: StageTimes::default(),
            control_messages: Vec::new(),
            is_wake_due: false,
            segment_end: None,
        }
    }

    /// Attached actors, in ascending order.
    pub fn actors(&self) -> impl Iterator<Item = ActorId> {
        self.actors.keys().copied()
    }

    /// Faults so far.
    pub fn faults(&self) -> Faults {
        self.faults
    }

    /// Time by stage of all actors, as last reported.
    pub fn actor_times(&self) -> StageTimes {
        let living = self
            .actors
            .values()
            .map(AttachedActor::times_since_first_heard);
        living.fold(self.times_of_departed, |sum, times| sum.plus(&times))
    }

    /// Counts an invalid heartbeat.
    pub fn refuse_status(&mut self) {
        self.faults.refuse(Refusal::Status);
    }

    /// Situation at `now`: what is being waited for.
    pub fn situation(&self, now: Instant) -> Situation {
        let since = |then| now.saturating_duration_since(then);
        let out = self.actors.iter().flat_map(|(id, actor)| {
            actor.tickets.iter().map(move |issued| EpisodeOut {
                episode: issued.ticket().episode,
                actor: *id,
                records: issued.assembly.records(),
                issued: since(issued.since),
                unheard: since(actor.last_sign),
            })
        });
        let mut out: Vec<_> = out.collect();
        out.sort_by_key(|out| out.episode);
        Situation {
            actors: self.actors.len(),
            waiting: self.waiting.len(),
            out,
        }
    }

    /// Number of orders that are not committed yet.
    pub fn open_orders(&self) -> usize {
        self.waiting.len()
            + self
                .actors
                .values()
                .map(|actor| actor.tickets.len())
                .sum::<usize>()
    }

    /// Takes an order; it is flown after those taken before.
    pub fn order(&mut self, order: EpisodeOrder) {
        self.waiting.push_back(order);
    }

    /// Takes an actor's heartbeat. From now on, a new actor, or a new incarnation of a known one,
    /// can be given tickets.
    pub fn on_status(&mut self, status: &ActorStatus, now: Instant) {
        let known = self
            .actors
            .get(&status.actor)
            .map(|actor| actor.incarnation);
        match status.state {
            ActorState::Leaving => {
                if known == Some(status.incarnation) {
                    self.actors
                        .entry(status.actor)
                        .and_modify(|actor| actor.times = status.times);
                    self.dismiss(status.actor, Reissue::Left);
                }
            }
            // Incarnations grow: a late heartbeat of an older one is ignored.
            ActorState::Serving if known.is_some_and(|known| known > status.incarnation) => {}
            ActorState::Serving => {
                if known.is_some_and(|known| known != status.incarnation) {
                    self.dismiss(status.actor, Reissue::Restarted);
                }
                // A hard limit, because each claimed actor would be given tickets.
                if !self.actors.contains_key(&status.actor)
                    && self.actors.len() >= self.limits.max_actors
                {
                    self.faults.refuse(Refusal::Status);
                    tracing::debug!(
                        actor = %status.actor,
                        limit = self.limits.max_actors,
                        "more actors than transport.max_actors"
                    );
                    return;
                }
                self.failures.heard(status.actor, now);
                let actor = self.actors.entry(status.actor).or_insert_with(|| {
                    tracing::info!(actor = %status.actor, pid = status.pid, "actor attached");
                    AttachedActor {
                        incarnation: status.incarnation,
                        last_sign: now,
                        tickets: VecDeque::new(),
                        spoiled: 0,
                        first_times: status.times,
                        times: status.times,
                        may_wait: true,
                    }
                });
                actor.last_sign = now;
                actor.times = status.times;
                // An actor without a ticket sends a heartbeat and waits. A ticket on its way at
                // that time is found only when the actor is woken.
                actor.may_wait = true;
                for issued in &mut actor.tickets {
                    self.is_wake_due |= std::mem::take(&mut issued.no_heartbeat_since);
                }
            }
        }
    }

    /// Takes a record; returns the episode that it completes.
    ///
    /// # Errors
    /// [`HopelessEpisode`] when an episode has failed too often.
    pub fn on_record(
        &mut self,
        record: &TransitionRecord,
        now: Instant,
    ) -> Result<Option<(BatchPlace, CommittedEpisode)>, HopelessEpisode> {
        let id = ActorId(record.actor);
        let Some(actor) = self
            .actors
            .get_mut(&id)
            .filter(|actor| actor.incarnation.0 == record.incarnation)
        else {
            self.faults.refuse(Refusal::Stranger);
            return Ok(None);
        };
        actor.last_sign = now;
        let is_of = |issued: &IssuedTicket| {
            issued.ticket().episode.0 == record.episode
                && issued.ticket().attempt.0 == record.attempt
        };
        let Some(position) = actor.tickets.iter().position(is_of) else {
            // A record of an episode that was given up.
            self.faults.refuse(Refusal::NoTicket);
            return Ok(None);
        };
        if actor.tickets[position].no_heartbeat_since {
            actor.may_wait = false;
        }
        // Tickets are flown in order. Those before this one were lost on the way to the actor, or
        // their records were lost on the way here.
        for _ in 0..position {
            self.reissue_first(id, Reissue::Skipped);
        }
        self.advance(id, record, now)
    }

    /// Adds the record to the first episode of actor `id`.
    fn advance(
        &mut self,
        id: ActorId,
        record: &TransitionRecord,
        now: Instant,
    ) -> Result<Option<(BatchPlace, CommittedEpisode)>, HopelessEpisode> {
        let Some(issued) = self
            .actors
            .get_mut(&id)
            .and_then(|actor| actor.tickets.front_mut())
        else {
            return Ok(None);
        };
        match issued.assembly.push(record) {
            Ok(Assembled::Step) => Ok(None),
            Ok(Assembled::Whole(episode)) => {
                let place = issued.assembly.order().place;
                self.remove_first(id, now);
                self.failures.flown(episode.episode);
                self.segment_end = SegmentEnd::of(&episode);
                Ok(Some((place, *episode)))
            }
            Ok(Assembled::Failed) => {
                let episode = issued.ticket().episode;
                self.fail(id, episode, "the simulator broke down")
                    .map(|()| None)
            }
            Err(fault) => {
                let episode = issued.ticket().episode;
                self.refuse(id, episode, record, &fault).map(|()| None)
            }
        }
    }

    fn refuse(
        &mut self,
        id: ActorId,
        episode: EpisodeId,
        record: &TransitionRecord,
        fault: &RecordFault,
    ) -> Result<(), HopelessEpisode> {
        self.faults.refuse(fault.into());
        if self.is_worth_logging(id) {
            tracing::warn!(
                actor = %id,
                %episode,
                step = record.step,
                %fault,
                "record refused"
            );
        }
        match fault {
            // A record was lost on the way, which need not happen again.
            RecordFault::Mismatch { .. } => {
                self.spoil_first(id, Reissue::Hole);
                Ok(())
            }
            // The actor computed something invalid.
            fault => self.fail(id, episode, &fault.to_string()),
        }
    }

    /// Has the first episode of actor `id` flown again, a limited number of times.
    fn fail(&mut self, id: ActorId, episode: EpisodeId, why: &str) -> Result<(), HopelessEpisode> {
        self.failures.failed(episode, id, why)?;
        self.spoil_first(id, Reissue::Failed);
        Ok(())
    }

    /// Has the first episode of actor `id` flown again, and counts it against the actor.
    fn spoil_first(&mut self, id: ActorId, why: Reissue) {
        self.reissue_first(id, why);
        if let Some(actor) = self.actors.get_mut(&id) {
            actor.spoiled += 1;
            if actor.spoiled == MOST_SPOILED {
                tracing::warn!(
                    actor = %id,
                    episodes = actor.spoiled,
                    "actor spoils every episode; other actors are preferred"
                );
            }
        }
    }

    /// `true` at every doubling, so that an actor that always spoils episodes does not fill the
    /// log.
    fn is_worth_logging(&self, id: ActorId) -> bool {
        let spoiled = self.actors.get(&id).map_or(0, |actor| actor.spoiled);
        spoiled == 0 || spoiled.is_power_of_two()
    }

    /// Gives up silent actors and late tickets.
    pub fn on_time(&mut self, now: Instant) {
        let silence = Duration::from_secs_f64(self.limits.actor_silence_secs);
        let deadline = Duration::from_secs_f64(self.limits.episode_deadline_secs);
        let ids: Vec<ActorId> = self.actors.keys().copied().collect();
        for id in ids {
            let actor = &self.actors[&id];
            if now.saturating_duration_since(actor.last_sign) > silence {
                self.dismiss(id, Reissue::Silent);
            } else if let Some(issued) = actor.tickets.front()
                && now.saturating_duration_since(issued.since) > deadline
            {
                // The actor sends heartbeats but no record: its connection may be broken in one
                // direction. A new connection is not.
                if issued.assembly.is_empty() {
                    let rejoin = ControlRecord::rejoin(self.run, id, actor.incarnation);
                    self.control_messages.push(ControlMessage::Control(rejoin));
                }
                self.spoil_first(id, Reissue::Late);
                self.restart_clock(id, now);
            }
        }
        self.failures.on_time(now);
    }

    /// Issues tickets while there are orders, and actors with credit. Every actor gets its first
    /// ticket before any gets a second. An actor that spoils every episode gets none while there
    /// are others. Returns the messages to send.
    pub fn issue(&mut self, now: Instant) -> Vec<ControlMessage> {
        let mut messages = std::mem::take(&mut self.control_messages);
        self.is_wake_due |= !messages.is_empty();
        let credit = self.limits.tickets_per_actor;
        let any_trusted = self.actors.values().any(AttachedActor::is_trusted);
        while !self.waiting.is_empty() {
            let with_credit = self.actors.iter_mut().filter(|(_, actor)| {
                actor.tickets.len() < credit && (actor.is_trusted() || !any_trusted)
            });
            let Some((&id, actor)) = with_credit.min_by_key(|(_, actor)| actor.tickets.len())
            else {
                break;
            };
            let Some(order) = self.waiting.pop_front() else {
                break;
            };
            messages.push(ControlMessage::fly(&order.ticket, id, actor.incarnation));
            let begins = self.segment_end.filter(|end| end.is_before(&order));
            let longest = self.limits.max_records_per_episode;
            let assembly =
                Assembly::new(order, begins, longest, self.lengths, id, actor.incarnation);
            self.is_wake_due |= actor.may_wait || actor.tickets.is_empty();
            actor.tickets.push_back(IssuedTicket {
                since: now,
                assembly,
                no_heartbeat_since: true,
            });
        }
        messages
    }

    /// `true` if, since the last call, something was sent to an actor that may be waiting. A flying
    /// actor checks for messages before each step. Waking all actors for every episode would cost
    /// more with every actor.
    pub fn take_wake(&mut self) -> bool {
        std::mem::take(&mut self.is_wake_due)
    }

    /// Removes an actor; its tickets are issued again.
    fn dismiss(&mut self, id: ActorId, why: Reissue) {
        while self
            .actors
            .get(&id)
            .is_some_and(|actor| !actor.tickets.is_empty())
        {
            self.reissue_last(id, why);
        }
        if let Some(actor) = self.actors.remove(&id) {
            self.times_of_departed = self
                .times_of_departed
                .plus(&actor.times_since_first_heard());
            tracing::info!(actor = %id, "actor {}", why.name());
        }
    }

    fn remove_first(&mut self, id: ActorId, now: Instant) {
        if let Some(actor) = self.actors.get_mut(&id) {
            actor.tickets.pop_front();
            actor.spoiled = 0;
        }
        self.restart_clock(id, now);
    }

    /// Starts a ticket's time when its actor can begin to fly it.
    fn restart_clock(&mut self, id: ActorId, now: Instant) {
        if let Some(next) = self
            .actors
            .get_mut(&id)
            .and_then(|actor| actor.tickets.front_mut())
        {
            next.since = now;
        }
    }

    fn reissue_first(&mut self, id: ActorId, why: Reissue) {
        if let Some(issued) = self
            .actors
            .get_mut(&id)
            .and_then(|actor| actor.tickets.pop_front())
        {
            self.reissue(issued, id, why);
        }
    }

    fn reissue_last(&mut self, id: ActorId, why: Reissue) {
        if let Some(issued) = self
            .actors
            .get_mut(&id)
            .and_then(|actor| actor.tickets.pop_back())
        {
            self.reissue(issued, id, why);
        }
    }

    fn reissue(&mut self, issued: IssuedTicket, id: ActorId, why: Reissue) {
        let mut order = issued.assembly.into_order();
        if self.is_worth_logging(id) {
            tracing::warn!(
                actor = %id,
                episode = %order.ticket.episode,
                attempt = %order.ticket.attempt,
                "ticket issued again: it or its actor {}",
                why.name()
            );
        }
        order.ticket.attempt = Attempt(order.ticket.attempt.0.wrapping_add(1));
        self.faults.reissue(why);
        // The oldest episodes are waited for: back to the front.
        self.waiting.push_front(order);
    }
}

#[cfg(test)]
#[path = "segment_tests.rs"]
mod segment_tests;
#[cfg(test)]
#[path = "dispatcher_tests.rs"]
mod tests;
#[cfg(test)]
#[path = "waking_tests.rs"]
mod waking_tests;
