//! Assembles streamed records into a whole flight.
//!
//! A flight is committed once, complete and in order, or not at all; nothing downstream ever sees half of one, or one flown with two policies.

use serde::{Deserialize, Serialize};
use skein_protocol::IMAGE_PIXELS;
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
    /// How the last step left the flight; its walls passed are in `flight`.
    last_step: StepEnd,
}

/// How a step left its flight.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum StepEnd {
    /// It goes on.
    Onward,
    /// It ended in a state without a future.
    Terminated { level_up: bool },
    /// It was cut off.
    Truncated,
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
            hit_wall: None,
            depth: (keep == Keep::Depth).then(Vec::new),
        };
        Self {
            ticket,
            actor,
            incarnation,
            flight,
            keep,
            longest_records,
            last_step: StepEnd::Onward,
        }
    }

    /// Whether nothing has arrived yet.
    pub fn is_empty(&self) -> bool {
        self.flight.observations.is_empty()
    }

    /// Records that have arrived.
    pub fn records(&self) -> usize {
        self.flight.observations.len()
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
        match kind {
            RecordKind::Closing => self.check_ending(record)?,
            RecordKind::Step | RecordKind::Failed => self.check_step(record)?,
        }
        if self.is_empty() {
            self.make_room();
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
        self.flight.walls_passed = record.walls_passed;
        self.last_step = StepEnd::of(record);
        Ok(Assembled::Step)
    }

    /// Makes room for the images of the longest flight at once. The system gives memory as it is written to, so what is not needed costs nothing; images that
    /// grew would be moved again and again, with as much fresh memory each time.
    fn make_room(&mut self) {
        if let Some(depth) = &mut self.flight.depth {
            depth.reserve_exact(self.longest_records * IMAGE_PIXELS);
        }
    }

    /// Whether the flight goes on, and walls are passed as the step says.
    fn check_step(&self, record: &TransitionRecord) -> Result<(), RecordFault> {
        let passed_before = self.flight.walls_passed;
        let passes = record.walls_passed > passed_before;
        let levels_up = record.level_up == 1;
        // Reaching the end wall is a level-up too, and terminates the flight.
        let may_level_up = passes || record.terminated == 1;
        refuse_contradictions([
            ("a step after the flight's end", self.last_step != StepEnd::Onward),
            ("walls passed grow fewer", record.walls_passed < passed_before),
            ("a wall passed without a level-up", passes && !levels_up),
            ("a level-up without a wall passed", levels_up && !may_level_up),
        ])
    }

    /// Whether the last step ended the flight as the closing record says.
    fn check_ending(&self, record: &TransitionRecord) -> Result<(), RecordFault> {
        if self.is_empty() {
            // It is told from one that is out of its place.
            return Ok(());
        }
        let outcome = Outcome::from_code(record.outcome);
        let fits = match self.last_step {
            StepEnd::Onward => false,
            StepEnd::Truncated => outcome == Some(Outcome::TimedOut),
            StepEnd::Terminated { level_up } => {
                outcome == Some(Outcome::Collided) || (outcome == Some(Outcome::ReachedEnd) && level_up)
            }
        };
        let passed = self.flight.walls_passed;
        refuse_contradictions([
            ("the flight did not end as it closes", !fits),
            ("walls passed after the last step", record.walls_passed != passed),
        ])
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
        self.flight.hit_wall = (record.hit_wall > 0).then_some(record.hit_wall);
        if let Some(depth) = &mut self.flight.depth {
            depth.shrink_to_fit();
        }
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

impl StepEnd {
    fn of(record: &TransitionRecord) -> Self {
        match (record.terminated, record.truncated) {
            (1, _) => Self::Terminated {
                level_up: record.level_up == 1,
            },
            (_, 1) => Self::Truncated,
            _ => Self::Onward,
        }
    }
}

/// Refuses the first of the contradictions that is there.
fn refuse_contradictions<const N: usize>(contradictions: [(&'static str, bool); N]) -> Result<(), RecordFault> {
    match contradictions.into_iter().find(|(_, is_there)| *is_there) {
        Some((what, _)) => Err(RecordFault::Contradiction { what }),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use bytemuck::Zeroable;
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
        record.truncated = u8::from(step == STEPS - 1);
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
        let onward = |step| {
            let mut record = record(step);
            record.kind = RecordKind::Step.code();
            record.truncated = 0;
            record
        };
        for step in 0..STEPS {
            assembly.push(&onward(step)).unwrap();
        }
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

    #[test]
    fn a_flight_that_contradicts_itself_is_refused() {
        // A change of one record, by its step, and what is said of it or of the first one that shows it.
        type Case = (u32, fn(&mut TransitionRecord), &'static str);
        let cases: [Case; 9] = [
            (0, |r| r.truncated = 1, "a step after the flight's end"),
            (0, |r| r.terminated = 1, "a step after the flight's end"),
            (2, |r| r.truncated = 0, "the flight did not end as it closes"),
            (
                3,
                |r| r.outcome = Outcome::Collided.code(),
                "the flight did not end as it closes",
            ),
            (
                2,
                |r| (r.truncated, r.terminated) = (0, 1),
                "the flight did not end as it closes",
            ),
            (1, |r| r.walls_passed = 1, "a wall passed without a level-up"),
            (1, |r| r.level_up = 1, "a level-up without a wall passed"),
            (1, |r| (r.walls_passed, r.level_up) = (1, 1), "walls passed grow fewer"),
            (3, |r| r.walls_passed = 1, "walls passed after the last step"),
        ];
        for (step, change, expected) in cases {
            let mut assembly = assembly(Keep::Latents);
            let fault = (0..=STEPS).find_map(|at| {
                let mut record = record(at);
                record.course_walls = 5;
                if at == step {
                    change(&mut record);
                }
                assembly.push(&record).err()
            });
            assert_eq!(fault, Some(RecordFault::Contradiction { what: expected }), "{expected}");
        }
    }

    #[test]
    fn what_was_hit_is_known_of_the_committed_flight() {
        for (hit_wall, expected) in [(0, None), (1, Some(1))] {
            let mut assembly = assembly(Keep::Latents);
            let mut last = record(0);
            last.terminated = 1;
            assembly.push(&last).unwrap();
            let mut closing = record(1);
            closing.kind = RecordKind::Closing.code();
            closing.outcome = Outcome::Collided.code();
            (closing.course_walls, closing.hit_wall) = (5, hit_wall);
            let Assembled::Whole(flight) = assembly.push(&closing).unwrap() else {
                panic!("a closing record ends a flight");
            };
            assert_eq!(flight.hit_wall, expected);
        }
    }

    #[test]
    fn the_end_wall_is_reached_by_a_level_up_that_passes_no_wall() {
        for (level_up, is_refused) in [(1, false), (0, true)] {
            let mut assembly = assembly(Keep::Latents);
            let mut last = record(0);
            (last.terminated, last.level_up) = (1, level_up);
            assembly.push(&last).unwrap();
            let mut closing = record(1);
            closing.kind = RecordKind::Closing.code();
            closing.outcome = Outcome::ReachedEnd.code();
            closing.course_walls = 5;
            assert_eq!(assembly.push(&closing).is_err(), is_refused);
        }
    }
}
