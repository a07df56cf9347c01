//! Episodes as a function of ticket and policy, computed from hashes instead of physics.
//!
//! They have what the protocol must preserve: every step depends on all before it and on the
//! policy, a segment continues where the actions so far lead, and the end is not known in advance.

use skein_learner::episode::CommittedEpisode;
use skein_protocol::ids::{ActorId, ActorIncarnation, Attempt, Epoch};
use skein_protocol::ticket::{CourseChoice, Ticket};
use skein_protocol::transition::{Outcome, RecordKind, TransitionRecord};

/// Steps of the longest episode.
const LONGEST: u64 = 5;
/// Walls of every course.
const COURSE_WALLS: u8 = 5;

/// Combines two numbers into one that depends on every bit of both.
pub(crate) fn mix(left: u64, right: u64) -> u64 {
    let mut hash = left.rotate_left(23) ^ right.wrapping_mul(0x9e37_79b9_7f4a_7c15);
    hash = (hash ^ (hash >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    hash = (hash ^ (hash >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    hash ^ (hash >> 31)
}

/// A ticket being flown.
#[derive(Debug)]
pub(crate) struct Flight {
    state: u64,
    policy: u64,
    /// The next step.
    step: u64,
    /// Steps of the whole episode.
    length: u64,
    /// Step at which the ticket ends.
    end: u64,
    outcome: Outcome,
}

/// An observation and its consequence.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Moment {
    pub(crate) position: f32,
    pub(crate) what: What,
}

/// Consequence of an observation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum What {
    /// A step; with an outcome if it is the episode's last.
    Step {
        action: f32,
        reward: f32,
        ends: Option<Outcome>,
    },
    /// Nothing: the episode is over.
    Closing(Outcome),
    /// Nothing: the segment is over.
    SegmentEnd,
}

impl Flight {
    /// Begins `ticket` with the policy of its snapshot, after the actions flown earlier.
    pub(crate) fn begin(ticket: &Ticket, policy: u64) -> Self {
        let course = match ticket.course {
            CourseChoice::Training => 1,
            CourseChoice::Evaluation(index) => mix(2, index.into()),
            CourseChoice::Generated(seed) => mix(3, seed),
        };
        let start = mix(mix(ticket.seed, course), ticket.start_level.into());
        let length = 1 + mix(start, 1) % LONGEST;
        let first = u64::from(ticket.first_step());
        let flown = ticket
            .segment
            .as_ref()
            .map_or(&[][..], |segment| &segment.prior_actions);
        Self {
            state: flown
                .iter()
                .fold(start, |state, action| after(state, action[0])),
            policy,
            step: first,
            length,
            end: ticket.segment.as_ref().map_or(length, |segment| {
                length.min(first + u64::from(segment.steps))
            }),
            outcome: match mix(start, 2) % 3 {
                0 => Outcome::TimedOut,
                _ => Outcome::Collided,
            },
        }
    }

    /// Writes the next record of `ticket`, flown by this incarnation of `actor`. Each flight signs
    /// its records, where learning does not look.
    pub(crate) fn record(
        moment: &Moment,
        step: u32,
        ticket: &Ticket,
        (actor, incarnation): (ActorId, ActorIncarnation),
    ) -> Box<TransitionRecord> {
        let mut record: Box<TransitionRecord> = bytemuck::zeroed_box();
        record.begin(ticket, actor, incarnation, step);
        record.position_m[0] = moment.position;
        record.ground_truth[..3].copy_from_slice(&signature(ticket, (actor, incarnation)));
        match moment.what {
            What::Step {
                action,
                reward,
                ends,
            } => {
                record.action[0] = action;
                record.reward = reward;
                record.reward_terms[0] = reward;
                record.terminated = u8::from(ends == Some(Outcome::Collided));
                record.truncated = u8::from(ends == Some(Outcome::TimedOut));
            }
            What::Closing(outcome) => {
                record.kind = RecordKind::Closing.code();
                record.outcome = outcome.code();
                record.course_walls = COURSE_WALLS;
            }
            What::SegmentEnd => record.kind = RecordKind::SegmentEnd.code(),
        }
        record
    }
}

/// State after an action in `state`.
fn after(state: u64, action: f32) -> u64 {
    mix(state, action.to_bits().into())
}

impl Iterator for Flight {
    type Item = (u32, Moment);

    fn next(&mut self) -> Option<(u32, Moment)> {
        if self.step > self.end {
            return None;
        }
        let (step, position) = (self.step, (self.state >> 44) as f32);
        self.step += 1;
        if step == self.end {
            let what = match step == self.length {
                true => What::Closing(self.outcome),
                false => What::SegmentEnd,
            };
            return Some((step as u32, Moment { position, what }));
        }
        let chosen = mix(self.state, self.policy);
        // Sixteen bits, which a single holds exactly.
        let action = (chosen & 0xffff) as f32 / 65_536.0;
        let what = What::Step {
            action,
            reward: (chosen >> 48) as f32,
            ends: (step + 1 == self.length).then_some(self.outcome),
        };
        self.state = after(self.state, action);
        Some((step as u32, Moment { position, what }))
    }
}

/// Signature of the flight of `ticket` by this incarnation of `actor`.
fn signature(ticket: &Ticket, (actor, incarnation): (ActorId, ActorIncarnation)) -> [f32; 3] {
    // Twenty bits, which a single holds exactly.
    let incarnation = mix(incarnation.0, 0) >> 44;
    [actor.0 as f32, incarnation as f32, ticket.attempt.0 as f32]
}

/// `true` if `episode` is a single flight, on this attempt and by the actor that it names.
pub(crate) fn is_single_flight(episode: &CommittedEpisode, attempt: Attempt) -> bool {
    let signatures = || {
        let seen = episode.observations.iter();
        seen.map(|seen| [0, 1, 2].map(|place| seen.ground_truth[place]))
    };
    signatures().next().is_some_and(|[actor, _, flown]| {
        actor == episode.actor.0 as f32 && flown == attempt.0 as f32
    }) && signatures().is_sorted_by(|one, next| one == next)
}

/// Digest of all that learning may depend on, as the learner committed it.
pub(crate) fn digest(episode: &CommittedEpisode) -> u64 {
    let head = [
        episode.episode.0,
        episode.epoch.0,
        episode.policy_version.0,
        episode.level.into(),
        episode.first_step as u64,
        episode.action_before[0].to_bits().into(),
    ];
    let steps = (0..).zip(&episode.observations).map(|(index, seen)| {
        let done: Option<(f32, f32)> =
            (|| Some((episode.actions.get(index)?[0], *episode.rewards.get(index)?)))();
        (seen.position_m[0], done)
    });
    digest_of(head, steps, episode.outcome)
}

/// Digest of the episode that `ticket` asks for.
pub(crate) fn digest_of_ticket(ticket: &Ticket, epoch: Epoch, policy: u64) -> Flown {
    let flown = ticket
        .segment
        .as_ref()
        .map_or(&[][..], |segment| &segment.prior_actions);
    let head = [
        ticket.episode.0,
        epoch.0,
        ticket.policy_version.0,
        ticket.start_level.into(),
        ticket.first_step().into(),
        flown.last().map_or(0, |action| action[0].to_bits().into()),
    ];
    let moments: Vec<Moment> = Flight::begin(ticket, policy)
        .map(|(_, moment)| moment)
        .collect();
    let done = |moment: &Moment| match moment.what {
        What::Step { action, reward, .. } => Some((action, reward)),
        What::Closing(_) | What::SegmentEnd => None,
    };
    let outcome = moments.iter().find_map(|moment| match moment.what {
        What::Closing(outcome) => Some(outcome),
        What::Step { .. } | What::SegmentEnd => None,
    });
    let steps = moments.iter().map(|moment| (moment.position, done(moment)));
    Flown {
        digest: digest_of(head, steps, outcome),
        actions: moments
            .iter()
            .filter_map(done)
            .map(|(action, _)| action)
            .collect(),
        outcome,
    }
}

/// A ticket flown in peace.
#[derive(Debug)]
pub(crate) struct Flown {
    pub(crate) digest: u64,
    pub(crate) actions: Vec<f32>,
    pub(crate) outcome: Option<Outcome>,
}

fn digest_of(
    head: [u64; 6],
    steps: impl Iterator<Item = (f32, Option<(f32, f32)>)>,
    outcome: Option<Outcome>,
) -> u64 {
    let head = head.into_iter().fold(0, mix);
    let flown = steps.fold(head, |hash, (position, done)| {
        let hash = mix(hash, position.to_bits().into());
        match done {
            Some((action, reward)) => {
                mix(mix(hash, action.to_bits().into()), reward.to_bits().into())
            }
            None => mix(hash, 1),
        }
    });
    mix(flown, outcome.map_or(0, |outcome| outcome.code().into()))
}
