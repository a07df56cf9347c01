//! Tests that a segment is a function of its ticket, independent of who flew the earlier ones.

use skein_protocol::MAX_ACTION;
use skein_protocol::ids::{Attempt, EpisodeId, PolicyVersion};
use skein_protocol::ticket::{CourseChoice, Exploration};

use super::tests::{
    ACTOR, INCARNATION, STORMY, Tape, environment_loop, flown, fly, network, raw, ticket,
};
use super::*;

/// Returns `ticket` for the `steps` that follow `flown`.
fn segment(ticket: &Ticket, steps: u32, flown: &[Action]) -> Ticket {
    Ticket {
        segment: Some(Segment {
            steps,
            prior_actions: flown.into(),
        }),
        ..ticket.clone()
    }
}

/// Flies `ticket` in segments of `steps` with `fly`. Returns the records without the segments'
/// ends, and those ends.
fn flown_in_segments(
    ticket: &Ticket,
    steps: u32,
    mut fly: impl FnMut(&Ticket) -> (Option<EpisodeScore>, Tape),
) -> (Vec<Box<TransitionRecord>>, Vec<Box<TransitionRecord>>) {
    let (mut records, mut ends, mut flown): (Vec<Box<TransitionRecord>>, Vec<_>, Vec<_>) =
        Default::default();
    loop {
        let segment = segment(ticket, steps, &flown);
        let (score, mut tape) = fly(&segment);
        let kind = match score {
            Some(_) => RecordKind::Closing,
            None => RecordKind::SegmentEnd,
        };
        let (first, last) = (segment.first_step(), tape.sent.len() - 1);
        for (step, record) in tape.sent.iter().enumerate() {
            let kind = if step == last { kind } else { RecordKind::Step };
            assert_eq!(
                record.check(&segment, ACTOR, INCARNATION, first + step as u32),
                Ok(kind)
            );
        }
        if score.is_some() {
            records.extend(tape.sent);
            return (records, ends);
        }
        assert_eq!(last, steps as usize);
        ends.extend(tape.sent.pop());
        flown.extend(tape.sent.iter().map(|record| record.action));
        records.extend(tape.sent);
    }
}

#[test]
fn an_episode_in_segments_without_noise_is_the_episode_flown_whole() {
    for simulator in ["", STORMY] {
        for course in [CourseChoice::Training, CourseChoice::Generated(1)] {
            let ticket = Ticket {
                course,
                ..ticket(Exploration::Mode, 1)
            };
            let mut used = environment_loop(simulator);
            let (_, whole) = flown(&mut used, &ticket);
            for steps in [1, 3, 200] {
                let (records, ends) =
                    flown_in_segments(&ticket, steps, |segment| fly(&mut used, segment));
                assert!(raw(&records) == raw(&whole.sent), "in segments of {steps}");
                // A segment ends with the observation that the next one begins with.
                for (end, next) in ends
                    .iter()
                    .zip(records.iter().skip(steps as usize).step_by(steps as usize))
                {
                    let seen = |record: &TransitionRecord| {
                        (
                            record.position_m,
                            record.velocity_mps,
                            record.latent,
                            record.depth,
                        )
                    };
                    assert!(seen(end) == seen(next));
                    assert_eq!(end.action, [0.0; MAX_ACTION]);
                }
            }
        }
    }
}

#[test]
fn a_segment_does_not_depend_on_who_flew_the_earlier_ones() {
    for simulator in ["", STORMY] {
        for exploration in [Exploration::Uniform, Exploration::Sample] {
            let ticket = ticket(exploration, 1);
            let mut one = environment_loop(simulator);
            let (alone, _) = flown_in_segments(&ticket, 2, |segment| fly(&mut one, segment));
            assert!(alone.len() > 6, "too short to compare anything");
            // Each segment by a new loop, or by one that has flown another episode in between.
            let (strangers, _) = flown_in_segments(&ticket, 2, |segment| {
                fly(&mut environment_loop(simulator), segment)
            });
            assert!(raw(&strangers) == raw(&alone));
            let (distracted, _) = flown_in_segments(&ticket, 2, |next| {
                let other = Ticket {
                    seed: 7,
                    ..ticket.clone()
                };
                fly(&mut one, &segment(&other, 2, &[]));
                fly(&mut one, next)
            });
            assert!(raw(&distracted) == raw(&alone));
            let (longer, _) = flown_in_segments(&ticket, 3, |segment| fly(&mut one, segment));
            assert!(
                raw(&longer) != raw(&alone),
                "the noise of each segment is its own"
            );
        }
    }
}

#[test]
fn a_loop_resumes_only_the_exact_episode_that_it_paused() {
    let mut environment_loop = environment_loop("");
    let ticket = ticket(Exploration::Uniform, 1);
    let (_, tape) = fly(&mut environment_loop, &segment(&ticket, 2, &[]));
    let flown: Vec<_> = tape.sent[..2].iter().map(|record| record.action).collect();
    let flies_on = |environment_loop: &EnvironmentLoop, ticket: &Ticket| {
        let paused = environment_loop.paused.as_ref();
        paused.is_some_and(|paused| paused.is_before(ticket, ticket.segment.as_ref().unwrap()))
    };
    let next = segment(&ticket, 5, &flown);
    let again = Ticket {
        attempt: Attempt(9),
        policy_version: PolicyVersion(99),
        exploration: Exploration::Sample,
        ..next.clone()
    };
    assert!(flies_on(&environment_loop, &next) && flies_on(&environment_loop, &again));
    let mut nearly = [flown[0], flown[1]];
    nearly[1][1] = f32::from_bits(nearly[1][1].to_bits() ^ 1);
    for elsewhere in [
        segment(&ticket, 5, &flown[..1]),
        segment(&ticket, 5, &nearly),
        segment(&ticket, 5, &[]),
        Ticket {
            seed: 2,
            ..next.clone()
        },
        Ticket {
            episode: EpisodeId(6),
            ..next.clone()
        },
        Ticket {
            course: CourseChoice::Evaluation(0),
            ..next.clone()
        },
        Ticket {
            start_level: 1,
            ..next.clone()
        },
    ] {
        assert!(!flies_on(&environment_loop, &elsewhere), "{elsewhere:?}");
    }
    // A whole episode leaves nothing unfinished.
    super::tests::flown(&mut environment_loop, &ticket);
    assert!(environment_loop.paused.is_none());
}

#[test]
fn a_segment_after_the_episodes_end_is_a_fault() {
    let ticket = ticket(Exploration::Mode, 1);
    let (_, whole) = flown(&mut environment_loop(""), &ticket);
    let actions: Vec<_> = whole.sent.iter().map(|record| record.action).collect();
    let mut tape = Tape::default();
    let end = environment_loop("").fly(&segment(&ticket, 1, &actions), &network(|_| {}), &mut tape);
    let Err(EpisodeError::Fault(fault)) = end else {
        panic!("{end:?}")
    };
    let steps = whole.sent.len() - 1;
    assert_eq!(
        fault.to_string(),
        format!(
            "the episode ends in step {steps}, within the {} steps before the segment",
            steps + 1
        )
    );
    assert_eq!(tape.sent[0].kind, RecordKind::Failed.code());
}
