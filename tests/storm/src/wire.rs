//! The learner's ports, as two queues that the world fills and empties.

use std::cell::RefCell;
use std::collections::{BTreeMap, VecDeque};
use std::rc::Rc;

use skein_learner::episodes::ports::Ports;
use skein_protocol::ids::{Attempt, EpisodeId, RunId};
use skein_protocol::snapshot::Snapshot;
use skein_protocol::status::StatusRecord;
use skein_protocol::ticket::{Control, ControlMessage};
use skein_protocol::transition::TransitionRecord;
use skein_transport::ServiceError;

use crate::mutant::{Mutant, Tampering};

/// The ports of one incarnation of the learner.
#[derive(Debug, Clone)]
pub(crate) struct VirtualPorts(Rc<RefCell<Traffic>>);

#[derive(Debug)]
struct Traffic {
    run: RunId,
    statuses: VecDeque<StatusRecord>,
    records: VecDeque<Rc<TransitionRecord>>,
    sent: Vec<Sent>,
    /// `true` while every service fails.
    is_broken: bool,
    /// Newest attempt of each episode.
    attempts: BTreeMap<EpisodeId, Attempt>,
    tampering: Tampering,
}

/// Something that the learner did to its ports.
#[derive(Debug)]
pub(crate) enum Sent {
    /// A message to all connected actors.
    Message(Rc<ControlMessage>),
    /// A snapshot to all actors, also to those that connect later.
    Snapshot(Rc<Snapshot>),
    /// All actors are woken.
    Wake,
    /// Actors that have joined are connected.
    Connect,
}

impl VirtualPorts {
    pub(crate) fn new(run: RunId, mutant: Option<Mutant>) -> Self {
        Self(Rc::new(RefCell::new(Traffic {
            run,
            statuses: VecDeque::new(),
            records: VecDeque::new(),
            sent: Vec::new(),
            is_broken: false,
            attempts: BTreeMap::new(),
            tampering: Tampering::of(mutant),
        })))
    }

    /// Lets a heartbeat arrive.
    pub(crate) fn deliver_status(&self, status: StatusRecord) {
        self.0.borrow_mut().statuses.push_back(status);
    }

    /// Lets a record arrive.
    pub(crate) fn deliver_record(&self, record: Rc<TransitionRecord>) {
        self.0.borrow_mut().records.push_back(record);
    }

    /// Takes what was sent since the last call, in order.
    pub(crate) fn take_sent(&self) -> Vec<Sent> {
        std::mem::take(&mut self.0.borrow_mut().sent)
    }

    /// Attempt on which `episode` was last ordered.
    pub(crate) fn newest_attempt(&self, episode: EpisodeId) -> Attempt {
        let traffic = self.0.borrow();
        traffic
            .attempts
            .get(&episode)
            .copied()
            .unwrap_or(Attempt(0))
    }

    /// Lets every service fail.
    pub(crate) fn break_down(&self) {
        self.0.borrow_mut().is_broken = true;
    }

    /// Lets every service work again.
    pub(crate) fn mend(&self) {
        self.0.borrow_mut().is_broken = false;
    }

    fn send(&self, sent: Sent) -> Result<(), ServiceError> {
        self.check()?.sent.push(sent);
        Ok(())
    }

    fn check(&self) -> Result<std::cell::RefMut<'_, Traffic>, ServiceError> {
        let traffic = self.0.borrow_mut();
        match traffic.is_broken {
            false => Ok(traffic),
            true => Err(ServiceError {
                service: "all",
                operation: "weathering the storm",
                cause: "broken".to_owned(),
                remedy: "",
            }),
        }
    }
}

impl Ports for VirtualPorts {
    type Record = Rc<TransitionRecord>;

    fn receive_status(&self) -> Result<Option<StatusRecord>, ServiceError> {
        Ok(self.check()?.statuses.pop_front())
    }

    fn receive_transition(&self) -> Result<Option<Rc<TransitionRecord>>, ServiceError> {
        let traffic = &mut *self.check()?;
        let record = traffic.records.pop_front();
        Ok(record.map(|record| traffic.tampering.received(record)))
    }

    fn send(&self, message: &ControlMessage) -> Result<(), ServiceError> {
        let traffic = &mut *self.check()?;
        if let Ok(Control::Fly(ticket)) = message.read(traffic.run) {
            traffic.attempts.insert(ticket.episode, ticket.attempt);
            if !traffic.tampering.lets_pass(&ticket) {
                return Ok(());
            }
        }
        traffic.sent.push(Sent::Message(Rc::new(message.clone())));
        Ok(())
    }

    fn publish(&self, snapshot: &Snapshot) -> Result<(), ServiceError> {
        self.send(Sent::Snapshot(Rc::new(snapshot.clone())))
    }

    fn wake_actors(&self) -> Result<(), ServiceError> {
        self.send(Sent::Wake)
    }

    fn connect(&self) -> Result<(), ServiceError> {
        self.send(Sent::Connect)
    }

    fn maintain(&self) -> Result<(), ServiceError> {
        self.connect()
    }
}
