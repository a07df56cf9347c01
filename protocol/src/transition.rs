//! The transition record: one step of an episode, as it lies in shared memory.
//!
//! An episode or segment of T steps is T+1 records. Record t holds the observation at step t, the
//! action chosen on it, and the reward and end flags that followed; the closing record holds only
//! the last observation. The depth camera renders into [`TransitionRecord::depth`] of a loaned
//! sample, and the learner reads it there: the image's bytes are written once.

use bytemuck::{Pod, Zeroable};
use serde::{Deserialize, Serialize};

use crate::ids::{ActorId, ActorIncarnation};
use crate::ticket::Ticket;
use crate::{
    Action, ActionSpace, GROUND_TRUTH, IMAGE_PIXELS, LatentCode, MAX_ACTION, REWARD_TERMS,
};

/// Largest magnitude in a valid record: the settings limit each term of a reward to 10⁶ and
/// corridors to 1 km. The learner squares its inputs, and single precision ends at 3 · 10³⁸.
pub const MAX_MAGNITUDE: f32 = 1e7;

/// Bytes between `hit_wall` and `ground_truth`, so that the image starts on a cache line.
const RESERVED: usize = {
    // 365: the header's other fields.
    let used = size_of::<f32>() * (REWARD_TERMS + GROUND_TRUTH + 2 * MAX_ACTION) + 365;
    used.next_multiple_of(64) - used
};

/// One step of an episode on the wire. Every bit pattern is a valid value of every field's type;
/// [`TransitionRecord::check`] checks the meaning.
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub struct TransitionRecord {
    /// The run.
    pub run: u64,
    /// The episode.
    pub episode: u64,
    /// The snapshot that the whole ticket is flown with.
    pub policy_version: u64,
    /// The actor's incarnation.
    pub incarnation: u64,
    /// The actor.
    pub actor: u32,
    /// The ticket's attempt. It distinguishes an episode flown again from a late copy.
    pub attempt: u32,
    /// Step within the episode, from 0 without a gap. Earlier segments and the closing record
    /// count.
    pub step: u32,
    /// A [`RecordKind`].
    pub kind: u8,
    /// The level whose start the episode begins at.
    pub start_level: u8,
    /// Walls passed in the episode so far, this step included.
    pub walls_passed: u8,
    /// An [`Outcome`], in the closing record.
    pub outcome: u8,
    /// Position in the world in metres: along the corridor, lateral, up.
    pub position_m: [f32; 3],
    /// Orientation, world from body, as a unit quaternion (i, j, k, w).
    pub orientation: [f32; 4],
    /// Velocity in the world in metres per second: forward, left, up.
    pub velocity_mps: [f32; 3],
    /// The goal from the drone, in the heading frame, in metres: forward, left, up.
    pub goal_m: [f32; 3],
    /// The VAE's latent mean of `depth`; zero from index `vae.latent` on.
    pub latent: LatentCode,
    /// The action, each number in [-1, 1]; zero beyond those of the run's
    /// [`ActionSpace`](crate::ActionSpace).
    pub action: Action,
    /// The teacher's action for the same observation, each in [-1, 1]; zero if the ticket asks for
    /// none.
    pub teacher_action: Action,
    /// Sum of `reward_terms`.
    pub reward: f32,
    /// The terms of the reward: [`REWARD_TERM_NAMES`](crate::REWARD_TERM_NAMES).
    pub reward_terms: [f32; REWARD_TERMS],
    /// 1 if a wall was crossed or the destination reached in this step.
    pub level_up: u8,
    /// 1 if the episode ended in this step in a state without a future (collision, destination).
    pub terminated: u8,
    /// 1 if the step limit ended the episode in this step; its value still bootstraps.
    pub truncated: u8,
    /// Walls of the course, in the closing record: the maximum of `walls_passed`.
    pub course_walls: u8,
    /// The wall that was hit, from 1 in course order, in the closing record of an episode that
    /// collided; 0 for the corridor and in all other records.
    pub hit_wall: u8,
    reserved: [u8; RESERVED],
    /// The simulator's ground truth at the time of the observation, which the camera does not see;
    /// see [`CriticInput::GroundTruth`](crate::config::CriticInput::GroundTruth).
    pub ground_truth: [f32; GROUND_TRUTH],
    /// Depth image, 128×72, row by row from the top left; 255 is the camera's range or farther. It
    /// starts on a cache line.
    pub depth: [u8; IMAGE_PIXELS],
}

// The header is whole cache lines (eight for four terms of the reward), so the image starts on a
// cache line in samples aligned to one (see `services`). There is no padding, so the record is
// plain data.
const HEADER: usize = std::mem::offset_of!(TransitionRecord, depth);
const _: () = assert!(HEADER.is_multiple_of(64));
const _: () = assert!(size_of::<TransitionRecord>() == HEADER + IMAGE_PIXELS);
const _: () = assert!(align_of::<TransitionRecord>() == 8);

/// Lengths of what records have more room for than a run needs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RecordLengths {
    /// Length of the latent code.
    pub latent: usize,
    /// Numbers of an action.
    pub action: ActionSpace,
}

/// Role of a record within its episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RecordKind {
    /// An observation, the action on it and the consequences.
    Step,
    /// The last observation of an episode.
    Closing,
    /// The last observation of a segment whose episode continues.
    SegmentEnd,
    /// The simulator failed; the episode's earlier records are void.
    Failed,
}

/// Outcome of an episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// Touched a wall or the corridor.
    Collided,
    /// Reached the end wall: the course is passed.
    ReachedEnd,
    /// Reached the step limit while flying.
    TimedOut,
}

impl Outcome {
    /// Returns the code on the wire.
    pub fn code(self) -> u8 {
        match self {
            Self::Collided => 1,
            Self::ReachedEnd => 2,
            Self::TimedOut => 3,
        }
    }

    /// Reads a code from the wire; returns `None` if it is not an outcome.
    pub fn from_code(code: u8) -> Option<Self> {
        [Self::Collided, Self::ReachedEnd, Self::TimedOut]
            .into_iter()
            .find(|outcome| outcome.code() == code)
    }

    /// Returns the name in `episodes.csv`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Collided => "collided",
            Self::ReachedEnd => "reached_end",
            Self::TimedOut => "timed_out",
        }
    }
}

impl RecordKind {
    /// Returns the code on the wire.
    pub fn code(self) -> u8 {
        match self {
            Self::Step => 1,
            Self::Closing => 2,
            Self::Failed => 3,
            Self::SegmentEnd => 4,
        }
    }

    /// Reads a code from the wire; returns `None` if it is not a kind.
    pub fn from_code(code: u8) -> Option<Self> {
        [Self::Step, Self::Closing, Self::Failed, Self::SegmentEnd]
            .into_iter()
            .find(|kind| kind.code() == code)
    }
}

impl TransitionRecord {
    /// Writes the header for `step` of `ticket` and clears everything else except the image, which
    /// is rendered over.
    pub fn begin(
        &mut self,
        ticket: &Ticket,
        actor: ActorId,
        incarnation: ActorIncarnation,
        step: u32,
    ) {
        bytemuck::bytes_of_mut(self)[..std::mem::offset_of!(Self, depth)].fill(0);
        self.run = ticket.run.0;
        self.episode = ticket.episode.0;
        self.policy_version = ticket.policy_version.0;
        self.incarnation = incarnation.0;
        self.actor = actor.0;
        self.attempt = ticket.attempt.0;
        self.step = step;
        self.kind = RecordKind::Step.code();
        self.start_level = ticket.start_level;
    }

    /// Returns the record's kind if it is valid as step `step` of `ticket` flown by `incarnation`
    /// of `actor`.
    ///
    /// # Errors
    /// [`RecordFault`] names the field; such a record is never learned from.
    pub fn check(
        &self,
        ticket: &Ticket,
        actor: ActorId,
        incarnation: ActorIncarnation,
        step: u32,
    ) -> Result<RecordKind, RecordFault> {
        let same = |name, found: u64, expected: u64| {
            if found == expected {
                Ok(())
            } else {
                Err(RecordFault::Mismatch {
                    name,
                    found,
                    expected,
                })
            }
        };
        same("run", self.run, ticket.run.0)?;
        same("episode", self.episode, ticket.episode.0)?;
        same(
            "policy_version",
            self.policy_version,
            ticket.policy_version.0,
        )?;
        same("attempt", self.attempt.into(), ticket.attempt.0.into())?;
        same("actor", self.actor.into(), actor.0.into())?;
        same("incarnation", self.incarnation, incarnation.0)?;
        same(
            "start_level",
            self.start_level.into(),
            ticket.start_level.into(),
        )?;
        same("step", self.step.into(), step.into())?;
        let kind = RecordKind::from_code(self.kind).ok_or(RecordFault::Code {
            name: "kind",
            value: self.kind,
        })?;
        if kind != RecordKind::Failed {
            self.check_numbers()?;
        }
        if kind == RecordKind::Closing {
            self.check_ending()?;
        }
        Ok(kind)
    }

    /// Checks that code and actions are not longer than `lengths`.
    ///
    /// # Errors
    /// [`RecordFault::Contradiction`]; such a record was made with another encoder or another
    /// vehicle.
    pub fn check_lengths(&self, lengths: RecordLengths) -> Result<(), RecordFault> {
        let numbers = lengths.action.numbers();
        for (beyond, what) in [
            (
                &self.latent[lengths.latent..],
                "the latent code is longer than vae.latent",
            ),
            (
                &self.action[numbers..],
                "the action has more numbers than simulator.vehicle.action",
            ),
            (
                &self.teacher_action[numbers..],
                "the teacher's action has more numbers than simulator.vehicle.action",
            ),
        ] {
            if beyond.iter().any(|&value| value != 0.0) {
                return Err(RecordFault::Contradiction { what });
            }
        }
        Ok(())
    }

    fn check_numbers(&self) -> Result<(), RecordFault> {
        let range = -MAX_MAGNITUDE..=MAX_MAGNITUDE;
        // NaN is outside every range.
        let finite = |name, values: &[f32]| match values.iter().find(|value| !range.contains(value))
        {
            None => Ok(()),
            Some(value) if value.is_finite() => Err(RecordFault::TooLarge {
                name,
                value: *value,
            }),
            Some(_) => Err(RecordFault::NotFinite { name }),
        };
        finite("position_m", &self.position_m)?;
        finite("orientation", &self.orientation)?;
        finite("velocity_mps", &self.velocity_mps)?;
        finite("goal_m", &self.goal_m)?;
        finite("latent", &self.latent)?;
        finite("ground_truth", &self.ground_truth)?;
        finite("action", &self.action)?;
        finite("teacher_action", &self.teacher_action)?;
        finite("reward", &[self.reward])?;
        finite("reward_terms", &self.reward_terms)?;
        // Summed in the actor's order, so that the sums are bit-equal.
        let sum = self.reward_terms.into_iter().reduce(|sum, term| sum + term);
        if Some(self.reward) != sum {
            return Err(RecordFault::Contradiction {
                what: "the reward is not the sum of its terms",
            });
        }
        for action in [self.action, self.teacher_action] {
            if action.iter().any(|value| value.abs() > 1.0) {
                return Err(RecordFault::ActionOutOfRange { action });
            }
        }
        for (name, value) in [
            ("level_up", self.level_up),
            ("terminated", self.terminated),
            ("truncated", self.truncated),
        ] {
            if value > 1 {
                return Err(RecordFault::Code { name, value });
            }
        }
        if self.terminated == 1 && self.truncated == 1 {
            return Err(RecordFault::Contradiction {
                what: "the episode was terminated and truncated in one step",
            });
        }
        Ok(())
    }

    fn check_ending(&self) -> Result<(), RecordFault> {
        let (name, value) = if Outcome::from_code(self.outcome).is_none() {
            ("outcome", self.outcome)
        } else if u32::from(self.start_level) + u32::from(self.walls_passed)
            > u32::from(self.course_walls) + 1
        {
            ("walls_passed", self.walls_passed)
        } else if !self.may_have_hit_wall() {
            ("hit_wall", self.hit_wall)
        } else {
            return Ok(());
        };
        Err(RecordFault::Code { name, value })
    }

    /// Returns `true` if `hit_wall` is 0, or a wall that an episode which collided could reach: at
    /// most the first one that it has not passed.
    fn may_have_hit_wall(&self) -> bool {
        let next = u32::from(self.start_level) + u32::from(self.walls_passed);
        let reachable = next.min(self.course_walls.into());
        let collided = Outcome::from_code(self.outcome) == Some(Outcome::Collided);
        self.hit_wall == 0 || (collided && u32::from(self.hit_wall) <= reachable)
    }
}

/// Reason why a record is refused.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum RecordFault {
    /// The record belongs elsewhere, or records before it are missing.
    #[error("{name} is {found}, expected {expected}")]
    Mismatch {
        /// The field.
        name: &'static str,
        /// Its value.
        found: u64,
        /// The expected value.
        expected: u64,
    },
    /// A field has a value that no episode produces.
    #[error("{name} has the impossible value {value}")]
    Code {
        /// The field.
        name: &'static str,
        /// Its value.
        value: u8,
    },
    /// A field is infinite or NaN.
    #[error("{name} is not finite")]
    NotFinite {
        /// The field.
        name: &'static str,
    },
    /// A field exceeds every simulated value.
    #[error("{name} holds {value}, beyond {MAX_MAGNITUDE}")]
    TooLarge {
        /// The field.
        name: &'static str,
        /// The number.
        value: f32,
    },
    /// The episode is too long.
    #[error("the episode has more than the {most} records of transport.max_records_per_episode")]
    TooLong {
        /// Records of the longest episode.
        most: usize,
    },
    /// The record contradicts itself or earlier records.
    #[error("{what}")]
    Contradiction {
        /// The contradiction.
        what: &'static str,
    },
    /// An action that no policy of Skein chooses.
    #[error("action {action:?} is outside [-1, 1]")]
    ActionOutOfRange {
        /// The action.
        action: Action,
    },
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::MAX_LATENT;
    use crate::ids::{Attempt, EpisodeId, PolicyVersion, RunId};
    use crate::ticket::{CourseChoice, Exploration};

    const ACTOR: ActorId = ActorId(2);
    const INCARNATION: ActorIncarnation = ActorIncarnation(11);

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

    fn record() -> TransitionRecord {
        let mut record = TransitionRecord::zeroed();
        record.begin(&ticket(), ACTOR, INCARNATION, 4);
        record
    }

    #[test]
    fn a_begun_record_belongs_to_its_ticket_and_keeps_the_image() {
        let mut record = record();
        record.depth[17] = 200;
        record.begin(&ticket(), ACTOR, INCARNATION, 4);
        assert_eq!(record.depth[17], 200);
        assert_eq!(
            record.check(&ticket(), ACTOR, INCARNATION, 4),
            Ok(RecordKind::Step)
        );
    }

    #[test]
    fn a_record_of_anything_else_is_refused_by_name() {
        let check = |change: fn(&mut TransitionRecord)| {
            let mut record = record();
            change(&mut record);
            record
                .check(&ticket(), ACTOR, INCARNATION, 4)
                .unwrap_err()
                .to_string()
        };
        assert!(check(|r| r.run = 2).contains("run"));
        assert!(check(|r| r.episode = 6).contains("episode"));
        assert!(check(|r| r.policy_version = 4).contains("policy_version"));
        assert!(check(|r| r.attempt = 1).contains("attempt"));
        assert!(check(|r| r.actor = 3).contains("actor"));
        assert!(check(|r| r.incarnation = 12).contains("incarnation"));
        assert!(check(|r| r.step = 5).contains("step"));
        assert!(check(|r| r.kind = 9).contains("kind"));
        assert!(check(|r| r.kind = RecordKind::Closing.code()).contains("outcome"));
        assert!(check(|r| r.latent[3] = f32::NAN).contains("latent"));
        assert!(check(|r| r.goal_m[1] = f32::NAN).contains("goal_m"));
        assert!(check(|r| r.ground_truth[15] = f32::NAN).contains("ground_truth"));
        assert!(check(|r| r.reward = f32::INFINITY).contains("reward is not finite"));
        assert!(check(|r| r.velocity_mps[1] = -1e8).contains("velocity_mps holds -100000000"));
        assert!(check(|r| r.action[1] = 1.5).contains("action"));
        assert!(check(|r| r.terminated = 2).contains("terminated"));
        assert!(check(|r| r.reward = 0.5).contains("not the sum of its terms"));
        assert!(
            check(|r| (r.terminated, r.truncated) = (1, 1)).contains("terminated and truncated")
        );
        let closes = |r: &mut TransitionRecord| {
            r.kind = RecordKind::Closing.code();
            r.outcome = Outcome::ReachedEnd.code();
            (r.walls_passed, r.course_walls) = (6, 5);
        };
        assert!(check(closes).contains("walls_passed has the impossible value 6"));
    }

    #[test]
    fn code_and_actions_end_where_the_configuration_says() {
        let lengths = |latent, action| RecordLengths { latent, action };
        let mut record = record();
        record.latent[..16].fill(0.5);
        record.action[..3].fill(0.5);
        record.teacher_action[..3].fill(0.5);
        let check = |record: &TransitionRecord, latent, action| {
            let checked = record.check_lengths(lengths(latent, action));
            checked.map_err(|fault| fault.to_string())
        };
        for (latent, action) in [
            (16, ActionSpace::Velocity),
            (MAX_LATENT, ActionSpace::VelocityYaw),
        ] {
            assert_eq!(check(&record, latent, action), Ok(()));
        }
        for value in [1e-30, f32::NAN] {
            record.latent[15] = value;
            let refused = check(&record, 15, ActionSpace::Velocity).unwrap_err();
            assert!(refused.contains("longer than vae.latent"), "{refused}");
        }
        let refused = check(&record, 16, ActionSpace::Lateral).unwrap_err();
        assert!(refused.starts_with("the action has more"), "{refused}");
        record.action[2] = 0.0;
        let refused = check(&record, 16, ActionSpace::Lateral).unwrap_err();
        assert!(
            refused.starts_with("the teacher's action has more"),
            "{refused}"
        );
    }

    #[test]
    fn a_wall_is_hit_only_by_an_episode_that_collided_and_could_reach_it() {
        let hit = |outcome: Outcome, hit_wall| {
            let mut record = record();
            record.kind = RecordKind::Closing.code();
            record.outcome = outcome.code();
            (record.walls_passed, record.course_walls, record.hit_wall) = (2, 5, hit_wall);
            record.check(&ticket(), ACTOR, INCARNATION, 4)
        };
        for (outcome, hit_wall, is_sound) in [
            (Outcome::Collided, 0, true),
            (Outcome::Collided, 1, true),
            (Outcome::Collided, 3, true),
            (Outcome::Collided, 4, false),
            (Outcome::TimedOut, 0, true),
            (Outcome::TimedOut, 3, false),
            (Outcome::ReachedEnd, 1, false),
        ] {
            assert_eq!(
                hit(outcome, hit_wall).is_ok(),
                is_sound,
                "{outcome:?}, wall {hit_wall}"
            );
        }
    }
}
