//! Opening of services: every name and every limit.

use iceoryx2::node::Node;
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::event;

use super::wire::Wire;
use super::{Ipc, ServiceError, failed};
use skein_protocol::PROTOCOL_VERSION;
use skein_protocol::config::{Config, TransportSection};
use skein_protocol::segment::SegmentRecord;
use skein_protocol::snapshot::{SnapshotHeader, SnapshotLayout};
use skein_protocol::status::StatusRecord;
use skein_protocol::ticket::ControlRecord;
use skein_protocol::transition::TransitionRecord;
use skein_run::RunIdentity;

/// Records that the learner holds while it reads them.
const BORROWED_RECORDS: usize = 2;
/// Snapshots that a late joiner still receives: with policy lag 1 two versions are in use, and an
/// evaluation adds a third.
pub(super) const SNAPSHOT_HISTORY: usize = 4;
/// Tickets of segments that may wait for an actor.
const SEGMENT_BUFFER: usize = 1;

/// Mode in which services are opened.
#[derive(Debug, Clone, Copy)]
pub(super) enum OpenMode {
    /// The learner creates them.
    Create,
    /// All others join existing ones.
    Join,
}

/// Opens services of one run with the limits of its configuration.
pub(super) struct Opener<'a> {
    pub(super) node: &'a Node<Ipc>,
    pub(super) mode: OpenMode,
    attributes: AttributeVerifier,
    pub(super) actors: usize,
}

/// Creates or joins a service of the [`Opener`], depending on its mode. A macro, because builders
/// of different payloads share no trait.
macro_rules! opened {
    ($opener:expr, $service:expr, $builder:expr) => {
        match $opener.mode {
            OpenMode::Create => $builder
                .open_or_create_with_attributes(&$opener.attributes)
                .map_err(failed($service, "opening")),
            OpenMode::Join => $builder
                .open_with_attributes(&$opener.attributes)
                .map_err(failed($service, "opening")),
        }
    };
}

impl<'a> Opener<'a> {
    pub(super) fn new(
        node: &'a Node<Ipc>,
        mode: OpenMode,
        identity: &RunIdentity,
        config: &Config,
    ) -> Result<Self, ServiceError> {
        let layout = SnapshotLayout::of(config).digest();
        let mut attributes = AttributeVerifier::new();
        for (key, value) in [
            ("protocol", PROTOCOL_VERSION.to_string()),
            ("run", format!("{:016x}", identity.run.0)),
            ("config", format!("{:016x}", identity.config_digest)),
            ("snapshot-layout", format!("{layout:016x}")),
        ] {
            let key = key
                .try_into()
                .map_err(failed("all", "naming an attribute"))?;
            let value = value
                .as_str()
                .try_into()
                .map_err(failed("all", "setting an attribute"))?;
            attributes = attributes
                .require(&key, &value)
                .map_err(failed("all", "setting an attribute"))?;
        }
        // A restarted actor may join before its dead predecessor's slots are reclaimed, and the
        // learner's own waker takes one.
        Ok(Self {
            node,
            mode,
            attributes,
            actors: 2 * config.transport.max_actors,
        })
    }

    pub(super) fn nodes(&self) -> usize {
        self.actors + 2
    }

    pub(super) fn transitions(
        &self,
        config: &Config,
    ) -> Result<
        iceoryx2::service::port_factory::publish_subscribe::PortFactory<
            Ipc,
            Wire<TransitionRecord>,
            (),
        >,
        ServiceError,
    > {
        let name = service_name("transitions")?;
        let builder = || {
            self.node
                .service_builder(&name)
                .publish_subscribe::<Wire<TransitionRecord>>()
                .payload_alignment(Alignment::new(64).expect("64 is a power of two"))
                .max_publishers(self.actors)
                .max_subscribers(1)
                .max_nodes(self.nodes())
                // Every episode that an actor holds a ticket for fits whole, so no record is
                // refused for lack of space.
                .subscriber_max_buffer_size(transition_buffer(&config.transport))
                .subscriber_max_borrowed_samples(BORROWED_RECORDS)
                .history_size(0)
                .enable_safe_overflow(false)
        };
        opened!(self, "transitions", builder())
    }

    pub(super) fn status(
        &self,
    ) -> Result<
        iceoryx2::service::port_factory::publish_subscribe::PortFactory<
            Ipc,
            Wire<StatusRecord>,
            (),
        >,
        ServiceError,
    > {
        let name = service_name("status")?;
        let builder = || {
            self.node
                .service_builder(&name)
                .publish_subscribe::<Wire<StatusRecord>>()
                .max_publishers(self.actors)
                .max_subscribers(1)
                .max_nodes(self.nodes())
                .subscriber_max_buffer_size(8)
                .subscriber_max_borrowed_samples(1)
                // A restarted learner receives the status of its actors at once.
                .history_size(1)
                // Only the newest heartbeats matter.
                .enable_safe_overflow(true)
        };
        opened!(self, "status", builder())
    }

    pub(super) fn control(
        &self,
        config: &Config,
    ) -> Result<
        iceoryx2::service::port_factory::publish_subscribe::PortFactory<
            Ipc,
            Wire<ControlRecord>,
            (),
        >,
        ServiceError,
    > {
        let name = service_name("control")?;
        let builder = || {
            self.node
                .service_builder(&name)
                .publish_subscribe::<Wire<ControlRecord>>()
                .max_publishers(1)
                .max_subscribers(self.actors)
                .max_nodes(self.nodes())
                .subscriber_max_buffer_size(control_buffer(&config.transport))
                .subscriber_max_borrowed_samples(1)
                .history_size(0)
                .enable_safe_overflow(false)
        };
        opened!(self, "control", builder())
    }

    pub(super) fn segments(
        &self,
    ) -> Result<
        iceoryx2::service::port_factory::publish_subscribe::PortFactory<
            Ipc,
            Wire<SegmentRecord>,
            (),
        >,
        ServiceError,
    > {
        let name = service_name("segments")?;
        let builder = || {
            self.node
                .service_builder(&name)
                .publish_subscribe::<Wire<SegmentRecord>>()
                .max_publishers(1)
                .max_subscribers(self.actors)
                .max_nodes(self.nodes())
                .subscriber_max_buffer_size(SEGMENT_BUFFER)
                .subscriber_max_borrowed_samples(1)
                .history_size(0)
                // One segment of one episode is in progress at a time, so only the newest ticket of
                // a segment counts.
                .enable_safe_overflow(true)
        };
        opened!(self, "segments", builder())
    }

    pub(super) fn weights(
        &self,
    ) -> Result<
        iceoryx2::service::port_factory::publish_subscribe::PortFactory<
            Ipc,
            [u8],
            Wire<SnapshotHeader>,
        >,
        ServiceError,
    > {
        let name = service_name("weights")?;
        let builder = || {
            self.node
                .service_builder(&name)
                .publish_subscribe::<[u8]>()
                .user_header::<Wire<SnapshotHeader>>()
                .max_publishers(1)
                .max_subscribers(self.actors)
                .max_nodes(self.nodes())
                .subscriber_max_buffer_size(SNAPSHOT_HISTORY)
                .subscriber_max_borrowed_samples(1)
                .history_size(SNAPSHOT_HISTORY)
                // Only the newest snapshots matter.
                .enable_safe_overflow(true)
        };
        opened!(self, "weights", builder())
    }

    pub(super) fn event(
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

/// Returns how many records of an actor may wait for the learner: every episode that it holds a
/// ticket for, whole.
pub(super) fn transition_buffer(transport: &TransportSection) -> usize {
    transport.max_records_per_episode * transport.tickets_per_actor
}

/// Returns how many messages may wait for an actor. Every actor receives all tickets, so there is
/// room for everyone's, some of them twice, while this one flies.
pub(super) fn control_buffer(transport: &TransportSection) -> usize {
    4 * transport.max_actors * transport.tickets_per_actor + 64
}

/// Returns how many messages to actors exist at once. Usually all actors have the same ones left to
/// read. Actors that were stopped at different times hold the messages of those times, up to this
/// number. Beyond it no message can be sent, and the learner gives up the transport.
pub(super) fn control_slots(transport: &TransportSection) -> usize {
    16 * control_buffer(transport)
}

/// Returns how many tickets of segments exist at once: for each actor one that waits and one being
/// read, and one being written.
pub(super) fn segment_slots(transport: &TransportSection) -> usize {
    2 * transport.max_actors * (SEGMENT_BUFFER + 1) + 1
}

fn service_name(name: &'static str) -> Result<ServiceName, ServiceError> {
    name.try_into().map_err(failed(name, "naming"))
}
