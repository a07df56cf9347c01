//! An actor that waits is woken to what it is given; one that flies is left alone.

use std::collections::VecDeque;
use std::time::Instant;

use proptest::prelude::*;

use super::tests::{LIFE, RUN, attach, desk, feed, limits, order, records, tickets_for};
use super::*;

#[test]
fn an_actor_is_woken_to_a_ticket_unless_it_shows_that_it_flies() {
    let now = Instant::now();
    let (mut desk, tickets) = desk(now);
    assert!(desk.take_wake(), "it had nothing to fly");
    assert!(!desk.take_wake(), "once is enough");

    // It flies 0, and finds 2 before it flies 1 or after.
    feed(&mut desk, &records(&tickets[0], 0, LIFE), now);
    let second = tickets_for(&desk.issue(now), 0, LIFE).remove(0);
    assert!(!desk.take_wake(), "it flies");

    // It may say this for want of 2, which was on its way.
    attach(&mut desk, 0, LIFE, now);
    assert!(desk.take_wake());
    attach(&mut desk, 0, LIFE, now);
    assert!(
        !desk.take_wake(),
        "nothing is on its way that was not when it was woken"
    );

    // Nothing that it was given before that word shows that it has heard the word's answer.
    (3..6).for_each(|flight| desk.order(order(flight)));
    feed(&mut desk, &records(&tickets[1], 0, LIFE), now);
    let third = tickets_for(&desk.issue(now), 0, LIFE).remove(0);
    assert!(desk.take_wake(), "it may wait");
    feed(&mut desk, &records(&second, 0, LIFE), now);
    let fourth = tickets_for(&desk.issue(now), 0, LIFE).remove(0);
    assert!(desk.take_wake(), "it may wait");
    feed(&mut desk, &records(&third, 0, LIFE), now);
    assert_eq!(tickets_for(&desk.issue(now), 0, LIFE).len(), 1);
    assert!(!desk.take_wake(), "it flies");
    feed(&mut desk, &records(&fourth, 0, LIFE), now);
}

#[test]
fn an_actor_that_is_asked_to_join_anew_is_woken() {
    let now = Instant::now();
    let (mut desk, _) = desk(now);
    desk.take_wake();
    let late = now + Duration::from_secs(61);
    attach(&mut desk, 0, LIFE, late);
    desk.take_wake();
    desk.on_time(late);
    desk.issue(late);
    assert!(desk.take_wake());
}

/// Where an actor is between two looks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
enum Stage {
    #[default]
    Looks,
    FoundNothing,
    Waits,
}

/// An actor that looks for tickets before each flight, and speaks and waits when there are none.
#[derive(Default)]
struct Actor {
    stage: Stage,
    told: VecDeque<Ticket>,
    /// A call stays until it is heard.
    is_called: bool,
    /// What the learner has not taken in: words and records go different ways.
    words: usize,
    sent: VecDeque<TransitionRecord>,
}

struct World {
    desk: Desk,
    actors: Vec<Actor>,
    now: Instant,
}

impl World {
    fn new(flights: u64) -> Self {
        let mut desk = Desk::new(RUN, &limits(), 32);
        (0..flights).for_each(|flight| desk.order(order(flight)));
        let mut actors = vec![Actor::default(), Actor::default(), Actor::default()];
        actors.iter_mut().for_each(|actor| actor.words = 1);
        Self {
            desk,
            actors,
            now: Instant::now(),
        }
    }

    /// Actor `id` does the next thing it does; whether there was anything.
    fn actor_goes_on(&mut self, id: usize) -> bool {
        let actor = &mut self.actors[id];
        actor.stage = match actor.stage {
            Stage::Looks => match actor.told.pop_front() {
                Some(ticket) => {
                    actor.sent.extend(records(&ticket, id as u32, LIFE));
                    Stage::Looks
                }
                None => Stage::FoundNothing,
            },
            Stage::FoundNothing => {
                actor.words += 1;
                Stage::Waits
            }
            Stage::Waits if std::mem::take(&mut actor.is_called) => Stage::Looks,
            Stage::Waits => return false,
        };
        true
    }

    /// A round of the learner, which takes in at most `most` records of each actor; whether there were any.
    fn learner_goes_on(&mut self, most: usize) -> bool {
        let mut has_heard = false;
        for (id, actor) in self.actors.iter_mut().enumerate() {
            for _ in 0..std::mem::take(&mut actor.words) {
                attach(&mut self.desk, id as u32, LIFE, self.now);
                has_heard = true;
            }
        }
        for id in 0..self.actors.len() {
            let waiting = &mut self.actors[id].sent;
            let taken: Vec<_> = waiting.drain(..most.min(waiting.len())).collect();
            has_heard |= !taken.is_empty();
            for record in taken {
                if !feed(&mut self.desk, &[record], self.now).is_empty() {
                    self.hand_out();
                }
            }
        }
        self.hand_out();
        if self.desk.take_wake() {
            self.actors.iter_mut().for_each(|actor| actor.is_called = true);
        }
        has_heard
    }

    fn hand_out(&mut self) {
        let messages = self.desk.issue(self.now);
        for (id, actor) in self.actors.iter_mut().enumerate() {
            actor.told.extend(tickets_for(&messages, id as u32, LIFE));
        }
    }
}

proptest! {
    #[test]
    fn nobody_sleeps_through_a_ticket(steps in prop::collection::vec((0..4_usize, 0..9_usize), 0..300)) {
        let mut world = World::new(60);
        for (who, most) in steps {
            if who < world.actors.len() {
                world.actor_goes_on(who);
            } else {
                world.learner_goes_on(most);
            }
        }
        // To the end; whoever waits uncalled stays where it is.
        loop {
            let actors = (0..world.actors.len()).filter(|&id| world.actor_goes_on(id)).count();
            if actors == 0 && !world.learner_goes_on(usize::MAX) {
                break;
            }
        }
        prop_assert_eq!(world.desk.open_orders(), 0);
    }
}
