//! Assembles streamed records into a whole flight.
//!
//! A flight is committed once, complete and in order, or not at all; nothing downstream ever sees half of one, or one flown with two policies.

use serde::{Deserialize, Serialize};
use skein_protocol::ids::{ActorId, Epoch, Incarnation};
use skein_protocol::ticket::Ticket;
use skein_protocol::transition::{Outcome, RecordFault, RecordKind, TransitionRecord};

use crate::flight::{CommittedFlight, StepObservation};

/// What the learner wants of a flight, besides that it is flown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
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
    longest_records: usize,
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
    /// Nothing of `ticket`'s flight yet, which has at most `longest_records`.
    pub fn new(
        ticket: Ticket,
        epoch: Epoch,
        keep: Keep,
        longest_records: usize,
        actor: ActorId,
        incarnation: Incarnation,
    ) -> Self {
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
            longest_records,
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
        if self.flight.observations.len() == self.longest_records {
            let most = self.longest_records;
            return Err(RecordFault::TooLong { most });
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
        let (epoch, longest_records) = (self.flight.epoch, self.longest_records);
        let empty = Self::new(
            self.ticket,
            epoch,
            self.keep,
            longest_records,
            self.actor,
            self.incarnation,
        );
        Ok(std::mem::replace(self, empty).flight)
    }
}

#[cfg(test)]
mod tests {
    use bytemuck::Zeroable;
    use skein_protocol::IMAGE_PIXELS;
    use skein_protocol::ids::{Attempt, FlightId, PolicyVersion, RunId};
    use skein_protocol::ticket::{CourseChoice, Exploration};

    use super::*;

    const ACTOR: ActorId = ActorId(2);
    const LIFE: Incarnation = Incarnation(11);
    /// Steps of the flight here.
    const STEPS: u32 = 3;

    fn ticket() -> Ticket {
        Ticket {
            run: RunId(1),
            flight: FlightId(5),
            attempt: Attempt(0),
            policy_version: PolicyVersion(3),
            course: CourseChoice::Training,
            start_level: 1,
            exploration: Exploration::Sample,
            seed: 9,
        }
    }

    fn assembly(keep: Keep) -> Assembly {
        Assembly::new(ticket(), Epoch(0), keep, STEPS as usize + 1, ACTOR, LIFE)
    }

    /// Record `step`, its image filled with its number.
    fn record(step: u32) -> TransitionRecord {
        let mut record = TransitionRecord::zeroed();
        record.begin(&ticket(), ACTOR, LIFE, step);
        record.depth.fill(step as u8);
        if step == STEPS {
            record.kind = RecordKind::Closing.code();
            record.outcome = Outcome::TimedOut.code();
        }
        record
    }

    fn assemble(keep: Keep) -> CommittedFlight {
        let mut assembly = assembly(keep);
        for step in 0..STEPS {
            assert!(matches!(assembly.push(&record(step)), Ok(Assembled::Step)));
        }
        match assembly.push(&record(STEPS)) {
            Ok(Assembled::Whole(flight)) => *flight,
            other => panic!("the closing record gives {other:?}"),
        }
    }

    #[test]
    fn no_flight_mixes_policy_versions() {
        for strange in 1..=STEPS {
            let mut assembly = assembly(Keep::Latents);
            for step in 0..strange {
                assembly.push(&record(step)).unwrap();
            }
            let mut newer = record(strange);
            newer.policy_version += 1;
            let fault = assembly.push(&newer).unwrap_err();
            let (name, found, expected) = ("policy_version", 4, 3);
            assert_eq!(fault, RecordFault::Mismatch { name, found, expected });
        }
        assert_eq!(assemble(Keep::Latents).policy_version, PolicyVersion(3));
    }

    #[test]
    fn a_flight_that_never_ends_is_refused_at_its_limit() {
        let mut assembly = assembly(Keep::Depth);
        for step in 0..STEPS {
            assembly.push(&record(step)).unwrap();
        }
        let onward = |step| {
            let mut record = record(step);
            record.kind = RecordKind::Step.code();
            record
        };
        assert!(matches!(assembly.push(&onward(STEPS)), Ok(Assembled::Step)));
        let fault = assembly.push(&onward(STEPS + 1)).unwrap_err();
        assert_eq!(
            fault,
            RecordFault::TooLong {
                most: STEPS as usize + 1
            }
        );
    }

    #[test]
    fn depth_images_are_copied_only_for_who_wants_them() {
        assert_eq!(assemble(Keep::Latents).depth, None);
        let kept = assemble(Keep::Depth).depth.unwrap();
        let images: Vec<_> = kept.chunks_exact(IMAGE_PIXELS).map(|image| image.to_vec()).collect();
        assert_eq!(images, (0..=3).map(|step| vec![step; IMAGE_PIXELS]).collect::<Vec<_>>());
    }
}
