//! Transition and status records in any sequence, through the learner's dispatcher. Whatever
//! arrives, an episode is committed once, complete and finite, or not at all.

use std::collections::BTreeSet;
use std::mem::offset_of;
use std::time::{Duration, Instant};

use bytemuck::{Zeroable, bytes_of_mut};
use skein_learner::episode::CommittedEpisode;
use skein_learner::episodes::assembly::KeptData;
use skein_learner::episodes::dispatcher::{BatchPlace, Dispatcher, EpisodeOrder};
use skein_protocol::ActionSpace;
use skein_protocol::config::TransportSection;
use skein_protocol::ids::{
    ActorId, ActorIncarnation, Attempt, EpisodeId, Epoch, PolicyVersion, RunId,
};
use skein_protocol::stages::StageTimes;
use skein_protocol::status::{ActorState, ActorStatus, StatusRecord};
use skein_protocol::ticket::{Control, CourseChoice, Exploration, Ticket};
use skein_protocol::transition::{Outcome, RecordKind, RecordLengths, TransitionRecord};

use super::signals::pod;
use super::{ReaderDecision, Target, USUAL};
use crate::script::Script;

pub(super) const RECORDS: Target = Target {
    name: "records",
    reads: "transition and status records, built from a script of actions by actors",
    longest_bytes: 512,
    weight: 2 * USUAL,
    samples,
    run: |bytes| FuzzedLearner::new().follow(&mut Script::new(bytes)),
};

const RUN: RunId = RunId(1);
/// Number of episodes ordered initially.
const EPISODES: u64 = 6;
/// Number of records of the longest episode.
const LONGEST_EPISODE: usize = 8;
/// Length of the latent codes.
const LATENT: usize = 16;
const LENGTHS: RecordLengths = RecordLengths {
    latent: LATENT,
    action: ActionSpace::Lateral,
};
/// Number of bytes of a record before its image.
const HEADER: usize = offset_of!(TransitionRecord, depth);

pub(super) fn sample_ticket(episode: u64) -> Ticket {
    Ticket {
        run: RUN,
        episode: EpisodeId(episode),
        attempt: Attempt(0),
        policy_version: PolicyVersion(3),
        course: CourseChoice::Training,
        start_level: 1,
        exploration: Exploration::Sample,
        seed: episode,
        teacher_share: None,
        segment: None,
    }
}

/// Returns scripts in which episodes are flown correctly, and some in which they are not.
fn samples() -> Vec<Vec<u8>> {
    /// Actor 0, in incarnation 1, serves.
    const ATTACH: [u8; 4] = [1, 0, 1, 0];
    const ISSUE: [u8; 1] = [2];
    const STEP: [u8; 3] = [3, 0, 0];
    // The last step, then the closing record.
    const CLOSE: [u8; 6] = [3, 0, 2, 3, 0, 1];
    let changed = |place: usize, value: u8| {
        let [low, high] = (place as u16).to_le_bytes();
        [4, 0, 0, 1, low, high, value]
    };
    vec![
        [
            &ATTACH[..],
            &ISSUE,
            &STEP,
            &STEP,
            &CLOSE,
            &ISSUE,
            &STEP,
            &CLOSE,
        ]
        .concat(),
        [
            &ATTACH[..],
            &ISSUE,
            &STEP,
            &changed(0, 9),
            &STEP,
            &[5, 200],
            &ISSUE,
            &CLOSE,
        ]
        .concat(),
        [
            &ATTACH[..],
            &[1, 1, 1, 0],
            &ISSUE,
            &STEP,
            &[1, 0, 2, 0],
            &ISSUE,
            &STEP,
            &CLOSE,
        ]
        .concat(),
        [&ATTACH[..], &ISSUE, &STEP.repeat(12), &CLOSE].concat(),
        [
            &ATTACH[..],
            &ISSUE,
            &changed(offset_of!(TransitionRecord, level_up), 0x7f),
            &changed(44, 3),
            &changed(44, 3),
        ]
        .concat(),
        // A number after the latent code.
        [
            &ATTACH[..],
            &ISSUE,
            &changed(offset_of!(TransitionRecord, latent) + 4 * LATENT + 3, 0x3f),
            &CLOSE,
        ]
        .concat(),
    ]
}

/// The learner's dispatcher, and the tickets of its actors.
struct FuzzedLearner {
    dispatcher: Dispatcher,
    now: Instant,
    held: Vec<HeldTicket>,
    committed: BTreeSet<BatchPlace>,
}

/// A ticket as known to the actor incarnation that holds it.
struct HeldTicket {
    ticket: Ticket,
    actor: ActorId,
    incarnation: ActorIncarnation,
    step: u32,
}

impl FuzzedLearner {
    fn new() -> Self {
        let limits = TransportSection {
            max_records_per_episode: LONGEST_EPISODE,
            ..TransportSection::default()
        };
        let mut dispatcher = Dispatcher::new(RUN, &limits, LENGTHS);
        for episode in 0..EPISODES {
            dispatcher.order(EpisodeOrder {
                ticket: sample_ticket(episode),
                epoch: Epoch(0),
                keep: keep(episode),
                place: BatchPlace {
                    batch: 0,
                    index: episode as usize,
                },
            });
        }
        Self {
            dispatcher,
            now: Instant::now(),
            held: Vec::new(),
            committed: BTreeSet::new(),
        }
    }

    fn follow(mut self, script: &mut Script<'_>) -> ReaderDecision {
        while !script.is_over() {
            match script.u8() % 7 {
                0 => {
                    let record: StatusRecord = pod(script.bytes(size_of::<StatusRecord>()));
                    record
                        .read(RUN)
                        .inspect(|status| self.dispatcher.on_status(status, self.now));
                }
                1 => self.attach(script),
                2 => self.issue(),
                3 => self.send(script, |_, _| {}),
                4 => self.send(script, change),
                5 => {
                    self.now += Duration::from_secs(script.u8().into());
                    self.dispatcher.on_time(self.now);
                }
                _ => {
                    let mut record = TransitionRecord::zeroed();
                    let bytes = script.bytes(HEADER);
                    bytes_of_mut(&mut record)[..bytes.len()].copy_from_slice(bytes);
                    self.receive(&record);
                }
            }
            let open = self.dispatcher.open_orders() + self.committed.len();
            // An episode that was given up for good ends the run; only that one may be missing.
            assert!(open <= EPISODES as usize, "{open} of {EPISODES} episodes");
        }
        ReaderDecision::of(self.committed.first())
    }

    /// Lets one of three actors, in one of four incarnations, come or go.
    fn attach(&mut self, script: &mut Script<'_>) {
        let status = ActorStatus {
            actor: ActorId(u32::from(script.u8() % 3)),
            incarnation: ActorIncarnation(u64::from(script.u8() % 4)),
            pid: 1,
            state: script.one_of(&[
                ActorState::Serving,
                ActorState::Serving,
                ActorState::Leaving,
            ]),
            newest_policy: None,
            episodes_flown: 0,
            times: StageTimes::default(),
        };
        self.dispatcher.on_status(&status, self.now);
    }

    fn issue(&mut self) {
        for message in self.dispatcher.issue(self.now) {
            let ticket = match message.read(RUN) {
                Ok(Control::Fly(ticket)) => ticket,
                Ok(Control::Rejoin) => continue,
                other => panic!("the dispatcher sends tickets and letters, not {other:?}"),
            };
            let incarnations = (0..3).flat_map(|actor| {
                (0..4).map(move |incarnation| (ActorId(actor), ActorIncarnation(incarnation)))
            });
            // Other actors appeared through records of random bytes; they hold their tickets for
            // ever.
            for (actor, incarnation) in
                incarnations.filter(|&(actor, incarnation)| message.is_for(actor, incarnation))
            {
                self.held.push(HeldTicket {
                    ticket: ticket.clone(),
                    actor,
                    incarnation,
                    step: 0,
                });
            }
        }
    }

    /// Sends the next record of a ticket, correct except for `change`.
    fn send(
        &mut self,
        script: &mut Script<'_>,
        change: fn(&mut TransitionRecord, &mut Script<'_>),
    ) {
        let (which, end) = (usize::from(script.u8()), script.u8() % 4);
        let count = self.held.len();
        let Some(held) = self.held.get_mut(which % count.max(1)) else {
            return;
        };
        let mut record = TransitionRecord::zeroed();
        record.begin(&held.ticket, held.actor, held.incarnation, held.step);
        held.step += 1;
        record.truncated = u8::from(end == 2);
        if end == 1 {
            record.kind = RecordKind::Closing.code();
            record.outcome = Outcome::TimedOut.code();
            record.course_walls = 5;
        }
        change(&mut record, script);
        self.receive(&record);
    }

    fn receive(&mut self, record: &TransitionRecord) {
        // A hopeless episode ends a run; here the others continue.
        if let Ok(Some((place, episode))) = self.dispatcher.on_record(record, self.now) {
            assert!(
                self.committed.insert(place),
                "{place:?} was committed twice"
            );
            assert_sound(&episode);
        }
    }
}

fn keep(episode: u64) -> KeptData {
    if episode.is_multiple_of(2) {
        KeptData::Depth
    } else {
        KeptData::Latents
    }
}

/// Replaces up to three bytes of the record's header.
fn change(record: &mut TransitionRecord, script: &mut Script<'_>) {
    for _ in 0..script.u8() % 4 {
        let place = usize::from(script.u16()) % HEADER;
        bytes_of_mut(record)[place] = script.u8();
    }
}

fn assert_sound(episode: &CommittedEpisode) {
    episode.check().unwrap();
    let ticket = sample_ticket(episode.episode.0);
    assert_eq!(
        (episode.policy_version, episode.level),
        (ticket.policy_version, ticket.start_level)
    );
    assert_eq!(
        episode.depth.is_some(),
        keep(episode.episode.0) == KeptData::Depth
    );
    assert!(episode.observations.len() <= LONGEST_EPISODE);
    assert!(episode.walls_passed <= episode.course_walls);
    let codes = episode.observations.iter();
    assert!(
        codes
            .flat_map(|seen| &seen.latent[LATENT..])
            .all(|&value| value == 0.0)
    );
    let actions = episode.actions.iter().flatten();
    assert!(actions.clone().all(|action| action.abs() <= 1.0));
    let seen = episode.observations.iter().flat_map(|seen| {
        seen.latent
            .into_iter()
            .chain(seen.velocity_mps)
            .chain(seen.position_m)
            .chain(seen.orientation)
    });
    let numbers = seen
        .chain(episode.rewards.iter().copied())
        .chain(episode.reward_terms.iter().flatten().copied());
    // Squares of learned values must be finite too.
    numbers.for_each(|number| assert!((number * number).is_finite(), "{number}"));
    assert!(episode.total_reward().is_finite());
}
