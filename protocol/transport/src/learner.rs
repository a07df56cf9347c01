//! The learner's ends of the services.

use std::path::PathBuf;
use std::time::Duration;

use iceoryx2::node::Node;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::*;

use super::dead::Reclaimer;
use super::joining::JoinError;
use super::memory::reserve;
use super::opening::{Manner, Opener, control_slots};
use super::wire::{ReceivedTransition, Wire};
use super::{Ipc, ServiceError, failed, node, wait};
use skein_protocol::config::Config;
use skein_protocol::segment::SegmentRecord;
use skein_protocol::snapshot::{Snapshot, SnapshotHeader, SnapshotLayout};
use skein_protocol::status::StatusRecord;
use skein_protocol::ticket::{ControlRecord, Message};
use skein_protocol::transition::TransitionRecord;
use skein_run::fault::{FaultPoint, pass};
use skein_run::{Announcement, LearnerIncarnation, RunIdentity};

/// Snapshots that exist at once in shared memory: the history, one being written, and those that
/// slow readers still hold.
pub(super) const SNAPSHOT_SLOTS: usize = 8;

/// The learner's ends.
#[derive(Debug)]
pub struct LearnerPorts {
    identity: RunIdentity,
    incarnation: LearnerIncarnation,
    dead: Reclaimer,
    /// What of it lies in shared memory from its start to its end.
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

/// Wakes the learner's receiving thread from another thread of the learner: ports belong to the
/// thread that opened them.
#[derive(Debug)]
pub struct LearnerWaker {
    wake_learner: Notifier<Ipc>,
    _node: Node<Ipc>,
}

impl LearnerPorts {
    /// Opens the learner's ends of every service for its new `incarnation`, on the thread that will
    /// use them, and announces it. For who holds the [`LearnerLock`](skein_run::LearnerLock).
    ///
    /// # Errors
    /// [`JoinError`] says which service and why.
    pub fn open(
        identity: &RunIdentity,
        incarnation: LearnerIncarnation,
        config: &Config,
    ) -> Result<Self, JoinError> {
        let mut ports = Self::create(identity, incarnation, config)?;
        reserve(identity, incarnation)?;
        ports.shared_memory = identity.shared_memory(incarnation).collect();
        pass(FaultPoint::LearnerStarted);
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
            .close_to_others(incarnation)
            .map_err(failed("all", "closing shared memory to other users"))?;
        let open = Opener::new(&node, Manner::Create, identity, config)?;
        let layout = SnapshotLayout::of(config);
        let weights_factory = open.weights()?;
        let messages = control_slots(&config.transport);
        Ok(Self {
            identity: identity.clone(),
            incarnation,
            dead: Reclaimer::new(identity, incarnation),
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

    /// Waits until an actor has something to say, `timeout` has passed, or a signal has come.
    ///
    /// # Errors
    /// [`ServiceError`] when the wait itself fails.
    pub fn wait(&self, timeout: Duration) -> Result<(), ServiceError> {
        wait(&self.wake, timeout).map_err(failed("wake-learner", "waiting"))
    }

    /// The next transition record, if one has arrived.
    ///
    /// # Errors
    /// [`ServiceError`] when an actor's memory cannot be mapped.
    pub fn receive_transition(&self) -> Result<Option<ReceivedTransition>, ServiceError> {
        let sample = self
            .transitions
            .receive()
            .map_err(failed("transitions", "receiving"))?;
        Ok(sample.map(ReceivedTransition))
    }

    /// The next status record, if one has arrived.
    ///
    /// # Errors
    /// [`ServiceError`] when an actor's memory cannot be mapped.
    pub fn receive_status(&self) -> Result<Option<StatusRecord>, ServiceError> {
        let sample = self
            .status
            .receive()
            .map_err(failed("status", "receiving"))?;
        Ok(sample.map(|sample| sample.0))
    }

    /// Sends `message` to the actors connected now; a lost one is made good by the ticket's
    /// deadline.
    ///
    /// # Errors
    /// [`ServiceError`] when there is no memory to send it in.
    pub fn send(&self, message: &Message) -> Result<(), ServiceError> {
        match message {
            Message::Control(record) => self.send_control(*record),
            Message::Segment(record) => self
                .segments
                .send_copy(Wire(**record))
                .map(drop)
                .map_err(failed("segments", "sending")),
        }
    }

    /// Sends `record` as [`LearnerPorts::send`] does.
    ///
    /// # Errors
    /// [`ServiceError`] when there is no memory to send it in.
    pub fn send_control(&self, record: ControlRecord) -> Result<(), ServiceError> {
        self.control
            .send_copy(Wire(record))
            .map(drop)
            .map_err(failed("control", "sending"))
    }

    /// Copies `snapshot` into shared memory once; every actor reads it there.
    ///
    /// # Errors
    /// [`ServiceError`] when there is no memory to send it in.
    pub fn publish(&self, snapshot: &Snapshot) -> Result<(), ServiceError> {
        let bytes: &[u8] = bytemuck::cast_slice(&snapshot.values);
        let mut sample = self
            .weights
            .loan_slice_uninit(bytes.len())
            .map_err(failed("weights", "loaning"))?;
        *sample.user_header_mut() = Wire(snapshot.header(self.identity.run, &self.layout));
        let sample = sample.write_from_slice(bytes);
        pass(FaultPoint::LearnerPublishing);
        sample.send().map_err(failed("weights", "sending"))?;
        pass(FaultPoint::LearnerPublished);
        Ok(())
    }

    /// Wakes all actors that wait.
    ///
    /// # Errors
    /// [`ServiceError`] when the event cannot be raised.
    pub fn wake_actors(&self) -> Result<(), ServiceError> {
        self.wake_actors
            .notify()
            .map(drop)
            .map_err(failed("wake-actors", "notifying"))
    }

    /// Connects to actors that have come, hands late joiners the newest snapshots, and reclaims
    /// what dead processes held. To be called regularly.
    ///
    /// # Errors
    /// [`ServiceError`] when a peer's memory cannot be mapped, or actors can no longer find this
    /// learner.
    pub fn maintain(&self) -> Result<(), ServiceError> {
        self.check_findable()?;
        self.connect()?;
        self.dead.reclaim(&self.node)
    }

    /// Connects to actors that have come, and hands late joiners the newest snapshots.
    ///
    /// # Errors
    /// [`ServiceError`] when a peer's memory cannot be mapped.
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

    /// Looks for this learner as an actor would.
    fn check_findable(&self) -> Result<(), ServiceError> {
        let present = self
            .identity
            .present_incarnation()
            .map_err(failed("all", "looking at what actors need"))?;
        let folder = self.identity.incarnation_folder(self.incarnation);
        let is_announced = present.is_some_and(|found| found.incarnation == self.incarnation);
        let gone = match self.shared_memory.iter().find(|segment| !segment.exists()) {
            Some(segment) => segment,
            None if !is_announced || !folder.is_dir() => &self.identity.transport_folder(),
            None => return Ok(()),
        };
        Err(ServiceError {
            service: "all",
            operation: "looking at what actors need",
            cause: format!("{} was removed, or what was in it", gone.display()),
            remedy: "; leave what is called skein alone in /tmp and /dev/shm while a run is under way",
        })
    }
}

impl LearnerWaker {
    /// Opens the waker, on the thread that will use it, once the receiving thread has opened its
    /// ends.
    ///
    /// # Errors
    /// [`ServiceError`] says which service and why.
    pub fn open(
        identity: &RunIdentity,
        incarnation: LearnerIncarnation,
        config: &Config,
    ) -> Result<Self, ServiceError> {
        let node = node(identity, incarnation, "learner-waker")?;
        let open = Opener::new(&node, Manner::Join, identity, config)?;
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
    /// [`ServiceError`] when the event cannot be raised.
    pub fn wake(&self) -> Result<(), ServiceError> {
        self.wake_learner
            .notify()
            .map(drop)
            .map_err(failed("wake-learner", "notifying"))
    }
}
