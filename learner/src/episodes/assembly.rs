//! Assembles streamed records into a whole episode, or into a whole segment of one.
//!
//! An episode is committed once, complete and in order, or not at all. Nothing downstream ever sees
//! half an episode, or one flown with two policies. For an episode in segments, the same holds for
//! each segment, and each begins where the one before it ended.

use skein_protocol::ids::{ActorId, ActorIncarnation, EpisodeId};
use skein_protocol::transition::{
    Outcome, RecordFault, RecordKind, RecordLengths, TransitionRecord,
};
use skein_protocol::{Action, IMAGE_PIXELS};

use super::order::EpisodeOrder;
use crate::episode::{CommittedEpisode, StepObservation};

pub use super::order::KeptData;

/// An episode or segment whose records are arriving.
#[derive(Debug)]
pub struct Assembly {
    order: EpisodeOrder,
    actor: ActorId,
    incarnation: ActorIncarnation,
    episode: CommittedEpisode,
    /// Required start of a later segment: the end of the one before it.
    begins: Option<SegmentEnd>,
    longest_records: usize,
    lengths: RecordLengths,
    /// State of the episode after the last step; its walls passed are in `episode`.
    last_step: StepEnd,
}

/// End of a segment whose episode continues.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SegmentEnd {
    episode: EpisodeId,
    /// Steps flown since the reset.
    steps: usize,
    walls_passed: u8,
    seen: StepObservation,
}

impl SegmentEnd {
    /// Returns the end of `segment`; `None` if its episode ended too.
    pub fn of(segment: &CommittedEpisode) -> Option<Self> {
        let seen = *segment.observations.last()?;
        segment.outcome.is_none().then_some(Self {
            episode: segment.episode,
            steps: segment.first_step + segment.steps(),
            walls_passed: segment.walls_passed,
            seen,
        })
    }

    /// `true` if `order` asks for the segment that comes next.
    pub fn is_before(&self, order: &EpisodeOrder) -> bool {
        (self.episode, self.steps) == (order.ticket.episode, order.ticket.first_step() as usize)
    }

    /// `true` if the vehicle is at the same place, to the last bit. A newer encoder may have
    /// encoded the image, so codes are not compared.
    fn is_at(&self, record: &TransitionRecord) -> bool {
        self.seen.position_m == record.position_m
            && self.seen.velocity_mps == record.velocity_mps
            && self.seen.orientation == record.orientation
    }
}

/// State of an episode after a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum StepEnd {
    /// The episode continues.
    Onward,
    /// The episode ended in a state without a future.
    Terminated { level_up: bool },
    /// The episode was cut off.
    Truncated,
}

/// Effect of a record on its episode.
#[derive(Debug)]
pub enum Assembled {
    /// One more step.
    Step,
    /// The last record of the episode or segment.
    Whole(Box<CommittedEpisode>),
    /// The simulator failed; the episode is void.
    Failed,
}

impl Assembly {
    /// Starts empty, for `order`. An episode has at most `longest_records` records, with codes and
    /// actions of these `lengths`. A later segment `begins` at the end of the one before it.
    pub fn new(
        order: EpisodeOrder,
        begins: Option<SegmentEnd>,
        longest_records: usize,
        lengths: RecordLengths,
        actor: ActorId,
        incarnation: ActorIncarnation,
    ) -> Self {
        Self {
            episode: CommittedEpisode {
                walls_passed: begins.map_or(0, |begins| begins.walls_passed),
                ..nothing_of(&order, actor)
            },
            order,
            actor,
            incarnation,
            begins,
            longest_records,
            lengths,
            last_step: StepEnd::Onward,
        }
    }

    /// The order that is being flown.
    pub fn order(&self) -> &EpisodeOrder {
        &self.order
    }

    /// Returns the order; drops what was assembled.
    pub fn into_order(self) -> EpisodeOrder {
        self.order
    }

    /// `true` if no record has arrived yet.
    pub fn is_empty(&self) -> bool {
        self.episode.observations.is_empty()
    }

    /// Number of records that have arrived.
    pub fn records(&self) -> usize {
        self.episode.observations.len()
    }

    /// Adds the next record.
    ///
    /// # Errors
    /// [`RecordFault`] when it is not the next record of this episode, or is invalid; the episode
    /// is void then.
    pub fn push(&mut self, record: &TransitionRecord) -> Result<Assembled, RecordFault> {
        let step = self.order.ticket.first_step() + self.episode.observations.len() as u32;
        let kind = record.check(&self.order.ticket, self.actor, self.incarnation, step)?;
        if kind == RecordKind::Failed {
            return Ok(Assembled::Failed);
        }
        record.check_lengths(self.lengths)?;
        if self.episode.observations.len() == self.longest_records {
            let most = self.longest_records;
            return Err(RecordFault::TooLong { most });
        }
        match kind {
            RecordKind::Closing => self.check_ending(record)?,
            RecordKind::SegmentEnd => self.check_segment_end(record)?,
            RecordKind::Step | RecordKind::Failed => self.check_step(record)?,
        }
        if self.is_empty() {
            self.check_begin(record)?;
            self.make_room();
        }
        self.episode.observations.push(StepObservation {
            latent: record.latent,
            velocity_mps: record.velocity_mps,
            goal_m: record.goal_m,
            position_m: record.position_m,
            orientation: record.orientation,
            ground_truth: record.ground_truth,
        });
        if let Some(depth) = &mut self.episode.depth {
            depth.extend_from_slice(&record.depth);
        }
        match kind {
            RecordKind::Closing => self.close(record)?,
            RecordKind::SegmentEnd => {}
            RecordKind::Step | RecordKind::Failed => {
                self.take_step(record);
                return Ok(Assembled::Step);
            }
        }
        self.finish()
            .map(|episode| Assembled::Whole(Box::new(episode)))
    }

    fn take_step(&mut self, record: &TransitionRecord) {
        self.episode.actions.push(record.action);
        self.episode.teacher_actions.push(record.teacher_action);
        self.episode.rewards.push(record.reward);
        self.episode.reward_terms.push(record.reward_terms);
        self.episode.level_up.push(record.level_up == 1);
        self.episode.walls_passed = record.walls_passed;
        self.last_step = StepEnd::of(record);
    }

    /// Reserves memory for the images of the longest episode at once. The system provides pages
    /// only when written, so unused memory costs nothing. Growing buffers would be moved again and
    /// again, into fresh memory each time.
    fn make_room(&mut self) {
        let longest = self
            .segment_steps()
            .map_or(self.longest_records, |steps| steps + 1);
        if let Some(depth) = &mut self.episode.depth {
            depth.reserve_exact(longest.min(self.longest_records) * IMAGE_PIXELS);
        }
    }

    /// Steps of the segment, if it is one.
    fn segment_steps(&self) -> Option<usize> {
        self.order
            .ticket
            .segment
            .as_ref()
            .map(|segment| segment.steps as usize)
    }

    /// Checks that a later segment begins where the one before it ended. A machine whose physics
    /// differ must not continue the episode.
    fn check_begin(&self, record: &TransitionRecord) -> Result<(), RecordFault> {
        let is_elsewhere = self.begins.is_some_and(|begins| !begins.is_at(record));
        refuse_contradictions([(
            "the segment does not begin where the one before it ended",
            is_elsewhere,
        )])
    }

    /// Checks that the episode continues, and that its walls and level-ups agree.
    fn check_step(&self, record: &TransitionRecord) -> Result<(), RecordFault> {
        let passed_before = self.episode.walls_passed;
        let passes = record.walls_passed > passed_before;
        let levels_up = record.level_up == 1;
        // Reaching the end wall is a level-up too, and terminates the episode.
        let may_level_up = passes || record.terminated == 1;
        let is_over = self.segment_steps() == Some(self.episode.steps());
        refuse_contradictions([
            (
                "a step after the episode's end",
                self.last_step != StepEnd::Onward,
            ),
            ("a step after the segment's last", is_over),
            (
                "walls passed grow fewer",
                record.walls_passed < passed_before,
            ),
            ("a wall passed without a level-up", passes && !levels_up),
            (
                "a level-up without a wall passed",
                levels_up && !may_level_up,
            ),
        ])
    }

    /// Checks that the closing record's outcome fits the last step.
    fn check_ending(&self, record: &TransitionRecord) -> Result<(), RecordFault> {
        if self.is_empty() {
            // `close` refuses this with a fitting message.
            return Ok(());
        }
        let outcome = Outcome::from_code(record.outcome);
        let fits = match self.last_step {
            StepEnd::Onward => false,
            StepEnd::Truncated => outcome == Some(Outcome::TimedOut),
            StepEnd::Terminated { level_up } => {
                outcome == Some(Outcome::Collided)
                    || (outcome == Some(Outcome::ReachedEnd) && level_up)
            }
        };
        let passed = self.episode.walls_passed;
        refuse_contradictions([
            ("the episode did not end as it closes", !fits),
            (
                "walls passed after the last step",
                record.walls_passed != passed,
            ),
        ])
    }

    /// Checks that the segment is over, and its episode is not.
    fn check_segment_end(&self, record: &TransitionRecord) -> Result<(), RecordFault> {
        let steps = self.segment_steps();
        refuse_contradictions([
            (
                "a segment ends in an episode that is flown whole",
                steps.is_none(),
            ),
            (
                "the segment ends before its last step",
                steps != Some(self.episode.steps()),
            ),
            (
                "the episode ended before the segment",
                self.last_step != StepEnd::Onward,
            ),
            (
                "walls passed after the last step",
                record.walls_passed != self.episode.walls_passed,
            ),
        ])
    }

    /// Takes the outcome from the closing record.
    fn close(&mut self, record: &TransitionRecord) -> Result<(), RecordFault> {
        let outcome = Outcome::from_code(record.outcome).ok_or(RecordFault::Code {
            name: "outcome",
            value: record.outcome,
        })?;
        self.episode.outcome = Some(outcome);
        self.episode.walls_passed = record.walls_passed;
        self.episode.course_walls = record.course_walls;
        self.episode.hit_wall = (record.hit_wall > 0).then_some(record.hit_wall);
        Ok(())
    }

    /// Returns what was assembled.
    fn finish(&mut self) -> Result<CommittedEpisode, RecordFault> {
        if self.episode.actions.is_empty() {
            let step = self.order.ticket.first_step().into();
            return Err(RecordFault::Mismatch {
                name: "step",
                found: step,
                expected: step + 1,
            });
        }
        if let Some(depth) = &mut self.episode.depth {
            depth.shrink_to_fit();
        }
        let nothing = nothing_of(&self.order, self.actor);
        Ok(std::mem::replace(&mut self.episode, nothing))
    }
}

/// The episode or segment that `order` asks for, before its first record.
fn nothing_of(order: &EpisodeOrder, actor: ActorId) -> CommittedEpisode {
    let ticket = &order.ticket;
    let flown: &[Action] = ticket
        .segment
        .as_ref()
        .map_or(&[], |segment| &segment.prior_actions);
    CommittedEpisode {
        episode: ticket.episode,
        epoch: order.epoch,
        policy_version: ticket.policy_version,
        actor,
        level: ticket.start_level,
        first_step: flown.len(),
        action_before: flown.last().copied().unwrap_or_default(),
        observations: Vec::new(),
        actions: Vec::new(),
        teacher_actions: Vec::new(),
        rewards: Vec::new(),
        reward_terms: Vec::new(),
        level_up: Vec::new(),
        outcome: None,
        walls_passed: 0,
        course_walls: 0,
        hit_wall: None,
        depth: (order.keep == KeptData::Depth).then(Vec::new),
    }
}

impl StepEnd {
    fn of(record: &TransitionRecord) -> Self {
        match (record.terminated, record.truncated) {
            (1, _) => Self::Terminated {
                level_up: record.level_up == 1,
            },
            (_, 1) => Self::Truncated,
            _ => Self::Onward,
        }
    }
}

/// Returns the first contradiction that holds as an error.
fn refuse_contradictions<const N: usize>(
    contradictions: [(&'static str, bool); N],
) -> Result<(), RecordFault> {
    match contradictions.into_iter().find(|(_, is_there)| *is_there) {
        Some((what, _)) => Err(RecordFault::Contradiction { what }),
        None => Ok(()),
    }
}

#[cfg(test)]
#[path = "assembly_tests.rs"]
mod tests;
