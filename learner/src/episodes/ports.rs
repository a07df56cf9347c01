//! The transport as the receiving thread uses it.
//!
//! The thread's rounds take any implementation, so that they can be driven without shared memory
//! and without a clock.

use std::ops::Deref;

use skein_protocol::snapshot::Snapshot;
use skein_protocol::status::StatusRecord;
use skein_protocol::ticket::{ControlMessage, ControlRecord};
use skein_protocol::transition::TransitionRecord;
use skein_transport::{LearnerPorts, ReceivedTransition, ServiceError};

/// The learner's side of the services. No method blocks, and nothing sent is promised to arrive.
///
/// # Errors
/// Every method: [`ServiceError`] when a service fails now; it may work in the next round.
pub trait Ports {
    /// A received record, wherever it lies.
    type Record: Deref<Target = TransitionRecord>;

    /// Returns the next heartbeat of an actor, if one has arrived.
    fn receive_status(&self) -> Result<Option<StatusRecord>, ServiceError>;

    /// Returns the next record, if one has arrived.
    fn receive_transition(&self) -> Result<Option<Self::Record>, ServiceError>;

    /// Sends `message` to the actors that are connected now.
    fn send(&self, message: &ControlMessage) -> Result<(), ServiceError>;

    /// Publishes `snapshot` to all actors, and to those that connect later.
    fn publish(&self, snapshot: &Snapshot) -> Result<(), ServiceError>;

    /// Wakes all waiting actors.
    fn wake_actors(&self) -> Result<(), ServiceError>;

    /// Connects to new actors.
    fn connect(&self) -> Result<(), ServiceError>;

    /// Does the periodic work, which includes [`Ports::connect`].
    fn maintain(&self) -> Result<(), ServiceError>;

    /// Sends `record` to the actors that are connected now.
    ///
    /// # Errors
    /// As [`Ports::send`].
    fn send_control(&self, record: ControlRecord) -> Result<(), ServiceError> {
        self.send(&ControlMessage::Control(record))
    }
}

impl Ports for LearnerPorts {
    type Record = ReceivedTransition;

    fn receive_status(&self) -> Result<Option<StatusRecord>, ServiceError> {
        self.receive_status()
    }

    fn receive_transition(&self) -> Result<Option<ReceivedTransition>, ServiceError> {
        self.receive_transition()
    }

    fn send(&self, message: &ControlMessage) -> Result<(), ServiceError> {
        self.send(message)
    }

    fn publish(&self, snapshot: &Snapshot) -> Result<(), ServiceError> {
        self.publish(snapshot)
    }

    fn wake_actors(&self) -> Result<(), ServiceError> {
        self.wake_actors()
    }

    fn connect(&self) -> Result<(), ServiceError> {
        self.connect()
    }

    fn maintain(&self) -> Result<(), ServiceError> {
        self.maintain()
    }
}
