//! The environment loop: one ticket in, one flight out.
//!
//! [`Pilot::fly`] is the whole of it, and the only one: training, evaluation during training and evaluation of a file differ in the ticket and in where
//! the records go. A flight is a function of its ticket and of the snapshot the ticket names, so nothing is remembered from one flight to the next, and
//! start, exploration noise and disturbances are drawn from generators of their own.

use std::ops::DerefMut;

use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use skein_protocol::ACTION;
use skein_protocol::evaluation::FlightScore;
use skein_protocol::ids::{ActorId, Incarnation};
use skein_protocol::seeds::{Purpose, derive};
use skein_protocol::stages::Stage;
use skein_protocol::ticket::Ticket;
use skein_protocol::transition::{Outcome, RecordKind, TransitionRecord};
use skein_simulator::course::{Course, NoSuchLevel};
use skein_simulator::reward::{RewardSettings, RewardTerms};
use skein_simulator::simulator::{self, LevelUp, Obstacle, SimulationError, Simulator, StepReport};

use crate::agent::Agent;
use crate::courses::{NoCourse, Simulators};
use skein_inference::Network;

/// Flies tickets.
pub struct Pilot {
    actor: ActorId,
    incarnation: Incarnation,
    simulators: Simulators,
    reward: RewardSettings,
    agent: Agent,
}

impl Pilot {
    /// A pilot who signs records as `incarnation` of `actor`.
    pub fn new(actor: ActorId, incarnation: Incarnation, simulators: Simulators, agent: Agent) -> Self {
        let reward = simulators.settings().reward.clone();
        Self {
            actor,
            incarnation,
            simulators,
            reward,
            agent,
        }
    }

    /// Signs records as `incarnation` from now on.
    pub fn begin_life(&mut self, incarnation: Incarnation) {
        self.incarnation = incarnation;
    }

    /// Flies `ticket` with `network` from take-off to its end: each step a record into `link`, and a closing one at last.
    ///
    /// # Errors
    /// [`FlightError`]; what was sent of the flight is void then.
    pub fn fly<L: RecordLink>(
        &mut self,
        ticket: &Ticket,
        network: &Network,
        link: &mut L,
    ) -> Result<FlightScore, FlightError<L::Error>> {
        let mut noise = generator(ticket, Purpose::ActionNoise);
        let begin = |link: &mut L, step| {
            let mut record = link.loan().map_err(FlightError::Link)?;
            record.begin(ticket, self.actor, self.incarnation, step);
            Ok(record)
        };

        let mut record = begin(link, 0)?;
        let simulator = match take_off(&mut self.simulators, ticket) {
            Ok(simulator) => simulator,
            Err(fault) => return Err(give_up(fault, record, link)),
        };
        link.lap(Stage::TakeOff);
        self.agent
            .observe(simulator, network, &mut record, |stage| link.lap(stage));

        let mut previous_action = [0.0; ACTION];
        let mut flight_return = 0.0;
        for step in 1.. {
            if link.directive().map_err(FlightError::Link)? == Directive::Abandon {
                return Err(FlightError::Abandoned);
            }
            let action = self
                .agent
                .act(ticket.exploration, network, &record, &previous_action, &mut noise);
            link.lap(Stage::Policy);
            let report = match simulator.step(action) {
                Ok(report) => report,
                Err(error) => return Err(give_up(error.into(), record, link)),
            };
            link.lap(Stage::Physics);

            // The reward looks at what the action led to, so the next image comes before this record is complete.
            let mut next = begin(link, step)?;
            self.agent
                .observe(simulator, network, &mut next, |stage| link.lap(stage));
            let reward = RewardTerms::of(&self.reward, &report, &next.depth);
            complete(&mut record, action, &report, &reward);
            link.send(record).map_err(FlightError::Link)?;

            flight_return += f64::from(reward.total());
            previous_action = action;
            record = next;
            if let Some(ended) = report.outcome {
                let outcome = outcome(ended);
                let hit_wall = hit_wall(&report);
                close(&mut record, outcome, &report, simulator.course());
                link.send(record).map_err(FlightError::Link)?;
                return Ok(FlightScore {
                    walls_passed: report.walls_passed.into(),
                    // As in `flights.csv`.
                    flight_return: f64::from(flight_return as f32),
                    outcome,
                    hit_wall,
                });
            }
        }
        unreachable!("the simulator's step limit ends every flight before the step numbers run out")
    }
}

/// Where a flight's records go: shared memory in a run, plain memory in a stand-alone evaluation.
pub trait RecordLink {
    /// A record being written.
    type Loan: DerefMut<Target = TransitionRecord>;
    /// Why no record can be had or sent.
    type Error: std::error::Error + 'static;

    /// A record to write into; what it holds is arbitrary. Two are on loan at a time.
    ///
    /// # Errors
    /// When there is none.
    fn loan(&mut self) -> Result<Self::Loan, Self::Error>;

    /// Hands a record over.
    ///
    /// # Errors
    /// When nobody can take it.
    fn send(&mut self, record: Self::Loan) -> Result<(), Self::Error>;

    /// Asked before every step: whether to fly on.
    ///
    /// # Errors
    /// When that cannot be known.
    fn directive(&mut self) -> Result<Directive, Self::Error>;

    /// Told at the end of each stage of a step, for whoever wants to know where the time goes; what it does itself, a link books itself.
    fn lap(&mut self, _stage: Stage) {}
}

/// Whether to fly on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Directive {
    /// Fly on.
    Continue,
    /// Break the flight off: nobody wants it any more.
    Abandon,
}

/// Why a flight was not flown to its end.
#[derive(Debug, thiserror::Error)]
pub enum FlightError<E: std::error::Error + 'static> {
    /// It was told to stop.
    #[error("the flight was abandoned")]
    Abandoned,
    /// The ticket or the physics is at fault; the link has been told by a record of kind [`RecordKind::Failed`].
    #[error("the flight failed: {0}")]
    Fault(#[source] FlightFault),
    /// Records cannot be sent.
    #[error("the flight's records cannot be sent: {0}")]
    Link(#[source] E),
}

/// What is wrong with a flight itself: whoever flies it again meets it again.
#[derive(Debug, thiserror::Error)]
pub enum FlightFault {
    /// The ticket names a course that is not there.
    #[error(transparent)]
    Course(#[from] NoCourse),
    /// The ticket names a level that is not there.
    #[error(transparent)]
    Level(#[from] NoSuchLevel),
    /// The simulation broke down.
    #[error(transparent)]
    Simulation(#[from] SimulationError),
}

fn take_off<'a>(simulators: &'a mut Simulators, ticket: &Ticket) -> Result<&'a mut Simulator, FlightFault> {
    let simulator = simulators.of(ticket)?;
    simulator.reset(
        ticket.start_level,
        &mut generator(ticket, Purpose::StartPosition),
        &mut generator(ticket, Purpose::Disturbances),
    )?;
    Ok(simulator)
}

/// What draws for one purpose in the flight of `ticket`.
fn generator(ticket: &Ticket, purpose: Purpose) -> Pcg64Mcg {
    Pcg64Mcg::seed_from_u64(derive(ticket.seed, purpose, 0))
}

/// Writes into the record of an observation what was done on it and what came of that.
fn complete(record: &mut TransitionRecord, action: [f32; ACTION], report: &StepReport, reward: &RewardTerms) {
    record.action = action;
    record.walls_passed = report.walls_passed;
    record.reward = reward.total();
    record.reward_terms = [reward.collision, reward.level_up, reward.destination, reward.action];
    let arrived = report.outcome == Some(simulator::Outcome::ReachedEnd);
    record.level_up = u8::from(report.level_up == LevelUp::Yes || arrived);
    record.terminated = u8::from(arrived || report.outcome == Some(simulator::Outcome::Collided));
    record.truncated = u8::from(report.outcome == Some(simulator::Outcome::TimedOut));
}

/// Makes a record with an observation the flight's last.
fn close(record: &mut TransitionRecord, outcome: Outcome, report: &StepReport, course: &Course) {
    record.kind = RecordKind::Closing.code();
    record.walls_passed = report.walls_passed;
    record.course_walls = course.levels();
    record.outcome = outcome.code();
    record.hit_wall = hit_wall(report).unwrap_or(0);
}

/// The wall that was hit, from 1 in flight order.
fn hit_wall(report: &StepReport) -> Option<u8> {
    match report.hit {
        Some(Obstacle::Wall(place)) => Some(place),
        Some(Obstacle::Corridor) | None => None,
    }
}

/// Sends `record` as the word that the flight has failed.
fn give_up<L: RecordLink>(fault: FlightFault, mut record: L::Loan, link: &mut L) -> FlightError<L::Error> {
    record.kind = RecordKind::Failed.code();
    match link.send(record) {
        Ok(()) => FlightError::Fault(fault),
        Err(error) => FlightError::Link(error),
    }
}

/// The simulator and the protocol know nothing of each other; here they meet.
fn outcome(ended: simulator::Outcome) -> Outcome {
    match ended {
        simulator::Outcome::Collided => Outcome::Collided,
        simulator::Outcome::ReachedEnd => Outcome::ReachedEnd,
        simulator::Outcome::TimedOut => Outcome::TimedOut,
    }
}

#[cfg(test)]
mod tests;
