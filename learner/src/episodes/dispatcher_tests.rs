//! Each loss has its remedy. The storms of `tests/storm/` test the whole: every ordered episode is
//! committed exactly once and whole, whatever happens to records and actors.

use bytemuck::Zeroable;
use skein_protocol::ActionSpace;
use skein_protocol::ids::{Epoch, PolicyVersion};
use skein_protocol::stages::Stage;
use skein_protocol::ticket::{Control, CourseChoice, Exploration};
use skein_protocol::transition::{Outcome, RecordKind};

use super::super::assembly::KeptData;
use super::*;

pub(super) const RUN: RunId = RunId(1);
pub(super) const INCARNATION: ActorIncarnation = ActorIncarnation(100);
pub(super) const LENGTHS: RecordLengths = RecordLengths {
    latent: 32,
    action: ActionSpace::Lateral,
};

pub(super) fn limits() -> TransportSection {
    TransportSection {
        tickets_per_actor: 2,
        actor_silence_secs: 5.0,
        episode_deadline_secs: 60.0,
        ..Default::default()
    }
}

pub(super) fn order(episode: u64) -> EpisodeOrder {
    let ticket = Ticket {
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
    };
    EpisodeOrder {
        ticket,
        epoch: Epoch(0),
        keep: KeptData::Latents,
        place: BatchPlace {
            batch: 0,
            index: episode as usize,
        },
    }
}

pub(super) fn attach(
    dispatcher: &mut Dispatcher,
    actor: u32,
    incarnation: ActorIncarnation,
    now: Instant,
) {
    dispatcher.on_status(&status(actor, incarnation), now);
}

fn status(actor: u32, incarnation: ActorIncarnation) -> ActorStatus {
    ActorStatus {
        actor: ActorId(actor),
        incarnation,
        pid: 1,
        state: ActorState::Serving,
        newest_policy: None,
        episodes_flown: 0,
        times: StageTimes::default(),
    }
}

/// Sends a heartbeat of an actor that has flown for `secs` seconds in this incarnation.
fn flown(
    dispatcher: &mut Dispatcher,
    actor: u32,
    incarnation: ActorIncarnation,
    state: ActorState,
    secs: u64,
    now: Instant,
) {
    let mut status = ActorStatus {
        state,
        ..status(actor, incarnation)
    };
    status
        .times
        .add(Stage::Physics, secs, Duration::from_secs(secs));
    dispatcher.on_status(&status, now);
}

/// Tickets issued to `actor`.
pub(super) fn tickets_for(
    messages: &[ControlMessage],
    actor: u32,
    incarnation: ActorIncarnation,
) -> Vec<Ticket> {
    let own = messages
        .iter()
        .filter(|message| message.is_for(ActorId(actor), incarnation));
    own.filter_map(|message| match message.read(RUN) {
        Ok(Control::Fly(ticket)) => Some(ticket),
        _ => None,
    })
    .collect()
}

/// The records of an episode of `2 + episode % 3` steps.
pub(super) fn records(
    ticket: &Ticket,
    actor: u32,
    incarnation: ActorIncarnation,
) -> Vec<TransitionRecord> {
    let steps = 2 + (ticket.episode.0 % 3) as u32;
    (0..=steps)
        .map(|step| {
            let mut record = TransitionRecord::zeroed();
            record.begin(ticket, ActorId(actor), incarnation, step);
            record.reward = ticket.episode.0 as f32 + step as f32;
            record.reward_terms[0] = record.reward;
            record.terminated = u8::from(step == steps - 1);
            if step == steps {
                record.kind = RecordKind::Closing.code();
                record.outcome = Outcome::Collided.code();
            }
            record
        })
        .collect()
}

pub(super) fn feed(
    dispatcher: &mut Dispatcher,
    records: &[TransitionRecord],
    now: Instant,
) -> Vec<(BatchPlace, CommittedEpisode)> {
    records
        .iter()
        .filter_map(|record| dispatcher.on_record(record, now).unwrap())
        .collect()
}

/// Returns a dispatcher with one actor that holds tickets 0 and 1 of three orders.
pub(super) fn dispatcher(now: Instant) -> (Dispatcher, Vec<Ticket>) {
    let mut dispatcher = Dispatcher::new(RUN, &limits(), LENGTHS);
    (0..3).for_each(|episode| dispatcher.order(order(episode)));
    attach(&mut dispatcher, 0, INCARNATION, now);
    let tickets = tickets_for(&dispatcher.issue(now), 0, INCARNATION);
    assert_eq!(
        tickets
            .iter()
            .map(|ticket| ticket.episode.0)
            .collect::<Vec<_>>(),
        [0, 1]
    );
    (dispatcher, tickets)
}

#[test]
fn credit_bounds_outstanding_tickets_and_returns_with_each_episode() {
    let now = Instant::now();
    let (mut dispatcher, tickets) = dispatcher(now);
    assert!(dispatcher.issue(now).is_empty());
    assert_eq!(
        feed(&mut dispatcher, &records(&tickets[0], 0, INCARNATION), now).len(),
        1
    );
    assert_eq!(
        tickets_for(&dispatcher.issue(now), 0, INCARNATION)[0].episode,
        EpisodeId(2)
    );
}

#[test]
fn every_actor_gets_its_first_ticket_before_any_its_second() {
    let now = Instant::now();
    let mut dispatcher = Dispatcher::new(RUN, &limits(), LENGTHS);
    (0..3).for_each(|episode| dispatcher.order(order(episode)));
    attach(&mut dispatcher, 0, INCARNATION, now);
    attach(&mut dispatcher, 1, INCARNATION, now);
    let messages = dispatcher.issue(now);
    assert_eq!(tickets_for(&messages, 0, INCARNATION).len(), 2);
    assert_eq!(
        tickets_for(&messages, 1, INCARNATION)[0].episode,
        EpisodeId(1)
    );
}

#[test]
fn an_episode_with_a_hole_is_discarded_whole_and_flown_again() {
    let now = Instant::now();
    let (mut dispatcher, tickets) = dispatcher(now);
    let mut sent = records(&tickets[0], 0, INCARNATION);
    sent.remove(1);
    assert!(feed(&mut dispatcher, &sent, now).is_empty());
    assert_eq!(dispatcher.faults().reissued(), 1);
    let again = tickets_for(&dispatcher.issue(now), 0, INCARNATION).remove(0);
    assert_eq!((again.episode, again.attempt), (EpisodeId(0), Attempt(1)));
    // The actor continues with what it holds: episode 1, then episode 0 again.
    assert_eq!(
        feed(&mut dispatcher, &records(&tickets[1], 0, INCARNATION), now)[0]
            .1
            .episode,
        EpisodeId(1)
    );
    let flown = feed(&mut dispatcher, &records(&again, 0, INCARNATION), now);
    assert_eq!(flown[0].1.rewards, [0.0, 1.0]);
}

#[test]
fn tickets_of_a_silent_actor_go_to_another_and_its_late_episode_is_not_taken() {
    let start = Instant::now();
    let (mut dispatcher, tickets) = dispatcher(start);
    let late = start + Duration::from_secs(6);
    attach(&mut dispatcher, 1, INCARNATION, late);
    dispatcher.on_time(late);
    assert_eq!(dispatcher.actors().count(), 1);
    let again = tickets_for(&dispatcher.issue(late), 1, INCARNATION);
    assert_eq!(
        again
            .iter()
            .map(|ticket| ticket.episode.0)
            .collect::<Vec<_>>(),
        [0, 1]
    );
    assert!(feed(&mut dispatcher, &records(&tickets[0], 0, INCARNATION), late).is_empty());
    attach(&mut dispatcher, 0, INCARNATION, late);
    assert!(
        feed(&mut dispatcher, &records(&tickets[0], 0, INCARNATION), late).is_empty(),
        "attempt 0 is void"
    );
    assert_eq!(
        feed(&mut dispatcher, &records(&again[0], 1, INCARNATION), late).len(),
        1
    );
}

#[test]
fn a_restarted_actor_owes_nothing_of_its_former_incarnation() {
    let now = Instant::now();
    let (mut dispatcher, tickets) = dispatcher(now);
    let next = ActorIncarnation(101);
    attach(&mut dispatcher, 0, next, now);
    attach(&mut dispatcher, 0, INCARNATION, now); // a late heartbeat of the former incarnation
    let again = tickets_for(&dispatcher.issue(now), 0, next);
    assert_eq!(
        again
            .iter()
            .map(|ticket| (ticket.episode.0, ticket.attempt.0))
            .collect::<Vec<_>>(),
        [(0, 1), (1, 1)]
    );
    assert!(feed(&mut dispatcher, &records(&tickets[0], 0, INCARNATION), now).is_empty());
    assert_eq!(
        feed(&mut dispatcher, &records(&again[0], 0, next), now).len(),
        1
    );
}

#[test]
fn a_lost_ticket_is_issued_again_when_the_next_one_is_flown() {
    let now = Instant::now();
    let (mut dispatcher, tickets) = dispatcher(now);
    assert_eq!(
        feed(&mut dispatcher, &records(&tickets[1], 0, INCARNATION), now)[0]
            .1
            .episode,
        EpisodeId(1)
    );
    assert_eq!(
        tickets_for(&dispatcher.issue(now), 0, INCARNATION)[0].attempt,
        Attempt(1)
    );
}

#[test]
fn a_ticket_that_takes_too_long_is_issued_again_though_its_actor_lives() {
    let start = Instant::now();
    let (mut dispatcher, tickets) = dispatcher(start);
    let mut now = start;
    for _ in 0..16 {
        now += Duration::from_secs(4);
        attach(&mut dispatcher, 0, INCARNATION, now);
        dispatcher.on_time(now);
    }
    let messages = dispatcher.issue(now);
    assert!(
        messages
            .iter()
            .any(|message| message.is_for(ActorId(0), INCARNATION)
                && message.read(RUN) == Ok(Control::Rejoin)),
        "no record arrived: its connection is broken"
    );
    assert_eq!(dispatcher.faults().reissued(), 1);
    assert!(feed(&mut dispatcher, &records(&tickets[0], 0, INCARNATION), now).is_empty());
}

/// Lets an actor fail its first episode again and again, with `damage` to its first record, until
/// the dispatcher gives up; at most `most` times.
fn fail_for_ever(
    dispatcher: &mut Dispatcher,
    actor: u32,
    most: usize,
    damage: fn(&mut TransitionRecord),
) -> Result<(), HopelessEpisode> {
    let now = Instant::now();
    for _ in 0..most {
        dispatcher.issue(now);
        let issued = dispatcher.actors[&ActorId(actor)].tickets.front();
        let Some(ticket) = issued.map(|issued| issued.ticket().clone()) else {
            return Ok(());
        };
        let mut record = records(&ticket, actor, INCARNATION)[0];
        damage(&mut record);
        assert!(dispatcher.on_record(&record, now)?.is_none());
    }
    Ok(())
}

const NOT_A_NUMBER: fn(&mut TransitionRecord) = |record| record.reward = f32::NAN;

#[test]
fn an_episode_that_the_only_actor_always_fails_is_given_up_with_the_reason() {
    let now = Instant::now();
    let hopeless = |damage| {
        fail_for_ever(&mut dispatcher(now).0, 0, 9, damage)
            .unwrap_err()
            .to_string()
    };
    let broken_down = hopeless(|record| record.kind = RecordKind::Failed.code());
    assert!(
        broken_down.contains("failed 3 times, at last because the simulator broke down"),
        "{broken_down}"
    );
    assert!(hopeless(NOT_A_NUMBER).contains("reward is not finite"));
}

#[test]
fn an_actor_that_sends_garbage_for_ever_fails_no_run_while_another_flies() {
    let now = Instant::now();
    let mut dispatcher = Dispatcher::new(RUN, &limits(), LENGTHS);
    (0..6).for_each(|episode| dispatcher.order(order(episode)));
    attach(&mut dispatcher, 0, INCARNATION, now);
    dispatcher.issue(now);
    attach(&mut dispatcher, 1, INCARNATION, now);
    fail_for_ever(&mut dispatcher, 0, 1000, NOT_A_NUMBER).unwrap();
    assert!(
        dispatcher.actors[&ActorId(0)].tickets.is_empty(),
        "others are preferred to it"
    );
    let mut committed = 0;
    while dispatcher.open_orders() > 0 {
        dispatcher.issue(now);
        let ticket = dispatcher.actors[&ActorId(1)].tickets[0].ticket().clone();
        committed += feed(&mut dispatcher, &records(&ticket, 1, INCARNATION), now).len();
    }
    assert_eq!(committed, 6);
    assert!(dispatcher.faults().refused_by_reason()["not finite"] >= u64::from(MOST_SPOILED));
}

#[test]
fn an_episode_that_two_actors_fail_is_given_up() {
    let now = Instant::now();
    let mut dispatcher = Dispatcher::new(RUN, &limits(), LENGTHS);
    dispatcher.order(order(0));
    attach(&mut dispatcher, 0, INCARNATION, now);
    dispatcher.issue(now);
    attach(&mut dispatcher, 1, INCARNATION, now);
    fail_for_ever(&mut dispatcher, 0, 1000, NOT_A_NUMBER).unwrap();
    let hopeless = fail_for_ever(&mut dispatcher, 1, 1, NOT_A_NUMBER).unwrap_err();
    assert_eq!(hopeless.episode, EpisodeId(0));
}

#[test]
fn an_actor_that_may_come_back_is_waited_for_before_an_episode_is_given_up() {
    let start = Instant::now();
    let (mut dispatcher, _) = dispatcher(start);
    attach(&mut dispatcher, 1, INCARNATION, start);
    let gone = start + Duration::from_secs(6);
    attach(&mut dispatcher, 0, INCARNATION, gone);
    dispatcher.on_time(gone);
    assert_eq!(dispatcher.actors().collect::<Vec<_>>(), [ActorId(0)]);
    fail_for_ever(&mut dispatcher, 0, 1000, NOT_A_NUMBER).unwrap();
    let later = start + Duration::from_secs(31);
    attach(&mut dispatcher, 0, INCARNATION, later);
    dispatcher.on_time(later);
    fail_for_ever(&mut dispatcher, 0, 1, NOT_A_NUMBER).unwrap_err();
}

#[test]
fn actors_beyond_the_limit_get_no_tickets_until_there_is_room() {
    let start = Instant::now();
    let mut dispatcher = Dispatcher::new(
        RUN,
        &TransportSection {
            max_actors: 2,
            ..limits()
        },
        LENGTHS,
    );
    (0..3).for_each(|actor| attach(&mut dispatcher, actor, INCARNATION, start));
    assert_eq!(dispatcher.actors().count(), 2);
    let later = start + Duration::from_secs(6);
    attach(&mut dispatcher, 1, INCARNATION, later);
    dispatcher.on_time(later);
    attach(&mut dispatcher, 2, INCARNATION, later);
    assert_eq!(
        dispatcher.actors().collect::<Vec<_>>(),
        [ActorId(1), ActorId(2)]
    );
}

#[test]
fn the_times_of_all_incarnations_of_all_actors_are_summed_without_counting_twice() {
    let now = Instant::now();
    let mut dispatcher = Dispatcher::new(RUN, &limits(), LENGTHS);
    let flies = |dispatcher: &mut Dispatcher, actor, incarnation, secs| {
        flown(
            dispatcher,
            actor,
            incarnation,
            ActorState::Serving,
            secs,
            now,
        )
    };
    let physics = |dispatcher: &Dispatcher| dispatcher.actor_times().of(Stage::Physics);
    let next_incarnation = ActorIncarnation(INCARNATION.0 + 1);
    attach(&mut dispatcher, 0, INCARNATION, now);
    attach(&mut dispatcher, 1, INCARNATION, now);
    flies(&mut dispatcher, 0, INCARNATION, 3);
    flies(&mut dispatcher, 0, INCARNATION, 5);
    flies(&mut dispatcher, 1, INCARNATION, 20);
    assert_eq!(physics(&dispatcher).count, 25);
    // The next incarnation counts from zero; a late heartbeat of an older one is ignored.
    attach(&mut dispatcher, 0, next_incarnation, now);
    flies(&mut dispatcher, 0, next_incarnation, 100);
    flies(&mut dispatcher, 0, INCARNATION, 7000);
    assert_eq!(physics(&dispatcher).count, 125);
    // The last heartbeat before leaving is included.
    flown(
        &mut dispatcher,
        0,
        next_incarnation,
        ActorState::Leaving,
        101,
        now,
    );
    assert_eq!(physics(&dispatcher).count, 126);
    // Taken for dead, and heard again in the same incarnation.
    let later = now + 2 * Duration::from_secs_f64(limits().actor_silence_secs);
    dispatcher.on_time(later);
    assert_eq!(
        (dispatcher.actors().count(), physics(&dispatcher).count),
        (0, 126)
    );
    flown(
        &mut dispatcher,
        1,
        INCARNATION,
        ActorState::Serving,
        30,
        later,
    );
    flown(
        &mut dispatcher,
        1,
        INCARNATION,
        ActorState::Serving,
        31,
        later,
    );
    assert_eq!(physics(&dispatcher).count, 127);
    assert_eq!(physics(&dispatcher).nanos, 127_000_000_000);
}
