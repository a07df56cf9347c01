//! The ticket: the complete input of an episode.
//!
//! An episode is flown only for a ticket, and two actors with the same ticket fly the same episode,
//! bit for bit. The learner sends tickets inside [`ControlRecord`]s, messages of fixed size;
//! tickets of [segments](crate::segment) inside [`SegmentRecord`]s, which have more room.

use bytemuck::{Pod, Zeroable};
use serde::{Deserialize, Serialize};

use crate::ids::{ActorId, ActorIncarnation, Attempt, EpisodeId, PolicyVersion, RunId};
use crate::segment::{Segment, SegmentRecord};

/// Ticket of an episode: its course, policy, exploration and seed.
#[derive(Debug, Clone, PartialEq)]
pub struct Ticket {
    /// The run it belongs to.
    pub run: RunId,
    /// Its number.
    pub episode: EpisodeId,
    /// Number of earlier attempts at this episode.
    pub attempt: Attempt,
    /// The snapshot to fly the whole ticket with.
    pub policy_version: PolicyVersion,
    /// Course.
    pub course: CourseChoice,
    /// The level whose start the episode begins at, from 1.
    pub start_level: u8,
    /// Choice of actions.
    pub exploration: Exploration,
    /// Seed of everything random in the episode.
    pub seed: u64,
    /// Share of the steps that the teacher flies, in [0, 1]; its action is then in every record.
    /// `None` where no teacher is asked.
    pub teacher_share: Option<f32>,
    /// The part of the episode to fly; `None` for all of it.
    pub segment: Option<Segment>,
}

impl Ticket {
    /// Returns the number of steps flown on earlier tickets of this episode.
    pub fn first_step(&self) -> u32 {
        self.segment
            .as_ref()
            .map_or(0, |segment| segment.prior_actions.len() as u32)
    }
}

/// Course of an episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum CourseChoice {
    /// The training course.
    Training,
    /// The evaluation course of this index.
    Evaluation(u32),
    /// A generated course of this seed.
    Generated(u64),
}

/// Choice of actions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Exploration {
    /// Uniformly at random, before the first update.
    Uniform,
    /// Sampled from the policy, in training.
    Sample,
    /// The policy's mode, without noise, in evaluation.
    Mode,
}

/// Message from the learner to an actor.
#[derive(Debug, Clone, PartialEq)]
pub enum Control {
    /// Fly this ticket.
    Fly(Ticket),
    /// The learner is alive.
    Heartbeat,
    /// The run is over: stop flying and exit.
    Stop,
    /// No record of this actor arrives: join again.
    Rejoin,
}

/// [`Control`] on the wire, addressed to one actor or, for heartbeats and the stop, to all.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct ControlRecord {
    run: u64,
    to_incarnation: u64,
    episode: u64,
    policy_version: u64,
    course_seed: u64,
    seed: u64,
    to_actor: u32,
    attempt: u32,
    course_index: u32,
    kind: u8,
    course_kind: u8,
    start_level: u8,
    exploration: u8,
    /// 1 if the teacher is asked.
    teacher: u32,
    teacher_share: f32,
}

// Six 8-byte and three 4-byte fields, four bytes, then two 4-byte fields: no padding, so no
// uninitialised byte ever leaves the process.
const _: () = assert!(size_of::<ControlRecord>() == 6 * 8 + 3 * 4 + 4 + 2 * 4);

const ALL_ACTORS: u32 = u32::MAX;

impl ControlRecord {
    /// Builds the record of `ticket` for a whole episode, for one incarnation of one actor.
    pub fn fly(ticket: &Ticket, actor: ActorId, incarnation: ActorIncarnation) -> Self {
        let (course_kind, course_index, course_seed) = match ticket.course {
            CourseChoice::Training => (0, 0, 0),
            CourseChoice::Evaluation(index) => (1, index, 0),
            CourseChoice::Generated(seed) => (2, 0, seed),
        };
        Self {
            run: ticket.run.0,
            to_incarnation: incarnation.0,
            episode: ticket.episode.0,
            policy_version: ticket.policy_version.0,
            course_seed,
            seed: ticket.seed,
            to_actor: actor.0,
            attempt: ticket.attempt.0,
            course_index,
            kind: 1,
            course_kind,
            start_level: ticket.start_level,
            exploration: match ticket.exploration {
                Exploration::Uniform => 0,
                Exploration::Sample => 1,
                Exploration::Mode => 2,
            },
            teacher: u32::from(ticket.teacher_share.is_some()),
            teacher_share: ticket.teacher_share.unwrap_or_default(),
        }
    }

    /// Builds a heartbeat to all actors.
    pub fn heartbeat(run: RunId) -> Self {
        Self::broadcast(run, 0)
    }

    /// Builds the end of the run, to all actors.
    pub fn stop(run: RunId) -> Self {
        Self::broadcast(run, 2)
    }

    /// Builds the request to one incarnation of one actor to join again.
    pub fn rejoin(run: RunId, actor: ActorId, incarnation: ActorIncarnation) -> Self {
        Self {
            to_actor: actor.0,
            to_incarnation: incarnation.0,
            ..Self::broadcast(run, 3)
        }
    }

    fn broadcast(run: RunId, kind: u8) -> Self {
        Self {
            run: run.0,
            to_incarnation: 0,
            episode: 0,
            policy_version: 0,
            course_seed: 0,
            seed: 0,
            to_actor: ALL_ACTORS,
            attempt: 0,
            course_index: 0,
            kind,
            course_kind: 0,
            start_level: 0,
            exploration: 0,
            teacher: 0,
            teacher_share: 0.0,
        }
    }

    /// Returns `true` if the message is for this incarnation of this actor.
    pub fn is_for(&self, actor: ActorId, incarnation: ActorIncarnation) -> bool {
        self.to_actor == ALL_ACTORS
            || (self.to_actor == actor.0 && self.to_incarnation == incarnation.0)
    }

    /// Reads the message.
    ///
    /// # Errors
    /// [`ControlFault`] if the record holds what no learner of this version and run writes.
    pub fn read(&self, run: RunId) -> Result<Control, ControlFault> {
        if self.run != run.0 {
            return Err(ControlFault::OtherRun(self.run));
        }
        match self.kind {
            0 => Ok(Control::Heartbeat),
            1 => self.ticket(run).map(Control::Fly),
            2 => Ok(Control::Stop),
            3 => Ok(Control::Rejoin),
            kind => Err(ControlFault::Field {
                name: "kind",
                value: kind,
            }),
        }
    }

    fn ticket(&self, run: RunId) -> Result<Ticket, ControlFault> {
        if self.start_level == 0 {
            return Err(ControlFault::Field {
                name: "start_level",
                value: 0,
            });
        }
        Ok(Ticket {
            run,
            episode: EpisodeId(self.episode),
            attempt: Attempt(self.attempt),
            policy_version: PolicyVersion(self.policy_version),
            course: match self.course_kind {
                0 => CourseChoice::Training,
                1 => CourseChoice::Evaluation(self.course_index),
                2 => CourseChoice::Generated(self.course_seed),
                value => {
                    return Err(ControlFault::Field {
                        name: "course_kind",
                        value,
                    });
                }
            },
            start_level: self.start_level,
            exploration: match self.exploration {
                0 => Exploration::Uniform,
                1 => Exploration::Sample,
                2 => Exploration::Mode,
                value => {
                    return Err(ControlFault::Field {
                        name: "exploration",
                        value,
                    });
                }
            },
            seed: self.seed,
            teacher_share: self.teacher_share()?,
            segment: None,
        })
    }

    fn teacher_share(&self) -> Result<Option<f32>, ControlFault> {
        match self.teacher {
            0 => Ok(None),
            // NaN is outside every range.
            1 if (0.0..=1.0).contains(&self.teacher_share) => Ok(Some(self.teacher_share)),
            _ => Err(ControlFault::TeacherShare(self.teacher_share)),
        }
    }
}

/// A message to actors, by the service that carries it.
#[derive(Debug, Clone, PartialEq)]
pub enum ControlMessage {
    /// Everything except tickets of segments.
    Control(ControlRecord),
    /// The ticket of a segment.
    Segment(Box<SegmentRecord>),
}

impl ControlMessage {
    /// Builds the message with `ticket`, for one incarnation of one actor.
    pub fn fly(ticket: &Ticket, actor: ActorId, incarnation: ActorIncarnation) -> Self {
        match &ticket.segment {
            None => Self::Control(ControlRecord::fly(ticket, actor, incarnation)),
            Some(segment) => Self::Segment(Box::new(SegmentRecord::fly(
                ticket,
                segment,
                actor,
                incarnation,
            ))),
        }
    }

    /// Returns `true` if the message is for this incarnation of this actor.
    pub fn is_for(&self, actor: ActorId, incarnation: ActorIncarnation) -> bool {
        match self {
            Self::Control(record) => record.is_for(actor, incarnation),
            Self::Segment(record) => record.is_for(actor, incarnation),
        }
    }

    /// Reads the message.
    ///
    /// # Errors
    /// [`ControlFault`] if the message holds what no learner of this version and run writes.
    pub fn read(&self, run: RunId) -> Result<Control, ControlFault> {
        match self {
            Self::Control(record) => record.read(run),
            Self::Segment(record) => record.read(run),
        }
    }
}

/// Reason why a control record is refused.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum ControlFault {
    /// The record belongs to another run.
    #[error("control record of run {0:016x}")]
    OtherRun(u64),
    /// A field has an unknown value.
    #[error("control record with {name} = {value}")]
    Field {
        /// The field.
        name: &'static str,
        /// Its value.
        value: u8,
    },
    /// The teacher's share is none.
    #[error("control record with teacher_share = {0}, which is outside [0, 1]")]
    TeacherShare(f32),
    /// The ticket of a segment is invalid.
    #[error("the ticket of a segment {0}")]
    Segment(&'static str),
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    pub(crate) fn ticket() -> Ticket {
        Ticket {
            run: RunId(3),
            episode: EpisodeId(7),
            attempt: Attempt(1),
            policy_version: PolicyVersion(5),
            course: CourseChoice::Generated(99),
            start_level: 2,
            exploration: Exploration::Sample,
            seed: 42,
            teacher_share: Some(0.25),
            segment: None,
        }
    }

    #[test]
    fn a_ticket_survives_the_wire() {
        let choices = [
            CourseChoice::Training,
            CourseChoice::Evaluation(3),
            CourseChoice::Generated(99),
        ];
        let explorations = [Exploration::Uniform, Exploration::Sample, Exploration::Mode];
        for (course, exploration) in choices.into_iter().zip(explorations) {
            let ticket = Ticket {
                course,
                exploration,
                ..ticket()
            };
            let record = ControlRecord::fly(&ticket, ActorId(4), ActorIncarnation(8));
            assert_eq!(record.read(RunId(3)), Ok(Control::Fly(ticket)));
        }
    }

    #[test]
    fn a_ticket_is_for_one_incarnation_of_one_actor() {
        let record = ControlRecord::fly(&ticket(), ActorId(4), ActorIncarnation(8));
        assert!(record.is_for(ActorId(4), ActorIncarnation(8)));
        assert!(!record.is_for(ActorId(4), ActorIncarnation(9)));
        assert!(!record.is_for(ActorId(5), ActorIncarnation(8)));
        assert!(ControlRecord::stop(RunId(3)).is_for(ActorId(5), ActorIncarnation(1)));
        let rejoin = ControlRecord::rejoin(RunId(3), ActorId(4), ActorIncarnation(8));
        assert_eq!(rejoin.read(RunId(3)), Ok(Control::Rejoin));
        assert!(
            rejoin.is_for(ActorId(4), ActorIncarnation(8))
                && !rejoin.is_for(ActorId(4), ActorIncarnation(9))
        );
    }

    #[test]
    fn garbage_is_refused_with_the_field() {
        let mut record = ControlRecord::fly(&ticket(), ActorId(4), ActorIncarnation(8));
        assert_eq!(record.read(RunId(4)), Err(ControlFault::OtherRun(3)));
        record.exploration = 77;
        assert_eq!(
            record.read(RunId(3)),
            Err(ControlFault::Field {
                name: "exploration",
                value: 77
            })
        );
        record.exploration = 1;
        for share in [-0.1, 1.5, f32::NAN] {
            record.teacher_share = share;
            assert!(matches!(
                record.read(RunId(3)),
                Err(ControlFault::TeacherShare(_))
            ));
        }
        record.teacher_share = 0.0;
        assert!(record.read(RunId(3)).is_ok());
        record.start_level = 0;
        assert!(record.read(RunId(3)).is_err());
    }
}
