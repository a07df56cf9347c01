//! The actors' processes.

use std::rc::Rc;

use skein_protocol::ids::ActorId;
use skein_protocol::transition::TransitionRecord;

use super::{Content, Due, Event, World};
use crate::actor::{ActorProcess, Deed, Then};
use crate::weather::{MILLISECOND, SECOND};

/// Poisoned records of an episode, below the number at which it is given up.
const MOST_POISONED: u32 = 2;

impl World<'_> {
    pub(super) fn start_actor(&mut self, actor: usize) {
        if self.actors[actor].process.is_some() {
            return;
        }
        self.note("actor starts", [actor as u64, 0, 0]);
        let process = ActorProcess::start(ActorId(actor as u32), self.mutant, self.instant());
        self.actors[actor].process = Some(process);
        self.actors[actor].frozen_until = 0;
        self.actor_due(actor, 0);
    }

    /// Lets an actor do its next operation after `delay`, in place of any planned one.
    pub(super) fn actor_due(&mut self, actor: usize, delay: u64) {
        let number = self.numbers + 1;
        let at = self.now + delay;
        self.actors[actor].due = Due { number, at };
        self.schedule(delay, Event::Actor { actor, number });
    }

    pub(super) fn act(&mut self, actor: usize, number: u64) {
        let now = self.instant();
        let slot = &mut self.actors[actor];
        if slot.due.number != number {
            return;
        }
        if slot.frozen_until > self.now {
            let delay = slot.frozen_until - self.now;
            self.actor_due(actor, delay);
            return;
        }
        let Some(process) = &mut slot.process else {
            return;
        };
        let mut deeds = Vec::new();
        let life = self.lives[slot.host];
        // Nanoseconds since 1970: never near 0.
        let clock = self.now + 3600 * SECOND - slot.behind;
        // What is sent before an exit is of the session that ends.
        let former = process.session();
        let former_life = process.joined_mut().map(|joined| joined.life);
        let then = process.act(&self.shape.config, life, clock, now, &mut deeds);
        let session = former.or(process.session());
        let life = former_life.or_else(|| process.joined_mut().map(|joined| joined.life));
        if let (Some((_, session)), Some(life)) = (session, life) {
            for deed in deeds {
                let content = match deed {
                    Deed::Report(status) => Content::Status(status),
                    Deed::Send(record) => Content::Record(self.poisoned(actor, record)),
                };
                self.send(actor, session, life, content);
            }
        }
        match then {
            Then::Fly => {
                let delay = self.dice.between(MILLISECOND, self.weather.longest_step);
                self.actor_due(actor, delay);
            }
            Then::GoOn => {
                let delay = self.dice.between(1, MILLISECOND);
                self.actor_due(actor, delay);
            }
            Then::Wait(patience) => self.actor_due(actor, patience.as_nanos() as u64 + 1),
            Then::Exit => {
                self.note("actor exits", [actor as u64, 0, 0]);
                self.actors[actor].process = None;
                self.restart_actor(actor);
            }
        }
    }

    /// Returns `record`, spoilt if its time has come.
    pub(super) fn poisoned(
        &mut self,
        actor: usize,
        mut record: Rc<TransitionRecord>,
    ) -> Rc<TransitionRecord> {
        if !std::mem::take(&mut self.actors[actor].is_poisoned) {
            return record;
        }
        let times = self.poisoned.entry(record.episode).or_default();
        if *times < MOST_POISONED {
            *times += 1;
            Rc::make_mut(&mut record).reward = f32::NAN;
        }
        record
    }

    pub(super) fn restart_actor(&mut self, actor: usize) {
        let delay = self.dice.between(SECOND / 4, 4 * SECOND);
        self.schedule(delay, Event::StartActor(actor));
    }
}
