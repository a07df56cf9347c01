//! A segment: some steps of an episode, flown on their own ticket, so that the rest can be flown
//! with newer weights.
//!
//! A segment is a function of its ticket, as an episode is: the ticket carries the actions flown so
//! far. The actor that flew the previous segment still has the drone where it ended. Any other
//! actor resets and repeats the actions; the simulator is deterministic, so the result is
//! identical.
//!
//! Tickets of segments have their own service. The actions make them thirty times as long as other
//! messages, of which shared memory has room for thousands.

use std::sync::Arc;

use bytemuck::{Pod, Zeroable};

use crate::ids::{ActorId, ActorIncarnation, RunId};
use crate::ticket::{Control, ControlFault, ControlRecord, Ticket};
use crate::{Action, MAX_ACTION};

/// Most earlier actions that a segment's ticket has room for.
pub const MAX_PRIOR_ACTIONS: usize = 256;

/// The part of an episode that a ticket is for.
#[derive(Debug, Clone, PartialEq)]
pub struct Segment {
    /// Steps to fly, unless the episode ends earlier.
    pub steps: u32,
    /// Actions flown earlier, from the reset on, at most [`MAX_PRIOR_ACTIONS`].
    pub prior_actions: Arc<[Action]>,
}

/// [`Ticket`] of a segment on the wire.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct SegmentRecord {
    ticket: ControlRecord,
    steps: u32,
    /// Number of valid `actions`.
    prior_actions: u32,
    actions: [Action; MAX_PRIOR_ACTIONS],
}

// Whole fields of eight bytes: no padding, so no uninitialised byte ever leaves the process.
const _: () = assert!(
    size_of::<SegmentRecord>()
        == size_of::<ControlRecord>() + 2 * 4 + MAX_PRIOR_ACTIONS * MAX_ACTION * 4
);

impl SegmentRecord {
    /// Builds the record of `segment` of `ticket`'s episode, for one incarnation of one actor.
    ///
    /// # Panics
    /// If there are more than [`MAX_PRIOR_ACTIONS`] earlier actions; the configuration allows no
    /// episode that long.
    pub fn fly(
        ticket: &Ticket,
        segment: &Segment,
        actor: ActorId,
        incarnation: ActorIncarnation,
    ) -> Self {
        let mut actions = [[0.0; MAX_ACTION]; MAX_PRIOR_ACTIONS];
        actions[..segment.prior_actions.len()].copy_from_slice(&segment.prior_actions);
        Self {
            ticket: ControlRecord::fly(ticket, actor, incarnation),
            steps: segment.steps,
            prior_actions: segment.prior_actions.len() as u32,
            actions,
        }
    }

    /// Returns `true` if the record is for this incarnation of this actor.
    pub fn is_for(&self, actor: ActorId, incarnation: ActorIncarnation) -> bool {
        self.ticket.is_for(actor, incarnation)
    }

    /// Reads the record: a ticket to fly a segment.
    ///
    /// # Errors
    /// [`ControlFault`] if the record holds what no learner of this version and run writes.
    pub fn read(&self, run: RunId) -> Result<Control, ControlFault> {
        let Control::Fly(ticket) = self.ticket.read(run)? else {
            return Err(ControlFault::Segment("is not a ticket"));
        };
        let flown =
            self.actions
                .get(..self.prior_actions as usize)
                .ok_or(ControlFault::Segment(
                    "has more actions than it has room for",
                ))?;
        // NaN is outside every range.
        let are_actions = flown
            .iter()
            .flatten()
            .all(|command| (-1.0..=1.0).contains(command));
        if !are_actions {
            return Err(ControlFault::Segment("has an action outside [-1, 1]"));
        }
        if self.steps == 0 {
            return Err(ControlFault::Segment("has zero steps"));
        }
        let segment = Segment {
            steps: self.steps,
            prior_actions: flown.into(),
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
        let actions = (0..flown).map(|step| [step as f32 / 256.0, -1.0, 0.5, 0.0]);
        let segment = Segment {
            steps: 3,
            prior_actions: actions.collect(),
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
        for flown in [0, 1, MAX_PRIOR_ACTIONS] {
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
        assert!(refused(|record| record.prior_actions = 257).contains("more actions"));
        assert!(refused(|record| record.actions[1][0] = f32::NAN).contains("outside [-1, 1]"));
        assert!(refused(|record| record.actions[0][1] = 1.5).contains("outside [-1, 1]"));
        assert!(refused(|record| record.steps = 0).contains("zero steps"));
        assert!(
            refused(|record| record.ticket = ControlRecord::stop(RUN)).contains("not a ticket")
        );
        assert!(matches!(
            record(2).read(RunId(4)),
            Err(ControlFault::OtherRun(3))
        ));
        // Unused actions are ignored.
        let mut record = record(2);
        record.actions[2] = [f32::NAN; MAX_ACTION];
        assert_eq!(record.read(RUN), Ok(Control::Fly(ticket(2))));
    }
}
