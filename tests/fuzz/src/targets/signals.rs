//! Status and control records and tickets of segments, bit for bit: an accepted record is identical
//! when written again.

use std::time::Duration;

use bytemuck::{Pod, Zeroable, bytes_of, pod_read_unaligned};
use skein_protocol::ids::{ActorId, ActorIncarnation, PolicyVersion, RunId};
use skein_protocol::segment::{Segment, SegmentRecord};
use skein_protocol::stages::{Stage, StageTimes};
use skein_protocol::status::{ActorState, ActorStatus, StatusRecord};
use skein_protocol::ticket::{Control, ControlRecord};
use skein_run::tables::stages_table;

use super::records::sample_ticket;
use super::{ReaderDecision, Target, USUAL};

pub(super) const SIGNALS: Target = Target {
    name: "signals",
    reads: "status and control records, tickets of segments",
    longest_bytes: size_of::<SegmentRecord>(),
    weight: 2 * USUAL,
    samples: signal_samples,
    run: |bytes| {
        let run = run_of(bytes);
        let read = [
            status(pod(bytes), run),
            control(pod(bytes), run),
            segment(pod(bytes), run),
        ];
        ReaderDecision::of(read.into_iter().flatten().next())
    },
};

fn signal_samples() -> Vec<Vec<u8>> {
    let mut times = StageTimes::default();
    times.add(Stage::Physics, 300, Duration::from_millis(450));
    times.add(Stage::ActorIdle, 2, Duration::from_secs(3));
    let status = ActorStatus {
        actor: ActorId(3),
        incarnation: ActorIncarnation(7),
        pid: 4711,
        state: ActorState::Serving,
        newest_policy: Some(PolicyVersion(2)),
        episodes_flown: 12,
        times,
    };
    let run = RunId(1);
    let ticket = sample_ticket(5);
    let segment = Segment {
        steps: 1,
        prior_actions: vec![[0.5, -1.0, 0.25, 0.0]; 3].into(),
    };
    vec![
        bytes_of(&SegmentRecord::fly(
            &ticket,
            &segment,
            ActorId(3),
            ActorIncarnation(7),
        ))
        .to_vec(),
        bytes_of(&StatusRecord::new(run, &status)).to_vec(),
        bytes_of(&ControlRecord::fly(
            &ticket,
            ActorId(3),
            ActorIncarnation(7),
        ))
        .to_vec(),
        bytes_of(&ControlRecord::heartbeat(run)).to_vec(),
        bytes_of(&ControlRecord::stop(run)).to_vec(),
        bytes_of(&ControlRecord::rejoin(run, ActorId(3), ActorIncarnation(7))).to_vec(),
    ]
}

/// Interprets `bytes` as a record, filled up with zeros.
pub(super) fn pod<T: Pod + Zeroable>(bytes: &[u8]) -> T {
    let mut padded = vec![0; size_of::<T>()];
    let given = bytes.len().min(padded.len());
    padded[..given].copy_from_slice(&bytes[..given]);
    pod_read_unaligned(&padded)
}

/// Returns the run of a record. All records begin with it; taking it from the input lets the reader
/// see the rest.
fn run_of(bytes: &[u8]) -> RunId {
    RunId(pod(bytes))
}

fn status(record: StatusRecord, run: RunId) -> Option<()> {
    assert_eq!(record.read(RunId(!run.0)), None);
    let status = record.read(run)?;
    assert_eq!(StatusRecord::new(run, &status).read(run), Some(status));
    // Accepted values of 1024 actors can be added and shown.
    let ten_times = (0..10).fold(status.times, |sum, _| sum.plus(&sum));
    assert!(stages_table(&ten_times, 80).lines().count() >= 3);
    Some(())
}

fn control(record: ControlRecord, run: RunId) -> Option<()> {
    assert!(record.read(RunId(!run.0)).is_err());
    if let Control::Fly(ticket) = record.read(run).ok()? {
        let again = ControlRecord::fly(&ticket, ActorId(1), ActorIncarnation(2));
        assert!(ticket.start_level > 0);
        assert_eq!(again.read(run), Ok(Control::Fly(ticket)));
    }
    Some(())
}

fn segment(record: SegmentRecord, run: RunId) -> Option<()> {
    assert!(record.read(RunId(!run.0)).is_err());
    let Control::Fly(ticket) = record.read(run).ok()? else {
        panic!("a record of a segment is a ticket or nothing");
    };
    let segment = ticket.segment.clone().expect("it is of a segment");
    assert!(
        segment.steps > 0
            && segment
                .prior_actions
                .iter()
                .flatten()
                .all(|command| command.abs() <= 1.0)
    );
    let again = SegmentRecord::fly(&ticket, &segment, ActorId(1), ActorIncarnation(2));
    assert_eq!(again.read(run), Ok(Control::Fly(ticket)));
    Some(())
}
