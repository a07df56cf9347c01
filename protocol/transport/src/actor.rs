//! An actor's ports of the services.

use std::time::Duration;

use iceoryx2::node::Node;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::*;

use super::join::{JoinError, find_learner};
use super::memory::{release_pages, reserve};
use super::open::{OpenMode, Opener};
use super::wire::{LoanedTransition, Wire};
use super::{Ipc, ServiceError, failed, node, wait};
use skein_protocol::config::Config;
use skein_protocol::ids::RunId;
use skein_protocol::segment::SegmentRecord;
use skein_protocol::snapshot::{Snapshot, SnapshotHeader, SnapshotLayout};
use skein_protocol::status::StatusRecord;
use skein_protocol::ticket::{ControlMessage, ControlRecord};
use skein_protocol::transition::TransitionRecord;
use skein_run::{LearnerIncarnation, RunIdentity};

/// Samples that an actor loans at one time: the record being completed and the next one, because
/// the reward depends on the next image.
const LOANED_RECORDS: usize = 2;

/// Ports of an actor.
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
    // Keeps the node alive longer than its ports.
    _node: Node<Ipc>,
}

impl ActorPorts {
    /// Joins the living learner: opens an actor's ports of every service, on the thread that will
    /// use them. Does not block.
    ///
    /// # Errors
    /// [`JoinError::NoLearner`] if there is no learner to join; [`JoinError::Mismatch`] if this
    /// process does not match the learner.
    pub fn join(identity: &RunIdentity, config: &Config) -> Result<Self, JoinError> {
        let incarnation = find_learner(identity, config)?.incarnation;
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
        let open = Opener::new(&node, OpenMode::Join, identity, config)?;
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

    /// Returns the run.
    pub fn run(&self) -> RunId {
        self.run
    }

    /// Returns the incarnation of the learner that was joined.
    pub fn incarnation(&self) -> LearnerIncarnation {
        self.incarnation
    }

    /// Waits until the learner has sent something, `timeout` has passed, or a signal has arrived.
    ///
    /// # Errors
    /// [`ServiceError`] if the wait itself fails.
    pub fn wait(&self, timeout: Duration) -> Result<(), ServiceError> {
        wait(&self.wake, timeout).map_err(failed("wake-actors", "waiting"))
    }

    /// Loans a record in shared memory, to be written in place. Its content is arbitrary.
    ///
    /// # Errors
    /// [`ServiceError`] if the learner holds all of this actor's memory, which tickets rule out.
    pub fn loan_transition(&self) -> Result<LoanedTransition, ServiceError> {
        let sample = self
            .transitions
            .loan_uninit()
            .map_err(failed("transitions", "loaning"))?;
        // SAFETY: the record is plain data, for which every bit pattern is valid, and the memory is
        // a shared mapping that the operating system and iceoryx2 have initialised with zeros.
        Ok(LoanedTransition(unsafe { sample.assume_init() }))
    }

    /// Sends a record without a copy. Its arrival is not guaranteed: the learner counts records.
    ///
    /// # Errors
    /// [`ServiceError`] if the connection is broken.
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
    /// [`ServiceError`] if there is no memory for it.
    pub fn send_status(&self, record: StatusRecord) -> Result<(), ServiceError> {
        self.status
            .send_copy(Wire(record))
            .map(drop)
            .map_err(failed("status", "sending"))
    }

    /// Returns the next message, if one has arrived. Tickets of segments come last.
    ///
    /// # Errors
    /// [`ServiceError`] if the learner's memory cannot be mapped.
    pub fn receive_control(&self) -> Result<Option<ControlMessage>, ServiceError> {
        if let Some(sample) = self
            .control
            .receive()
            .map_err(failed("control", "receiving"))?
        {
            return Ok(Some(ControlMessage::Control(sample.0)));
        }
        let sample = self
            .segments
            .receive()
            .map_err(failed("segments", "receiving"))?;
        Ok(sample.map(|sample| ControlMessage::Segment(Box::new(sample.0))))
    }

    /// Returns the next snapshot, if one has arrived; the inner result is an error if it cannot be
    /// flown.
    ///
    /// # Errors
    /// [`ServiceError`] if the learner's memory cannot be mapped.
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
            release_pages(sample.payload());
            received
        }))
    }

    /// Wakes the learner.
    ///
    /// # Errors
    /// [`ServiceError`] if the event cannot be raised.
    pub fn wake_learner(&self) -> Result<(), ServiceError> {
        self.wake_learner
            .notify()
            .map(drop)
            .map_err(failed("wake-learner", "notifying"))
    }

    /// Connects to a learner that has appeared. Called regularly.
    ///
    /// # Errors
    /// [`ServiceError`] if the learner's memory cannot be mapped.
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
