//! The ticket dispatcher: who flies what, what has come of it, what must be flown again.
//!
//! Actors fly only against tickets and get another one only as an episode is taken in, so what is
//! outstanding is bounded and no buffer can overflow. An episode that arrives with a hole, from a
//! dead actor, or too late is discarded whole and its ticket issued again, with the next attempt
//! number: exactly-once commit from at-least-once flying. Which actor flies a ticket, and how
//! often, changes nothing in the episode.
//!
//! Deliberately absent: clocks and transport. Time is passed in, messages are passed in and out, so
//! that every path can be tested.

use std::collections::{BTreeMap, VecDeque};
use std::time::{Duration, Instant};

use skein_protocol::config::TransportSection;
use skein_protocol::ids::{ActorId, ActorIncarnation, Attempt, EpisodeId, RunId};
use skein_protocol::stages::Times;
use skein_protocol::status::{ActorState, ActorStatus};
use skein_protocol::ticket::{ControlRecord, Message, Ticket};
use skein_protocol::transition::{RecordFault, TransitionRecord};

use super::assembly::{Assembled, Assembly, SegmentEnd};
use super::failures::Failures;
use super::faults::{Faults, Refusal, Reissue};
use super::situation::{EpisodeOut, Situation};
use crate::episode::CommittedEpisode;

pub use super::failures::HopelessEpisode;
pub use super::order::{Order, Place};

/// Episodes that an actor may spoil one after the other before others are preferred to it.
const MOST_SPOILED: u32 = 3;

/// The book-keeping.
#[derive(Debug)]
pub struct Dispatcher {
    run: RunId,
    limits: TransportSection,
    /// Length of the latent codes that actors send.
    latent: usize,
    /// Orders without an actor, first to be flown first.
    waiting: VecDeque<Order>,
    actors: BTreeMap<ActorId, Actor>,
    failures: Failures,
    faults: Faults,
    /// What the time of actors that are gone went into.
    times_of_the_gone: Times,
    /// What is to be said to actors besides their tickets.
    letters: Vec<Message>,
    /// Whether something was said to an actor that may not look by itself.
    is_wake_due: bool,
    /// Where the last segment ended, if its episode goes on.
    segment_end: Option<SegmentEnd>,
}

#[derive(Debug)]
struct Actor {
    incarnation: ActorIncarnation,
    last_sign: Instant,
    /// Tickets it holds, in the order it flies them.
    tickets: VecDeque<Issued>,
    /// Episodes it has spoiled since the last one that was committed.
    spoiled: u32,
    /// What its time had gone into when it was first heard of: an actor that was taken for dead and
    /// is not is not counted twice.
    first_times: Times,
    times: Times,
    /// It has spoken since, and nothing shows that it has seen a ticket that it was given after: it
    /// may have found nothing to fly and be waiting.
    may_wait: bool,
}

impl Actor {
    fn times_since_it_came(&self) -> Times {
        self.times.since(&self.first_times)
    }

    fn is_trusted(&self) -> bool {
        self.spoiled < MOST_SPOILED
    }
}

#[derive(Debug)]
struct Issued {
    since: Instant,
    assembly: Assembly,
    /// Whether its actor has not spoken since: one that flies it does not wait.
    is_newest_word: bool,
}

impl Issued {
    fn ticket(&self) -> &Ticket {
        &self.assembly.order().ticket
    }
}

impl Dispatcher {
    /// A dispatcher of `run` without orders and actors; records hold codes of `latent` numbers.
    pub fn new(run: RunId, limits: &TransportSection, latent: usize) -> Self {
        Self {
            run,
            limits: limits.clone(),
            latent,
            waiting: VecDeque::new(),
            actors: BTreeMap::new(),
            failures: Failures::default(),
            faults: Faults::default(),
            times_of_the_gone: Times::default(),
            letters: Vec::new(),
            is_wake_due: false,
            segment_end: None,
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

    /// What the time of all actors went into, as far as they have told.
    pub fn actor_times(&self) -> Times {
        let living = self.actors.values().map(Actor::times_since_it_came);
        living.fold(self.times_of_the_gone, |sum, times| sum.plus(&times))
    }

    /// Counts a heartbeat that makes no sense.
    pub fn refuse_status(&mut self) {
        self.faults.refuse(Refusal::Status);
    }

    /// Who waits for whom at `now`.
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

    /// Orders that are not committed yet.
    pub fn open_orders(&self) -> usize {
        self.waiting.len()
            + self
                .actors
                .values()
                .map(|actor| actor.tickets.len())
                .sum::<usize>()
    }

    /// Takes an order; it is flown after those taken before.
    pub fn order(&mut self, order: Order) {
        self.waiting.push_back(order);
    }

    /// Takes an actor's heartbeat: a new actor, or a new incarnation of a known one, can be given
    /// tickets from now on.
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
            // An older incarnation's late word is not believed: incarnations grow.
            ActorState::Serving if known.is_some_and(|known| known > status.incarnation) => {}
            ActorState::Serving => {
                if known.is_some_and(|known| known != status.incarnation) {
                    self.dismiss(status.actor, Reissue::Restarted);
                }
                // A bound, whatever actors say that there be: each would be given tickets.
                if !self.actors.contains_key(&status.actor)
                    && self.actors.len() >= self.limits.max_actors
                {
                    self.faults.refuse(Refusal::Status);
                    tracing::debug!(actor = %status.actor, limit = self.limits.max_actors, "more actors than transport.max_actors");
                    return;
                }
                self.failures.heard(status.actor, now);
                let actor = self.actors.entry(status.actor).or_insert_with(|| {
                    tracing::info!(actor = %status.actor, pid = status.pid, "actor attached");
                    Actor {
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
                // It speaks when it finds nothing to fly. What was on its way to it then, it finds
                // when it is woken.
                actor.may_wait = true;
                for issued in &mut actor.tickets {
                    self.is_wake_due |= std::mem::take(&mut issued.is_newest_word);
                }
            }
        }
    }

    /// Takes a record; returns the episode it completes.
    ///
    /// # Errors
    /// [`HopelessEpisode`] when an episode has failed too often.
    pub fn on_record(
        &mut self,
        record: &TransitionRecord,
        now: Instant,
    ) -> Result<Option<(Place, CommittedEpisode)>, HopelessEpisode> {
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
        let is_of = |issued: &Issued| {
            issued.ticket().episode.0 == record.episode
                && issued.ticket().attempt.0 == record.attempt
        };
        let Some(position) = actor.tickets.iter().position(is_of) else {
            // The rest of an episode that was given up.
            self.faults.refuse(Refusal::NoTicket);
            return Ok(None);
        };
        if actor.tickets[position].is_newest_word {
            actor.may_wait = false;
        }
        // Tickets are flown in order: those before this one never reached the actor, or their
        // records never reached us.
        for _ in 0..position {
            self.reissue_first(id, Reissue::Skipped);
        }
        self.advance(id, record, now)
    }

    /// Takes the record into the first episode of actor `id`.
    fn advance(
        &mut self,
        id: ActorId,
        record: &TransitionRecord,
        now: Instant,
    ) -> Result<Option<(Place, CommittedEpisode)>, HopelessEpisode> {
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
        if self.is_worth_telling(id) {
            tracing::warn!(actor = %id, %episode, step = record.step, %fault, "record refused");
        }
        match fault {
            // Something got lost on the way, which need not happen again.
            RecordFault::Mismatch { .. } => {
                self.spoil_first(id, Reissue::Hole);
                Ok(())
            }
            // What an actor computed makes no sense.
            fault => self.fail(id, episode, &fault.to_string()),
        }
    }

    /// Has the first episode of actor `id` flown again, but not for ever.
    fn fail(&mut self, id: ActorId, episode: EpisodeId, why: &str) -> Result<(), HopelessEpisode> {
        self.failures.failed(episode, id, why)?;
        self.spoil_first(id, Reissue::Failed);
        Ok(())
    }

    /// Has the first episode of actor `id` flown again, and remembers it of the actor.
    fn spoil_first(&mut self, id: ActorId, why: Reissue) {
        self.reissue_first(id, why);
        if let Some(actor) = self.actors.get_mut(&id) {
            actor.spoiled += 1;
            if actor.spoiled == MOST_SPOILED {
                tracing::warn!(actor = %id, episodes = actor.spoiled, "actor spoils every episode; others are preferred to it");
            }
        }
    }

    /// An actor that spoils episodes for ever must not fill the log: every doubling is told.
    fn is_worth_telling(&self, id: ActorId) -> bool {
        let spoiled = self.actors.get(&id).map_or(0, |actor| actor.spoiled);
        spoiled == 0 || spoiled.is_power_of_two()
    }

    /// Gives up actors that are silent and tickets that take too long.
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
                // Of an actor that speaks, not one record came: its line may be broken in one
                // direction. A new one is not.
                if issued.assembly.is_empty() {
                    let letter = ControlRecord::rejoin(self.run, id, actor.incarnation);
                    self.letters.push(Message::Control(letter));
                }
                self.spoil_first(id, Reissue::Late);
                self.restart_clock(id, now);
            }
        }
        self.failures.on_time(now);
    }

    /// Hands out tickets as far as there are orders and actors with credit: each actor its first
    /// before any its second, and none to an actor that spoils every episode while there are
    /// others. Returns what to send.
    pub fn issue(&mut self, now: Instant) -> Vec<Message> {
        let mut messages = std::mem::take(&mut self.letters);
        self.is_wake_due |= !messages.is_empty();
        let credit = self.limits.tickets_per_actor;
        let any_trusted = self.actors.values().any(Actor::is_trusted);
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
            messages.push(Message::fly(&order.ticket, id, actor.incarnation));
            let begins = self.segment_end.filter(|end| end.is_before(&order));
            let longest = self.limits.max_records_per_episode;
            let assembly =
                Assembly::new(order, begins, longest, self.latent, id, actor.incarnation);
            self.is_wake_due |= actor.may_wait || actor.tickets.is_empty();
            actor.tickets.push_back(Issued {
                since: now,
                assembly,
                is_newest_word: true,
            });
        }
        messages
    }

    /// Whether an actor may wait that was given something since this was last asked. One that flies
    /// looks by itself before each step, and to wake all actors for every episode costs the more,
    /// the more of them there are.
    pub fn take_wake(&mut self) -> bool {
        std::mem::take(&mut self.is_wake_due)
    }

    /// Forgets an actor; its tickets are issued again.
    fn dismiss(&mut self, id: ActorId, why: Reissue) {
        while self
            .actors
            .get(&id)
            .is_some_and(|actor| !actor.tickets.is_empty())
        {
            self.reissue_last(id, why);
        }
        if let Some(actor) = self.actors.remove(&id) {
            self.times_of_the_gone = self.times_of_the_gone.plus(&actor.times_since_it_came());
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

    /// A ticket's time runs from when the actor could begin it.
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

    fn reissue(&mut self, issued: Issued, id: ActorId, why: Reissue) {
        let mut order = issued.assembly.into_order();
        if self.is_worth_telling(id) {
            tracing::warn!(actor = %id, episode = %order.ticket.episode, attempt = %order.ticket.attempt, "ticket issued again: it or its actor {}", why.name());
        }
        order.ticket.attempt = Attempt(order.ticket.attempt.0.wrapping_add(1));
        self.faults.reissue(why);
        // Others wait for the oldest episodes: back to the front.
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
