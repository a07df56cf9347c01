//! An episode in segments continues where it was, whichever actor flies the next segment, or that
//! segment is flown again.

use std::time::{Duration, Instant};

use skein_protocol::MAX_ACTION;
use skein_protocol::segment::Segment;
use skein_protocol::transition::RecordKind;

use super::tests::{INCARNATION, LENGTHS, RUN, attach, feed, limits, order, records, tickets_for};
use super::*;

/// Order of the one-step segment of episode 0 that follows `flown` steps.
fn segment(flown: usize) -> EpisodeOrder {
    let mut order = order(0);
    order.ticket.segment = Some(Segment {
        steps: 1,
        prior_actions: vec![[0.0; MAX_ACTION]; flown].into(),
    });
    order.place.batch = flown as u64;
    order
}

/// Records of `ticket`: a step from `x_m` to one metre further, and the segment's end.
fn flown(ticket: &Ticket, actor: u32, x_m: f32) -> [TransitionRecord; 2] {
    let first = ticket.first_step();
    [0, 1].map(|offset| {
        let mut record = records(ticket, actor, INCARNATION)[0];
        record.step = first + offset;
        record.position_m[0] = x_m + offset as f32;
        if offset == 1 {
            record.kind = RecordKind::SegmentEnd.code();
        }
        record
    })
}

/// Returns a dispatcher whose first segment actor 0 of two has flown, from 0 m to 1 m. The ticket
/// of the second is issued to it.
fn dispatcher(now: Instant) -> (Dispatcher, Ticket) {
    let mut dispatcher = Dispatcher::new(RUN, &limits(), LENGTHS);
    attach(&mut dispatcher, 0, INCARNATION, now);
    attach(&mut dispatcher, 1, INCARNATION, now);
    dispatcher.order(segment(0));
    let first = tickets_for(&dispatcher.issue(now), 0, INCARNATION).remove(0);
    let committed = feed(&mut dispatcher, &flown(&first, 0, 0.0), now);
    assert_eq!((committed.len(), committed[0].1.outcome), (1, None));
    dispatcher.order(segment(1));
    let second = tickets_for(&dispatcher.issue(now), 0, INCARNATION).remove(0);
    (dispatcher, second)
}

#[test]
fn a_segment_of_a_dead_actor_is_flown_by_another_with_all_earlier_actions() {
    let start = Instant::now();
    let (mut dispatcher, _) = dispatcher(start);
    let later = start + Duration::from_secs(6);
    attach(&mut dispatcher, 1, INCARNATION, later);
    dispatcher.on_time(later);
    let again = tickets_for(&dispatcher.issue(later), 1, INCARNATION).remove(0);
    assert_eq!((again.first_step(), again.attempt), (1, Attempt(1)));
    let committed = feed(&mut dispatcher, &flown(&again, 1, 1.0), later);
    let segment = &committed[0].1;
    assert_eq!(
        (segment.first_step, segment.steps(), segment.outcome),
        (1, 1, None)
    );
}

#[test]
fn a_segment_that_begins_elsewhere_than_the_one_before_ended_is_refused() {
    let now = Instant::now();
    let (mut dispatcher, second) = dispatcher(now);
    assert!(feed(&mut dispatcher, &flown(&second, 0, 1.000_001)[..1], now).is_empty());
    assert_eq!(dispatcher.faults().reissued(), 1);
    let again = tickets_for(&dispatcher.issue(now), 0, INCARNATION).remove(0);
    assert_eq!(feed(&mut dispatcher, &flown(&again, 0, 1.0), now).len(), 1);
}

#[test]
fn a_segment_that_no_actor_begins_at_the_right_place_is_given_up_with_the_reason() {
    let now = Instant::now();
    let (mut dispatcher, second) = dispatcher(now);
    let mut issued = Some((0, second));
    let hopeless = loop {
        let (actor, ticket) = issued.expect("it is issued again and again");
        if let Err(hopeless) = dispatcher.on_record(&flown(&ticket, actor, 7.0)[0], now) {
            break hopeless;
        }
        let messages = dispatcher.issue(now);
        issued = (0..2)
            .find_map(|actor| Some((actor, tickets_for(&messages, actor, INCARNATION).pop()?)));
    };
    assert_eq!(hopeless.episode, EpisodeId(0));
    assert!(hopeless.why.contains("does not begin where"), "{hopeless}");
}
