//! Whatever happens to records and actors, every ordered flight is committed exactly once, whole, and as its ticket says.

use std::collections::BTreeMap;

use bytemuck::Zeroable;
use proptest::prelude::*;
use skein_protocol::ids::{Epoch, PolicyVersion};
use skein_protocol::stages::Stage;
use skein_protocol::ticket::{Control, CourseChoice, Exploration};
use skein_protocol::transition::{Outcome, RecordKind};

use super::super::assembly::Keep;
use super::super::failures;
use super::*;

pub(super) const RUN: RunId = RunId(1);
pub(super) const LIFE: Incarnation = Incarnation(100);

pub(super) fn limits() -> TransportSection {
    TransportSection {
        tickets_per_actor: 2,
        actor_silence_secs: 5.0,
        flight_deadline_secs: 60.0,
        ..Default::default()
    }
}

pub(super) fn order(flight: u64) -> Order {
    let ticket = Ticket {
        run: RUN,
        flight: FlightId(flight),
        attempt: Attempt(0),
        policy_version: PolicyVersion(3),
        course: CourseChoice::Training,
        start_level: 1,
        exploration: Exploration::Sample,
        seed: flight,
        leg: None,
    };
    Order {
        ticket,
        epoch: Epoch(0),
        keep: Keep::Latents,
        place: Place {
            batch: 0,
            index: flight as usize,
        },
    }
}

pub(super) fn attach(desk: &mut Desk, actor: u32, life: Incarnation, now: Instant) {
    desk.on_status(&status(actor, life), now);
}

fn status(actor: u32, life: Incarnation) -> ActorStatus {
    ActorStatus {
        actor: ActorId(actor),
        incarnation: life,
        pid: 1,
        state: ActorState::Serving,
        newest_policy: None,
        flights_flown: 0,
        times: Times::default(),
    }
}

/// A sign of life of an actor that has flown for so many seconds in this life.
fn flown(desk: &mut Desk, actor: u32, life: Incarnation, state: ActorState, secs: u64, now: Instant) {
    let mut status = ActorStatus {
        state,
        ..status(actor, life)
    };
    status.times.add(Stage::Physics, secs, Duration::from_secs(secs));
    desk.on_status(&status, now);
}

/// Tickets handed out to `actor`.
pub(super) fn tickets_for(messages: &[Message], actor: u32, life: Incarnation) -> Vec<Ticket> {
    let own = messages.iter().filter(|message| message.is_for(ActorId(actor), life));
    own.filter_map(|message| match message.read(RUN) {
        Ok(Control::Fly(ticket)) => Some(ticket),
        _ => None,
    })
    .collect()
}

/// The records of a flight of `2 + flight % 3` steps.
pub(super) fn records(ticket: &Ticket, actor: u32, life: Incarnation) -> Vec<TransitionRecord> {
    let steps = 2 + (ticket.flight.0 % 3) as u32;
    (0..=steps)
        .map(|step| {
            let mut record = TransitionRecord::zeroed();
            record.begin(ticket, ActorId(actor), life, step);
            record.reward = ticket.flight.0 as f32 + step as f32;
            record.reward_terms = [record.reward, 0.0, 0.0, 0.0];
            record.terminated = u8::from(step == steps - 1);
            if step == steps {
                record.kind = RecordKind::Closing.code();
                record.outcome = Outcome::Collided.code();
            }
            record
        })
        .collect()
}

pub(super) fn feed(desk: &mut Desk, records: &[TransitionRecord], now: Instant) -> Vec<(Place, CommittedFlight)> {
    records
        .iter()
        .filter_map(|record| desk.on_record(record, now).unwrap())
        .collect()
}

/// A desk with one actor that holds tickets 0 and 1 of three orders.
pub(super) fn desk(now: Instant) -> (Desk, Vec<Ticket>) {
    let mut desk = Desk::new(RUN, &limits(), 32);
    (0..3).for_each(|flight| desk.order(order(flight)));
    attach(&mut desk, 0, LIFE, now);
    let tickets = tickets_for(&desk.issue(now), 0, LIFE);
    assert_eq!(tickets.iter().map(|ticket| ticket.flight.0).collect::<Vec<_>>(), [0, 1]);
    (desk, tickets)
}

#[test]
fn credit_bounds_what_is_in_the_air_and_returns_with_each_flight() {
    let now = Instant::now();
    let (mut desk, tickets) = desk(now);
    assert!(desk.issue(now).is_empty());
    assert_eq!(feed(&mut desk, &records(&tickets[0], 0, LIFE), now).len(), 1);
    assert_eq!(tickets_for(&desk.issue(now), 0, LIFE)[0].flight, FlightId(2));
}

#[test]
fn every_actor_gets_its_first_ticket_before_any_its_second() {
    let now = Instant::now();
    let mut desk = Desk::new(RUN, &limits(), 32);
    (0..3).for_each(|flight| desk.order(order(flight)));
    attach(&mut desk, 0, LIFE, now);
    attach(&mut desk, 1, LIFE, now);
    let messages = desk.issue(now);
    assert_eq!(tickets_for(&messages, 0, LIFE).len(), 2);
    assert_eq!(tickets_for(&messages, 1, LIFE)[0].flight, FlightId(1));
}

#[test]
fn a_flight_with_a_hole_is_discarded_whole_and_flown_again() {
    let now = Instant::now();
    let (mut desk, tickets) = desk(now);
    let mut sent = records(&tickets[0], 0, LIFE);
    sent.remove(1);
    assert!(feed(&mut desk, &sent, now).is_empty());
    assert_eq!(desk.faults().reissued(), 1);
    let again = tickets_for(&desk.issue(now), 0, LIFE).remove(0);
    assert_eq!((again.flight, again.attempt), (FlightId(0), Attempt(1)));
    // The actor flies on with what it holds: flight 1, then flight 0 again.
    assert_eq!(
        feed(&mut desk, &records(&tickets[1], 0, LIFE), now)[0].1.flight,
        FlightId(1)
    );
    let flown = feed(&mut desk, &records(&again, 0, LIFE), now);
    assert_eq!(flown[0].1.rewards, [0.0, 1.0]);
}

#[test]
fn tickets_of_a_silent_actor_go_to_another_and_its_late_flight_is_not_taken() {
    let start = Instant::now();
    let (mut desk, tickets) = desk(start);
    let late = start + Duration::from_secs(6);
    attach(&mut desk, 1, LIFE, late);
    desk.on_time(late);
    assert_eq!(desk.actors().count(), 1);
    let again = tickets_for(&desk.issue(late), 1, LIFE);
    assert_eq!(again.iter().map(|ticket| ticket.flight.0).collect::<Vec<_>>(), [0, 1]);
    assert!(feed(&mut desk, &records(&tickets[0], 0, LIFE), late).is_empty());
    attach(&mut desk, 0, LIFE, late);
    assert!(
        feed(&mut desk, &records(&tickets[0], 0, LIFE), late).is_empty(),
        "attempt 0 is void"
    );
    assert_eq!(feed(&mut desk, &records(&again[0], 1, LIFE), late).len(), 1);
}

#[test]
fn a_restarted_actor_owes_nothing_of_its_former_life() {
    let now = Instant::now();
    let (mut desk, tickets) = desk(now);
    let next = Incarnation(101);
    attach(&mut desk, 0, next, now);
    attach(&mut desk, 0, LIFE, now); // a late word of the former life
    let again = tickets_for(&desk.issue(now), 0, next);
    assert_eq!(
        again
            .iter()
            .map(|ticket| (ticket.flight.0, ticket.attempt.0))
            .collect::<Vec<_>>(),
        [(0, 1), (1, 1)]
    );
    assert!(feed(&mut desk, &records(&tickets[0], 0, LIFE), now).is_empty());
    assert_eq!(feed(&mut desk, &records(&again[0], 0, next), now).len(), 1);
}

#[test]
fn a_ticket_that_got_lost_is_issued_again_when_the_next_one_is_flown() {
    let now = Instant::now();
    let (mut desk, tickets) = desk(now);
    assert_eq!(
        feed(&mut desk, &records(&tickets[1], 0, LIFE), now)[0].1.flight,
        FlightId(1)
    );
    assert_eq!(tickets_for(&desk.issue(now), 0, LIFE)[0].attempt, Attempt(1));
}

#[test]
fn a_ticket_that_takes_too_long_is_issued_again_though_its_actor_lives() {
    let start = Instant::now();
    let (mut desk, tickets) = desk(start);
    let mut now = start;
    for _ in 0..16 {
        now += Duration::from_secs(4);
        attach(&mut desk, 0, LIFE, now);
        desk.on_time(now);
    }
    let letters = desk.issue(now);
    assert!(
        letters
            .iter()
            .any(|letter| letter.is_for(ActorId(0), LIFE) && letter.read(RUN) == Ok(Control::Rejoin)),
        "nothing at all came of it: its line is broken"
    );
    assert_eq!(desk.faults().reissued(), 1);
    assert!(feed(&mut desk, &records(&tickets[0], 0, LIFE), now).is_empty());
}

/// Has an actor fail what is its first flight, again and again, by `damage` to its first record, until the desk gives up; at most `most` times.
fn fail_for_ever(
    desk: &mut Desk,
    actor: u32,
    most: usize,
    damage: fn(&mut TransitionRecord),
) -> Result<(), HopelessFlight> {
    let now = Instant::now();
    for _ in 0..most {
        desk.issue(now);
        let issued = desk.actors[&ActorId(actor)].tickets.front();
        let Some(ticket) = issued.map(|issued| issued.ticket().clone()) else {
            return Ok(());
        };
        let mut record = records(&ticket, actor, LIFE)[0];
        damage(&mut record);
        assert!(desk.on_record(&record, now)?.is_none());
    }
    Ok(())
}

const NOT_A_NUMBER: fn(&mut TransitionRecord) = |record| record.reward = f32::NAN;

#[test]
fn a_flight_that_the_only_actor_always_fails_is_given_up_with_the_reason() {
    let now = Instant::now();
    let hopeless = |damage| fail_for_ever(&mut desk(now).0, 0, 9, damage).unwrap_err().to_string();
    let broken_down = hopeless(|record| record.kind = RecordKind::Failed.code());
    assert!(
        broken_down.contains("failed 3 times, at last because the simulator broke down"),
        "{broken_down}"
    );
    assert!(hopeless(NOT_A_NUMBER).contains("reward is not finite"));
}

#[test]
fn an_actor_that_sends_garbage_for_ever_fails_no_run_while_another_flies() {
    let now = Instant::now();
    let mut desk = Desk::new(RUN, &limits(), 32);
    (0..6).for_each(|flight| desk.order(order(flight)));
    attach(&mut desk, 0, LIFE, now);
    desk.issue(now);
    attach(&mut desk, 1, LIFE, now);
    fail_for_ever(&mut desk, 0, 1000, NOT_A_NUMBER).unwrap();
    assert!(
        desk.actors[&ActorId(0)].tickets.is_empty(),
        "others are preferred to it"
    );
    let mut committed = 0;
    while desk.open_orders() > 0 {
        desk.issue(now);
        let ticket = desk.actors[&ActorId(1)].tickets[0].ticket().clone();
        committed += feed(&mut desk, &records(&ticket, 1, LIFE), now).len();
    }
    assert_eq!(committed, 6);
    assert!(desk.faults().refused_by_reason()["not finite"] >= u64::from(MOST_SPOILED));
}

#[test]
fn a_flight_that_two_actors_fail_is_given_up() {
    let now = Instant::now();
    let mut desk = Desk::new(RUN, &limits(), 32);
    desk.order(order(0));
    attach(&mut desk, 0, LIFE, now);
    desk.issue(now);
    attach(&mut desk, 1, LIFE, now);
    fail_for_ever(&mut desk, 0, 1000, NOT_A_NUMBER).unwrap();
    let hopeless = fail_for_ever(&mut desk, 1, 1, NOT_A_NUMBER).unwrap_err();
    assert_eq!(hopeless.flight, FlightId(0));
}

#[test]
fn an_actor_that_may_come_back_is_waited_for_before_a_flight_is_given_up() {
    let start = Instant::now();
    let (mut desk, _) = desk(start);
    attach(&mut desk, 1, LIFE, start);
    let gone = start + Duration::from_secs(6);
    attach(&mut desk, 0, LIFE, gone);
    desk.on_time(gone);
    assert_eq!(desk.actors().collect::<Vec<_>>(), [ActorId(0)]);
    fail_for_ever(&mut desk, 0, 1000, NOT_A_NUMBER).unwrap();
    let later = start + Duration::from_secs(31);
    attach(&mut desk, 0, LIFE, later);
    desk.on_time(later);
    fail_for_ever(&mut desk, 0, 1, NOT_A_NUMBER).unwrap_err();
}

#[test]
fn actors_beyond_the_limit_get_no_tickets_until_there_is_room() {
    let start = Instant::now();
    let mut desk = Desk::new(
        RUN,
        &TransportSection {
            max_actors: 2,
            ..limits()
        },
        32,
    );
    (0..3).for_each(|actor| attach(&mut desk, actor, LIFE, start));
    assert_eq!(desk.actors().count(), 2);
    let later = start + Duration::from_secs(6);
    attach(&mut desk, 1, LIFE, later);
    desk.on_time(later);
    attach(&mut desk, 2, LIFE, later);
    assert_eq!(desk.actors().collect::<Vec<_>>(), [ActorId(1), ActorId(2)]);
}

/// What may happen next to one of three actors.
#[derive(Debug, Clone, Copy)]
enum Event {
    FlyNext,
    LoseRecord(usize),
    RepeatRecord(usize),
    Poison(usize),
    DieMidway,
    SkipTicket,
    Restart,
    Silence,
}

fn event() -> impl Strategy<Value = (u32, Event)> {
    let kind = prop_oneof![
        8 => Just(Event::FlyNext),
        1 => (0..4_usize).prop_map(Event::LoseRecord),
        1 => (0..4_usize).prop_map(Event::RepeatRecord),
        1 => (0..4_usize).prop_map(Event::Poison),
        1 => Just(Event::DieMidway),
        1 => Just(Event::SkipTicket),
        1 => Just(Event::Restart),
        1 => Just(Event::Silence),
    ];
    (0..3_u32, kind)
}

proptest! {
    /// The whole promise, under arbitrary mishaps followed by quiet.
    #[test]
    fn every_order_is_committed_exactly_once_and_whole(events in prop::collection::vec(event(), 0..60)) {
        const ORDERS: u64 = 12;
        let mut now = Instant::now();
        let mut desk = Desk::new(RUN, &limits(), 32);
        (0..ORDERS).for_each(|flight| desk.order(order(flight)));
        let mut lives = [LIFE; 3];
        let mut held: [VecDeque<Ticket>; 3] = Default::default();
        let mut committed: BTreeMap<u64, CommittedFlight> = BTreeMap::new();
        // More than that, and the flight is given up: another test.
        let mut poisonings: BTreeMap<FlightId, usize> = BTreeMap::new();
        let calm = (0..3 * ORDERS as usize).map(|turn| ((turn % 3) as u32, Event::FlyNext));
        let quiet = calm.clone().chain([(0, Event::Silence)]).chain(calm);
        for (actor, event) in events.into_iter().chain(quiet) {
            now += Duration::from_millis(100);
            let index = actor as usize;
            for (other, life) in (0..3).zip(lives) {
                attach(&mut desk, other, life, now);
            }
            let messages = desk.issue(now);
            for other in 0..3 {
                held[other].extend(tickets_for(&messages, other as u32, lives[other]));
            }
            let next = held[index].front().cloned();
            let mut sent = next.map(|ticket| records(&ticket, actor, lives[index])).unwrap_or_default();
            let (mut forget, mut restart) = (true, false);
            match event {
                Event::FlyNext => {}
                Event::LoseRecord(at) if at < sent.len() => drop(sent.remove(at)),
                Event::RepeatRecord(at) if at < sent.len() => sent.insert(at, sent[at]),
                Event::Poison(at) if at < sent.len() => {
                    let poisoned = poisonings.entry(FlightId(sent[at].flight)).or_default();
                    *poisoned += 1;
                    if *poisoned < failures::MOST_FAILURES {
                        sent[at].reward = f32::NAN;
                    }
                }
                Event::DieMidway => {
                    sent.truncate(1);
                    restart = true;
                }
                Event::SkipTicket => sent.clear(),
                Event::Restart => {
                    sent.clear();
                    restart = true;
                }
                Event::Silence => {
                    sent.clear();
                    forget = false;
                    now += Duration::from_secs(6);
                    desk.on_time(now);
                    held.iter_mut().for_each(VecDeque::clear);
                }
                _ => sent.clear(),
            }
            for (place, flight) in feed(&mut desk, &sent, now) {
                prop_assert_eq!(place.index as u64, flight.flight.0);
                prop_assert!(flight.check().is_ok());
                prop_assert_eq!(flight.steps() as u64, 2 + flight.flight.0 % 3);
                prop_assert!(committed.insert(flight.flight.0, flight).is_none(), "committed twice");
            }
            if forget {
                held[index].pop_front();
            }
            if restart {
                lives[index] = Incarnation(lives[index].0 + 1);
                held[index].clear();
            }
        }
        prop_assert_eq!(committed.len() as u64, ORDERS);
        prop_assert_eq!(desk.open_orders(), 0);
    }
}

#[test]
fn the_times_of_all_lives_of_all_actors_are_summed_up_and_none_twice() {
    let now = Instant::now();
    let mut desk = Desk::new(RUN, &limits(), 32);
    let flies = |desk: &mut Desk, actor, life, secs| flown(desk, actor, life, ActorState::Serving, secs, now);
    let physics = |desk: &Desk| desk.actor_times().of(Stage::Physics);
    let next_life = Incarnation(LIFE.0 + 1);
    attach(&mut desk, 0, LIFE, now);
    attach(&mut desk, 1, LIFE, now);
    flies(&mut desk, 0, LIFE, 3);
    flies(&mut desk, 0, LIFE, 5);
    flies(&mut desk, 1, LIFE, 20);
    assert_eq!(physics(&desk).count, 25);
    // The next life counts from nothing; an older one's late word is not believed.
    attach(&mut desk, 0, next_life, now);
    flies(&mut desk, 0, next_life, 100);
    flies(&mut desk, 0, LIFE, 7000);
    assert_eq!(physics(&desk).count, 125);
    // What it says as it leaves is in.
    flown(&mut desk, 0, next_life, ActorState::Leaving, 101, now);
    assert_eq!(physics(&desk).count, 126);
    // Taken for dead, and heard again in the same life.
    let later = now + 2 * Duration::from_secs_f64(limits().actor_silence_secs);
    desk.on_time(later);
    assert_eq!((desk.actors().count(), physics(&desk).count), (0, 126));
    flown(&mut desk, 1, LIFE, ActorState::Serving, 30, later);
    flown(&mut desk, 1, LIFE, ActorState::Serving, 31, later);
    assert_eq!(physics(&desk).count, 127);
    assert_eq!(physics(&desk).nanos, 127_000_000_000);
}
