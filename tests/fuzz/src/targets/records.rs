//! Transition and status records in any sequence, through the learner's desk: whatever comes, a flight is committed whole, once and finite, or not at all.

use std::collections::BTreeSet;
use std::mem::offset_of;
use std::time::{Duration, Instant};

use bytemuck::{Zeroable, bytes_of_mut};
use skein_learner::flight::CommittedFlight;
use skein_learner::flights::assembly::Keep;
use skein_learner::flights::desk::{Desk, Order, Place};
use skein_protocol::config::TransportSection;
use skein_protocol::ids::{ActorId, Attempt, Epoch, FlightId, Incarnation, PolicyVersion, RunId};
use skein_protocol::stages::Times;
use skein_protocol::status::{ActorState, ActorStatus, StatusRecord};
use skein_protocol::ticket::{Control, CourseChoice, Exploration, Ticket};
use skein_protocol::transition::{Outcome, RecordKind, TransitionRecord};

use super::signals::pod;
use super::{Target, USUAL, Verdict};
use crate::script::Script;

pub(super) const RECORDS: Target = Target {
    name: "records",
    reads: "transition and status records, spelt by a script of what actors do",
    longest_bytes: 512,
    weight: 2 * USUAL,
    samples,
    run: |bytes| Learner::new().follow(&mut Script::new(bytes)),
};

const RUN: RunId = RunId(1);
/// Flights ordered in the beginning.
const FLIGHTS: u64 = 6;
/// Records of the longest flight.
const LONGEST_FLIGHT: usize = 8;
/// Length of the latent codes.
const LATENT: usize = 16;
/// Bytes of a record before its image.
const HEADER: usize = offset_of!(TransitionRecord, depth);

pub(super) fn sample_ticket(flight: u64) -> Ticket {
    Ticket {
        run: RUN,
        flight: FlightId(flight),
        attempt: Attempt(0),
        policy_version: PolicyVersion(3),
        course: CourseChoice::Training,
        start_level: 1,
        exploration: Exploration::Sample,
        seed: flight,
        leg: None,
    }
}

/// Scripts in which flights are flown as they should be, and some in which they are not.
fn samples() -> Vec<Vec<u8>> {
    /// Actor 0, in life 1, serves.
    const ATTACH: [u8; 4] = [1, 0, 1, 0];
    const ISSUE: [u8; 1] = [2];
    const STEP: [u8; 3] = [3, 0, 0];
    // The last step, and the closing record after it.
    const CLOSE: [u8; 6] = [3, 0, 2, 3, 0, 1];
    let changed = |place: usize, value: u8| {
        let [low, high] = (place as u16).to_le_bytes();
        [4, 0, 0, 1, low, high, value]
    };
    vec![
        [&ATTACH[..], &ISSUE, &STEP, &STEP, &CLOSE, &ISSUE, &STEP, &CLOSE].concat(),
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
        // A number behind the latent code.
        [
            &ATTACH[..],
            &ISSUE,
            &changed(offset_of!(TransitionRecord, latent) + 4 * LATENT + 3, 0x3f),
            &CLOSE,
        ]
        .concat(),
    ]
}

/// The learner's desk, and what its actors hold.
struct Learner {
    desk: Desk,
    now: Instant,
    held: Vec<Held>,
    committed: BTreeSet<Place>,
}

/// A ticket, as the life of an actor that holds it knows it.
struct Held {
    ticket: Ticket,
    actor: ActorId,
    life: Incarnation,
    step: u32,
}

impl Learner {
    fn new() -> Self {
        let limits = TransportSection {
            max_records_per_flight: LONGEST_FLIGHT,
            ..TransportSection::default()
        };
        let mut desk = Desk::new(RUN, &limits, LATENT);
        for flight in 0..FLIGHTS {
            desk.order(Order {
                ticket: sample_ticket(flight),
                epoch: Epoch(0),
                keep: keep(flight),
                place: Place {
                    batch: 0,
                    index: flight as usize,
                },
            });
        }
        Self {
            desk,
            now: Instant::now(),
            held: Vec::new(),
            committed: BTreeSet::new(),
        }
    }

    fn follow(mut self, script: &mut Script<'_>) -> Verdict {
        while !script.is_over() {
            match script.u8() % 7 {
                0 => {
                    let record: StatusRecord = pod(script.bytes(size_of::<StatusRecord>()));
                    record.read(RUN).inspect(|status| self.desk.on_status(status, self.now));
                }
                1 => self.attach(script),
                2 => self.issue(),
                3 => self.send(script, |_, _| {}),
                4 => self.send(script, change),
                5 => {
                    self.now += Duration::from_secs(script.u8().into());
                    self.desk.on_time(self.now);
                }
                _ => {
                    let mut record = TransitionRecord::zeroed();
                    let bytes = script.bytes(HEADER);
                    bytes_of_mut(&mut record)[..bytes.len()].copy_from_slice(bytes);
                    self.receive(&record);
                }
            }
            let open = self.desk.open_orders() + self.committed.len();
            // A flight that was given up for good ends the run; it alone may be missing.
            assert!(open <= FLIGHTS as usize, "{open} of {FLIGHTS} flights");
        }
        Verdict::of(self.committed.first())
    }

    /// An actor of three, in one of four lives, comes or goes.
    fn attach(&mut self, script: &mut Script<'_>) {
        let status = ActorStatus {
            actor: ActorId(u32::from(script.u8() % 3)),
            incarnation: Incarnation(u64::from(script.u8() % 4)),
            pid: 1,
            state: script.one_of(&[ActorState::Serving, ActorState::Serving, ActorState::Leaving]),
            newest_policy: None,
            flights_flown: 0,
            times: Times::default(),
        };
        self.desk.on_status(&status, self.now);
    }

    fn issue(&mut self) {
        for message in self.desk.issue(self.now) {
            let ticket = match message.read(RUN) {
                Ok(Control::Fly(ticket)) => ticket,
                Ok(Control::Rejoin) => continue,
                other => panic!("the desk sends tickets and letters, not {other:?}"),
            };
            let lives = (0..3).flat_map(|actor| (0..4).map(move |life| (ActorId(actor), Incarnation(life))));
            // Other actors came by records of random bytes and hold theirs for ever.
            for (actor, life) in lives.filter(|&(actor, life)| message.is_for(actor, life)) {
                self.held.push(Held {
                    ticket: ticket.clone(),
                    actor,
                    life,
                    step: 0,
                });
            }
        }
    }

    /// The next record of a ticket, as it should be but for what `change` makes of it.
    fn send(&mut self, script: &mut Script<'_>, change: fn(&mut TransitionRecord, &mut Script<'_>)) {
        let (which, end) = (usize::from(script.u8()), script.u8() % 4);
        let count = self.held.len();
        let Some(held) = self.held.get_mut(which % count.max(1)) else {
            return;
        };
        let mut record = TransitionRecord::zeroed();
        record.begin(&held.ticket, held.actor, held.life, held.step);
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
        // A hopeless flight ends a run; here the others are flown on.
        if let Ok(Some((place, flight))) = self.desk.on_record(record, self.now) {
            assert!(self.committed.insert(place), "{place:?} was committed twice");
            assert_sound(&flight);
        }
    }
}

fn keep(flight: u64) -> Keep {
    if flight.is_multiple_of(2) {
        Keep::Depth
    } else {
        Keep::Latents
    }
}

/// Up to three bytes of the record's header are something else.
fn change(record: &mut TransitionRecord, script: &mut Script<'_>) {
    for _ in 0..script.u8() % 4 {
        let place = usize::from(script.u16()) % HEADER;
        bytes_of_mut(record)[place] = script.u8();
    }
}

fn assert_sound(flight: &CommittedFlight) {
    flight.check().unwrap();
    let ticket = sample_ticket(flight.flight.0);
    assert_eq!(
        (flight.policy_version, flight.level),
        (ticket.policy_version, ticket.start_level)
    );
    assert_eq!(flight.depth.is_some(), keep(flight.flight.0) == Keep::Depth);
    assert!(flight.observations.len() <= LONGEST_FLIGHT);
    assert!(flight.walls_passed <= flight.course_walls);
    let codes = flight.observations.iter();
    assert!(codes.flat_map(|seen| &seen.latent[LATENT..]).all(|&value| value == 0.0));
    let actions = flight.actions.iter().flatten();
    assert!(actions.clone().all(|action| action.abs() <= 1.0));
    let seen = flight.observations.iter().flat_map(|seen| {
        seen.latent
            .into_iter()
            .chain(seen.velocity_mps)
            .chain(seen.position_m)
            .chain(seen.orientation)
    });
    let numbers = seen
        .chain(flight.rewards.iter().copied())
        .chain(flight.reward_terms.iter().flatten().copied());
    // Squares of what is learned from must be finite too.
    numbers.for_each(|number| assert!((number * number).is_finite(), "{number}"));
    assert!(flight.total_reward().is_finite());
}
