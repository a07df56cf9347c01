//! The links between learner and actors.

use skein_protocol::ids::ActorIncarnation;

use super::{Arrival, Content, Event, World};
use crate::actor::ActorProcess;
use crate::weather::SECOND;

impl World<'_> {
    /// Sends `content` between the session of an actor and the life of the learner that it joined.
    pub(super) fn send(
        &mut self,
        actor: usize,
        session: ActorIncarnation,
        life: u64,
        content: Content,
    ) {
        let slot = &self.actors[actor];
        let is_wake = matches!(content, Content::Wake);
        let mut link = self.weather.links[slot.host];
        if !self.is_stormy {
            (link.lost, link.doubled, link.reordered, link.late) = (0, 0, 0, 0);
        }
        let is_muted = slot.muted_until > self.now && matches!(content, Content::Record(_));
        if is_muted || self.dice.chance(link.lost) {
            return;
        }
        let copies = 1 + u64::from(self.dice.chance(link.doubled));
        for _ in 0..copies {
            let mut at = self.now + self.dice.between(1, link.latency);
            if self.dice.chance(link.late) {
                at += self.dice.between(1, 6 * SECOND);
            }
            let last = &mut self.actors[actor].last_arrivals[content.channel()];
            if !self.dice.chance(link.reordered) && !is_wake {
                at = at.max(*last);
                *last = at;
            }
            let arrival = Arrival {
                actor,
                session,
                life,
                content: content.clone(),
            };
            self.schedule(at - self.now, Event::Arrival(Box::new(arrival)));
        }
    }

    pub(super) fn arrive(&mut self, arrival: Arrival) {
        let Arrival {
            actor,
            session,
            life,
            content,
        } = arrival;
        let [first, second] = content.numbers();
        self.note(content.name(), [actor as u64, first, second]);
        // Shared memory of a dead learner is never used again. A link may be worse.
        let is_stale_taken = self.dice.chance(self.weather.stale);
        let slot = &mut self.actors[actor];
        let is_present = self.lives[slot.host] == Some(life);
        match content {
            Content::Status(_) | Content::Record(_) if !is_present && !is_stale_taken => {}
            Content::Status(status) => {
                if let Some(learner) = &self.learner.process {
                    learner.ports.deliver_status(status);
                    self.wake_server();
                }
            }
            Content::Record(record) => {
                if let Some(learner) = &self.learner.process {
                    learner.ports.deliver_record(record);
                    self.wake_server();
                }
            }
            Content::Message(_) | Content::Snapshot(_) | Content::Wake => {
                let joined = slot.process.as_mut().and_then(ActorProcess::joined_mut);
                let Some(joined) = joined.filter(|joined| {
                    is_stale_taken || (joined.life == life && joined.incarnation() == session)
                }) else {
                    return;
                };
                match content {
                    Content::Message(message) => joined.deliver_message(message),
                    Content::Snapshot(snapshot) => joined.deliver_snapshot(snapshot),
                    _ if joined.wake() => self.actor_due(actor, 1),
                    _ => {}
                }
            }
        }
    }
}
