//! Assembles streamed records into a whole flight.
//!
//! A flight is committed once, complete and in order, or not at all; nothing downstream ever sees half of one, or one flown with two policies.

use skein_protocol::ids::{ActorId, Epoch, Incarnation};
use skein_protocol::ticket::Ticket;
use skein_protocol::transition::{Outcome, RecordFault, RecordKind, TransitionRecord};

use crate::flight::{CommittedFlight, StepObservation};

/// What the learner wants of a flight, besides that it is flown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Keep {
    /// Latent codes and telemetry only.
    Latents,
    /// The depth images too: they are copied out of shared memory, once.
    Depth,
}

/// A flight under way.
#[derive(Debug)]
pub struct Assembly {
    ticket: Ticket,
    actor: ActorId,
    incarnation: Incarnation,
    flight: CommittedFlight,
    keep: Keep,
}

/// What a record did to its flight.
#[derive(Debug)]
pub enum Assembled {
    /// It is one more step.
    Step,
    /// It was the last.
    Whole(Box<CommittedFlight>),
    /// The simulator failed; the flight is void.
    Failed,
}

impl Assembly {
    /// Nothing of `ticket`'s flight yet.
    pub fn new(ticket: Ticket, epoch: Epoch, keep: Keep, actor: ActorId, incarnation: Incarnation) -> Self {
        let flight = CommittedFlight {
            flight: ticket.flight,
            epoch,
            policy_version: ticket.policy_version,
            actor,
            level: ticket.start_level,
            observations: Vec::new(),
            actions: Vec::new(),
            rewards: Vec::new(),
            reward_terms: Vec::new(),
            level_up: Vec::new(),
            outcome: Outcome::TimedOut,
            walls_passed: 0,
            course_walls: 0,
            depth: (keep == Keep::Depth).then(Vec::new),
        };
        Self {
            ticket,
            actor,
            incarnation,
            flight,
            keep,
        }
    }

    /// Whether nothing has arrived yet.
    pub fn is_empty(&self) -> bool {
        self.flight.observations.is_empty()
    }

    /// Takes the next record in.
    ///
    /// # Errors
    /// [`RecordFault`] when it is not the next record of this flight, or makes no sense; the flight is void then.
    pub fn push(&mut self, record: &TransitionRecord) -> Result<Assembled, RecordFault> {
        let step = self.flight.observations.len() as u32;
        let kind = record.check(&self.ticket, self.actor, self.incarnation, step)?;
        if kind == RecordKind::Failed {
            return Ok(Assembled::Failed);
        }
        self.flight.observations.push(StepObservation {
            latent: record.latent,
            velocity_mps: record.velocity_mps,
            position_m: record.position_m,
            orientation: record.orientation,
        });
        if let (Keep::Depth, Some(depth)) = (self.keep, &mut self.flight.depth) {
            depth.extend_from_slice(&record.depth);
        }
        if kind == RecordKind::Closing {
            return self.close(record).map(|flight| Assembled::Whole(Box::new(flight)));
        }
        self.flight.actions.push(record.action);
        self.flight.rewards.push(record.reward);
        self.flight.reward_terms.push(record.reward_terms);
        self.flight.level_up.push(record.level_up == 1);
        Ok(Assembled::Step)
    }

    fn close(&mut self, record: &TransitionRecord) -> Result<CommittedFlight, RecordFault> {
        let outcome = Outcome::from_code(record.outcome).ok_or(RecordFault::Code {
            name: "outcome",
            value: record.outcome,
        })?;
        if self.flight.actions.is_empty() {
            return Err(RecordFault::Mismatch {
                name: "step",
                found: 0,
                expected: 1,
            });
        }
        self.flight.outcome = outcome;
        self.flight.walls_passed = record.walls_passed;
        self.flight.course_walls = record.course_walls;
        let empty = Self::new(self.ticket, self.flight.epoch, self.keep, self.actor, self.incarnation);
        Ok(std::mem::replace(self, empty).flight)
    }
}
