//! The protocol's records as iceoryx2 sends them.

use std::ops::{Deref, DerefMut};

use bytemuck::Pod;
use iceoryx2::prelude::ZeroCopySend;
use iceoryx2::sample::Sample;
use iceoryx2::sample_mut::SampleMut;
use skein_protocol::segment::SegmentRecord;
use skein_protocol::snapshot::SnapshotHeader;
use skein_protocol::status::StatusRecord;
use skein_protocol::ticket::ControlRecord;
use skein_protocol::transition::TransitionRecord;

use super::Ipc;

/// A protocol record in shared memory. The record itself cannot implement iceoryx2's marker trait,
/// because the protocol knows no transport.
#[derive(Debug, Clone, Copy, Default)]
#[repr(transparent)]
pub(super) struct Wire<T>(pub(super) T);

/// A record that iceoryx2 sends.
pub(super) trait WireRecord: Pod {
    /// Name of the record for both ends. Its number rises when the layout changes.
    const NAME: &'static str;
}

impl WireRecord for TransitionRecord {
    const NAME: &'static str = "skein.TransitionRecord.v4";
}

impl WireRecord for StatusRecord {
    const NAME: &'static str = "skein.StatusRecord.v2";
}

impl WireRecord for ControlRecord {
    const NAME: &'static str = "skein.ControlRecord.v1";
}

impl WireRecord for SegmentRecord {
    const NAME: &'static str = "skein.SegmentRecord.v1";
}

impl WireRecord for SnapshotHeader {
    const NAME: &'static str = "skein.SnapshotHeader.v1";
}

// SAFETY: a `Pod` type holds no pointer, reference or padding and has a fixed layout, which `Wire`
// shares as it is transparent. So its bytes mean the same in every process.
unsafe impl<T: WireRecord> ZeroCopySend for Wire<T> {
    unsafe fn type_name() -> &'static str {
        T::NAME
    }
}

/// Transition record in shared memory, being written.
#[derive(Debug)]
pub struct LoanedTransition(pub(super) SampleMut<Ipc, Wire<TransitionRecord>, ()>);

impl Deref for LoanedTransition {
    type Target = TransitionRecord;

    fn deref(&self) -> &TransitionRecord {
        &self.0.payload().0
    }
}

impl DerefMut for LoanedTransition {
    fn deref_mut(&mut self) -> &mut TransitionRecord {
        &mut self.0.payload_mut().0
    }
}

/// Transition record in shared memory, received.
#[derive(Debug)]
pub struct ReceivedTransition(pub(super) Sample<Ipc, Wire<TransitionRecord>, ()>);

impl Deref for ReceivedTransition {
    type Target = TransitionRecord;

    fn deref(&self) -> &TransitionRecord {
        &self.0.payload().0
    }
}
