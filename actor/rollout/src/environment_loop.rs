//! The environment loop: one ticket in, one episode out, or one segment of an episode.
//!
//! [`EnvironmentLoop::fly`] is the whole of it, and the only one: training, evaluation during
//! training and evaluation of a file differ in the ticket and in where the records go. An episode
//! is a function of its ticket and of the snapshot the ticket names, so nothing is remembered from
//! one episode to the next, and start, exploration noise and disturbances are drawn from generators
//! of their own. What is remembered from one segment to the next saves time alone.

use std::ops::DerefMut;

use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use skein_protocol::ACTION;
use skein_protocol::evaluation::EpisodeScore;
use skein_protocol::ids::{ActorId, ActorIncarnation};
use skein_protocol::seeds::{Purpose, derive};
use skein_protocol::segment::Segment;
use skein_protocol::stages::Stage;
use skein_protocol::ticket::Ticket;
use skein_protocol::transition::{Outcome, RecordKind, TransitionRecord};
use skein_simulator::course::{Course, NoSuchLevel};
use skein_simulator::reward::{RewardSettings, RewardTerms};
use skein_simulator::simulator::{
    EpisodeOutcome, LevelUp, Obstacle, SimulationError, Simulator, StepReport,
};

use crate::agent::Agent;
use crate::courses::{NoCourse, Simulators};
use skein_inference::Network;

/// Flies tickets.
pub struct EnvironmentLoop {
    actor: ActorId,
    incarnation: ActorIncarnation,
    simulators: Simulators,
    reward: RewardSettings,
    agent: Agent,
    /// What the last ticket left in the air, if it was for a segment.
    under_way: Option<UnderWay>,
}

impl EnvironmentLoop {
    /// A environment_loop who signs records as `incarnation` of `actor`.
    pub fn new(
        actor: ActorId,
        incarnation: ActorIncarnation,
        simulators: Simulators,
        agent: Agent,
    ) -> Self {
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
    pub fn begin_incarnation(&mut self, incarnation: ActorIncarnation) {
        self.incarnation = incarnation;
    }

    /// Flies `ticket` with `network` to the end of its episode or its segment: each step a record
    /// into `link`, and a closing one at last. `None` when the episode goes on after the segment.
    ///
    /// # Errors
    /// [`EpisodeError`]; what was sent on this ticket is void then.
    pub fn fly<L: RecordLink>(
        &mut self,
        ticket: &Ticket,
        network: &Network,
        link: &mut L,
    ) -> Result<Option<EpisodeScore>, EpisodeError<L::Error>> {
        // Each segment draws from a generator of its own: who flies a later one need not know how
        // often the earlier ones drew.
        let mut noise = generator(ticket, Purpose::ActionNoise, ticket.first_step());
        let begin = |link: &mut L, step| {
            let mut record = link.loan().map_err(EpisodeError::Link)?;
            record.begin(ticket, self.actor, self.incarnation, step);
            Ok(record)
        };

        let mut record = begin(link, ticket.first_step())?;
        let (simulator, mut flown) =
            match take_up(&mut self.simulators, self.under_way.take(), ticket) {
                Ok(taken_up) => taken_up,
                Err(fault) => return Err(give_up(fault, record, link)),
            };
        link.lap(Stage::Reset);
        self.agent
            .observe(simulator, network, &mut record, |stage| link.lap(stage));

        let mut episode_return = 0.0;
        for step in ticket.first_step() + 1.. {
            if link.directive().map_err(EpisodeError::Link)? == Directive::Abandon {
                return Err(EpisodeError::Abandoned);
            }
            let previous_action = flown.last().copied().unwrap_or_default();
            let action = self.agent.act(
                ticket.exploration,
                network,
                &record,
                &previous_action,
                &mut noise,
            );
            link.lap(Stage::Policy);
            let report = match simulator.step(action) {
                Ok(report) => report,
                Err(error) => return Err(give_up(error.into(), record, link)),
            };
            link.lap(Stage::Physics);

            // The reward looks at what the action led to, so the next image comes before this
            // record is complete.
            let mut next = begin(link, step)?;
            self.agent
                .observe(simulator, network, &mut next, |stage| link.lap(stage));
            let reward = RewardTerms::of(&self.reward, &report, &next.depth);
            complete(&mut record, action, &report, &reward);
            link.send(record).map_err(EpisodeError::Link)?;

            episode_return += f64::from(reward.total());
            flown.push(action);
            record = next;
            if let Some(ended) = report.outcome {
                let score = close(
                    &mut record,
                    outcome(ended),
                    &report,
                    simulator.course(),
                    episode_return,
                );
                link.send(record).map_err(EpisodeError::Link)?;
                return Ok(Some(score));
            }
            if is_last_of_segment(ticket, step) {
                record.kind = RecordKind::SegmentEnd.code();
                record.walls_passed = report.walls_passed;
                link.send(record).map_err(EpisodeError::Link)?;
                self.under_way = Some(UnderWay::after(ticket, flown));
                return Ok(None);
            }
        }
        unreachable!(
            "the simulator's step limit ends every episode before the step numbers run out"
        )
    }
}

/// Where an episode's records go: shared memory in a run, plain memory in a stand-alone evaluation.
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

    /// Told at the end of each stage of a step, for whoever wants to know where the time goes; what
    /// it does itself, a link books itself.
    fn lap(&mut self, _stage: Stage) {}
}

/// Whether to fly on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Directive {
    /// Fly on.
    Continue,
    /// Break the episode off: nobody wants it any more.
    Abandon,
}

/// Why an episode was not flown to its end.
#[derive(Debug, thiserror::Error)]
pub enum EpisodeError<E: std::error::Error + 'static> {
    /// It was told to stop.
    #[error("the episode was abandoned")]
    Abandoned,
    /// The ticket or the physics is at fault; the link has been told by a record of kind
    /// [`RecordKind::Failed`].
    #[error("the episode failed: {0}")]
    Fault(#[source] EpisodeFault),
    /// Records cannot be sent.
    #[error("the episode's records cannot be sent: {0}")]
    Link(#[source] E),
}

/// What is wrong with an episode itself: whoever flies it again meets it again.
#[derive(Debug, thiserror::Error)]
pub enum EpisodeFault {
    /// The ticket names a course that is not there.
    #[error(transparent)]
    Course(#[from] NoCourse),
    /// The ticket names a level that is not there.
    #[error(transparent)]
    Level(#[from] NoSuchLevel),
    /// The simulation broke down.
    #[error(transparent)]
    Simulation(#[from] SimulationError),
    /// The actions before a segment do not lead to it.
    #[error(
        "the episode ends in step {step} of the {flown} that are said to have been flown before the segment"
    )]
    EndedBefore {
        /// The step, from 1.
        step: usize,
        /// Actions flown before.
        flown: usize,
    },
}

/// An episode in the middle, in the simulator that has flown the last of it.
struct UnderWay {
    ticket: Ticket,
    /// From reset on.
    flown: Vec<[f32; ACTION]>,
}

impl UnderWay {
    fn after(ticket: &Ticket, flown: Vec<[f32; ACTION]>) -> Self {
        let ticket = ticket.clone();
        Self { ticket, flown }
    }

    /// Whether `segment` of the episode of `ticket` begins here, to the last bit.
    fn is_before(&self, ticket: &Ticket, segment: &Segment) -> bool {
        let episode = |ticket: &Ticket| {
            (
                ticket.run,
                ticket.episode,
                ticket.course,
                ticket.start_level,
                ticket.seed,
            )
        };
        let bits = |actions: &[[f32; ACTION]]| -> Vec<_> {
            actions.iter().flatten().map(|x| x.to_bits()).collect()
        };
        episode(&self.ticket) == episode(ticket) && bits(&self.flown) == bits(&segment.flown)
    }
}

/// The simulator where `ticket` begins, and the actions that led there: at reset or, of a later
/// segment, where the one before ended. If that was not flown here, or something else was since,
/// the actions are repeated, which leads to the same place.
fn take_up<'a>(
    simulators: &'a mut Simulators,
    under_way: Option<UnderWay>,
    ticket: &Ticket,
) -> Result<(&'a mut Simulator, Vec<[f32; ACTION]>), EpisodeFault> {
    let Some(segment) = &ticket.segment else {
        return Ok((reset(simulators, ticket)?, Vec::new()));
    };
    if let Some(under_way) = under_way.filter(|under_way| under_way.is_before(ticket, segment)) {
        return Ok((simulators.of(ticket)?, under_way.flown));
    }
    let simulator = reset(simulators, ticket)?;
    for (number, action) in (1..).zip(segment.flown.iter()) {
        if simulator.step(*action)?.outcome.is_some() {
            return Err(EpisodeFault::EndedBefore {
                step: number,
                flown: segment.flown.len(),
            });
        }
    }
    Ok((simulator, segment.flown.to_vec()))
}

fn is_last_of_segment(ticket: &Ticket, step: u32) -> bool {
    let segment = ticket.segment.as_ref();
    segment.is_some_and(|segment| step == ticket.first_step() + segment.steps)
}

fn reset<'a>(
    simulators: &'a mut Simulators,
    ticket: &Ticket,
) -> Result<&'a mut Simulator, EpisodeFault> {
    let simulator = simulators.of(ticket)?;
    simulator.reset(
        ticket.start_level,
        &mut generator(ticket, Purpose::StartPosition, 0),
        &mut generator(ticket, Purpose::Disturbances, 0),
    )?;
    Ok(simulator)
}

/// What draws for one purpose in the episode of `ticket`, from `step` on.
fn generator(ticket: &Ticket, purpose: Purpose, step: u32) -> Pcg64Mcg {
    Pcg64Mcg::seed_from_u64(derive(ticket.seed, purpose, step.into()))
}

/// Writes into the record of an observation what was done on it and what came of that.
fn complete(
    record: &mut TransitionRecord,
    action: [f32; ACTION],
    report: &StepReport,
    reward: &RewardTerms,
) {
    record.action = action;
    record.walls_passed = report.walls_passed;
    record.reward = reward.total();
    record.reward_terms = [
        reward.collision,
        reward.level_up,
        reward.destination,
        reward.open_view,
    ];
    let arrived = report.outcome == Some(EpisodeOutcome::ReachedEnd);
    record.level_up = u8::from(report.level_up == LevelUp::Yes || arrived);
    record.terminated = u8::from(arrived || report.outcome == Some(EpisodeOutcome::Collided));
    record.truncated = u8::from(report.outcome == Some(EpisodeOutcome::TimedOut));
}

/// Makes a record with an observation the episode's last; returns what the episode came to.
fn close(
    record: &mut TransitionRecord,
    outcome: Outcome,
    report: &StepReport,
    course: &Course,
    episode_return: f64,
) -> EpisodeScore {
    let hit_wall = hit_wall(report);
    record.kind = RecordKind::Closing.code();
    record.walls_passed = report.walls_passed;
    record.course_walls = course.levels();
    record.outcome = outcome.code();
    record.hit_wall = hit_wall.unwrap_or(0);
    EpisodeScore {
        walls_passed: report.walls_passed.into(),
        // As in `episodes.csv`; of a segment, what was earned in it.
        episode_return: f64::from(episode_return as f32),
        outcome,
        hit_wall,
    }
}

/// The wall that was hit, from 1 in episode order.
fn hit_wall(report: &StepReport) -> Option<u8> {
    match report.hit {
        Some(Obstacle::Wall(place)) => Some(place),
        Some(Obstacle::Corridor) | None => None,
    }
}

/// Sends `record` as the word that the episode has failed.
fn give_up<L: RecordLink>(
    fault: EpisodeFault,
    mut record: L::Loan,
    link: &mut L,
) -> EpisodeError<L::Error> {
    record.kind = RecordKind::Failed.code();
    match link.send(record) {
        Ok(()) => EpisodeError::Fault(fault),
        Err(error) => EpisodeError::Link(error),
    }
}

/// The simulator and the protocol know nothing of each other; here they meet.
fn outcome(ended: EpisodeOutcome) -> Outcome {
    match ended {
        EpisodeOutcome::Collided => Outcome::Collided,
        EpisodeOutcome::ReachedEnd => Outcome::ReachedEnd,
        EpisodeOutcome::TimedOut => Outcome::TimedOut,
    }
}

#[cfg(test)]
mod segment_tests;
#[cfg(test)]
mod tests;
