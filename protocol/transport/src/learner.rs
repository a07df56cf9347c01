//! The learner's ports of the services.

use std::path::PathBuf;
use std::time::Duration;

use iceoryx2::node::Node;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::*;

use super::join::JoinError;
use super::memory::reserve;
use super::open::{OpenMode, Opener, control_slots};
use super::reclaim::Reclaimer;
use super::wire::{ReceivedTransition, Wire};
use super::{Ipc, ServiceError, failed, node, wait};
use skein_protocol::config::Config;
use skein_protocol::segment::SegmentRecord;
use skein_protocol::snapshot::{Snapshot, SnapshotHeader, SnapshotLayout};
use skein_protocol::status::StatusRecord;
use skein_protocol::ticket::{ControlMessage, ControlRecord};
use skein_protocol::transition::TransitionRecord;
use skein_run::fault::{FaultPoint, die_if_armed};
use skein_run::{Announcement, LearnerIncarnation, RunIdentity};

/// Snapshots in shared memory at one time: the history, one being written, and those that slow
/// readers still hold.
pub(super) const SNAPSHOT_SLOTS: usize = 8;

/// Ports of the learner.
#[derive(Debug)]
pub struct LearnerPorts {
    identity: RunIdentity,
    incarnation: LearnerIncarnation,
    reclaimer: Reclaimer,
    /// Its segments that exist from its start to its end.
    shared_memory: Vec<PathBuf>,
    layout: SnapshotLayout,
    transitions: Subscriber<Ipc, Wire<TransitionRecord>, ()>,
    status: Subscriber<Ipc, Wire<StatusRecord>, ()>,
    control: Publisher<Ipc, Wire<ControlRecord>, ()>,
    segments: Publisher<Ipc, Wire<SegmentRecord>, ()>,
    weights: Publisher<Ipc, [u8], Wire<SnapshotHeader>>,
    wake: Listener<Ipc>,
    wake_actors: Notifier<Ipc>,
    node: Node<Ipc>,
}

/// Wakes the learner's receiving thread from another thread of the learner. Needed because ports
/// belong to the thread that opened them.
#[derive(Debug)]
pub struct LearnerWaker {
    wake_learner: Notifier<Ipc>,
    _node: Node<Ipc>,
}

impl LearnerPorts {
    /// Opens the learner's ports of every service for its new `incarnation`, on the thread that
    /// will use them, and announces it. The caller holds the
    /// [`LearnerLock`](skein_run::LearnerLock).
    ///
    /// # Errors
    /// [`JoinError`] names the service and the cause.
    pub fn open(
        identity: &RunIdentity,
        incarnation: LearnerIncarnation,
        config: &Config,
    ) -> Result<Self, JoinError> {
        let mut ports = Self::create(identity, incarnation, config)?;
        reserve(identity, incarnation)?;
        ports.shared_memory = identity.shared_memory(incarnation).collect();
        die_if_armed(FaultPoint::LearnerStarted);
        identity.announce(&Announcement::new(identity, incarnation, config))?;
        Ok(ports)
    }

    fn create(
        identity: &RunIdentity,
        incarnation: LearnerIncarnation,
        config: &Config,
    ) -> Result<Self, ServiceError> {
        let node = node(identity, incarnation, "learner")?;
        identity
            .restrict_to_owner(incarnation)
            .map_err(failed("all", "closing shared memory to other users"))?;
        let open = Opener::new(&node, OpenMode::Create, identity, config)?;
        let layout = SnapshotLayout::of(config);
        let weights_factory = open.weights()?;
        let messages = control_slots(&config.transport);
        Ok(Self {
            identity: identity.clone(),
            incarnation,
            reclaimer: Reclaimer::new(identity, incarnation),
            shared_memory: Vec::new(),
            transitions: open
                .transitions(config)?
                .subscriber_builder()
                .create()
                .map_err(failed("transitions", "subscribing"))?,
            status: open
                .status()?
                .subscriber_builder()
                .create()
                .map_err(failed("status", "subscribing"))?,
            control: open
                .control(config)?
                .publisher_builder()
                .max_loaned_samples(1)
                .backpressure_strategy(BackpressureStrategy::DiscardData)
                .override_sample_preallocation(move |worst_case| worst_case.min(messages))
                .create()
                .map_err(failed("control", "publishing"))?,
            segments: open
                .segments()?
                .publisher_builder()
                .max_loaned_samples(1)
                .backpressure_strategy(BackpressureStrategy::DiscardData)
                .create()
                .map_err(failed("segments", "publishing"))?,
            weights: weights_factory
                .publisher_builder()
                .initial_max_slice_len(layout.values() * size_of::<f32>())
                .allocation_strategy(AllocationStrategy::Static)
                .max_loaned_samples(1)
                .backpressure_strategy(BackpressureStrategy::DiscardData)
                .override_sample_preallocation(|worst_case| worst_case.min(SNAPSHOT_SLOTS))
                .create()
                .map_err(failed("weights", "publishing"))?,
            wake: open
                .event("wake-learner", open.actors, 1)?
                .listener_builder()
                .create()
                .map_err(failed("wake-learner", "listening"))?,
            wake_actors: open
                .event("wake-actors", 1, open.actors)?
                .notifier_builder()
                .create()
                .map_err(failed("wake-actors", "notifying"))?,
            layout,
            node,
        })
    }

    /// Waits until an actor has sent something, `timeout` has passed, or a signal has arrived.
    ///
    /// # Errors
    /// [`ServiceError`] if the wait itself fails.
    pub fn wait(&self, timeout: Duration) -> Result<(), ServiceError> {
        wait(&self.wake, timeout).map_err(failed("wake-learner", "waiting"))
    }

    /// Returns the next transition record, if one has arrived.
    ///
    /// # Errors
    /// [`ServiceError`] if an actor's memory cannot be mapped.
    pub fn receive_transition(&self) -> Result<Option<ReceivedTransition>, ServiceError> {
        let sample = self
            .transitions
            .receive()
            .map_err(failed("transitions", "receiving"))?;
        Ok(sample.map(ReceivedTransition))
    }

    /// Returns the next status record, if one has arrived.
    ///
    /// # Errors
    /// [`ServiceError`] if an actor's memory cannot be mapped.
    pub fn receive_status(&self) -> Result<Option<StatusRecord>, ServiceError> {
        let sample = self
            .status
            .receive()
            .map_err(failed("status", "receiving"))?;
        Ok(sample.map(|sample| sample.0))
    }

    /// Sends `message` to the actors connected now. The ticket's deadline covers a lost message.
    ///
    /// # Errors
    /// [`ServiceError`] if there is no memory for it.
    pub fn send(&self, message: &ControlMessage) -> Result<(), ServiceError> {
        match message {
            ControlMessage::Control(record) => self.send_control(*record),
            ControlMessage::Segment(record) => self
                .segments
                .send_copy(Wire(**record))
                .map(drop)
                .map_err(failed("segments", "sending")),
        }
    }

    /// Sends `record` as [`LearnerPorts::send`] does.
    ///
    /// # Errors
    /// [`ServiceError`] if there is no memory for it.
    pub fn send_control(&self, record: ControlRecord) -> Result<(), ServiceError> {
        self.control
            .send_copy(Wire(record))
            .map(drop)
            .map_err(failed("control", "sending"))
    }

    /// Copies `snapshot` into shared memory once; every actor reads it there.
    ///
    /// # Errors
    /// [`ServiceError`] if there is no memory for it.
    pub fn publish(&self, snapshot: &Snapshot) -> Result<(), ServiceError> {
        let bytes: &[u8] = bytemuck::cast_slice(&snapshot.values);
        let mut sample = self
            .weights
            .loan_slice_uninit(bytes.len())
            .map_err(failed("weights", "loaning"))?;
        *sample.user_header_mut() = Wire(snapshot.header(self.identity.run, &self.layout));
        let sample = sample.write_from_slice(bytes);
        die_if_armed(FaultPoint::LearnerPublishing);
        sample.send().map_err(failed("weights", "sending"))?;
        die_if_armed(FaultPoint::LearnerPublished);
        Ok(())
    }

    /// Wakes all waiting actors.
    ///
    /// # Errors
    /// [`ServiceError`] if the event cannot be raised.
    pub fn wake_actors(&self) -> Result<(), ServiceError> {
        self.wake_actors
            .notify()
            .map(drop)
            .map_err(failed("wake-actors", "notifying"))
    }

    /// Connects to new actors, sends late joiners the newest snapshots, and reclaims the resources
    /// of dead processes. Called regularly.
    ///
    /// # Errors
    /// [`ServiceError`] if a peer's memory cannot be mapped, or actors can no longer find this
    /// learner.
    pub fn maintain(&self) -> Result<(), ServiceError> {
        self.check_findable()?;
        self.connect()?;
        self.reclaimer.reclaim(&self.node)
    }

    /// Connects to new actors, and sends late joiners the newest snapshots.
    ///
    /// # Errors
    /// [`ServiceError`] if a peer's memory cannot be mapped.
    pub fn connect(&self) -> Result<(), ServiceError> {
        self.transitions
            .update_connections()
            .map_err(failed("transitions", "connecting"))?;
        self.status
            .update_connections()
            .map_err(failed("status", "connecting"))?;
        self.weights
            .update_connections()
            .map_err(failed("weights", "connecting"))?;
        self.segments
            .update_connections()
            .map_err(failed("segments", "connecting"))?;
        self.control
            .update_connections()
            .map_err(failed("control", "connecting"))
    }

    /// Checks that an actor could find this learner.
    fn check_findable(&self) -> Result<(), ServiceError> {
        let present = self
            .identity
            .current_incarnation()
            .map_err(failed("all", "checking what actors need"))?;
        let folder = self.identity.incarnation_folder(self.incarnation);
        let is_announced = present.is_some_and(|found| found.incarnation == self.incarnation);
        let gone = match self.shared_memory.iter().find(|segment| !segment.exists()) {
            Some(segment) => segment,
            None if !is_announced || !folder.is_dir() => &self.identity.transport_folder(),
            None => return Ok(()),
        };
        Err(ServiceError {
            service: "all",
            operation: "checking what actors need",
            cause: format!("{} or its content was removed", gone.display()),
            remedy: "; do not remove skein's files in /tmp and /dev/shm during a run",
        })
    }
}

impl LearnerWaker {
    /// Opens the waker on the thread that will use it, after the receiving thread has opened its
    /// ports.
    ///
    /// # Errors
    /// [`ServiceError`] names the service and the cause.
    pub fn open(
        identity: &RunIdentity,
        incarnation: LearnerIncarnation,
        config: &Config,
    ) -> Result<Self, ServiceError> {
        let node = node(identity, incarnation, "learner-waker")?;
        let open = Opener::new(&node, OpenMode::Join, identity, config)?;
        let wake_learner = open
            .event("wake-learner", open.actors, 1)?
            .notifier_builder()
            .create()
            .map_err(failed("wake-learner", "notifying"))?;
        Ok(Self {
            wake_learner,
            _node: node,
        })
    }

    /// Wakes the receiving thread.
    ///
    /// # Errors
    /// [`ServiceError`] if the event cannot be raised.
    pub fn wake(&self) -> Result<(), ServiceError> {
        self.wake_learner
            .notify()
            .map(drop)
            .map_err(failed("wake-learner", "notifying"))
    }
}
