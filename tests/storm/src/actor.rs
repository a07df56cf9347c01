//! An actor process: joins a learner, and flies tickets as `skein_actor::service` does, one
//! operation at a time.

use std::collections::{BTreeMap, VecDeque};
use std::rc::Rc;
use std::time::{Duration, Instant};

use skein_actor::session::{DisconnectReason, Session};
use skein_protocol::config::Config;
use skein_protocol::ids::{ActorId, ActorIncarnation, PolicyVersion};
use skein_protocol::snapshot::Snapshot;
use skein_protocol::stages::StageTimes;
use skein_protocol::status::{ActorState, ActorStatus, StatusRecord};
use skein_protocol::ticket::{ControlMessage, Ticket};
use skein_protocol::transition::TransitionRecord;

use crate::calm::policy_of;
use crate::flight::Flight;
use crate::mutant::Mutant;
use crate::shape::RUN;

/// Time between two tries to join.
const JOIN_INTERVAL: Duration = Duration::from_millis(100);

/// A running actor process.
#[derive(Debug)]
pub(crate) struct ActorProcess {
    id: ActorId,
    mutant: Option<Mutant>,
    /// Time of the last message of a learner; at first, the start of the process.
    last_heard: Instant,
    newest_life: Option<u64>,
    last_incarnation: ActorIncarnation,
    joined: Option<Joined>,
}

/// The joined learner.
#[derive(Debug)]
pub(crate) struct Joined {
    /// The learner's life, as it looks from this host.
    pub(crate) life: u64,
    /// `true` once the learner has connected to this actor.
    pub(crate) is_connected: bool,
    session: Session,
    /// Policies of the snapshots received.
    policies: BTreeMap<PolicyVersion, u64>,
    flight: Option<(Ticket, Flight)>,
    messages: VecDeque<Rc<ControlMessage>>,
    snapshots: VecDeque<Rc<Snapshot>>,
    is_woken: bool,
    is_waiting: bool,
}

/// Message that an operation of an actor sends.
#[derive(Debug)]
pub(crate) enum Deed {
    /// Sends a heartbeat.
    Report(StatusRecord),
    /// Sends a record.
    Send(Rc<TransitionRecord>),
}

/// Continuation after an operation.
#[derive(Debug)]
pub(crate) enum Then {
    /// The next operation takes the time of a step.
    Fly,
    /// The next operation comes at once.
    GoOn,
    /// Nothing before this time has passed, or the actor is woken.
    Wait(Duration),
    /// The process ends.
    Exit,
}

impl ActorProcess {
    /// Starts the process at `now`.
    pub(crate) fn start(id: ActorId, mutant: Option<Mutant>, now: Instant) -> Self {
        Self {
            id,
            mutant,
            last_heard: now,
            newest_life: None,
            last_incarnation: ActorIncarnation(0),
            joined: None,
        }
    }

    /// The joined learner, if there is one.
    pub(crate) fn joined_mut(&mut self) -> Option<&mut Joined> {
        self.joined.as_mut()
    }

    /// Identity in the present session.
    pub(crate) fn session(&self) -> Option<(ActorId, ActorIncarnation)> {
        self.joined.as_ref().map(|joined| joined.session.identity())
    }

    /// Status of the present session.
    pub(crate) fn status(&self, state: ActorState) -> Option<StatusRecord> {
        self.joined.as_ref().map(|joined| joined.status(state))
    }

    /// Does the next operation. `life`: the learner's life that can be joined from this host.
    /// `clock`: what this host's clock shows, in nanoseconds.
    pub(crate) fn act(
        &mut self,
        config: &Config,
        life: Option<u64>,
        clock: u64,
        now: Instant,
        deeds: &mut Vec<Deed>,
    ) -> Then {
        match self.joined.take() {
            None => self.join(config, life, clock, now, deeds),
            Some(mut joined) => {
                let (then, reason) = joined.act(life, self.mutant, now, deeds);
                let Some(reason) = reason else {
                    self.joined = Some(joined);
                    return then;
                };
                self.last_heard = joined.session.last_heard();
                if reason != DisconnectReason::LearnerGone {
                    deeds.push(Deed::Report(joined.status(ActorState::Leaving)));
                }
                match reason {
                    DisconnectReason::Exit(_) => Then::Exit,
                    _ => Then::GoOn,
                }
            }
        }
    }

    fn join(
        &mut self,
        config: &Config,
        life: Option<u64>,
        clock: u64,
        now: Instant,
        deeds: &mut Vec<Deed>,
    ) -> Then {
        let Some(life) = life else {
            let silence = Duration::from_secs_f64(config.transport.learner_silence_secs);
            return match now.saturating_duration_since(self.last_heard) > silence {
                true => Then::Exit,
                false => Then::Wait(JOIN_INTERVAL),
            };
        };
        if self.newest_life.is_none_or(|newest| newest < life) {
            self.newest_life = Some(life);
            self.last_heard = now;
        }
        self.last_incarnation = ActorIncarnation(clock.max(self.last_incarnation.0 + 1));
        let identity = (self.id, self.last_incarnation);
        let joined = Joined {
            life,
            is_connected: false,
            session: Session::begin(RUN, config, identity, self.last_heard, now),
            policies: BTreeMap::new(),
            flight: None,
            messages: VecDeque::new(),
            snapshots: VecDeque::new(),
            is_woken: false,
            is_waiting: false,
        };
        deeds.push(Deed::Report(joined.status(ActorState::Serving)));
        self.joined = Some(joined);
        Then::GoOn
    }
}

impl Joined {
    /// Incarnation of the actor in this session.
    pub(crate) fn incarnation(&self) -> ActorIncarnation {
        self.session.identity().1
    }

    /// Takes a message from the network.
    pub(crate) fn deliver_message(&mut self, message: Rc<ControlMessage>) {
        self.messages.push_back(message);
    }

    /// Takes a snapshot from the network.
    pub(crate) fn deliver_snapshot(&mut self, snapshot: Rc<Snapshot>) {
        self.snapshots.push_back(snapshot);
    }

    /// Wakes the actor; returns `true` if it waits.
    pub(crate) fn wake(&mut self) -> bool {
        self.is_woken = true;
        self.is_waiting
    }

    fn status(&self, state: ActorState) -> StatusRecord {
        let (actor, incarnation) = self.session.identity();
        let status = ActorStatus {
            actor,
            incarnation,
            pid: 1,
            state,
            newest_policy: self.session.weights().newest(),
            episodes_flown: 0,
            times: StageTimes::default(),
        };
        StatusRecord::new(RUN, &status)
    }

    fn act(
        &mut self,
        life: Option<u64>,
        mutant: Option<Mutant>,
        now: Instant,
        deeds: &mut Vec<Deed>,
    ) -> (Then, Option<DisconnectReason>) {
        self.is_waiting = false;
        self.listen_for_control(life, now, deeds);
        let reason = self.session.disconnect_reason(now, || false);
        if reason.is_some() {
            return (Then::GoOn, reason);
        }
        if let Some((ticket, flight)) = &mut self.flight {
            let identity = self.session.identity();
            match flight.next() {
                Some((step, moment)) => {
                    let record = Flight::record(&moment, step, ticket, identity);
                    deeds.push(Deed::Send(record.into()));
                    return (Then::Fly, None);
                }
                None => self.flight = None,
            }
        }
        while let Some(snapshot) = self.snapshots.pop_front() {
            self.policies.insert(snapshot.version, policy_of(&snapshot));
            self.session.on_snapshot(Snapshot::clone(&snapshot));
        }
        self.session.on_time(now);
        match self.session.take_ticket() {
            Some(ticket) => {
                let policy = match mutant {
                    Some(Mutant::OtherSnapshot) => self.policies.values().next_back(),
                    _ => self.policies.get(&ticket.policy_version),
                };
                let flight = policy.map(|policy| Flight::begin(&ticket, *policy));
                self.flight = flight.map(|flight| (ticket, flight));
                (Then::Fly, None)
            }
            None => (self.wait(now, deeds), None),
        }
    }

    fn listen_for_control(&mut self, life: Option<u64>, now: Instant, deeds: &mut Vec<Deed>) {
        while let Some(message) = self.messages.pop_front() {
            self.session.on_message(&message, now);
        }
        if self.session.is_heartbeat_due(now) {
            if life != Some(self.life) {
                self.session.learner_is_gone();
            }
            self.session.has_beaten(now);
            deeds.push(Deed::Report(self.status(ActorState::Serving)));
        }
    }

    fn wait(&mut self, now: Instant, deeds: &mut Vec<Deed>) -> Then {
        if self.session.begins_to_wait() {
            deeds.push(Deed::Report(self.status(ActorState::Serving)));
        }
        if std::mem::take(&mut self.is_woken) {
            return Then::GoOn;
        }
        self.is_waiting = true;
        Then::Wait(self.session.patience(now))
    }
}
