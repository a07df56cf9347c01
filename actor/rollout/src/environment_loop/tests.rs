use std::sync::Arc;

use bytemuck::Zeroable;
use skein_protocol::config::{Observation, ObservationLayout};
use skein_protocol::ids::{Attempt, EpisodeId, RunId};
use skein_protocol::snapshot::SnapshotLayout;
use skein_protocol::ticket::{CourseChoice, Exploration};
use skein_protocol::{ActionSpace, IMAGE_PIXELS, MAX_ACTION};

use super::*;
use crate::courses::Courses;
use crate::testing::{config, random_snapshot};
use skein_inference::Scratch;

pub(super) const ACTOR: ActorId = ActorId(3);
pub(super) const INCARNATION: ActorIncarnation = ActorIncarnation(8);

/// Link that keeps the sent records, and the address of each image when loaned and when sent.
#[derive(Default)]
pub(super) struct Tape {
    pub(super) sent: Vec<Box<TransitionRecord>>,
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
        let enough = self
            .abandon_after
            .is_some_and(|steps| self.sent.len() >= steps);
        Ok(if enough {
            Directive::Abandon
        } else {
            Directive::Continue
        })
    }
}

pub(super) fn ticket(exploration: Exploration, seed: u64) -> Ticket {
    Ticket {
        run: RunId(1),
        episode: EpisodeId(5),
        attempt: Attempt(2),
        policy_version: NETWORK,
        course: CourseChoice::Training,
        start_level: 2,
        exploration,
        seed,
        teacher_share: None,
        segment: None,
    }
}

const NETWORK: skein_protocol::ids::PolicyVersion = skein_protocol::ids::PolicyVersion(4);

/// Returns the observation layout of the policies in these tests.
fn observation_layout() -> ObservationLayout {
    ObservationLayout::present(Observation::LatentVelocityAction, 32)
}

pub(super) fn environment_loop(simulator: &str) -> EnvironmentLoop {
    let courses = Courses::of_run(&config(simulator)).unwrap();
    EnvironmentLoop::new(
        ACTOR,
        INCARNATION,
        Simulators::new(Arc::new(courses)),
        Agent::new(observation_layout()),
    )
}

/// All disturbances at once.
pub(super) const STORMY: &str = "disturbances = { mass_spread = 0.2, latency_periods = 1, \
    gust.force_rms_n = 0.15, depth.model = \"stereo\" }";

pub(super) fn network(change: impl Fn(&mut [f32])) -> Network {
    let layout = SnapshotLayout::new(&observation_layout(), 16);
    let mut snapshot = random_snapshot(&layout, NETWORK.0);
    change(&mut snapshot.values[layout.policy()]);
    Network::new(&snapshot, &layout)
}

pub(super) fn flown(
    environment_loop: &mut EnvironmentLoop,
    ticket: &Ticket,
) -> (EpisodeScore, Tape) {
    let (score, tape) = fly(environment_loop, ticket);
    (score.expect("the episode is flown whole"), tape)
}

pub(super) fn fly(
    environment_loop: &mut EnvironmentLoop,
    ticket: &Ticket,
) -> (Option<EpisodeScore>, Tape) {
    let mut tape = Tape::default();
    let score = environment_loop
        .fly(ticket, &network(|_| {}), &mut tape)
        .unwrap();
    (score, tape)
}

fn bytes(tape: &Tape) -> Vec<&[u8]> {
    raw(&tape.sent)
}

pub(super) fn raw(records: &[Box<TransitionRecord>]) -> Vec<&[u8]> {
    records
        .iter()
        .map(|record| bytemuck::bytes_of(&**record))
        .collect()
}

#[test]
fn a_ticket_flown_again_is_the_same_episode_bit_for_bit() {
    let mut used = environment_loop("");
    for exploration in [Exploration::Uniform, Exploration::Sample, Exploration::Mode] {
        let (score, first) = flown(&mut used, &ticket(exploration, 1));
        let (_, other) = flown(&mut used, &ticket(exploration, 2));
        assert_ne!(bytes(&first), bytes(&other));
        let (score_again, again) = flown(&mut used, &ticket(exploration, 1));
        let (_, elsewhere) = flown(&mut environment_loop(""), &ticket(exploration, 1));
        assert_eq!(score, score_again);
        assert_eq!(bytes(&first), bytes(&again));
        assert_eq!(bytes(&first), bytes(&elsewhere));
    }
}

#[test]
fn actions_have_the_numbers_of_the_setting_and_zeros_behind_them() {
    for action in ActionSpace::ALL {
        let layout = ObservationLayout {
            action,
            ..observation_layout()
        };
        let snapshot_layout = SnapshotLayout::new(&layout, 16);
        let network = Network::new(
            &random_snapshot(&snapshot_layout, NETWORK.0),
            &snapshot_layout,
        );
        let config = config(&format!("vehicle.action = \"{}\"", action.name()));
        let courses = Arc::new(Courses::of_run(&config).unwrap());
        let mut environment_loop = EnvironmentLoop::new(
            ACTOR,
            INCARNATION,
            Simulators::new(courses),
            Agent::new(layout),
        );
        for exploration in [Exploration::Uniform, Exploration::Sample, Exploration::Mode] {
            let ticket = Ticket {
                teacher_share: Some(0.0),
                ..ticket(exploration, 1)
            };
            let mut tape = Tape::default();
            environment_loop.fly(&ticket, &network, &mut tape).unwrap();
            let (closing, steps) = tape.sent.split_last().unwrap();
            assert_eq!(closing.action, [0.0; MAX_ACTION]);
            for record in steps {
                assert_eq!(record.check_lengths(config.record_lengths()), Ok(()));
                let (own, beyond) = record.action.split_at(action.numbers());
                assert!(own.iter().all(|number| *number != 0.0), "{own:?}");
                assert!(beyond.iter().all(|number| *number == 0.0), "{beyond:?}");
            }
        }
    }
}

#[test]
fn a_snapshot_teaches_by_what_its_own_encoder_and_history_see() {
    let layout = ObservationLayout {
        history_steps: vec![2],
        ..ObservationLayout::present(Observation::LatentVelocityAction, 8)
    };
    let snapshot_layout = SnapshotLayout::new(&layout, 16);
    let snapshot = random_snapshot(&snapshot_layout, 9);
    let teacher = || Network::new(&snapshot, &snapshot_layout);
    let taught = |seed| {
        let ticket = Ticket {
            teacher_share: Some(0.3),
            ..ticket(Exploration::Sample, seed)
        };
        let mut taught = environment_loop("").with_teacher(teacher(), Agent::new(layout.clone()));
        flown(&mut taught, &ticket).1.sent
    };
    let sent = taught(1);
    let steps = sent.len() - 1;
    assert!(steps > 3, "too short to have a history");
    for (step, record) in sent[..steps].iter().enumerate() {
        let mut observed = Vec::new();
        for seen_step in [step, step.max(2) - 2] {
            let seen = &sent[seen_step];
            observed.extend(&teacher().encode(&seen.depth, &mut Scratch::default())[..8]);
            observed.extend(&seen.velocity_mps[1..]);
            let before = seen_step.checked_sub(1);
            let [left, up, ..] = before.map_or([0.0; MAX_ACTION], |before| sent[before].action);
            observed.extend([left, up]);
        }
        let expected = teacher().distribution(&observed, &mut Scratch::default());
        assert_eq!(record.teacher_action, expected.mode(), "step {step}");
    }
    // An actor that flew something else before teaches the same.
    let mut used = environment_loop("").with_teacher(teacher(), Agent::new(layout.clone()));
    let mut fly = |seed| {
        let ticket = Ticket {
            teacher_share: Some(0.3),
            ..ticket(Exploration::Sample, seed)
        };
        flown(&mut used, &ticket).1.sent
    };
    fly(1);
    assert_eq!(raw(&fly(2)), raw(&taught(2)));
}

#[test]
fn exploration_does_not_change_the_start() {
    let start = |exploration| {
        flown(&mut environment_loop(""), &ticket(exploration, 1))
            .1
            .sent[0]
            .position_m
    };
    assert_eq!(start(Exploration::Uniform), start(Exploration::Mode));
    assert_eq!(start(Exploration::Uniform), start(Exploration::Sample));
}

#[test]
fn an_episode_is_its_steps_without_a_gap_and_one_closing_record() {
    let ticket = ticket(Exploration::Sample, 1);
    let (score, tape) = flown(&mut environment_loop(""), &ticket);
    let (closing, steps) = tape.sent.split_last().unwrap();
    assert!(steps.len() > 3);
    for (step, record) in (0u32..).zip(&tape.sent) {
        let kind = if step as usize == steps.len() {
            RecordKind::Closing
        } else {
            RecordKind::Step
        };
        assert_eq!(record.check(&ticket, ACTOR, INCARNATION, step), Ok(kind));
    }
    assert_eq!(Outcome::from_code(closing.outcome), Some(score.outcome));
    assert_eq!(u32::from(closing.walls_passed), score.walls_passed);
    assert_eq!(closing.course_walls, 5);
    assert_eq!(closing.hit_wall, score.hit_wall.unwrap_or(0));
    let ends = |record: &&TransitionRecord| record.terminated + record.truncated > 0;
    assert!(
        steps.iter().rev().skip(1).all(|record| !ends(&&**record))
            && ends(&&**steps.last().unwrap())
    );
    let sum: f64 = steps.iter().map(|record| f64::from(record.reward)).sum();
    assert_eq!(f64::from(sum as f32), score.episode_return);
}

#[test]
fn each_record_holds_the_observation_and_the_reward_of_its_step() {
    let (_, tape) = flown(&mut environment_loop(""), &ticket(Exploration::Sample, 1));
    let (network, mut scratch) = (network(|_| {}), Scratch::default());
    for pair in tape.sent.windows(2) {
        assert_eq!(pair[0].latent, network.encode(&pair[0].depth, &mut scratch));
        let report = StepReport {
            walls_passed: 0,
            level_up: LevelUp::No,
            // This episode ends at the first wall.
            outcome: (pair[0].terminated == 1).then_some(EpisodeOutcome::Collided),
            hit: None,
            ..StepReport::default()
        };
        let expected = RewardTerms::of(&RewardSettings::default(), &report, &pair[1].depth);
        assert_eq!(pair[0].reward_terms, expected.values());
        assert_eq!(pair[0].reward, pair[0].reward_terms.iter().sum::<f32>());
    }
}

#[test]
fn the_teacher_is_recorded_in_each_step_and_flies_its_share() {
    let fly = |teacher_share| {
        let ticket = Ticket {
            teacher_share,
            ..ticket(Exploration::Sample, 1)
        };
        let (score, tape) = flown(&mut environment_loop(""), &ticket);
        (score.outcome, tape.sent)
    };
    let flown_by_teacher = |records: &[Box<TransitionRecord>]| {
        let steps = &records[..records.len() - 1];
        let by_teacher = steps
            .iter()
            .filter(|record| record.action == record.teacher_action);
        (by_teacher.count(), steps.len())
    };
    let (_, alone) = fly(None);
    let (_, watched) = fly(Some(0.0));
    assert!(
        alone
            .iter()
            .all(|record| record.teacher_action == [0.0; MAX_ACTION])
    );
    assert!(
        watched
            .iter()
            .any(|record| record.teacher_action != [0.0; MAX_ACTION])
    );
    let actions = |records: &[Box<TransitionRecord>]| -> Vec<_> {
        records.iter().map(|record| record.action).collect()
    };
    assert_eq!(actions(&alone), actions(&watched));
    assert_eq!(flown_by_teacher(&watched).0, 0);
    let (outcome, taught) = fly(Some(1.0));
    let (by_teacher, steps) = flown_by_teacher(&taught);
    assert_eq!((outcome, by_teacher), (Outcome::ReachedEnd, steps));
    let (_, both) = fly(Some(0.5));
    let (by_teacher, steps) = flown_by_teacher(&both);
    assert!(
        by_teacher > 0 && by_teacher < steps,
        "{by_teacher} of {steps}"
    );
}

#[test]
fn images_are_rendered_into_the_loaned_record_and_sent_from_there() {
    let (_, tape) = flown(&mut environment_loop(""), &ticket(Exploration::Uniform, 1));
    assert_eq!(tape.loaned_at, tape.sent_at);
    assert!(
        tape.sent
            .iter()
            .all(|record| record.depth.iter().any(|pixel| *pixel != 0xA5))
    );
}

#[test]
fn an_episode_cut_off_by_the_step_limit_is_truncated_and_not_terminated() {
    let (score, tape) = flown(
        &mut environment_loop("max_steps = 3"),
        &ticket(Exploration::Mode, 1),
    );
    assert_eq!((score.outcome, tape.sent.len()), (Outcome::TimedOut, 4));
    assert_eq!((tape.sent[2].truncated, tape.sent[2].terminated), (1, 0));
}

#[test]
fn an_abandoned_episode_has_no_closing_record() {
    let mut tape = Tape {
        abandon_after: Some(2),
        ..Tape::default()
    };
    let end = environment_loop("").fly(&ticket(Exploration::Mode, 1), &network(|_| {}), &mut tape);
    assert!(matches!(end, Err(EpisodeError::Abandoned)));
    assert_eq!(tape.sent.len(), 2);
    assert!(
        tape.sent
            .iter()
            .all(|record| record.kind == RecordKind::Step.code())
    );
}

#[test]
fn a_fault_ends_the_episode_with_a_record_that_says_so() {
    let mut tape = Tape::default();
    // Finite parameters whose products are not finite: infinity minus infinity in the second layer.
    let network = network(|policy| {
        policy
            .iter_mut()
            .enumerate()
            .for_each(|(index, value)| *value = if index % 2 == 0 { 1e38 } else { -9e37 });
    });
    let ticket = ticket(Exploration::Mode, 1);
    let end = environment_loop("").fly(&ticket, &network, &mut tape);
    assert!(
        matches!(end, Err(EpisodeError::Fault(EpisodeFault::Simulation(_)))),
        "{end:?}"
    );
    assert_eq!(
        tape.sent
            .last()
            .unwrap()
            .check(&ticket, ACTOR, INCARNATION, 0),
        Ok(RecordKind::Failed)
    );
}

#[test]
fn a_ticket_for_an_unknown_course_or_level_is_a_fault_and_not_a_crash() {
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
        let end = environment_loop("").fly(&ticket, &network(|_| {}), &mut tape);
        assert!(matches!(end, Err(EpisodeError::Fault(_))));
        assert_eq!(tape.sent[0].kind, RecordKind::Failed.code());
    }
}

#[test]
fn a_generated_course_depends_on_the_ticket_alone() {
    let generated = |seed| Ticket {
        course: CourseChoice::Generated(seed),
        ..ticket(Exploration::Mode, 1)
    };
    let mut used = environment_loop("");
    let (_, first) = flown(&mut used, &generated(1));
    let (_, other) = flown(&mut used, &generated(2));
    let (_, again) = flown(&mut used, &generated(1));
    assert_eq!(bytes(&first), bytes(&again));
    assert_ne!(bytes(&first), bytes(&other));
}

#[test]
fn a_disturbed_episode_is_a_function_of_its_ticket_too() {
    let mut used = environment_loop(STORMY);
    let (score, first) = flown(&mut used, &ticket(Exploration::Sample, 1));
    let (_, other) = flown(&mut used, &ticket(Exploration::Sample, 2));
    let (score_again, again) = flown(&mut used, &ticket(Exploration::Sample, 1));
    let (_, elsewhere) = flown(
        &mut environment_loop(STORMY),
        &ticket(Exploration::Sample, 1),
    );
    assert_eq!(score, score_again);
    assert_eq!(bytes(&first), bytes(&again));
    assert_eq!(bytes(&first), bytes(&elsewhere));
    assert_ne!(bytes(&first), bytes(&other));
    // It starts where the undisturbed episode of its ticket starts, but sees another image.
    let (_, calm) = flown(&mut environment_loop(""), &ticket(Exploration::Sample, 1));
    assert_eq!(first.sent[0].position_m, calm.sent[0].position_m);
    assert_ne!(first.sent[0].depth, calm.sent[0].depth);
}

#[test]
fn a_policy_with_a_history_acts_on_the_steps_in_its_records() {
    let observation_layout = ObservationLayout {
        history_steps: vec![1, 3],
        ..ObservationLayout::present(Observation::LatentVelocityAction, 16)
    };
    let layout = SnapshotLayout::new(&observation_layout, 16);
    let network = Network::new(&random_snapshot(&layout, NETWORK.0), &layout);
    let courses = Arc::new(Courses::of_run(&config("")).unwrap());
    let mut environment_loop = EnvironmentLoop::new(
        ACTOR,
        INCARNATION,
        Simulators::new(courses),
        Agent::new(observation_layout.clone()),
    );
    // The second episode must not remember the first.
    for seed in [1, 2] {
        let mut tape = Tape::default();
        environment_loop
            .fly(&ticket(Exploration::Mode, seed), &network, &mut tape)
            .unwrap();
        let steps = tape.sent.len() - 1;
        assert!(steps > 4, "too short to have a history");
        for (step, record) in tape.sent[..steps].iter().enumerate() {
            let mut observed = Vec::new();
            for seen_step in [step, step.max(1) - 1, step.max(3) - 3] {
                let seen = &tape.sent[seen_step];
                observed.extend(&seen.latent[..16]);
                assert_eq!(seen.latent[16..], [0.0; 48]);
                observed.extend(&seen.velocity_mps[1..]);
                observed.extend(if seen_step == 0 {
                    [0.0; 2]
                } else {
                    let [left, up, ..] = tape.sent[seen_step - 1].action;
                    [left, up]
                });
            }
            let action = network
                .distribution(&observed, &mut Scratch::default())
                .mode();
            assert_eq!(record.action, action, "step {step}");
        }
    }
}

#[test]
fn the_closing_record_names_the_wall_that_was_hit() {
    // A policy that flies straight on hits the first wall; one that climbs hits the ceiling.
    let closing = |bias: f32| {
        let mut tape = Tape::default();
        let layout = SnapshotLayout::new(&observation_layout(), 16);
        let steady = network(|policy| {
            policy.fill(0.0);
            // The last layer's bias begins with the means: lateral, vertical.
            let biases = policy.len() - 4;
            policy[biases + 1] = bias;
        });
        assert!(layout.policy().len() > 4);
        let ticket = Ticket {
            start_level: 1,
            ..ticket(Exploration::Mode, 1)
        };
        let score = environment_loop("")
            .fly(&ticket, &steady, &mut tape)
            .unwrap()
            .unwrap();
        let closing = tape.sent.pop().unwrap();
        assert_eq!((score.outcome, score.walls_passed), (Outcome::Collided, 0));
        (score.hit_wall, closing.hit_wall)
    };
    assert_eq!(closing(0.0), (Some(1), 1));
    assert_eq!(closing(5.0), (None, 0));
}
