//! A segment: some steps of an episode, flown on a ticket of their own, so that the rest can be
//! flown with what was learned meanwhile.
//!
//! A segment is a function of its ticket as an episode is: the ticket carries the actions flown so
//! far. An actor that has flown the segment before still has the drone where that ended; any other
//! takes off and repeats them, and as the simulator is deterministic it comes to the same.
//!
//! Tickets of segments have a service of their own. The actions make them thirty times as long as
//! other messages, of which shared memory has room for thousands.

use std::sync::Arc;

use bytemuck::{Pod, Zeroable};

use crate::ACTION;
use crate::ids::{ActorId, ActorIncarnation, RunId};
use crate::ticket::{Control, ControlFault, ControlRecord, Ticket};

/// Actions that a segment's ticket has room for.
pub const MOST_FLOWN: usize = 256;

/// Which part of its episode a ticket is for.
#[derive(Debug, Clone, PartialEq)]
pub struct Segment {
    /// Steps to be flown, unless the episode ends before.
    pub steps: u32,
    /// Actions flown before, from reset on, [`MOST_FLOWN`] at most.
    pub flown: Arc<[[f32; ACTION]]>,
}

/// The [`Ticket`] of a segment on the wire.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct SegmentRecord {
    ticket: ControlRecord,
    steps: u32,
    /// How many of `actions` there are.
    flown: u32,
    actions: [[f32; ACTION]; MOST_FLOWN],
}

// Whole fields of eight bytes: no padding, so no uninitialised byte ever leaves the process.
const _: () = assert!(
    size_of::<SegmentRecord>() == size_of::<ControlRecord>() + 2 * 4 + MOST_FLOWN * ACTION * 4
);

impl SegmentRecord {
    /// `segment` of `ticket`'s episode, for one incarnation of one actor.
    ///
    /// # Panics
    /// When more than [`MOST_FLOWN`] actions were flown before; the configuration allows no episode
    /// to become so long.
    pub fn fly(
        ticket: &Ticket,
        segment: &Segment,
        actor: ActorId,
        incarnation: ActorIncarnation,
    ) -> Self {
        let mut actions = [[0.0; ACTION]; MOST_FLOWN];
        actions[..segment.flown.len()].copy_from_slice(&segment.flown);
        Self {
            ticket: ControlRecord::fly(ticket, actor, incarnation),
            steps: segment.steps,
            flown: segment.flown.len() as u32,
            actions,
        }
    }

    /// Whether this incarnation of this actor is meant.
    pub fn is_for(&self, actor: ActorId, incarnation: ActorIncarnation) -> bool {
        self.ticket.is_for(actor, incarnation)
    }

    /// What is said: to fly a segment.
    ///
    /// # Errors
    /// [`ControlFault`] when the record holds what no learner of this version and run writes.
    pub fn read(&self, run: RunId) -> Result<Control, ControlFault> {
        let Control::Fly(ticket) = self.ticket.read(run)? else {
            return Err(ControlFault::Segment("is no ticket"));
        };
        let flown = self
            .actions
            .get(..self.flown as usize)
            .ok_or(ControlFault::Segment(
                "has more actions than it has room for",
            ))?;
        // No number is within bounds that is none.
        let are_actions = flown
            .iter()
            .flatten()
            .all(|command| (-1.0..=1.0).contains(command));
        if !are_actions {
            return Err(ControlFault::Segment("has an action outside [-1, 1]"));
        }
        if self.steps == 0 {
            return Err(ControlFault::Segment("is of no step"));
        }
        let segment = Segment {
            steps: self.steps,
            flown: flown.into(),
        };
        Ok(Control::Fly(Ticket {
            segment: Some(segment),
            ..ticket
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ticket::tests::ticket as whole_episode;

    const RUN: RunId = RunId(3);
    const ACTOR: ActorId = ActorId(4);
    const INCARNATION: ActorIncarnation = ActorIncarnation(8);

    fn ticket(flown: usize) -> Ticket {
        let actions = (0..flown).map(|step| [step as f32 / 256.0, -1.0]);
        let segment = Segment {
            steps: 3,
            flown: actions.collect(),
        };
        Ticket {
            segment: Some(segment),
            ..whole_episode()
        }
    }

    fn record(flown: usize) -> SegmentRecord {
        let ticket = ticket(flown);
        SegmentRecord::fly(
            &ticket,
            ticket.segment.as_ref().unwrap(),
            ACTOR,
            INCARNATION,
        )
    }

    #[test]
    fn a_segment_survives_the_wire_with_all_that_was_flown_before_it() {
        for flown in [0, 1, MOST_FLOWN] {
            let record = record(flown);
            assert_eq!(record.read(RUN), Ok(Control::Fly(ticket(flown))));
            assert!(
                record.is_for(ACTOR, INCARNATION) && !record.is_for(ACTOR, ActorIncarnation(9))
            );
        }
    }

    #[test]
    fn garbage_is_refused_with_what_is_wrong() {
        let refused = |damage: fn(&mut SegmentRecord)| {
            let mut record = record(2);
            damage(&mut record);
            record.read(RUN).unwrap_err().to_string()
        };
        assert!(refused(|record| record.flown = 257).contains("more actions"));
        assert!(refused(|record| record.actions[1][0] = f32::NAN).contains("outside [-1, 1]"));
        assert!(refused(|record| record.actions[0][1] = 1.5).contains("outside [-1, 1]"));
        assert!(refused(|record| record.steps = 0).contains("no step"));
        assert!(refused(|record| record.ticket = ControlRecord::stop(RUN)).contains("no ticket"));
        assert!(matches!(
            record(2).read(RunId(4)),
            Err(ControlFault::OtherRun(3))
        ));
        // What lies behind the actions is nobody's.
        let mut record = record(2);
        record.actions[2] = [f32::NAN; ACTION];
        assert_eq!(record.read(RUN), Ok(Control::Fly(ticket(2))));
    }
}
