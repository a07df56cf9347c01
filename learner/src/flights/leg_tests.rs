//! A flight in legs goes on where it was, whoever flies the next one, or that leg is flown again.

use std::time::{Duration, Instant};

use skein_protocol::leg::Leg;
use skein_protocol::transition::RecordKind;

use super::tests::{LIFE, RUN, attach, feed, limits, order, records, tickets_for};
use super::*;

/// The order of the leg of flight 0 that follows `flown` steps, one step long.
fn leg(flown: usize) -> Order {
    let mut order = order(0);
    order.ticket.leg = Some(Leg {
        steps: 1,
        flown: vec![[0.0, 0.0]; flown].into(),
    });
    order.place.batch = flown as u64;
    order
}

/// What an actor sends of `ticket`: a step from where the vehicle is at `x_m` to a metre behind, and the leg's end.
fn flown(ticket: &Ticket, actor: u32, x_m: f32) -> [TransitionRecord; 2] {
    let first = ticket.first_step();
    [0, 1].map(|offset| {
        let mut record = records(ticket, actor, LIFE)[0];
        record.step = first + offset;
        record.position_m[0] = x_m + offset as f32;
        if offset == 1 {
            record.kind = RecordKind::LegEnd.code();
        }
        record
    })
}

/// A desk whose first leg was flown by actor 0 of two, from 0 m to 1 m, and whose second is given to it.
fn desk(now: Instant) -> (Desk, Ticket) {
    let mut desk = Desk::new(RUN, &limits(), 32);
    attach(&mut desk, 0, LIFE, now);
    attach(&mut desk, 1, LIFE, now);
    desk.order(leg(0));
    let first = tickets_for(&desk.issue(now), 0, LIFE).remove(0);
    let committed = feed(&mut desk, &flown(&first, 0, 0.0), now);
    assert_eq!((committed.len(), committed[0].1.outcome), (1, None));
    desk.order(leg(1));
    let second = tickets_for(&desk.issue(now), 0, LIFE).remove(0);
    (desk, second)
}

#[test]
fn a_leg_of_an_actor_that_died_is_flown_by_another_with_all_that_was_flown_before() {
    let start = Instant::now();
    let (mut desk, _) = desk(start);
    let later = start + Duration::from_secs(6);
    attach(&mut desk, 1, LIFE, later);
    desk.on_time(later);
    let again = tickets_for(&desk.issue(later), 1, LIFE).remove(0);
    assert_eq!((again.first_step(), again.attempt), (1, Attempt(1)));
    let committed = feed(&mut desk, &flown(&again, 1, 1.0), later);
    let leg = &committed[0].1;
    assert_eq!((leg.first_step, leg.steps(), leg.outcome), (1, 1, None));
}

#[test]
fn a_leg_that_begins_elsewhere_than_the_one_before_ended_is_refused() {
    let now = Instant::now();
    let (mut desk, second) = desk(now);
    assert!(feed(&mut desk, &flown(&second, 0, 1.000_001)[..1], now).is_empty());
    assert_eq!(desk.faults().reissued(), 1);
    let again = tickets_for(&desk.issue(now), 0, LIFE).remove(0);
    assert_eq!(feed(&mut desk, &flown(&again, 0, 1.0), now).len(), 1);
}

#[test]
fn a_leg_that_no_actor_begins_where_it_must_is_given_up_with_the_reason() {
    let now = Instant::now();
    let (mut desk, second) = desk(now);
    let mut issued = Some((0, second));
    let hopeless = loop {
        let (actor, ticket) = issued.expect("it is issued again and again");
        if let Err(hopeless) = desk.on_record(&flown(&ticket, actor, 7.0)[0], now) {
            break hopeless;
        }
        let messages = desk.issue(now);
        issued = (0..2).find_map(|actor| Some((actor, tickets_for(&messages, actor, LIFE).pop()?)));
    };
    assert_eq!(hopeless.flight, FlightId(0));
    assert!(hopeless.why.contains("does not begin where"), "{hopeless}");
}
