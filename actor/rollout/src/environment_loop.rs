//! The environment loop: flies the episode or segment of one ticket.
//!
//! [`EnvironmentLoop::fly`] is the only such loop: training, evaluation during training and
//! evaluation of a file differ only in the ticket and in where the records go. An episode is a
//! function of its ticket and of the snapshot that the ticket names. So no state passes from one
//! episode to the next, and start, exploration noise and disturbances each have their own random
//! generator. State kept between segments only saves time.

use std::ops::DerefMut;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use skein_protocol::evaluation::EpisodeScore;
use skein_protocol::ids::{ActorId, ActorIncarnation};
use skein_protocol::seeds::{Purpose, derive};
use skein_protocol::segment::Segment;
use skein_protocol::stages::Stage;
use skein_protocol::ticket::Ticket;
use skein_protocol::transition::{Outcome, RecordKind, TransitionRecord};
use skein_protocol::{Action, REWARD_TERM_NAMES};
use skein_simulator::course::NoSuchLevel;
use skein_simulator::reward::{RewardSettings, RewardTerms};
use skein_simulator::simulator::{
    EpisodeOutcome, LevelUp, Obstacle, SimulationError, Simulator, StepReport,
};

use crate::agent::Agent;
use crate::courses::{CourseChoiceError, Simulators};
use crate::world::{World, Worlds};
use skein_inference::Network;

const _: () = assert!(
    are_equal(RewardTerms::NAMES, &REWARD_TERM_NAMES),
    "the terms of the simulator's reward are not REWARD_TERM_NAMES of skein-protocol: change these"
);

/// Flies tickets in the worlds `W`.
pub struct EnvironmentLoop<W = Simulators> {
    actor: ActorId,
    incarnation: ActorIncarnation,
    worlds: W,
    reward: RewardSettings,
    agent: Agent,
    /// Teacher of tickets that ask for one; `None`: the oracle.
    teacher: Option<(Network, Agent)>,
    /// The episode that the last ticket's segment left unfinished.
    paused: Option<PausedEpisode>,
}

impl<W: Worlds> EnvironmentLoop<W> {
    /// Creates a loop that marks records with `actor` and `incarnation`.
    pub fn new(actor: ActorId, incarnation: ActorIncarnation, worlds: W, agent: Agent) -> Self {
        let reward = worlds.reward_settings();
        Self {
            actor,
            incarnation,
            worlds,
            reward,
            agent,
            teacher: None,
            paused: None,
        }
    }

    /// Makes a trained policy the teacher, in the oracle's place. The agent sees what the policy
    /// saw in training.
    #[must_use]
    pub fn with_teacher(mut self, policy: Network, agent: Agent) -> Self {
        self.teacher = Some((policy, agent));
        self
    }

    /// Marks records with `incarnation` from now on.
    pub fn begin_incarnation(&mut self, incarnation: ActorIncarnation) {
        self.incarnation = incarnation;
    }

    /// Flies `ticket` with `network` to the end of its episode or segment. Sends a record per step
    /// to `link`, then a closing one. Returns `None` if the episode continues after the segment.
    ///
    /// # Errors
    /// [`EpisodeError`]; then the records already sent are void.
    pub fn fly<L: RecordLink>(
        &mut self,
        ticket: &Ticket,
        network: &Network,
        link: &mut L,
    ) -> Result<Option<EpisodeScore>, EpisodeError<L::Error>> {
        // Each segment has its own generator: an actor that flies a later one need not know how
        // often the earlier ones drew.
        let mut noise = generator(ticket, Purpose::ActionNoise, ticket.first_step());
        let mut teacher_steps = generator(ticket, Purpose::TeacherSteps, ticket.first_step());
        let begin = |link: &mut L, step| {
            let mut record = link.loan().map_err(EpisodeError::Link)?;
            record.begin(ticket, self.actor, self.incarnation, step);
            Ok(record)
        };

        let mut record = begin(link, ticket.first_step())?;
        let (world, mut flown) =
            match position_at_start(&mut self.worlds, self.paused.take(), ticket) {
                Ok(start) => start,
                Err(fault) => return Err(send_failure(fault, record, link)),
            };
        link.lap(Stage::Reset);
        self.agent
            .observe(world, network, &mut record, |stage| link.lap(stage));

        let mut episode_return = 0.0;
        for step in ticket.first_step() + 1.. {
            if link.directive().map_err(EpisodeError::Link)? == Directive::Abandon {
                return Err(EpisodeError::Abandoned);
            }
            let previous_action = flown.last().copied().unwrap_or_default();
            let own_action = self.agent.act(
                ticket.exploration,
                network,
                &record,
                &previous_action,
                &mut noise,
            );
            let action = match ticket.teacher_share {
                Some(share) => {
                    record.teacher_action = match &mut self.teacher {
                        Some((policy, agent)) => agent.advise(policy, &record, &previous_action),
                        None => match world.oracle_action() {
                            Ok(action) => action,
                            Err(fault) => return Err(send_failure(fault, record, link)),
                        },
                    };
                    match teacher_steps.random::<f32>() < share {
                        true => record.teacher_action,
                        false => own_action,
                    }
                }
                None => own_action,
            };
            link.lap(Stage::Policy);
            let report = match world.step(action) {
                Ok(report) => report,
                Err(fault) => return Err(send_failure(fault, record, link)),
            };
            link.lap(Stage::Physics);

            // The reward depends on the next image, so that comes before this record is complete.
            let mut next = begin(link, step)?;
            self.agent
                .observe(world, network, &mut next, |stage| link.lap(stage));
            let reward = world.reward(&self.reward, &report, &next.depth);
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
                    world.walls(),
                    episode_return,
                );
                link.send(record).map_err(EpisodeError::Link)?;
                return Ok(Some(score));
            }
            if is_last_of_segment(ticket, step) {
                record.kind = RecordKind::SegmentEnd.code();
                record.walls_passed = report.walls_passed;
                link.send(record).map_err(EpisodeError::Link)?;
                self.paused = Some(PausedEpisode::after(ticket, flown));
                return Ok(None);
            }
        }
        unreachable!(
            "the simulator's step limit ends every episode before the step numbers run out"
        )
    }
}

/// Destination of an episode's records: shared memory in a run, plain memory in a stand-alone
/// evaluation.
pub trait RecordLink {
    /// Record being written.
    type Loan: DerefMut<Target = TransitionRecord>;
    /// Error of loaning or sending.
    type Error: std::error::Error + 'static;

    /// Loans a record to write into; its content is arbitrary. Two are on loan at a time.
    ///
    /// # Errors
    /// If none is available.
    fn loan(&mut self) -> Result<Self::Loan, Self::Error>;

    /// Sends a record.
    ///
    /// # Errors
    /// If it cannot be sent.
    fn send(&mut self, record: Self::Loan) -> Result<(), Self::Error>;

    /// Returns, before every step, whether to continue.
    ///
    /// # Errors
    /// If that cannot be determined.
    fn directive(&mut self) -> Result<Directive, Self::Error>;

    /// Called at the end of each stage of a step, for time measurement. A link measures its own
    /// work itself.
    fn lap(&mut self, _stage: Stage) {}
}

/// Decision whether to continue an episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Directive {
    /// Continue.
    Continue,
    /// Stop the episode: it is no longer needed.
    Abandon,
}

/// Reason why an episode was not flown to its end.
#[derive(Debug, thiserror::Error)]
pub enum EpisodeError<E: std::error::Error + 'static> {
    /// The link asked to stop.
    #[error("the episode was abandoned")]
    Abandoned,
    /// The ticket or the physics is at fault. A record of kind [`RecordKind::Failed`] was sent.
    #[error("the episode failed: {0}")]
    Fault(#[source] EpisodeFault),
    /// The actor's own environment is at fault. Nothing was sent of it: another actor can fly the
    /// ticket.
    #[error("the actor's environment failed: {0}")]
    Foreign(String),
    /// Records cannot be sent.
    #[error("the episode's records cannot be sent: {0}")]
    Link(#[source] E),
}

/// Fault of an episode itself, which recurs for any actor that flies the ticket, or of a foreign
/// environment.
#[derive(Debug, thiserror::Error)]
pub enum EpisodeFault {
    /// The ticket names an unknown course.
    #[error(transparent)]
    Course(#[from] CourseChoiceError),
    /// The ticket names an unknown level.
    #[error(transparent)]
    Level(#[from] NoSuchLevel),
    /// The simulation failed.
    #[error(transparent)]
    Simulation(#[from] SimulationError),
    /// An environment that is not Skein's simulator failed.
    #[error("{0}")]
    Foreign(String),
    /// The earlier actions end the episode before the segment begins.
    #[error("the episode ends in step {step}, within the {prior_actions} steps before the segment")]
    EndedBefore {
        /// The step, from 1.
        step: usize,
        /// Steps before the segment.
        prior_actions: usize,
    },
}

/// Unfinished episode, whose latest segment is in the simulator.
struct PausedEpisode {
    ticket: Ticket,
    /// Actions from the reset on.
    flown: Vec<Action>,
}

impl PausedEpisode {
    fn after(ticket: &Ticket, flown: Vec<Action>) -> Self {
        let ticket = ticket.clone();
        Self { ticket, flown }
    }

    /// Returns `true` if `segment` of the episode of `ticket` begins exactly here, bit for bit.
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
        let bits = |actions: &[Action]| -> Vec<_> {
            actions.iter().flatten().map(|x| x.to_bits()).collect()
        };
        episode(&self.ticket) == episode(ticket)
            && bits(&self.flown) == bits(&segment.prior_actions)
    }
}

/// Returns the world in the state in which `ticket` begins, and the actions that led there.
/// The state is the reset or, for a later segment, the end of the previous one. If this loop does
/// not hold that state, it repeats the actions, with the same result.
fn position_at_start<'a, W: Worlds>(
    worlds: &'a mut W,
    paused: Option<PausedEpisode>,
    ticket: &Ticket,
) -> Result<(&'a mut W::World, Vec<Action>), EpisodeFault> {
    let Some(segment) = &ticket.segment else {
        return Ok((worlds.reset(ticket)?, Vec::new()));
    };
    if let Some(paused) = paused.filter(|paused| paused.is_before(ticket, segment)) {
        return Ok((worlds.resume(ticket)?, paused.flown));
    }
    let world = worlds.reset(ticket)?;
    for (number, action) in (1..).zip(segment.prior_actions.iter()) {
        if world.step(*action)?.outcome.is_some() {
            return Err(EpisodeFault::EndedBefore {
                step: number,
                prior_actions: segment.prior_actions.len(),
            });
        }
    }
    Ok((world, segment.prior_actions.to_vec()))
}

fn is_last_of_segment(ticket: &Ticket, step: u32) -> bool {
    let segment = ticket.segment.as_ref();
    segment.is_some_and(|segment| step == ticket.first_step() + segment.steps)
}

/// Starts the episode of `ticket`: everything random in it derives from the ticket's seed.
///
/// # Errors
/// [`EpisodeFault`] if the ticket names a course or level that does not exist.
pub fn reset<'a>(
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

/// Returns the random generator for one purpose in the episode of `ticket`, from `step` on.
fn generator(ticket: &Ticket, purpose: Purpose, step: u32) -> Pcg64Mcg {
    Pcg64Mcg::seed_from_u64(derive(ticket.seed, purpose, step.into()))
}

/// `==`, when compiling.
const fn are_equal(left: &[&str], right: &[&str]) -> bool {
    let mut equal = left.len() == right.len();
    let mut index = 0;
    while equal && index < left.len() {
        let (one, other) = (left[index].as_bytes(), right[index].as_bytes());
        equal = one.len() == other.len();
        let mut place = 0;
        while equal && place < one.len() {
            equal = one[place] == other[place];
            place += 1;
        }
        index += 1;
    }
    equal
}

/// Writes an action and its consequences into the record of its observation.
fn complete(
    record: &mut TransitionRecord,
    action: Action,
    report: &StepReport,
    reward: &RewardTerms,
) {
    record.action = action;
    record.walls_passed = report.walls_passed;
    record.reward = reward.total();
    record.reward_terms = reward.values();
    let arrived = report.outcome == Some(EpisodeOutcome::ReachedEnd);
    record.level_up = u8::from(report.level_up == LevelUp::Yes || arrived);
    record.terminated = u8::from(arrived || report.outcome == Some(EpisodeOutcome::Collided));
    record.truncated = u8::from(report.outcome == Some(EpisodeOutcome::TimedOut));
}

/// Makes a record with an observation the episode's closing one; returns the episode's score.
fn close(
    record: &mut TransitionRecord,
    outcome: Outcome,
    report: &StepReport,
    walls: u8,
    episode_return: f64,
) -> EpisodeScore {
    let hit_wall = hit_wall(report);
    record.kind = RecordKind::Closing.code();
    record.walls_passed = report.walls_passed;
    record.course_walls = walls;
    record.outcome = outcome.code();
    record.hit_wall = hit_wall.unwrap_or(0);
    EpisodeScore {
        walls_passed: report.walls_passed.into(),
        walls: walls.into(),
        // As in `episodes.csv`. For a segment, its rewards only.
        episode_return: f64::from(episode_return as f32),
        outcome,
        hit_wall,
    }
}

/// Returns the wall that was hit, from 1 in episode order.
fn hit_wall(report: &StepReport) -> Option<u8> {
    match report.hit {
        Some(Obstacle::Wall(wall)) => Some(wall),
        Some(Obstacle::Corridor) | None => None,
    }
}

/// Sends `record` to report that the episode has failed, unless only this actor's environment has.
fn send_failure<L: RecordLink>(
    fault: EpisodeFault,
    mut record: L::Loan,
    link: &mut L,
) -> EpisodeError<L::Error> {
    if let EpisodeFault::Foreign(fault) = fault {
        return EpisodeError::Foreign(fault);
    }
    record.kind = RecordKind::Failed.code();
    match link.send(record) {
        Ok(()) => EpisodeError::Fault(fault),
        Err(error) => EpisodeError::Link(error),
    }
}

/// Converts between simulator and protocol, which do not depend on each other.
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
