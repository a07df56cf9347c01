//! The learner's process and its three threads.

use skein_learner::episodes::ReceiverError;
use skein_learner::episodes::server::Next;

use super::{Content, Due, Event, World};
use crate::actor::ActorProcess;
use crate::learner::{LearnerProcess, Then, Trouble};
use crate::weather::{MILLISECOND, SECOND};
use crate::wire::Sent;

/// Snapshots that an actor gets when it connects.
const HISTORY: usize = 4;
/// Time until a full disk is tried again.
const DISK_PAUSE: u64 = SECOND;

impl World<'_> {
    pub(super) fn start_learner(&mut self) {
        if self.learner.process.is_some() {
            return;
        }
        self.note("learner starts", [0, 0, 0]);
        self.shape.disk.revive();
        self.learner.process = Some(LearnerProcess::start(self.shape, self.mutant));
        self.learner.frozen_until = 0;
        self.learner.history.clear();
        for host in 0..self.lives.len() {
            self.begin_life(host);
        }
        self.server_due(0);
        self.training_due(0);
    }

    /// Lets the learner appear on `host`, if it can.
    pub(super) fn begin_life(&mut self, host: usize) {
        if self.learner.process.is_some() && !self.is_cut[host] {
            self.newest_life += 1;
            self.lives[host] = Some(self.newest_life);
        }
    }

    pub(super) fn server_due(&mut self, delay: u64) {
        let number = self.numbers + 1;
        let at = self.now + delay;
        self.learner.server = Due { number, at };
        self.schedule(delay, Event::Server { number });
    }

    /// Lets the receiving thread do a round soon.
    pub(super) fn wake_server(&mut self) {
        let delay = self.dice.between(1, MILLISECOND);
        if self.learner.server.at > self.now + delay {
            self.server_due(delay);
        }
    }

    pub(super) fn training_due(&mut self, delay: u64) {
        let number = self.numbers + 1;
        let at = self.now + delay;
        self.learner.training = Due { number, at };
        self.schedule(delay, Event::Training { number });
    }

    /// Lets the training thread look again soon.
    pub(super) fn wake_training(&mut self) {
        let delay = self.dice.between(1, MILLISECOND);
        if self.learner.training.at > self.now + delay {
            self.training_due(delay);
        }
    }

    pub(super) fn writer_due(&mut self, delay: u64) {
        let number = self.numbers + 1;
        let at = self.now + delay;
        self.learner.writer = Due { number, at };
        self.schedule(delay, Event::Writer { number });
    }

    pub(super) fn serve(&mut self, number: u64) {
        if self.learner.server.number != number {
            return;
        }
        if self.learner.frozen_until > self.now {
            self.server_due(self.learner.frozen_until - self.now);
            return;
        }
        let now = self.instant();
        let Some(learner) = &mut self.learner.process else {
            return;
        };
        let next = learner.server.round(now);
        let sent = learner.ports.take_sent();
        for sent in sent {
            self.carry(sent);
        }
        match next {
            Ok(Next::AtOnce) => self.server_due(1),
            Ok(Next::Wait(patience)) => self.server_due(patience.as_nanos() as u64),
            Ok(Next::End) => {}
            Err(error) => self.learner_fails(Trouble::Receiver(error)),
        }
        if self.learner.training.at == u64::MAX {
            self.wake_training();
        }
    }

    /// Carries what the learner sent to the actors.
    pub(super) fn carry(&mut self, sent: Sent) {
        let content = match sent {
            Sent::Connect => {
                self.connect();
                return;
            }
            Sent::Message(message) => Content::Message(message),
            Sent::Wake => Content::Wake,
            Sent::Snapshot(snapshot) => {
                let history = &mut self.learner.history;
                history.push(snapshot.clone());
                if history.len() > HISTORY {
                    history.remove(0);
                }
                Content::Snapshot(snapshot)
            }
        };
        for actor in 0..self.actors.len() {
            let slot = &mut self.actors[actor];
            let joined = slot.process.as_mut().and_then(ActorProcess::joined_mut);
            let Some(joined) = joined.filter(|joined| joined.is_connected) else {
                continue;
            };
            if self.lives[slot.host] == Some(joined.life) {
                let (session, life) = (joined.incarnation(), joined.life);
                self.send(actor, session, life, content.clone());
            }
        }
    }

    /// Connects the learner to the actors that have joined it.
    pub(super) fn connect(&mut self) {
        for actor in 0..self.actors.len() {
            let slot = &mut self.actors[actor];
            let life = self.lives[slot.host];
            let joined = slot.process.as_mut().and_then(ActorProcess::joined_mut);
            let Some(joined) = joined.filter(|joined| Some(joined.life) == life) else {
                continue;
            };
            if !std::mem::replace(&mut joined.is_connected, true) {
                let (session, life) = (joined.incarnation(), joined.life);
                for snapshot in self.learner.history.clone() {
                    self.send(actor, session, life, Content::Snapshot(snapshot));
                }
            }
        }
    }

    pub(super) fn train(&mut self, number: u64) {
        if self.learner.training.number != number {
            return;
        }
        if self.learner.frozen_until > self.now {
            self.training_due(self.learner.frozen_until - self.now);
            return;
        }
        let Some(learner) = &mut self.learner.process else {
            return;
        };
        let was_busy = learner.writer.is_busy();
        let then = learner.training.step(&mut learner.writer);
        if !was_busy && learner.writer.is_busy() {
            let delay = self.dice.between(1, 200 * MILLISECOND);
            self.writer_due(delay);
        }
        match then {
            Ok(Then::GoOn) => {
                self.wake_server();
                let delay = self.dice.between(1, 5 * MILLISECOND);
                self.training_due(delay);
            }
            Ok(Then::Update) => {
                let longest = self.dice.pick(&[1, 50, 50, 1500]) * MILLISECOND;
                let delay = self.dice.between(1, longest);
                self.note("training updates", [delay, 0, 0]);
                self.training_due(delay);
            }
            Ok(Then::Wait) => self.learner.training.at = u64::MAX,
            Ok(Then::Retry) => self.training_due(DISK_PAUSE),
            Ok(Then::End) => {
                self.note("run is complete", [0, 0, 0]);
                self.is_complete = true;
            }
            Err(trouble) => self.learner_fails(trouble),
        }
    }

    pub(super) fn write(&mut self, number: u64) {
        if self.learner.writer.number != number {
            return;
        }
        if self.learner.frozen_until > self.now {
            self.writer_due(self.learner.frozen_until - self.now);
            return;
        }
        let Some(learner) = &mut self.learner.process else {
            return;
        };
        match learner.writer.step() {
            Ok(true) => {
                self.note("checkpoint is written", [0, 0, 0]);
                self.wake_training();
            }
            Ok(false) => self.writer_due(DISK_PAUSE),
            Err(trouble) => self.learner_fails(trouble),
        }
    }

    pub(super) fn learner_fails(&mut self, trouble: Trouble) {
        match trouble {
            Trouble::Dead | Trouble::Receiver(ReceiverError::Transport(_)) => self.kill_learner(),
            Trouble::Receiver(error) => self.fail(error.to_string()),
            Trouble::Broken(what) => self.fail(what),
        }
    }

    /// Adds the faults of the present learner to those of its predecessors.
    pub(super) fn count_faults(&mut self) {
        if let Some(learner) = &self.learner.process {
            let faults = learner.training.faults();
            let (reissued, refused) = (faults.reissued_by_reason(), faults.refused_by_reason());
            for (reason, count) in reissued.into_iter().chain(refused) {
                *self.faults.entry(reason).or_default() += count;
            }
        }
    }

    pub(super) fn kill_learner(&mut self) {
        self.count_faults();
        if self.learner.process.take().is_none() {
            return;
        }
        self.note("learner dies", [0, 0, 0]);
        self.lives.fill(None);
        let delay = self.dice.between(1, 4 * SECOND);
        self.schedule(delay, Event::StartLearner);
    }
}
