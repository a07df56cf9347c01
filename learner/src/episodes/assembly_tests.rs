//! An episode or a segment is whole, in order and consistent, or it is refused with the reason.

use bytemuck::Zeroable;
use skein_protocol::ActionSpace;
use skein_protocol::ids::{Attempt, Epoch, PolicyVersion, RunId};
use skein_protocol::segment::Segment;
use skein_protocol::ticket::{CourseChoice, Exploration, Ticket};

use super::super::order::BatchPlace;
use super::*;

const ACTOR: ActorId = ActorId(2);
const INCARNATION: ActorIncarnation = ActorIncarnation(11);
/// Length of the latent codes.
const LATENT: usize = 16;
const LENGTHS: RecordLengths = RecordLengths {
    latent: LATENT,
    action: ActionSpace::Lateral,
};
/// Steps of the test episode.
const STEPS: u32 = 3;

fn ticket() -> Ticket {
    Ticket {
        run: RunId(1),
        episode: EpisodeId(5),
        attempt: Attempt(0),
        policy_version: PolicyVersion(3),
        course: CourseChoice::Training,
        start_level: 1,
        exploration: Exploration::Sample,
        seed: 9,
        teacher_share: None,
        segment: None,
    }
}

fn order(ticket: Ticket, keep: KeptData) -> EpisodeOrder {
    EpisodeOrder {
        ticket,
        epoch: Epoch(0),
        keep,
        place: BatchPlace { batch: 0, index: 0 },
    }
}

fn assembly(keep: KeptData) -> Assembly {
    Assembly::new(
        order(ticket(), keep),
        None,
        STEPS as usize + 1,
        LENGTHS,
        ACTOR,
        INCARNATION,
    )
}

/// Record `step`, its image filled with the step number.
fn record(step: u32) -> TransitionRecord {
    let mut record = TransitionRecord::zeroed();
    record.begin(&ticket(), ACTOR, INCARNATION, step);
    record.depth.fill(step as u8);
    record.truncated = u8::from(step == STEPS - 1);
    if step == STEPS {
        record.kind = RecordKind::Closing.code();
        record.outcome = Outcome::TimedOut.code();
    }
    record
}

fn assemble(keep: KeptData) -> CommittedEpisode {
    let mut assembly = assembly(keep);
    for step in 0..STEPS {
        assert!(matches!(assembly.push(&record(step)), Ok(Assembled::Step)));
    }
    match assembly.push(&record(STEPS)) {
        Ok(Assembled::Whole(episode)) => *episode,
        other => panic!("the closing record gives {other:?}"),
    }
}

#[test]
fn no_episode_mixes_policy_versions() {
    for strange in 1..=STEPS {
        let mut assembly = assembly(KeptData::Latents);
        for step in 0..strange {
            assembly.push(&record(step)).unwrap();
        }
        let mut newer = record(strange);
        newer.policy_version += 1;
        let fault = assembly.push(&newer).unwrap_err();
        let (name, found, expected) = ("policy_version", 4, 3);
        assert_eq!(
            fault,
            RecordFault::Mismatch {
                name,
                found,
                expected
            }
        );
    }
    assert_eq!(assemble(KeptData::Latents).policy_version, PolicyVersion(3));
}

#[test]
fn a_code_that_is_longer_than_configured_is_refused() {
    let mut assembly = assembly(KeptData::Latents);
    let mut longer = record(0);
    longer.latent[..LATENT].fill(0.5);
    assembly.push(&longer).unwrap();
    longer.step = 1;
    longer.latent[LATENT] = 0.5;
    let fault = assembly.push(&longer).unwrap_err().to_string();
    assert!(fault.contains("longer than vae.latent"), "{fault}");
}

#[test]
fn an_episode_that_never_ends_is_refused_at_its_limit() {
    let mut assembly = assembly(KeptData::Depth);
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

/// The assembly of a segment of two steps, after one step of its episode.
fn segment(begins: Option<SegmentEnd>) -> Assembly {
    let segment = Segment {
        steps: 2,
        prior_actions: vec![[0.25, -0.5, 0.0, 0.0]].into(),
    };
    let ticket = Ticket {
        segment: Some(segment),
        ..ticket()
    };
    Assembly::new(
        order(ticket, KeptData::Depth),
        begins,
        100,
        LENGTHS,
        ACTOR,
        INCARNATION,
    )
}

fn changed(
    mut record: TransitionRecord,
    change: impl FnOnce(&mut TransitionRecord),
) -> TransitionRecord {
    change(&mut record);
    record
}

fn segment_end(step: u32) -> TransitionRecord {
    changed(onward(step), |record| {
        record.kind = RecordKind::SegmentEnd.code()
    })
}

/// A step after which the episode continues.
fn onward(step: u32) -> TransitionRecord {
    changed(record(step), |record| {
        (record.kind, record.truncated, record.outcome) = (RecordKind::Step.code(), 0, 0);
    })
}

#[test]
fn a_segment_holds_its_steps_and_the_action_before_them() {
    let mut assembly = segment(None);
    assert!(matches!(assembly.push(&onward(1)), Ok(Assembled::Step)));
    assert!(matches!(assembly.push(&onward(2)), Ok(Assembled::Step)));
    let Ok(Assembled::Whole(segment)) = assembly.push(&segment_end(3)) else {
        panic!("a segment's end ends it");
    };
    assert_eq!(
        (segment.first_step, segment.steps(), segment.outcome),
        (1, 2, None)
    );
    assert_eq!(
        (segment.action_before, segment.check()),
        ([0.25, -0.5, 0.0, 0.0], Ok(()))
    );
    assert!(!segment.terminated());
    let end = SegmentEnd::of(&segment).unwrap();
    assert_eq!((end.episode, end.steps), (EpisodeId(5), 3));
    // An episode may end in a segment; then no other segment follows.
    let mut last = self::segment(None);
    last.push(&changed(onward(1), |record| record.terminated = 1))
        .unwrap();
    let closing = changed(onward(2), |record| {
        (record.kind, record.outcome) = (RecordKind::Closing.code(), Outcome::Collided.code());
    });
    let Ok(Assembled::Whole(last)) = last.push(&closing) else {
        panic!("a closing record ends a segment, too");
    };
    assert_eq!(
        (last.outcome, SegmentEnd::of(&last)),
        (Some(Outcome::Collided), None)
    );
}

#[test]
fn a_segment_that_is_too_short_or_too_long_or_of_a_whole_episode_is_refused() {
    let refusal = |records: &[TransitionRecord], mut assembly: Assembly| {
        let fault = records
            .iter()
            .find_map(|record| assembly.push(record).err());
        fault.expect("one record is invalid").to_string()
    };
    assert!(refusal(&[onward(1), segment_end(2)], segment(None)).contains("before its last step"));
    assert!(
        refusal(&[onward(1), onward(2), onward(3)], segment(None))
            .contains("after the segment's last")
    );
    assert!(refusal(&[onward(0)], segment(None)).contains("step is 0, expected 1"));
    assert!(refusal(&[segment_end(1)], segment(None)).contains("before its last step"));
    assert!(
        refusal(&[onward(0), segment_end(1)], assembly(KeptData::Latents)).contains("flown whole")
    );
    let end = |change: fn(&mut TransitionRecord)| {
        refusal(
            &[onward(1), changed(onward(2), change), segment_end(3)],
            segment(None),
        )
    };
    assert!(end(|last| last.truncated = 1).contains("ended before the segment"));
    assert!(end(|last| (last.walls_passed, last.level_up) = (1, 1)).contains("walls passed after"));
}

#[test]
fn a_segment_begins_where_the_one_before_it_ended_with_the_walls_that_were_passed() {
    let seen = StepObservation {
        latent: [9.0; skein_protocol::MAX_LATENT],
        velocity_mps: [1.0, 0.5, 0.0],
        goal_m: [20.0, 0.0, 0.0],
        position_m: [3.0, 0.0, 2.0],
        orientation: [0.0, 0.0, 0.0, 1.0],
        ground_truth: [0.0; skein_protocol::GROUND_TRUTH],
    };
    let (episode, steps, walls_passed) = (EpisodeId(5), 1, 2);
    let begins = SegmentEnd {
        episode,
        steps,
        walls_passed,
        seen,
    };
    let there = changed(onward(1), |record| {
        (record.position_m, record.velocity_mps) = (seen.position_m, seen.velocity_mps);
        (record.orientation, record.walls_passed) = (seen.orientation, 2);
    });
    // A newer encoder encodes the same image differently.
    assert_ne!(there.latent, seen.latent);
    assert!(matches!(
        segment(Some(begins)).push(&there),
        Ok(Assembled::Step)
    ));
    let changes: [fn(&mut TransitionRecord); 3] = [
        |record| record.position_m[2] += 1e-6,
        |record| record.velocity_mps[1] = -0.5,
        |record| record.orientation[0] = 1e-9,
    ];
    for change in changes {
        let elsewhere = changed(there, change);
        let fault = segment(Some(begins))
            .push(&elsewhere)
            .unwrap_err()
            .to_string();
        assert!(fault.contains("does not begin where"), "{fault}");
    }
    let fewer = changed(there, |record| record.walls_passed = 1);
    assert!(segment(Some(begins)).push(&fewer).is_err());
}

#[test]
fn depth_images_are_copied_only_if_ordered() {
    assert_eq!(assemble(KeptData::Latents).depth, None);
    let kept = assemble(KeptData::Depth).depth.unwrap();
    let images: Vec<_> = kept
        .chunks_exact(IMAGE_PIXELS)
        .map(|image| image.to_vec())
        .collect();
    assert_eq!(
        images,
        (0..=3)
            .map(|step| vec![step; IMAGE_PIXELS])
            .collect::<Vec<_>>()
    );
}

#[test]
fn an_episode_that_contradicts_itself_is_refused() {
    // A change to one record, by its step, and the resulting error, here or at the first record
    // that reveals it.
    type Case = (u32, fn(&mut TransitionRecord), &'static str);
    let cases: [Case; 9] = [
        (0, |r| r.truncated = 1, "a step after the episode's end"),
        (0, |r| r.terminated = 1, "a step after the episode's end"),
        (
            2,
            |r| r.truncated = 0,
            "the episode did not end as it closes",
        ),
        (
            3,
            |r| r.outcome = Outcome::Collided.code(),
            "the episode did not end as it closes",
        ),
        (
            2,
            |r| (r.truncated, r.terminated) = (0, 1),
            "the episode did not end as it closes",
        ),
        (
            1,
            |r| r.walls_passed = 1,
            "a wall passed without a level-up",
        ),
        (1, |r| r.level_up = 1, "a level-up without a wall passed"),
        (
            1,
            |r| (r.walls_passed, r.level_up) = (1, 1),
            "walls passed grow fewer",
        ),
        (
            3,
            |r| r.walls_passed = 1,
            "walls passed after the last step",
        ),
    ];
    for (step, change, expected) in cases {
        let mut assembly = assembly(KeptData::Latents);
        let fault = (0..=STEPS).find_map(|at| {
            let mut record = record(at);
            record.course_walls = 5;
            if at == step {
                change(&mut record);
            }
            assembly.push(&record).err()
        });
        assert_eq!(
            fault,
            Some(RecordFault::Contradiction { what: expected }),
            "{expected}"
        );
    }
}

#[test]
fn a_committed_episode_names_the_wall_that_was_hit() {
    for (hit_wall, expected) in [(0, None), (1, Some(1))] {
        let mut assembly = assembly(KeptData::Latents);
        let mut last = record(0);
        last.terminated = 1;
        assembly.push(&last).unwrap();
        let mut closing = record(1);
        closing.kind = RecordKind::Closing.code();
        closing.outcome = Outcome::Collided.code();
        (closing.course_walls, closing.hit_wall) = (5, hit_wall);
        let Assembled::Whole(episode) = assembly.push(&closing).unwrap() else {
            panic!("a closing record ends an episode");
        };
        assert_eq!(episode.hit_wall, expected);
    }
}

#[test]
fn the_end_wall_is_reached_by_a_level_up_that_passes_no_wall() {
    for (level_up, is_refused) in [(1, false), (0, true)] {
        let mut assembly = assembly(KeptData::Latents);
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
