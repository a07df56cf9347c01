//! An actor that waits is woken to what it is given; one that flies is left alone.

use std::collections::VecDeque;
use std::time::Instant;

use proptest::prelude::*;

use super::tests::{
    INCARNATION, RUN, attach, dispatcher, feed, limits, order, records, tickets_for,
};
use super::*;

#[test]
fn an_actor_is_woken_to_a_ticket_unless_it_shows_that_it_flies() {
    let now = Instant::now();
    let (mut dispatcher, tickets) = dispatcher(now);
    assert!(dispatcher.take_wake(), "it had nothing to fly");
    assert!(!dispatcher.take_wake(), "once is enough");

    // It flies 0, and finds 2 before it flies 1 or after.
    feed(&mut dispatcher, &records(&tickets[0], 0, INCARNATION), now);
    let second = tickets_for(&dispatcher.issue(now), 0, INCARNATION).remove(0);
    assert!(!dispatcher.take_wake(), "it flies");

    // It may say this for want of 2, which was on its way.
    attach(&mut dispatcher, 0, INCARNATION, now);
    assert!(dispatcher.take_wake());
    attach(&mut dispatcher, 0, INCARNATION, now);
    assert!(
        !dispatcher.take_wake(),
        "nothing is on its way that was not when it was woken"
    );

    // Nothing that it was given before that word shows that it has heard the word's answer.
    (3..6).for_each(|episode| dispatcher.order(order(episode)));
    feed(&mut dispatcher, &records(&tickets[1], 0, INCARNATION), now);
    let third = tickets_for(&dispatcher.issue(now), 0, INCARNATION).remove(0);
    assert!(dispatcher.take_wake(), "it may wait");
    feed(&mut dispatcher, &records(&second, 0, INCARNATION), now);
    let fourth = tickets_for(&dispatcher.issue(now), 0, INCARNATION).remove(0);
    assert!(dispatcher.take_wake(), "it may wait");
    feed(&mut dispatcher, &records(&third, 0, INCARNATION), now);
    assert_eq!(tickets_for(&dispatcher.issue(now), 0, INCARNATION).len(), 1);
    assert!(!dispatcher.take_wake(), "it flies");
    feed(&mut dispatcher, &records(&fourth, 0, INCARNATION), now);
}

#[test]
fn an_actor_that_is_asked_to_join_anew_is_woken() {
    let now = Instant::now();
    let (mut dispatcher, _) = dispatcher(now);
    dispatcher.take_wake();
    let late = now + Duration::from_secs(61);
    attach(&mut dispatcher, 0, INCARNATION, late);
    dispatcher.take_wake();
    dispatcher.on_time(late);
    dispatcher.issue(late);
    assert!(dispatcher.take_wake());
}

/// Where an actor is between two looks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
enum Stage {
    #[default]
    Looks,
    FoundNothing,
    Waits,
}

/// An actor that looks for tickets before each episode, and speaks and waits when there are none.
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
    dispatcher: Dispatcher,
    actors: Vec<Actor>,
    now: Instant,
}

impl World {
    fn new(episodes: u64) -> Self {
        let mut dispatcher = Dispatcher::new(RUN, &limits(), 32);
        (0..episodes).for_each(|episode| dispatcher.order(order(episode)));
        let mut actors = vec![Actor::default(), Actor::default(), Actor::default()];
        actors.iter_mut().for_each(|actor| actor.words = 1);
        Self {
            dispatcher,
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
                    actor.sent.extend(records(&ticket, id as u32, INCARNATION));
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

    /// A round of the learner, which takes in at most `most` records of each actor; whether there
    /// were any.
    fn learner_goes_on(&mut self, most: usize) -> bool {
        let mut has_heard = false;
        for (id, actor) in self.actors.iter_mut().enumerate() {
            for _ in 0..std::mem::take(&mut actor.words) {
                attach(&mut self.dispatcher, id as u32, INCARNATION, self.now);
                has_heard = true;
            }
        }
        for id in 0..self.actors.len() {
            let waiting = &mut self.actors[id].sent;
            let taken: Vec<_> = waiting.drain(..most.min(waiting.len())).collect();
            has_heard |= !taken.is_empty();
            for record in taken {
                if !feed(&mut self.dispatcher, &[record], self.now).is_empty() {
                    self.hand_out();
                }
            }
        }
        self.hand_out();
        if self.dispatcher.take_wake() {
            self.actors
                .iter_mut()
                .for_each(|actor| actor.is_called = true);
        }
        has_heard
    }

    fn hand_out(&mut self) {
        let messages = self.dispatcher.issue(self.now);
        for (id, actor) in self.actors.iter_mut().enumerate() {
            actor
                .told
                .extend(tickets_for(&messages, id as u32, INCARNATION));
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
        prop_assert_eq!(world.dispatcher.open_orders(), 0);
    }
}
