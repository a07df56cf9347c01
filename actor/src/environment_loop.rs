//! The environment loop: one ticket in, one flight out.
//!
//! [`Pilot::fly`] is the whole of it, and the only one: training, evaluation during training and evaluation of a file differ in the ticket and in where
//! the records go. A flight is a function of its ticket and of the snapshot the ticket names, so nothing is remembered from one flight to the next, and
//! start and noise are drawn from generators of their own.

use std::ops::DerefMut;

use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use skein_protocol::ACTION;
use skein_protocol::evaluation::FlightScore;
use skein_protocol::ids::{ActorId, Incarnation};
use skein_protocol::seeds::{Purpose, derive};
use skein_protocol::ticket::Ticket;
use skein_protocol::transition::{Outcome, RecordKind, TransitionRecord};
use skein_simulator::course::NoSuchLevel;
use skein_simulator::reward::{RewardSettings, RewardTerms};
use skein_simulator::simulator::{self, LevelUp, SimulationError, Simulator, StepReport};

use crate::agent::Agent;
use crate::courses::{NoCourse, Simulators};
use crate::inference::Network;

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
        let mut start = Pcg64Mcg::seed_from_u64(derive(ticket.seed, Purpose::StartPosition, 0));
        let mut noise = Pcg64Mcg::seed_from_u64(derive(ticket.seed, Purpose::ActionNoise, 0));
        let begin = |link: &mut L, step| {
            let mut record = link.loan().map_err(FlightError::Link)?;
            record.begin(ticket, self.actor, self.incarnation, step);
            Ok(record)
        };

        let mut record = begin(link, 0)?;
        let simulator = match take_off(&mut self.simulators, ticket, &mut start) {
            Ok(simulator) => simulator,
            Err(fault) => return Err(give_up(fault, record, link)),
        };
        self.agent.observe(simulator, network, &mut record);

        let mut previous_action = [0.0; ACTION];
        let mut flight_return = 0.0;
        for step in 1.. {
            if link.directive().map_err(FlightError::Link)? == Directive::Abandon {
                return Err(FlightError::Abandoned);
            }
            let action = self
                .agent
                .act(ticket.exploration, network, &record, &previous_action, &mut noise);
            let report = match simulator.step(action) {
                Ok(report) => report,
                Err(error) => return Err(give_up(error.into(), record, link)),
            };

            // The reward looks at what the action led to, so the next image comes before this record is complete.
            let mut next = begin(link, step)?;
            self.agent.observe(simulator, network, &mut next);
            let reward = RewardTerms::of(&self.reward, &report, &next.depth);
            complete(&mut record, action, &report, &reward);
            link.send(record).map_err(FlightError::Link)?;

            flight_return += f64::from(reward.total());
            previous_action = action;
            record = next;
            if let Some(ended) = report.outcome {
                let outcome = outcome(ended);
                close(&mut record, outcome, &report);
                link.send(record).map_err(FlightError::Link)?;
                return Ok(FlightScore {
                    walls_passed: report.walls_passed.into(),
                    flight_return,
                    outcome,
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

fn take_off<'a>(
    simulators: &'a mut Simulators,
    ticket: &Ticket,
    start: &mut Pcg64Mcg,
) -> Result<&'a mut Simulator, FlightFault> {
    let simulator = simulators.of(ticket.course)?;
    simulator.reset(ticket.start_level, start)?;
    Ok(simulator)
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
fn close(record: &mut TransitionRecord, outcome: Outcome, report: &StepReport) {
    record.kind = RecordKind::Closing.code();
    record.walls_passed = report.walls_passed;
    record.outcome = outcome.code();
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
mod tests {
    use std::sync::Arc;

    use bytemuck::Zeroable;
    use skein_protocol::IMAGE_PIXELS;
    use skein_protocol::config::Observation;
    use skein_protocol::ids::{Attempt, FlightId, RunId};
    use skein_protocol::snapshot::SnapshotLayout;
    use skein_protocol::ticket::{CourseChoice, Exploration};

    use super::*;
    use crate::courses::Courses;
    use crate::inference::Scratch;
    use crate::testing::{config, random_snapshot};

    const ACTOR: ActorId = ActorId(3);
    const LIFE: Incarnation = Incarnation(8);

    /// Keeps what is sent, and where each image lay when it was loaned and when it was sent.
    #[derive(Default)]
    struct Tape {
        sent: Vec<Box<TransitionRecord>>,
        loaned_at: Vec<usize>,
        sent_at: Vec<usize>,
        abandon_after: Option<usize>,
    }

    impl RecordLink for Tape {
        type Loan = Box<TransitionRecord>;
        type Error = std::convert::Infallible;

        fn loan(&mut self) -> Result<Self::Loan, Self::Error> {
            let mut record = Box::new(TransitionRecord::zeroed());
            record.depth = [0xA5; IMAGE_PIXELS];
            self.loaned_at.push(record.depth.as_ptr() as usize);
            Ok(record)
        }

        fn send(&mut self, record: Self::Loan) -> Result<(), Self::Error> {
            self.sent_at.push(record.depth.as_ptr() as usize);
            self.sent.push(record);
            Ok(())
        }

        fn directive(&mut self) -> Result<Directive, Self::Error> {
            let enough = self.abandon_after.is_some_and(|steps| self.sent.len() >= steps);
            Ok(if enough {
                Directive::Abandon
            } else {
                Directive::Continue
            })
        }
    }

    fn ticket(exploration: Exploration, seed: u64) -> Ticket {
        Ticket {
            run: RunId(1),
            flight: FlightId(5),
            attempt: Attempt(2),
            policy_version: NETWORK,
            course: CourseChoice::Training,
            start_level: 2,
            exploration,
            seed,
        }
    }

    const NETWORK: skein_protocol::ids::PolicyVersion = skein_protocol::ids::PolicyVersion(4);

    fn pilot(simulator: &str) -> Pilot {
        let courses = Courses::of_run(&config(simulator)).unwrap();
        Pilot::new(
            ACTOR,
            LIFE,
            Simulators::new(Arc::new(courses)),
            Agent::new(Observation::LatentVelocityAction),
        )
    }

    fn network(change: impl Fn(&mut [f32])) -> Network {
        let layout = SnapshotLayout::new(Observation::LatentVelocityAction.len(), 16);
        let mut snapshot = random_snapshot(&layout, NETWORK.0);
        change(&mut snapshot.values[layout.policy()]);
        Network::new(&snapshot, &layout)
    }

    fn flown(pilot: &mut Pilot, ticket: &Ticket) -> (FlightScore, Tape) {
        let mut tape = Tape::default();
        let score = pilot.fly(ticket, &network(|_| {}), &mut tape).unwrap();
        (score, tape)
    }

    fn bytes(tape: &Tape) -> Vec<&[u8]> {
        tape.sent.iter().map(|record| bytemuck::bytes_of(&**record)).collect()
    }

    #[test]
    fn a_ticket_flown_again_is_the_same_flight_bit_for_bit() {
        let mut used = pilot("");
        for exploration in [Exploration::Uniform, Exploration::Sample, Exploration::Mode] {
            let (score, first) = flown(&mut used, &ticket(exploration, 1));
            let (_, other) = flown(&mut used, &ticket(exploration, 2));
            assert_ne!(bytes(&first), bytes(&other));
            let (score_again, again) = flown(&mut used, &ticket(exploration, 1));
            let (_, elsewhere) = flown(&mut pilot(""), &ticket(exploration, 1));
            assert_eq!(score, score_again);
            assert_eq!(bytes(&first), bytes(&again));
            assert_eq!(bytes(&first), bytes(&elsewhere));
        }
    }

    #[test]
    fn how_actions_are_chosen_does_not_move_the_start() {
        let start = |exploration| flown(&mut pilot(""), &ticket(exploration, 1)).1.sent[0].position_m;
        assert_eq!(start(Exploration::Uniform), start(Exploration::Mode));
        assert_eq!(start(Exploration::Uniform), start(Exploration::Sample));
    }

    #[test]
    fn a_flight_is_its_steps_without_a_gap_and_one_closing_record() {
        let ticket = ticket(Exploration::Sample, 1);
        let (score, tape) = flown(&mut pilot(""), &ticket);
        let (closing, steps) = tape.sent.split_last().unwrap();
        assert!(steps.len() > 3);
        for (step, record) in (0u32..).zip(&tape.sent) {
            let kind = if step as usize == steps.len() {
                RecordKind::Closing
            } else {
                RecordKind::Step
            };
            assert_eq!(record.check(&ticket, ACTOR, LIFE, step), Ok(kind));
        }
        assert_eq!(Outcome::from_code(closing.outcome), Some(score.outcome));
        assert_eq!(u32::from(closing.walls_passed), score.walls_passed);
        let ends = |record: &&TransitionRecord| record.terminated + record.truncated > 0;
        assert!(steps.iter().rev().skip(1).all(|record| !ends(&&**record)) && ends(&&**steps.last().unwrap()));
        let sum: f64 = steps.iter().map(|record| f64::from(record.reward)).sum();
        assert_eq!(sum, score.flight_return);
    }

    #[test]
    fn each_record_holds_what_was_seen_and_the_reward_for_what_came_next() {
        let (_, tape) = flown(&mut pilot(""), &ticket(Exploration::Sample, 1));
        let (network, mut scratch) = (network(|_| {}), Scratch::default());
        for pair in tape.sent.windows(2) {
            assert_eq!(pair[0].latent, network.encode(&pair[0].depth, &mut scratch));
            let report = StepReport {
                walls_passed: 0,
                level_up: LevelUp::No,
                outcome: None,
            };
            let expected = RewardTerms::of(&RewardSettings::default(), &report, &pair[1].depth);
            assert_eq!(pair[0].reward_terms[3], expected.action);
            assert_eq!(pair[0].reward, pair[0].reward_terms.iter().sum::<f32>());
        }
    }

    #[test]
    fn images_are_rendered_into_the_loaned_record_and_sent_from_there() {
        let (_, tape) = flown(&mut pilot(""), &ticket(Exploration::Uniform, 1));
        assert_eq!(tape.loaned_at, tape.sent_at);
        assert!(
            tape.sent
                .iter()
                .all(|record| record.depth.iter().any(|pixel| *pixel != 0xA5))
        );
    }

    #[test]
    fn a_flight_cut_off_by_the_step_limit_is_truncated_and_not_terminated() {
        let (score, tape) = flown(&mut pilot("max_steps = 3"), &ticket(Exploration::Mode, 1));
        assert_eq!((score.outcome, tape.sent.len()), (Outcome::TimedOut, 4));
        assert_eq!((tape.sent[2].truncated, tape.sent[2].terminated), (1, 0));
    }

    #[test]
    fn an_abandoned_flight_has_no_closing_record() {
        let mut tape = Tape {
            abandon_after: Some(2),
            ..Tape::default()
        };
        let end = pilot("").fly(&ticket(Exploration::Mode, 1), &network(|_| {}), &mut tape);
        assert!(matches!(end, Err(FlightError::Abandoned)));
        assert_eq!(tape.sent.len(), 2);
        assert!(tape.sent.iter().all(|record| record.kind == RecordKind::Step.code()));
    }

    #[test]
    fn a_fault_ends_the_flight_with_a_record_that_says_so() {
        let mut tape = Tape::default();
        // Finite parameters whose products are not: infinity minus infinity in the second layer.
        let network = network(|policy| {
            policy
                .iter_mut()
                .enumerate()
                .for_each(|(index, value)| *value = if index % 2 == 0 { 1e38 } else { -9e37 });
        });
        let ticket = ticket(Exploration::Mode, 1);
        let end = pilot("").fly(&ticket, &network, &mut tape);
        assert!(
            matches!(end, Err(FlightError::Fault(FlightFault::Simulation(_)))),
            "{end:?}"
        );
        assert_eq!(
            tape.sent.last().unwrap().check(&ticket, ACTOR, LIFE, 0),
            Ok(RecordKind::Failed)
        );
    }

    #[test]
    fn a_ticket_for_what_is_not_there_is_a_fault_and_not_a_crash() {
        for ticket in [
            Ticket {
                start_level: 99,
                ..ticket(Exploration::Mode, 1)
            },
            Ticket {
                course: CourseChoice::Evaluation(99),
                ..ticket(Exploration::Mode, 1)
            },
        ] {
            let mut tape = Tape::default();
            let end = pilot("").fly(&ticket, &network(|_| {}), &mut tape);
            assert!(matches!(end, Err(FlightError::Fault(_))));
            assert_eq!(tape.sent[0].kind, RecordKind::Failed.code());
        }
    }

    #[test]
    fn a_generated_course_is_the_tickets_own() {
        let generated = |seed| Ticket {
            course: CourseChoice::Generated(seed),
            ..ticket(Exploration::Mode, 1)
        };
        let mut used = pilot("");
        let (_, first) = flown(&mut used, &generated(1));
        let (_, other) = flown(&mut used, &generated(2));
        let (_, again) = flown(&mut used, &generated(1));
        assert_eq!(bytes(&first), bytes(&again));
        assert_ne!(bytes(&first), bytes(&other));
    }
}
