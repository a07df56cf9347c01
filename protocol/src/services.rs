//! The iceoryx2 services of a run: the only place that names or opens one, and sets every limit.
//!
//! | service | pattern | from → to | carries |
//! |---|---|---|---|
//! | `transitions` | publish-subscribe | actors → learner | [`TransitionRecord`], rendered into the loaned sample |
//! | `status` | publish-subscribe | actors → learner | [`StatusRecord`] |
//! | `control` | publish-subscribe | learner → actors | [`ControlRecord`]: tickets, signs of life, the stop |
//! | `weights` | publish-subscribe | learner → actors | snapshots' bytes behind a [`SnapshotHeader`] |
//! | `wake-learner`, `wake-actors` | event | both | that there is something to read |
//!
//! Nothing here blocks and nothing here is trusted to arrive: iceoryx2 loses samples silently when a peer dies or has not connected yet. Tickets bound
//! what is in flight, so no buffer can overflow but that of a process that was stopped, which misses what does not fit; a flight with a hole is discarded
//! and its ticket issued again; every wait has a deadline.
//!
//! Only the learner creates services; everybody else joins those that are there, so that an actor of a run that is over leaves nothing behind.
//!
//! Services carry protocol version, run, configuration and snapshot layout as attributes: a process that differs in one of them is refused on opening.

use std::fmt::Debug;
use std::path::PathBuf;
use std::thread::sleep;
use std::time::{Duration, Instant};

use iceoryx2::config::Config as IceoryxConfig;
use iceoryx2::node::{Node, NodeState, NodeView};
use iceoryx2::port::listener::{Listener, ListenerWaitError};
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::event;

use crate::PROTOCOL_VERSION;
use crate::config::Config;
use crate::ids::RunId;
use crate::run::RunIdentity;
use crate::snapshot::{Snapshot, SnapshotHeader, SnapshotLayout};
use crate::status::StatusRecord;
use crate::ticket::ControlRecord;
use crate::transition::TransitionRecord;

type Ipc = ipc::Service;
/// A transition record in shared memory, being written.
pub type LoanedTransition = iceoryx2::sample_mut::SampleMut<Ipc, TransitionRecord, ()>;
/// A transition record in shared memory, received.
pub type ReceivedTransition = iceoryx2::sample::Sample<Ipc, TransitionRecord, ()>;

/// Samples an actor loans at one time: the record being completed and the next one, whose image its reward needs.
const LOANED_RECORDS: usize = 2;
/// Records the learner holds while it looks at them.
const BORROWED_RECORDS: usize = 2;
/// Snapshots a late joiner still gets: with policy lag 1 two versions are in use, and an evaluation adds a third.
const SNAPSHOT_HISTORY: usize = 4;
/// Snapshots that exist at once in shared memory: the history, one being written, and those that slow readers still hold.
const SNAPSHOT_SLOTS: usize = 8;

/// Shortest wait for an event: the system counts in microseconds and takes none of them for no limit at all.
const SHORTEST_WAIT: Duration = Duration::from_micros(1);
/// How long an actor waits for a learner that starts at the same time.
const JOIN_PATIENCE: Duration = Duration::from_secs(20);
/// Time between two looks whether it is there.
const JOIN_INTERVAL: Duration = Duration::from_millis(50);
/// The name of the learner's node, by which others know that it is alive.
const LEARNER: &str = "learner";

/// The learner's ends.
#[derive(Debug)]
pub struct LearnerPorts {
    run: RunId,
    layout: SnapshotLayout,
    transitions: Subscriber<Ipc, TransitionRecord, ()>,
    status: Subscriber<Ipc, StatusRecord, ()>,
    control: Publisher<Ipc, ControlRecord, ()>,
    weights: Publisher<Ipc, [u8], SnapshotHeader>,
    wake: Listener<Ipc>,
    wake_actors: Notifier<Ipc>,
    node: Node<Ipc>,
}

/// An actor's ends.
#[derive(Debug)]
pub struct ActorPorts {
    run: RunId,
    layout: SnapshotLayout,
    transitions: Publisher<Ipc, TransitionRecord, ()>,
    status: Publisher<Ipc, StatusRecord, ()>,
    control: Subscriber<Ipc, ControlRecord, ()>,
    weights: Subscriber<Ipc, [u8], SnapshotHeader>,
    wake: Listener<Ipc>,
    wake_learner: Notifier<Ipc>,
    // Held so that the node outlives its ports and is seen as alive.
    _node: Node<Ipc>,
}

/// Wakes the learner's receiving thread from another thread of the learner: ports belong to the thread that opened them.
#[derive(Debug)]
pub struct LearnerWaker {
    wake_learner: Notifier<Ipc>,
    _node: Node<Ipc>,
}

/// What a service could not do.
#[derive(Debug, thiserror::Error)]
#[error("{operation} of service `{service}` failed: {cause}{remedy}")]
pub struct ServiceError {
    /// The service.
    pub service: &'static str,
    /// What was tried.
    pub operation: &'static str,
    /// iceoryx2's word for it.
    pub cause: String,
    /// What to do about it.
    pub remedy: &'static str,
}

/// Why a process could not join the services of a run.
#[derive(Debug, thiserror::Error)]
pub enum JoinError {
    /// The run is over, was never started on this machine, or its learner died.
    #[error("no learner of this run is there: none came to {} within {patience_secs} s", transport_root.display())]
    NoLearner {
        /// [`RunIdentity::transport_root`].
        transport_root: PathBuf,
        /// Seconds it was waited for.
        patience_secs: f64,
    },
    /// There is one, but its services cannot be used.
    #[error(transparent)]
    Service(#[from] ServiceError),
}

impl ServiceError {
    /// Whether waiting may help: the learner has not created the service yet, or its predecessor's is being removed.
    fn may_pass(&self) -> bool {
        ["DoesNotExist", "HangsInCreation", "IsMarkedForDestruction"]
            .iter()
            .any(|cause| self.cause.contains(cause))
    }
}

fn failed<E: Debug>(service: &'static str, operation: &'static str) -> impl FnOnce(E) -> ServiceError {
    move |error| {
        let cause = format!("{error:?}");
        let remedy = if cause.contains("IncompatibleAttributes") || cause.contains("IncompatibleTypes") {
            "; this process and the run differ in program version or configuration: start it from the same build and run directory"
        } else if cause.contains("DoesNotExist") {
            "; the learner of this run has not opened it, or is gone"
        } else if cause.contains("ExceedsMax") {
            "; no slot is free: raise transport.max_actors, or end the other learner of this run"
        } else if cause.contains("InsufficientPermissions") {
            "; the run belongs to another user"
        } else {
            ""
        };
        ServiceError {
            service,
            operation,
            cause,
            remedy,
        }
    }
}

/// How services come to be.
#[derive(Debug, Clone, Copy)]
enum Manner {
    /// They are created unless they are there.
    Create,
    /// They are created by the learner, until the deadline.
    Join { deadline: Instant },
}

impl Manner {
    fn joining(patience: Duration) -> Self {
        Self::Join {
            deadline: Instant::now() + patience,
        }
    }
}

/// Opens services of one run with the limits its configuration asks for.
struct Opener<'a> {
    node: &'a Node<Ipc>,
    manner: Manner,
    attributes: AttributeVerifier,
    actors: usize,
}

/// Creates or joins a service of the [`Opener`], as its manner says. A macro, because builders of different payloads have no trait in common.
macro_rules! opened {
    ($opener:expr, $service:expr, $builder:expr) => {
        match $opener.manner {
            Manner::Create => $builder
                .open_or_create_with_attributes(&$opener.attributes)
                .map_err(failed($service, "opening")),
            Manner::Join { deadline } => join(deadline, $service, || {
                $builder.open_with_attributes(&$opener.attributes)
            }),
        }
    };
}

/// Tries to open a service until it is there and complete, or the deadline has passed.
fn join<S, E: Debug>(
    deadline: Instant,
    service: &'static str,
    open: impl Fn() -> Result<S, E>,
) -> Result<S, ServiceError> {
    loop {
        match open().map_err(failed(service, "opening")) {
            Err(error) if error.may_pass() && Instant::now() < deadline => sleep(JOIN_INTERVAL),
            settled => return settled,
        }
    }
}

impl<'a> Opener<'a> {
    fn new(node: &'a Node<Ipc>, manner: Manner, identity: &RunIdentity, config: &Config) -> Result<Self, ServiceError> {
        let layout = SnapshotLayout::of(config).digest();
        let mut attributes = AttributeVerifier::new();
        for (key, value) in [
            ("protocol", PROTOCOL_VERSION.to_string()),
            ("run", format!("{:016x}", identity.run.0)),
            ("config", format!("{:016x}", identity.config_digest)),
            ("snapshot-layout", format!("{layout:016x}")),
        ] {
            let key = key.try_into().map_err(failed("all", "naming an attribute"))?;
            let value = value
                .as_str()
                .try_into()
                .map_err(failed("all", "setting an attribute"))?;
            attributes = attributes
                .require(&key, &value)
                .map_err(failed("all", "setting an attribute"))?;
        }
        // A restarted actor may come before its dead predecessor's slots are reclaimed; the learner's own waker takes one.
        Ok(Self {
            node,
            manner,
            attributes,
            actors: 2 * config.transport.max_actors,
        })
    }

    fn nodes(&self) -> usize {
        self.actors + 2
    }

    fn transitions(
        &self,
        config: &Config,
    ) -> Result<iceoryx2::service::port_factory::publish_subscribe::PortFactory<Ipc, TransitionRecord, ()>, ServiceError>
    {
        let name = service_name("transitions")?;
        let builder = || {
            self.node
                .service_builder(&name)
                .publish_subscribe::<TransitionRecord>()
                .payload_alignment(Alignment::new(64).expect("64 is a power of two"))
                .max_publishers(self.actors)
                .max_subscribers(1)
                .max_nodes(self.nodes())
                // Every flight an actor holds a ticket for fits whole, so a record is never refused for want of room.
                .subscriber_max_buffer_size(
                    config.transport.max_records_per_flight * config.transport.tickets_per_actor,
                )
                .subscriber_max_borrowed_samples(BORROWED_RECORDS)
                .history_size(0)
                .enable_safe_overflow(false)
        };
        opened!(self, "transitions", builder())
    }

    fn status(
        &self,
    ) -> Result<iceoryx2::service::port_factory::publish_subscribe::PortFactory<Ipc, StatusRecord, ()>, ServiceError>
    {
        let name = service_name("status")?;
        let builder = || {
            self.node
                .service_builder(&name)
                .publish_subscribe::<StatusRecord>()
                .max_publishers(self.actors)
                .max_subscribers(1)
                .max_nodes(self.nodes())
                .subscriber_max_buffer_size(8)
                .subscriber_max_borrowed_samples(1)
                // A late joiner of a learner, or a restarted one, hears of its actors at once.
                .history_size(1)
                // Only the newest signs of life matter.
                .enable_safe_overflow(true)
        };
        opened!(self, "status", builder())
    }

    fn control(
        &self,
        config: &Config,
    ) -> Result<iceoryx2::service::port_factory::publish_subscribe::PortFactory<Ipc, ControlRecord, ()>, ServiceError>
    {
        let name = service_name("control")?;
        let builder = || {
            self.node
                .service_builder(&name)
                .publish_subscribe::<ControlRecord>()
                .max_publishers(1)
                .max_subscribers(self.actors)
                .max_nodes(self.nodes())
                // All tickets pass by every actor: room for everyone's while this one flies.
                .subscriber_max_buffer_size(4 * config.transport.max_actors * config.transport.tickets_per_actor + 64)
                .subscriber_max_borrowed_samples(1)
                .history_size(0)
                .enable_safe_overflow(false)
        };
        opened!(self, "control", builder())
    }

    fn weights(
        &self,
    ) -> Result<iceoryx2::service::port_factory::publish_subscribe::PortFactory<Ipc, [u8], SnapshotHeader>, ServiceError>
    {
        let name = service_name("weights")?;
        let builder = || {
            self.node
                .service_builder(&name)
                .publish_subscribe::<[u8]>()
                .user_header::<SnapshotHeader>()
                .max_publishers(1)
                .max_subscribers(self.actors)
                .max_nodes(self.nodes())
                .subscriber_max_buffer_size(SNAPSHOT_HISTORY)
                .subscriber_max_borrowed_samples(1)
                .history_size(SNAPSHOT_HISTORY)
                // The newest snapshots win.
                .enable_safe_overflow(true)
        };
        opened!(self, "weights", builder())
    }

    fn event(
        &self,
        name: &'static str,
        notifiers: usize,
        listeners: usize,
    ) -> Result<event::PortFactory<Ipc>, ServiceError> {
        let service = service_name(name)?;
        let builder = || {
            self.node
                .service_builder(&service)
                .event()
                .max_notifiers(notifiers)
                .max_listeners(listeners)
                .max_nodes(self.nodes())
                .event_id_max_value(1)
        };
        opened!(self, name, builder())
    }
}

fn service_name(name: &'static str) -> Result<ServiceName, ServiceError> {
    name.try_into().map_err(failed(name, "naming"))
}

/// iceoryx2's settings for one run. Called before anything else of iceoryx2 is.
fn transport_config(identity: &RunIdentity) -> Result<IceoryxConfig, ServiceError> {
    // Everything iceoryx2 would print goes wrong again, with our words, in the errors returned here.
    set_log_level(LogLevel::Fatal);
    let mut config = IceoryxConfig::default();
    let root = identity.transport_root.to_string_lossy();
    config
        .global
        .set_root_path(&Path::new(root.as_bytes()).map_err(failed("all", "setting the root path"))?);
    config.global.prefix =
        FileName::new(identity.transport_prefix.as_bytes()).map_err(failed("all", "setting the prefix"))?;
    Ok(config)
}

fn node(identity: &RunIdentity, name: &str) -> Result<Node<Ipc>, ServiceError> {
    let config = transport_config(identity)?;
    NodeBuilder::new()
        .name(&NodeName::new(name).map_err(failed("all", "naming the node"))?)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .config(&config)
        .create::<Ipc>()
        .map_err(failed("all", "creating the node"))
}

/// Whether the learner of a run is alive on this machine. Looking leaves no trace.
///
/// # Errors
/// [`ServiceError`] when the run's processes cannot be looked at: it belongs to another user.
pub fn is_learner_alive(identity: &RunIdentity) -> Result<bool, ServiceError> {
    if !identity.transport_root.exists() {
        return Ok(false);
    }
    let mut is_alive = false;
    Node::<Ipc>::list(&transport_config(identity)?, |state| {
        if let NodeState::Alive(node) = state {
            is_alive |= node
                .details()
                .as_ref()
                .is_some_and(|details| details.name().as_str() == LEARNER);
        }
        CallbackProgression::Continue
    })
    .map_err(failed("all", "looking for the learner"))?;
    Ok(is_alive)
}

/// A node called `name` for a process that joins a learner. It is made only once there is a learner, because making it creates the transport's folder.
fn join_learner(identity: &RunIdentity, name: &str, patience: Duration) -> Result<Node<Ipc>, JoinError> {
    let deadline = Instant::now() + patience;
    while !is_learner_alive(identity)? {
        if Instant::now() >= deadline {
            return Err(JoinError::NoLearner {
                transport_root: identity.transport_root.clone(),
                patience_secs: patience.as_secs_f64(),
            });
        }
        sleep(JOIN_INTERVAL);
    }
    Ok(node(identity, name)?)
}

/// Waits for an event or a signal, not longer than `timeout`.
fn wait(wake: &Listener<Ipc>, timeout: Duration) -> Result<(), ListenerWaitError> {
    match wake.timed_wait(|_| {}, timeout.max(SHORTEST_WAIT)) {
        // A process that was stopped and continued, from a terminal say, is interrupted too; whoever waits looks round and waits again.
        Ok(_) | Err(ListenerWaitError::InterruptSignal) => Ok(()),
        Err(error) => Err(error),
    }
}

impl LearnerPorts {
    /// Opens the learner's ends of every service, on the thread that will use them.
    ///
    /// # Errors
    /// [`ServiceError`] says which service and what differs; a second learner of one run is refused.
    pub fn open(identity: &RunIdentity, config: &Config) -> Result<Self, ServiceError> {
        let node = node(identity, LEARNER)?;
        let open = Opener::new(&node, Manner::Create, identity, config)?;
        let layout = SnapshotLayout::of(config);
        let weights_factory = open.weights()?;
        Ok(Self {
            run: identity.run,
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
                .create()
                .map_err(failed("control", "publishing"))?,
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
        self.transitions.receive().map_err(failed("transitions", "receiving"))
    }

    /// The next status record, if one has arrived.
    ///
    /// # Errors
    /// [`ServiceError`] when an actor's memory cannot be mapped.
    pub fn receive_status(&self) -> Result<Option<StatusRecord>, ServiceError> {
        let sample = self.status.receive().map_err(failed("status", "receiving"))?;
        Ok(sample.map(|sample| *sample))
    }

    /// Sends `record` to the actors connected now; a lost one is made good by the ticket's deadline.
    ///
    /// # Errors
    /// [`ServiceError`] when there is no memory to send it in.
    pub fn send_control(&self, record: ControlRecord) -> Result<(), ServiceError> {
        self.control
            .send_copy(record)
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
        *sample.user_header_mut() = snapshot.header(self.run, &self.layout);
        sample
            .write_from_slice(bytes)
            .send()
            .map(drop)
            .map_err(failed("weights", "sending"))
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

    /// Connects to actors that have come, hands late joiners the newest snapshots, and reclaims what dead processes held. To be called regularly.
    ///
    /// # Errors
    /// [`ServiceError`] when a peer's memory cannot be mapped.
    pub fn maintain(&self) -> Result<(), ServiceError> {
        self.transitions
            .update_connections()
            .map_err(failed("transitions", "connecting"))?;
        self.status
            .update_connections()
            .map_err(failed("status", "connecting"))?;
        self.weights
            .update_connections()
            .map_err(failed("weights", "connecting"))?;
        self.control
            .update_connections()
            .map_err(failed("control", "connecting"))?;
        self.node.try_cleanup_dead_nodes();
        Ok(())
    }
}

impl LearnerWaker {
    /// Opens the waker, on the thread that will use it.
    ///
    /// # Errors
    /// [`JoinError`] says what differs, or that the receiving thread has not opened its ends.
    pub fn open(identity: &RunIdentity, config: &Config) -> Result<Self, JoinError> {
        let node = join_learner(identity, "learner-waker", JOIN_PATIENCE)?;
        let open = Opener::new(&node, Manner::joining(JOIN_PATIENCE), identity, config)?;
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

impl ActorPorts {
    /// Opens an actor's ends of every service, on the thread that will use them. Waits a while for a learner that is starting.
    ///
    /// # Errors
    /// [`JoinError::NoLearner`] when none came; nothing is left of the attempt then. [`JoinError::Service`] says which service and what differs.
    pub fn open(identity: &RunIdentity, config: &Config) -> Result<Self, JoinError> {
        Self::open_within(JOIN_PATIENCE, identity, config)
    }

    fn open_within(patience: Duration, identity: &RunIdentity, config: &Config) -> Result<Self, JoinError> {
        let node = join_learner(identity, "actor", patience)?;
        let open = Opener::new(&node, Manner::joining(patience), identity, config)?;
        Ok(Self {
            run: identity.run,
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

    /// Waits until the learner has something to say, `timeout` has passed, or a signal has come.
    ///
    /// # Errors
    /// [`ServiceError`] when the wait itself fails.
    pub fn wait(&self, timeout: Duration) -> Result<(), ServiceError> {
        wait(&self.wake, timeout).map_err(failed("wake-actors", "waiting"))
    }

    /// A record in shared memory, to be written in place. It holds whatever was in that memory before.
    ///
    /// # Errors
    /// [`ServiceError`] when the learner holds all of this actor's memory, which tickets rule out.
    pub fn loan_transition(&self) -> Result<LoanedTransition, ServiceError> {
        let sample = self
            .transitions
            .loan_uninit()
            .map_err(failed("transitions", "loaning"))?;
        // SAFETY: the record is plain data, for which every bit pattern is valid, and the memory is a shared mapping that the operating system
        // and iceoryx2 have initialised with zeros.
        Ok(unsafe { sample.assume_init() })
    }

    /// Sends a record without a copy. That it arrives is not promised: the learner counts.
    ///
    /// # Errors
    /// [`ServiceError`] when the connection is broken.
    pub fn send_transition(&self, record: LoanedTransition) -> Result<(), ServiceError> {
        record.send().map(drop).map_err(failed("transitions", "sending"))
    }

    /// Sends a sign of life.
    ///
    /// # Errors
    /// [`ServiceError`] when there is no memory to send it in.
    pub fn send_status(&self, record: StatusRecord) -> Result<(), ServiceError> {
        self.status
            .send_copy(record)
            .map(drop)
            .map_err(failed("status", "sending"))
    }

    /// The next control record, if one has arrived.
    ///
    /// # Errors
    /// [`ServiceError`] when the learner's memory cannot be mapped.
    pub fn receive_control(&self) -> Result<Option<ControlRecord>, ServiceError> {
        let sample = self.control.receive().map_err(failed("control", "receiving"))?;
        Ok(sample.map(|sample| *sample))
    }

    /// The next snapshot, if one has arrived; the inner result says whether it can be flown.
    ///
    /// # Errors
    /// [`ServiceError`] when the learner's memory cannot be mapped.
    pub fn receive_snapshot(&self) -> Result<Option<Result<Snapshot, crate::snapshot::SnapshotError>>, ServiceError> {
        let sample = self.weights.receive().map_err(failed("weights", "receiving"))?;
        Ok(sample.map(|sample| Snapshot::receive(sample.user_header(), sample.payload(), self.run, &self.layout)))
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
        self.weights
            .update_connections()
            .map_err(failed("weights", "connecting"))?;
        self.transitions
            .update_connections()
            .map_err(failed("transitions", "connecting"))?;
        self.status.update_connections().map_err(failed("status", "connecting"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::{ActorId, Attempt, FlightId, Incarnation, PolicyVersion};
    use crate::run::RunDirectory;
    use crate::ticket::{CourseChoice, Exploration, Ticket};

    struct Run {
        identity: RunIdentity,
        config: Config,
        _directory: tempfile::TempDir,
    }

    impl Run {
        fn new() -> Self {
            let directory = tempfile::tempdir().unwrap();
            let run = RunDirectory::new(directory.path());
            let mut config = Config::default();
            config.transport.max_actors = 2;
            config.sac.hidden_width = 8;
            run.create(&config).unwrap();
            let (identity, config) = run.open().unwrap();
            Self {
                identity,
                config,
                _directory: directory,
            }
        }

        fn learner(&self) -> Result<LearnerPorts, ServiceError> {
            LearnerPorts::open(&self.identity, &self.config)
        }

        fn actor(&self) -> Result<ActorPorts, JoinError> {
            ActorPorts::open(&self.identity, &self.config)
        }
    }

    impl Drop for Run {
        fn drop(&mut self) {
            self.identity.remove_transport();
        }
    }

    fn ticket(run: RunId) -> Ticket {
        Ticket {
            run,
            flight: FlightId(1),
            attempt: Attempt(0),
            policy_version: PolicyVersion(0),
            course: CourseChoice::Training,
            start_level: 1,
            exploration: Exploration::Uniform,
            seed: 7,
        }
    }

    #[test]
    fn the_image_written_into_the_loan_is_the_image_received() {
        let run = Run::new();
        let (learner, actor) = (run.learner().unwrap(), run.actor().unwrap());
        learner.maintain().unwrap();
        let ticket = ticket(run.identity.run);
        let mut record = actor.loan_transition().unwrap();
        record.begin(&ticket, ActorId(0), Incarnation(1), 0);
        record
            .depth
            .iter_mut()
            .enumerate()
            .for_each(|(index, pixel)| *pixel = index as u8);
        assert_eq!(
            record.depth.as_ptr() as usize % 64,
            0,
            "the image starts on a cache line"
        );
        actor.send_transition(record).unwrap();
        actor.wake_learner().unwrap();
        learner.wait(Duration::from_secs(1)).unwrap();
        let received = learner.receive_transition().unwrap().unwrap();
        received.check(&ticket, ActorId(0), Incarnation(1), 0).unwrap();
        assert!(
            received
                .depth
                .iter()
                .enumerate()
                .all(|(index, pixel)| *pixel == index as u8)
        );
    }

    #[test]
    fn a_late_actor_gets_the_newest_snapshots() {
        let run = Run::new();
        let learner = run.learner().unwrap();
        let values = SnapshotLayout::of(&run.config).values();
        for version in 0..7 {
            let snapshot = Snapshot {
                version: PolicyVersion(version),
                values: vec![version as f32; values],
            };
            learner.publish(&snapshot).unwrap();
        }
        let actor = run.actor().unwrap();
        learner.maintain().unwrap();
        let mut versions = Vec::new();
        while let Some(snapshot) = actor.receive_snapshot().unwrap() {
            versions.push(snapshot.unwrap().version.0);
        }
        assert_eq!(versions, [3, 4, 5, 6]);
    }

    #[test]
    fn the_largest_flight_of_every_ticket_fits_unread() {
        let run = Run::new();
        let (learner, actor) = (run.learner().unwrap(), run.actor().unwrap());
        learner.maintain().unwrap();
        let records = run.config.transport.max_records_per_flight * run.config.transport.tickets_per_actor;
        for step in 0..records {
            let mut record = actor.loan_transition().unwrap();
            record.begin(&ticket(run.identity.run), ActorId(0), Incarnation(1), step as u32);
            actor.send_transition(record).unwrap();
        }
        for step in 0..records {
            assert_eq!(learner.receive_transition().unwrap().unwrap().step, step as u32);
        }
    }

    #[test]
    fn a_wait_of_no_time_ends() {
        let (say, heard) = std::sync::mpsc::channel();
        std::thread::spawn(move || {
            let run = Run::new();
            let (learner, actor) = (run.learner().unwrap(), run.actor().unwrap());
            learner.wait(Duration::ZERO).unwrap();
            actor.wait(Duration::from_nanos(1)).unwrap();
            say.send(()).unwrap();
        });
        heard.recv_timeout(Duration::from_secs(5)).unwrap();
    }

    #[test]
    fn a_process_that_was_stopped_and_continued_goes_on() {
        let run = Run::new();
        let (learner, actor) = (run.learner().unwrap(), run.actor().unwrap());
        for wait in [&|time| learner.wait(time), &|time| actor.wait(time)] as [&dyn Fn(Duration) -> _; 2] {
            let mut stopper = std::process::Command::new("sh")
                .args(["-c", "sleep 0.1; kill -STOP $PPID; sleep 0.1; kill -CONT $PPID"])
                .spawn()
                .unwrap();
            wait(Duration::from_secs(1)).unwrap();
            stopper.wait().unwrap();
        }
    }

    #[test]
    fn a_second_learner_is_refused() {
        let run = Run::new();
        let _first = run.learner().unwrap();
        let refusal = run.learner().unwrap_err().to_string();
        assert!(refusal.contains("the other learner of this run"), "{refusal}");
    }

    #[test]
    fn an_actor_of_another_configuration_is_refused() {
        let mut run = Run::new();
        let _learner = run.learner().unwrap();
        run.identity.config_digest ^= 1;
        let refusal = run.actor().unwrap_err().to_string();
        assert!(
            refusal.contains("differ in program version or configuration"),
            "{refusal}"
        );
    }

    #[test]
    fn an_actor_waits_for_the_learner() {
        let run = Run::new();
        let (identity, config) = (run.identity.clone(), run.config.clone());
        let actor = std::thread::spawn(move || ActorPorts::open(&identity, &config).map(drop));
        sleep(3 * JOIN_INTERVAL);
        assert!(!actor.is_finished(), "the actor did not wait");
        let _learner = run.learner().unwrap();
        actor.join().unwrap().unwrap();
    }

    #[test]
    fn an_actor_of_a_run_that_is_over_leaves_nothing_behind() {
        let run = Run::new();
        drop(run.learner().unwrap());
        run.identity.remove_transport();
        assert!(!is_learner_alive(&run.identity).unwrap());
        let refusal = ActorPorts::open_within(2 * JOIN_INTERVAL, &run.identity, &run.config).unwrap_err();
        assert!(matches!(refusal, JoinError::NoLearner { .. }), "{refusal}");
        assert!(!run.identity.transport_root.exists());
    }

    #[test]
    fn a_transport_folder_alone_is_no_learner() {
        let run = Run::new();
        let learner = run.learner().unwrap();
        let _waker = LearnerWaker::open(&run.identity, &run.config).unwrap();
        assert!(is_learner_alive(&run.identity).unwrap());
        drop(learner);
        assert!(run.identity.transport_root.exists());
        assert!(!is_learner_alive(&run.identity).unwrap());
    }
}
