//! Assembles streamed records into a whole flight, or into a whole leg of one.
//!
//! A flight is committed once, complete and in order, or not at all; nothing downstream ever sees half of one, or one flown with two policies. Of a flight in legs
//! the same holds for each leg, and each begins where the one before it ended.

use skein_protocol::ids::{ActorId, FlightId, Incarnation};
use skein_protocol::transition::{Outcome, RecordFault, RecordKind, TransitionRecord};
use skein_protocol::{ACTION, IMAGE_PIXELS};

use super::order::Order;
use crate::flight::{CommittedFlight, StepObservation};

pub use super::order::Keep;

/// A flight under way.
#[derive(Debug)]
pub struct Assembly {
    order: Order,
    actor: ActorId,
    incarnation: Incarnation,
    flight: CommittedFlight,
    /// Of a later leg: where it is to begin.
    begins: Option<LegEnd>,
    longest_records: usize,
    latent: usize,
    /// How the last step left the flight; its walls passed are in `flight`.
    last_step: StepEnd,
}

/// Where a leg ended whose flight goes on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LegEnd {
    flight: FlightId,
    /// Steps flown since take-off.
    steps: usize,
    walls_passed: u8,
    seen: StepObservation,
}

impl LegEnd {
    /// Where `leg` ended; `None` if its flight did, too.
    pub fn of(leg: &CommittedFlight) -> Option<Self> {
        let seen = *leg.observations.last()?;
        leg.outcome.is_none().then_some(Self {
            flight: leg.flight,
            steps: leg.first_step + leg.steps(),
            walls_passed: leg.walls_passed,
            seen,
        })
    }

    /// Whether what `order` asks for is what comes next.
    pub fn is_before(&self, order: &Order) -> bool {
        (self.flight, self.steps) == (order.ticket.flight, order.ticket.first_step() as usize)
    }

    /// Whether the vehicle is where it was, to the last bit. The image may have been encoded anew.
    fn is_at(&self, record: &TransitionRecord) -> bool {
        self.seen.position_m == record.position_m
            && self.seen.velocity_mps == record.velocity_mps
            && self.seen.orientation == record.orientation
    }
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
    /// It was the last, of the flight or of the leg.
    Whole(Box<CommittedFlight>),
    /// The simulator failed; the flight is void.
    Failed,
}

impl Assembly {
    /// Nothing yet of what `order` asks for, of a flight of at most `longest_records` with codes of `latent` numbers. A later leg `begins` where the one before it ended.
    pub fn new(
        order: Order,
        begins: Option<LegEnd>,
        longest_records: usize,
        latent: usize,
        actor: ActorId,
        incarnation: Incarnation,
    ) -> Self {
        Self {
            flight: CommittedFlight {
                walls_passed: begins.map_or(0, |begins| begins.walls_passed),
                ..nothing_of(&order, actor)
            },
            order,
            actor,
            incarnation,
            begins,
            longest_records,
            latent,
            last_step: StepEnd::Onward,
        }
    }

    /// What was ordered.
    pub fn order(&self) -> &Order {
        &self.order
    }

    /// Gives the order back; what was assembled is dropped.
    pub fn into_order(self) -> Order {
        self.order
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
        let step = self.order.ticket.first_step() + self.flight.observations.len() as u32;
        let kind = record.check(&self.order.ticket, self.actor, self.incarnation, step)?;
        if kind == RecordKind::Failed {
            return Ok(Assembled::Failed);
        }
        record.check_latent(self.latent)?;
        if self.flight.observations.len() == self.longest_records {
            let most = self.longest_records;
            return Err(RecordFault::TooLong { most });
        }
        match kind {
            RecordKind::Closing => self.check_ending(record)?,
            RecordKind::LegEnd => self.check_leg_end(record)?,
            RecordKind::Step | RecordKind::Failed => self.check_step(record)?,
        }
        if self.is_empty() {
            self.check_begin(record)?;
            self.make_room();
        }
        self.flight.observations.push(StepObservation {
            latent: record.latent,
            velocity_mps: record.velocity_mps,
            position_m: record.position_m,
            orientation: record.orientation,
            ground_truth: record.ground_truth,
        });
        if let Some(depth) = &mut self.flight.depth {
            depth.extend_from_slice(&record.depth);
        }
        match kind {
            RecordKind::Closing => self.close(record)?,
            RecordKind::LegEnd => {}
            RecordKind::Step | RecordKind::Failed => {
                self.take_step(record);
                return Ok(Assembled::Step);
            }
        }
        self.finish().map(|flight| Assembled::Whole(Box::new(flight)))
    }

    fn take_step(&mut self, record: &TransitionRecord) {
        self.flight.actions.push(record.action);
        self.flight.rewards.push(record.reward);
        self.flight.reward_terms.push(record.reward_terms);
        self.flight.level_up.push(record.level_up == 1);
        self.flight.walls_passed = record.walls_passed;
        self.last_step = StepEnd::of(record);
    }

    /// Makes room for the images of the longest flight at once. The system gives memory as it is written to, so what is not needed costs nothing; images that
    /// grew would be moved again and again, with as much fresh memory each time.
    fn make_room(&mut self) {
        let longest = self.leg_steps().map_or(self.longest_records, |steps| steps + 1);
        if let Some(depth) = &mut self.flight.depth {
            depth.reserve_exact(longest.min(self.longest_records) * IMAGE_PIXELS);
        }
    }

    /// Steps of the leg, if it is one.
    fn leg_steps(&self) -> Option<usize> {
        self.order.ticket.leg.as_ref().map(|leg| leg.steps as usize)
    }

    /// Whether a later leg begins where the one before it ended: a record of a machine whose physics come to something else must not go on with the flight.
    fn check_begin(&self, record: &TransitionRecord) -> Result<(), RecordFault> {
        let is_elsewhere = self.begins.is_some_and(|begins| !begins.is_at(record));
        refuse_contradictions([("the leg does not begin where the one before it ended", is_elsewhere)])
    }

    /// Whether the flight goes on, and walls are passed as the step says.
    fn check_step(&self, record: &TransitionRecord) -> Result<(), RecordFault> {
        let passed_before = self.flight.walls_passed;
        let passes = record.walls_passed > passed_before;
        let levels_up = record.level_up == 1;
        // Reaching the end wall is a level-up too, and terminates the flight.
        let may_level_up = passes || record.terminated == 1;
        let is_over = self.leg_steps() == Some(self.flight.steps());
        refuse_contradictions([
            ("a step after the flight's end", self.last_step != StepEnd::Onward),
            ("a step after the leg's last", is_over),
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

    /// Whether the leg is over, and its flight is not.
    fn check_leg_end(&self, record: &TransitionRecord) -> Result<(), RecordFault> {
        let steps = self.leg_steps();
        refuse_contradictions([
            ("a leg ends in a flight that is flown whole", steps.is_none()),
            ("the leg ends before its last step", steps != Some(self.flight.steps())),
            ("the flight ended before the leg", self.last_step != StepEnd::Onward),
            (
                "walls passed after the last step",
                record.walls_passed != self.flight.walls_passed,
            ),
        ])
    }

    /// Ends the flight as the closing record says.
    fn close(&mut self, record: &TransitionRecord) -> Result<(), RecordFault> {
        let outcome = Outcome::from_code(record.outcome).ok_or(RecordFault::Code {
            name: "outcome",
            value: record.outcome,
        })?;
        self.flight.outcome = Some(outcome);
        self.flight.walls_passed = record.walls_passed;
        self.flight.course_walls = record.course_walls;
        self.flight.hit_wall = (record.hit_wall > 0).then_some(record.hit_wall);
        Ok(())
    }

    /// Hands out what was assembled.
    fn finish(&mut self) -> Result<CommittedFlight, RecordFault> {
        if self.flight.actions.is_empty() {
            let step = self.order.ticket.first_step().into();
            return Err(RecordFault::Mismatch {
                name: "step",
                found: step,
                expected: step + 1,
            });
        }
        if let Some(depth) = &mut self.flight.depth {
            depth.shrink_to_fit();
        }
        let nothing = nothing_of(&self.order, self.actor);
        Ok(std::mem::replace(&mut self.flight, nothing))
    }
}

/// The flight or leg that `order` asks for, before its first record.
fn nothing_of(order: &Order, actor: ActorId) -> CommittedFlight {
    let ticket = &order.ticket;
    let flown: &[[f32; ACTION]] = ticket.leg.as_ref().map_or(&[], |leg| &leg.flown);
    CommittedFlight {
        flight: ticket.flight,
        epoch: order.epoch,
        policy_version: ticket.policy_version,
        actor,
        level: ticket.start_level,
        first_step: flown.len(),
        action_before: flown.last().copied().unwrap_or_default(),
        observations: Vec::new(),
        actions: Vec::new(),
        rewards: Vec::new(),
        reward_terms: Vec::new(),
        level_up: Vec::new(),
        outcome: None,
        walls_passed: 0,
        course_walls: 0,
        hit_wall: None,
        depth: (order.keep == Keep::Depth).then(Vec::new),
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
#[path = "assembly_tests.rs"]
mod tests;
