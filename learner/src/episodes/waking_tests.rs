//! An actor that waits is woken for a new ticket; one that flies is not.

use std::collections::VecDeque;
use std::time::Instant;

use proptest::prelude::*;

use super::tests::{
    INCARNATION, LENGTHS, RUN, attach, dispatcher, feed, limits, order, records, tickets_for,
};
use super::*;

#[test]
fn an_actor_is_woken_for_a_ticket_unless_its_records_show_that_it_flies() {
    let now = Instant::now();
    let (mut dispatcher, tickets) = dispatcher(now);
    assert!(dispatcher.take_wake(), "it had nothing to fly");
    assert!(!dispatcher.take_wake(), "once is enough");

    // It flies 0, and finds 2 before it flies 1 or afterwards.
    feed(&mut dispatcher, &records(&tickets[0], 0, INCARNATION), now);
    let second = tickets_for(&dispatcher.issue(now), 0, INCARNATION).remove(0);
    assert!(!dispatcher.take_wake(), "it flies");

    // It may send this for lack of 2, which was on its way.
    attach(&mut dispatcher, 0, INCARNATION, now);
    assert!(dispatcher.take_wake());
    attach(&mut dispatcher, 0, INCARNATION, now);
    assert!(
        !dispatcher.take_wake(),
        "nothing is on its way that was not when it was woken"
    );

    // A ticket from before that heartbeat does not show that the actor has seen the later one.
    (3..6).for_each(|episode| dispatcher.order(order(episode)));
    feed(&mut dispatcher, &records(&tickets[1], 0, INCARNATION), now);
    let third = tickets_for(&dispatcher.issue(now), 0, INCARNATION).remove(0);
    assert!(dispatcher.take_wake(), "it may be waiting");
    feed(&mut dispatcher, &records(&second, 0, INCARNATION), now);
    let fourth = tickets_for(&dispatcher.issue(now), 0, INCARNATION).remove(0);
    assert!(dispatcher.take_wake(), "it may be waiting");
    feed(&mut dispatcher, &records(&third, 0, INCARNATION), now);
    assert_eq!(tickets_for(&dispatcher.issue(now), 0, INCARNATION).len(), 1);
    assert!(!dispatcher.take_wake(), "it flies");
    feed(&mut dispatcher, &records(&fourth, 0, INCARNATION), now);
}

#[test]
fn an_actor_that_is_asked_to_rejoin_is_woken() {
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

/// State of an actor between two looks for tickets.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
enum LookState {
    #[default]
    Looks,
    FoundNothing,
    Waits,
}

/// An actor that looks for tickets before each episode. Without a ticket, it sends a heartbeat and
/// waits.
#[derive(Default)]
struct SimulatedActor {
    stage: LookState,
    tickets: VecDeque<Ticket>,
    /// Stays set until the actor looks.
    is_called: bool,
    /// Heartbeats that the learner has not taken in; they travel apart from records.
    heartbeats: usize,
    sent: VecDeque<TransitionRecord>,
}

struct Simulation {
    dispatcher: Dispatcher,
    actors: Vec<SimulatedActor>,
    now: Instant,
}

impl Simulation {
    fn new(episodes: u64) -> Self {
        let mut dispatcher = Dispatcher::new(RUN, &limits(), LENGTHS);
        (0..episodes).for_each(|episode| dispatcher.order(order(episode)));
        let mut actors = vec![
            SimulatedActor::default(),
            SimulatedActor::default(),
            SimulatedActor::default(),
        ];
        actors.iter_mut().for_each(|actor| actor.heartbeats = 1);
        Self {
            dispatcher,
            actors,
            now: Instant::now(),
        }
    }

    /// Lets actor `id` do its next action; returns `true` if there was one.
    fn actor_acts(&mut self, id: usize) -> bool {
        let actor = &mut self.actors[id];
        actor.stage = match actor.stage {
            LookState::Looks => match actor.tickets.pop_front() {
                Some(ticket) => {
                    actor.sent.extend(records(&ticket, id as u32, INCARNATION));
                    LookState::Looks
                }
                None => LookState::FoundNothing,
            },
            LookState::FoundNothing => {
                actor.heartbeats += 1;
                LookState::Waits
            }
            LookState::Waits if std::mem::take(&mut actor.is_called) => LookState::Looks,
            LookState::Waits => return false,
        };
        true
    }

    /// Lets the learner do a round, which takes in at most `most` records per actor; returns `true`
    /// if anything arrived.
    fn learner_acts(&mut self, most: usize) -> bool {
        let mut has_heard = false;
        for (id, actor) in self.actors.iter_mut().enumerate() {
            for _ in 0..std::mem::take(&mut actor.heartbeats) {
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
                .tickets
                .extend(tickets_for(&messages, id as u32, INCARNATION));
        }
    }
}

proptest! {
    #[test]
    fn no_actor_sleeps_through_a_ticket(
        steps in prop::collection::vec((0..4_usize, 0..9_usize), 0..300),
    ) {
        let mut simulation = Simulation::new(60);
        for (who, most) in steps {
            if who < simulation.actors.len() {
                simulation.actor_acts(who);
            } else {
                simulation.learner_acts(most);
            }
        }
        // To the end; an actor that waits without being woken stays where it is.
        loop {
            let ids = 0..simulation.actors.len();
            let actors = ids.filter(|&id| simulation.actor_acts(id)).count();
            if actors == 0 && !simulation.learner_acts(usize::MAX) {
                break;
            }
        }
        prop_assert_eq!(simulation.dispatcher.open_orders(), 0);
    }
}
