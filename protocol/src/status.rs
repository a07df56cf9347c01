//! The status of an actor: a heartbeat with its counters.

use bytemuck::{Pod, Zeroable};

use crate::ids::{ActorId, ActorIncarnation, PolicyVersion, RunId};
use crate::stages::{ACTOR_STAGES, StageTime, StageTimes};

/// Heartbeat of an actor on the wire. It is sent at the actor's start, when it finds no ticket to
/// fly, at regular intervals, and at its end.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct StatusRecord {
    run: u64,
    incarnation: u64,
    newest_policy: u64,
    episodes_flown: u64,
    actor: u32,
    pid: u32,
    state: u32,
    reserved: u32,
    /// Times by stage, in the order of [`crate::stages::Stage::ALL`].
    times: [StageTime; ACTOR_STAGES],
}

// Four 8-byte and four 4-byte fields, then tallies of two 8-byte fields: no padding.
const _: () = assert!(size_of::<StatusRecord>() == 4 * 8 + 4 * 4 + ACTOR_STAGES * 16);

/// An actor's state, as read from a [`StatusRecord`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ActorStatus {
    /// The actor.
    pub actor: ActorId,
    /// Its incarnation.
    pub incarnation: ActorIncarnation,
    /// Process id.
    pub pid: u32,
    /// State.
    pub state: ActorState,
    /// The newest snapshot that it holds, if any.
    pub newest_policy: Option<PolicyVersion>,
    /// Episodes flown in this incarnation.
    pub episodes_flown: u64,
    /// Times of this incarnation, up to its last lap.
    pub times: StageTimes,
}

/// State of an actor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ActorState {
    /// Accepts tickets, or flies one.
    Serving,
    /// Accepts no more tickets.
    Leaving,
}

const NO_POLICY: u64 = u64::MAX;

impl StatusRecord {
    /// Builds the record of `status`.
    pub fn new(run: RunId, status: &ActorStatus) -> Self {
        Self {
            run: run.0,
            incarnation: status.incarnation.0,
            newest_policy: status.newest_policy.map_or(NO_POLICY, |version| version.0),
            episodes_flown: status.episodes_flown,
            actor: status.actor.0,
            pid: status.pid,
            state: match status.state {
                ActorState::Serving => 1,
                ActorState::Leaving => 2,
            },
            reserved: 0,
            times: status.times.of_actor(),
        }
    }

    /// Reads the status; returns `None` if the record is of another run, or holds what no actor of
    /// this version writes (unknown state, times of years).
    pub fn read(&self, run: RunId) -> Option<ActorStatus> {
        let state = match self.state {
            1 => ActorState::Serving,
            2 => ActorState::Leaving,
            _ => return None,
        };
        let times = StageTimes::read_actor(&self.times)?;
        (self.run == run.0).then_some(ActorStatus {
            actor: ActorId(self.actor),
            incarnation: ActorIncarnation(self.incarnation),
            pid: self.pid,
            state,
            newest_policy: (self.newest_policy != NO_POLICY)
                .then_some(PolicyVersion(self.newest_policy)),
            episodes_flown: self.episodes_flown,
            times,
        })
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::stages::Stage;

    #[test]
    fn a_status_survives_the_wire_of_its_own_run_only() {
        for newest_policy in [None, Some(PolicyVersion(4))] {
            let status = ActorStatus {
                actor: ActorId(1),
                incarnation: ActorIncarnation(2),
                pid: 3,
                state: ActorState::Leaving,
                newest_policy,
                episodes_flown: 6,
                times: times(7),
            };
            let record = StatusRecord::new(RunId(9), &status);
            assert_eq!(record.read(RunId(9)), Some(status));
            assert_eq!(record.read(RunId(8)), None);
            assert_eq!(StatusRecord { state: 7, ..record }.read(RunId(9)), None);
        }
    }

    fn times(nanos: u64) -> StageTimes {
        let mut times = StageTimes::default();
        times.add(Stage::TakeSnapshot, 1, Duration::from_nanos(nanos));
        times.add(Stage::ActorIdle, nanos, Duration::from_nanos(2));
        times
    }

    #[test]
    fn impossible_times_are_refused() {
        let read = |times| {
            let status = ActorStatus {
                actor: ActorId(1),
                incarnation: ActorIncarnation(2),
                pid: 3,
                state: ActorState::Serving,
                newest_policy: None,
                episodes_flown: 6,
                times,
            };
            StatusRecord::new(RunId(9), &status).read(RunId(9))
        };
        let years = |years: u64| years * 365 * 24 * 3600 * 1_000_000_000;
        assert!(read(times(years(9))).is_some());
        assert_eq!(read(times(years(10))), None);
        assert_eq!(read(times(u64::MAX)), None);
    }
}
