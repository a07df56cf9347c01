//! The mishaps, and their end.

use skein_protocol::status::{ActorState, StatusRecord};

use super::{Event, World};
use crate::weather::{Mishap, SECOND};

impl World<'_> {
    pub(super) fn strike(&mut self) {
        if !self.is_stormy {
            return;
        }
        let delay = self.dice.between(1, 2 * self.weather.between_mishaps);
        self.schedule(delay, Event::Strike);
        if self.weather.mishaps.is_empty() {
            return;
        }
        let mishap = self.dice.pick(&self.weather.mishaps);
        let actor = self.dice.below(self.actors.len() as u64) as usize;
        let host = self.actors[actor].host;
        // Often short, sometimes longer than any deadline.
        let longest = self
            .dice
            .pick(&[SECOND / 10, SECOND, 4 * SECOND, 12 * SECOND]);
        let time = self.dice.between(1, longest);
        self.note(mishap.name(), [actor as u64, host as u64, time]);
        match mishap {
            Mishap::KillActor => self.kill_actor(actor),
            Mishap::FreezeActor => self.actors[actor].frozen_until = self.now + time,
            Mishap::MuteActor => self.actors[actor].muted_until = self.now + time,
            Mishap::PoisonRecord => self.actors[actor].is_poisoned = true,
            Mishap::TurnClockBack => self.actors[actor].behind += time,
            Mishap::KillLearner => self.kill_learner(),
            Mishap::FreezeLearner => self.learner.frozen_until = self.now + time,
            Mishap::DieWriting => {
                let operations = self.dice.between(1, 40);
                self.shape.disk.arm(operations as u32);
            }
            Mishap::BreakPorts => {
                if let Some(learner) = &self.learner.process {
                    learner.ports.break_down();
                    self.schedule(time, Event::MendPorts);
                }
            }
            Mishap::FillDisk => {
                let operations = self.dice.between(1, 40);
                self.shape.disk.fill(operations as u32);
                self.schedule(time, Event::MakeRoom);
            }
            Mishap::CutPower => self.cut_power(),
            Mishap::CutLink => self.cut_link(host, time),
        }
    }

    pub(super) fn kill_actor(&mut self, actor: usize) {
        if self.actors[actor].process.take().is_some() {
            self.restart_actor(actor);
        }
    }

    pub(super) fn cut_power(&mut self) {
        self.kill_learner();
        for actor in 0..self.actors.len() {
            if self.actors[actor].host == 0 {
                self.kill_actor(actor);
            }
        }
        self.shape.disk.cut_power(&mut self.dice);
    }

    /// Cuts the link to a far host: the learner is gone there, and its actors are gone here.
    pub(super) fn cut_link(&mut self, host: usize, time: u64) {
        if host == 0 || std::mem::replace(&mut self.is_cut[host], true) {
            return;
        }
        self.lives[host] = None;
        for actor in 0..self.actors.len() {
            let slot = &self.actors[actor];
            let process = slot.process.as_ref().filter(|_| slot.host == host);
            let status = process.and_then(|process| process.status(ActorState::Leaving));
            // The near end says so, or falls silent too.
            if let Some(status) = status.filter(|_| self.dice.chance(500)) {
                let delay = self.dice.between(1, 3 * SECOND);
                self.schedule(
                    delay,
                    Event::NoticeCut {
                        actor,
                        status: Box::new(status),
                    },
                );
            }
        }
        self.schedule(time, Event::Heal(host));
    }

    pub(super) fn notice_cut(&mut self, actor: usize, status: StatusRecord) {
        self.note("cut is noticed", [actor as u64, 0, 0]);
        if let Some(learner) = &self.learner.process {
            learner.ports.deliver_status(status);
            self.wake_server();
        }
    }

    pub(super) fn heal(&mut self, host: usize) {
        if std::mem::take(&mut self.is_cut[host]) {
            self.note("link heals", [host as u64, 0, 0]);
            self.begin_life(host);
        }
    }

    pub(super) fn mend_ports(&mut self) {
        if let Some(learner) = &self.learner.process {
            learner.ports.mend();
            self.wake_server();
        }
    }

    /// From here on nothing happens that the run could not survive.
    pub(super) fn end_storm(&mut self) {
        self.note("storm ends", [0, 0, 0]);
        self.is_stormy = false;
        if self.learner.process.is_some() {
            self.shape.disk.revive();
        }
        self.shape.disk.make_room();
        self.mend_ports();
        for host in 0..self.lives.len() {
            self.heal(host);
        }
        for slot in &mut self.actors {
            (slot.muted_until, slot.is_poisoned) = (0, false);
        }
    }
}
