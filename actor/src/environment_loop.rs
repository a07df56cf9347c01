//! The environment loop: one ticket in, one flight out, or one leg of a flight.
//!
//! [`Pilot::fly`] is the whole of it, and the only one: training, evaluation during training and evaluation of a file differ in the ticket and in where
//! the records go. A flight is a function of its ticket and of the snapshot the ticket names, so nothing is remembered from one flight to the next, and
//! start, exploration noise and disturbances are drawn from generators of their own. What is remembered from one leg to the next saves time alone.

use std::ops::DerefMut;

use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use skein_protocol::ACTION;
use skein_protocol::evaluation::FlightScore;
use skein_protocol::ids::{ActorId, Incarnation};
use skein_protocol::leg::Leg;
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
    /// What the last ticket left in the air, if it was for a leg.
    under_way: Option<UnderWay>,
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
            under_way: None,
        }
    }

    /// Signs records as `incarnation` from now on.
    pub fn begin_life(&mut self, incarnation: Incarnation) {
        self.incarnation = incarnation;
    }

    /// Flies `ticket` with `network` to the end of its flight or its leg: each step a record into `link`, and a closing one at last. `None` when the flight
    /// goes on after the leg.
    ///
    /// # Errors
    /// [`FlightError`]; what was sent on this ticket is void then.
    pub fn fly<L: RecordLink>(
        &mut self,
        ticket: &Ticket,
        network: &Network,
        link: &mut L,
    ) -> Result<Option<FlightScore>, FlightError<L::Error>> {
        // Each leg draws from a generator of its own: who flies a later one need not know how often the earlier ones drew.
        let mut noise = generator(ticket, Purpose::ActionNoise, ticket.first_step());
        let begin = |link: &mut L, step| {
            let mut record = link.loan().map_err(FlightError::Link)?;
            record.begin(ticket, self.actor, self.incarnation, step);
            Ok(record)
        };

        let mut record = begin(link, ticket.first_step())?;
        let (simulator, mut flown) = match take_up(&mut self.simulators, self.under_way.take(), ticket) {
            Ok(taken_up) => taken_up,
            Err(fault) => return Err(give_up(fault, record, link)),
        };
        link.lap(Stage::TakeOff);
        self.agent
            .observe(simulator, network, &mut record, |stage| link.lap(stage));

        let mut flight_return = 0.0;
        for step in ticket.first_step() + 1.. {
            if link.directive().map_err(FlightError::Link)? == Directive::Abandon {
                return Err(FlightError::Abandoned);
            }
            let previous_action = flown.last().copied().unwrap_or_default();
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
            flown.push(action);
            record = next;
            if let Some(ended) = report.outcome {
                let score = close(&mut record, outcome(ended), &report, simulator.course(), flight_return);
                link.send(record).map_err(FlightError::Link)?;
                return Ok(Some(score));
            }
            if is_last_of_leg(ticket, step) {
                record.kind = RecordKind::LegEnd.code();
                record.walls_passed = report.walls_passed;
                link.send(record).map_err(FlightError::Link)?;
                self.under_way = Some(UnderWay::after(ticket, flown));
                return Ok(None);
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
    /// The actions before a leg do not lead to it.
    #[error("the flight ends in step {step} of the {flown} that are said to have been flown before the leg")]
    EndedBefore {
        /// The step, from 1.
        step: usize,
        /// Actions flown before.
        flown: usize,
    },
}

/// A flight in the middle, in the simulator that has flown the last of it.
struct UnderWay {
    ticket: Ticket,
    /// From take-off on.
    flown: Vec<[f32; ACTION]>,
}

impl UnderWay {
    fn after(ticket: &Ticket, flown: Vec<[f32; ACTION]>) -> Self {
        let ticket = ticket.clone();
        Self { ticket, flown }
    }

    /// Whether `leg` of the flight of `ticket` begins here, to the last bit.
    fn is_before(&self, ticket: &Ticket, leg: &Leg) -> bool {
        let flight = |ticket: &Ticket| {
            (
                ticket.run,
                ticket.flight,
                ticket.course,
                ticket.start_level,
                ticket.seed,
            )
        };
        let bits = |actions: &[[f32; ACTION]]| -> Vec<_> { actions.iter().flatten().map(|x| x.to_bits()).collect() };
        flight(&self.ticket) == flight(ticket) && bits(&self.flown) == bits(&leg.flown)
    }
}

/// The simulator where `ticket` begins, and the actions that led there: at take-off or, of a later leg, where the one before ended. If that was not flown here,
/// or something else was since, the actions are repeated, which leads to the same place.
fn take_up<'a>(
    simulators: &'a mut Simulators,
    under_way: Option<UnderWay>,
    ticket: &Ticket,
) -> Result<(&'a mut Simulator, Vec<[f32; ACTION]>), FlightFault> {
    let Some(leg) = &ticket.leg else {
        return Ok((take_off(simulators, ticket)?, Vec::new()));
    };
    if let Some(under_way) = under_way.filter(|under_way| under_way.is_before(ticket, leg)) {
        return Ok((simulators.of(ticket)?, under_way.flown));
    }
    let simulator = take_off(simulators, ticket)?;
    for (number, action) in (1..).zip(leg.flown.iter()) {
        if simulator.step(*action)?.outcome.is_some() {
            return Err(FlightFault::EndedBefore {
                step: number,
                flown: leg.flown.len(),
            });
        }
    }
    Ok((simulator, leg.flown.to_vec()))
}

fn is_last_of_leg(ticket: &Ticket, step: u32) -> bool {
    let leg = ticket.leg.as_ref();
    leg.is_some_and(|leg| step == ticket.first_step() + leg.steps)
}

fn take_off<'a>(simulators: &'a mut Simulators, ticket: &Ticket) -> Result<&'a mut Simulator, FlightFault> {
    let simulator = simulators.of(ticket)?;
    simulator.reset(
        ticket.start_level,
        &mut generator(ticket, Purpose::StartPosition, 0),
        &mut generator(ticket, Purpose::Disturbances, 0),
    )?;
    Ok(simulator)
}

/// What draws for one purpose in the flight of `ticket`, from `step` on.
fn generator(ticket: &Ticket, purpose: Purpose, step: u32) -> Pcg64Mcg {
    Pcg64Mcg::seed_from_u64(derive(ticket.seed, purpose, step.into()))
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

/// Makes a record with an observation the flight's last; returns what the flight came to.
fn close(
    record: &mut TransitionRecord,
    outcome: Outcome,
    report: &StepReport,
    course: &Course,
    flight_return: f64,
) -> FlightScore {
    let hit_wall = hit_wall(report);
    record.kind = RecordKind::Closing.code();
    record.walls_passed = report.walls_passed;
    record.course_walls = course.levels();
    record.outcome = outcome.code();
    record.hit_wall = hit_wall.unwrap_or(0);
    FlightScore {
        walls_passed: report.walls_passed.into(),
        // As in `flights.csv`; of a leg, what was earned in it.
        flight_return: f64::from(flight_return as f32),
        outcome,
        hit_wall,
    }
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
mod leg_tests;
#[cfg(test)]
mod tests;
