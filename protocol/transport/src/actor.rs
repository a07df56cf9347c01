//! An actor's ends of the services.

use std::time::Duration;

use iceoryx2::node::Node;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::*;

use super::joining::{JoinError, learner_of};
use super::memory::{let_go, reserve};
use super::opening::{Manner, Opener};
use super::wire::{LoanedTransition, Wire};
use super::{Ipc, ServiceError, failed, node, wait};
use skein_protocol::config::Config;
use skein_protocol::ids::RunId;
use skein_protocol::segment::SegmentRecord;
use skein_protocol::snapshot::{Snapshot, SnapshotHeader, SnapshotLayout};
use skein_protocol::status::StatusRecord;
use skein_protocol::ticket::{ControlRecord, Message};
use skein_protocol::transition::TransitionRecord;
use skein_run::{LearnerIncarnation, RunIdentity};

/// Samples an actor loans at one time: the record being completed and the next one, whose image its
/// reward needs.
const LOANED_RECORDS: usize = 2;
/// An actor's ends.
#[derive(Debug)]
pub struct ActorPorts {
    run: RunId,
    incarnation: LearnerIncarnation,
    layout: SnapshotLayout,
    transitions: Publisher<Ipc, Wire<TransitionRecord>, ()>,
    status: Publisher<Ipc, Wire<StatusRecord>, ()>,
    control: Subscriber<Ipc, Wire<ControlRecord>, ()>,
    segments: Subscriber<Ipc, Wire<SegmentRecord>, ()>,
    weights: Subscriber<Ipc, [u8], Wire<SnapshotHeader>>,
    wake: Listener<Ipc>,
    wake_learner: Notifier<Ipc>,
    // Held so that the node outlives its ports and is seen as alive.
    _node: Node<Ipc>,
}

impl ActorPorts {
    /// Joins the learner that lives now: opens an actor's ends of every service, on the thread that
    /// will use them. Waits for nothing.
    ///
    /// # Errors
    /// [`JoinError::NoLearner`] when there is none to join at this moment;
    /// [`JoinError::Difference`] when this process and the learner's do not fit.
    pub fn join(identity: &RunIdentity, config: &Config) -> Result<Self, JoinError> {
        let incarnation = learner_of(identity, config)?.incarnation;
        let ports = Self::open(identity, incarnation, config)?;
        reserve(identity, incarnation)?;
        Ok(ports)
    }

    fn open(
        identity: &RunIdentity,
        incarnation: LearnerIncarnation,
        config: &Config,
    ) -> Result<Self, ServiceError> {
        let node = node(identity, incarnation, "actor")?;
        let open = Opener::new(&node, Manner::Join, identity, config)?;
        Ok(Self {
            run: identity.run,
            incarnation,
            layout: SnapshotLayout::of(config),
            transitions: open
                .transitions(config)?
                .publisher_builder()
                .max_loaned_samples(LOANED_RECORDS)
                .backpressure_strategy(BackpressureStrategy::DiscardData)
                .create()
                .map_err(failed("transitions", "publishing"))?,
            status: open
                .status()?
                .publisher_builder()
                .max_loaned_samples(1)
                .backpressure_strategy(BackpressureStrategy::DiscardData)
                .create()
                .map_err(failed("status", "publishing"))?,
            control: open
                .control(config)?
                .subscriber_builder()
                .create()
                .map_err(failed("control", "subscribing"))?,
            segments: open
                .segments()?
                .subscriber_builder()
                .create()
                .map_err(failed("segments", "subscribing"))?,
            weights: open
                .weights()?
                .subscriber_builder()
                .create()
                .map_err(failed("weights", "subscribing"))?,
            wake: open
                .event("wake-actors", 1, open.actors)?
                .listener_builder()
                .create()
                .map_err(failed("wake-actors", "listening"))?,
            wake_learner: open
                .event("wake-learner", open.actors, 1)?
                .notifier_builder()
                .create()
                .map_err(failed("wake-learner", "notifying"))?,
            _node: node,
        })
    }

    /// The run.
    pub fn run(&self) -> RunId {
        self.run
    }

    /// The incarnation of the learner that was joined.
    pub fn incarnation(&self) -> LearnerIncarnation {
        self.incarnation
    }

    /// Waits until the learner has something to say, `timeout` has passed, or a signal has come.
    ///
    /// # Errors
    /// [`ServiceError`] when the wait itself fails.
    pub fn wait(&self, timeout: Duration) -> Result<(), ServiceError> {
        wait(&self.wake, timeout).map_err(failed("wake-actors", "waiting"))
    }

    /// A record in shared memory, to be written in place. It holds whatever was in that memory
    /// before.
    ///
    /// # Errors
    /// [`ServiceError`] when the learner holds all of this actor's memory, which tickets rule out.
    pub fn loan_transition(&self) -> Result<LoanedTransition, ServiceError> {
        let sample = self
            .transitions
            .loan_uninit()
            .map_err(failed("transitions", "loaning"))?;
        // SAFETY: the record is plain data, for which every bit pattern is valid, and the memory is
        // a shared mapping that the operating system and iceoryx2 have initialised with zeros.
        Ok(LoanedTransition(unsafe { sample.assume_init() }))
    }

    /// Sends a record without a copy. That it arrives is not promised: the learner counts.
    ///
    /// # Errors
    /// [`ServiceError`] when the connection is broken.
    pub fn send_transition(&self, record: LoanedTransition) -> Result<(), ServiceError> {
        record
            .0
            .send()
            .map(drop)
            .map_err(failed("transitions", "sending"))
    }

    /// Sends a heartbeat.
    ///
    /// # Errors
    /// [`ServiceError`] when there is no memory to send it in.
    pub fn send_status(&self, record: StatusRecord) -> Result<(), ServiceError> {
        self.status
            .send_copy(Wire(record))
            .map(drop)
            .map_err(failed("status", "sending"))
    }

    /// The next message, if one has arrived. Tickets of segments come after all else.
    ///
    /// # Errors
    /// [`ServiceError`] when the learner's memory cannot be mapped.
    pub fn receive_control(&self) -> Result<Option<Message>, ServiceError> {
        if let Some(sample) = self
            .control
            .receive()
            .map_err(failed("control", "receiving"))?
        {
            return Ok(Some(Message::Control(sample.0)));
        }
        let sample = self
            .segments
            .receive()
            .map_err(failed("segments", "receiving"))?;
        Ok(sample.map(|sample| Message::Segment(Box::new(sample.0))))
    }

    /// The next snapshot, if one has arrived; the inner result says whether it can be flown.
    ///
    /// # Errors
    /// [`ServiceError`] when the learner's memory cannot be mapped.
    pub fn receive_snapshot(
        &self,
    ) -> Result<Option<Result<Snapshot, skein_protocol::snapshot::SnapshotError>>, ServiceError>
    {
        let sample = self
            .weights
            .receive()
            .map_err(failed("weights", "receiving"))?;
        Ok(sample.map(|sample| {
            let received = Snapshot::receive(
                &sample.user_header().0,
                sample.payload(),
                self.run,
                &self.layout,
            );
            let_go(sample.payload());
            received
        }))
    }

    /// Wakes the learner.
    ///
    /// # Errors
    /// [`ServiceError`] when the event cannot be raised.
    pub fn wake_learner(&self) -> Result<(), ServiceError> {
        self.wake_learner
            .notify()
            .map(drop)
            .map_err(failed("wake-learner", "notifying"))
    }

    /// Connects to a learner that has come. To be called regularly.
    ///
    /// # Errors
    /// [`ServiceError`] when the learner's memory cannot be mapped.
    pub fn maintain(&self) -> Result<(), ServiceError> {
        self.control
            .update_connections()
            .map_err(failed("control", "connecting"))?;
        self.segments
            .update_connections()
            .map_err(failed("segments", "connecting"))?;
        self.weights
            .update_connections()
            .map_err(failed("weights", "connecting"))?;
        self.transitions
            .update_connections()
            .map_err(failed("transitions", "connecting"))?;
        self.status
            .update_connections()
            .map_err(failed("status", "connecting"))
    }
}
