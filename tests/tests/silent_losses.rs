//! Reproduces each way in which iceoryx2 silently loses data when a peer dies, and shows that none
//! of them loses or mixes up an episode.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::thread::sleep;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use skein_chaos::footprint;
use skein_learner::episode::CommittedEpisode;
use skein_learner::episodes::assembly::KeptData;
use skein_learner::episodes::dispatcher::{BatchPlace, Dispatcher, EpisodeOrder};
use skein_learner::episodes::receiver::EpisodeReceiver;
use skein_protocol::config::Config;
use skein_protocol::ids::{ActorId, ActorIncarnation, Attempt, EpisodeId, Epoch, PolicyVersion};
use skein_protocol::stages::StageTimes;
use skein_protocol::status::{ActorState, ActorStatus, StatusRecord};
use skein_protocol::ticket::{Control, CourseChoice, Exploration, Ticket};
use skein_protocol::transition::{Outcome, RecordKind};
use skein_run::{LearnerLock, Presence, RunDirectory, RunIdentity};
use skein_transport::{ActorPorts, LearnerPorts};

/// Steps of every episode in these tests.
const STEPS: u32 = 4;
const INCARNATION: ActorIncarnation = ActorIncarnation(1);
/// Time limit, longer than any of these tests takes.
const PATIENCE: Duration = Duration::from_secs(20);
/// Environment variable that passes the run's directory to a peer process.
const RUN_DIRECTORY: &str = "SKEIN_TEST_RUN";

/// A run with this process as one of its processes.
struct Run {
    directory: RunDirectory,
    identity: RunIdentity,
    config: Config,
    _presence: Presence,
    _folder: tempfile::TempDir,
}

impl Run {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let directory = RunDirectory::new(folder.path().join("run"));
        let mut config = Config::default();
        config.transport.max_actors = 2;
        config.transport.max_records_per_episode = 16;
        config.transport.actor_silence_secs = 1.0;
        config.sac.hidden_width = 8;
        directory.create(&config).unwrap();
        let (identity, config) = directory.open().unwrap();
        Self {
            _presence: Presence::enter(&identity).unwrap(),
            directory,
            identity,
            config,
            _folder: folder,
        }
    }

    fn learner(&self) -> (LearnerPorts, LearnerLock) {
        let lock = LearnerLock::take(&self.directory, &self.identity).unwrap();
        let ports = LearnerPorts::open(&self.identity, lock.incarnation(), &self.config).unwrap();
        (ports, lock)
    }

    fn actor(&self) -> ActorPorts {
        ActorPorts::join(&self.identity, &self.config).unwrap()
    }

    /// Returns the number of the transport's files, and of segments in shared memory.
    fn files(&self) -> (u64, u64) {
        let footprint = footprint(self.identity.run);
        (footprint.transport_entries, footprint.segments)
    }

    /// Returns a dispatcher with one order.
    fn dispatcher(&self) -> Dispatcher {
        let mut dispatcher = Dispatcher::new(
            self.identity.run,
            &self.config.transport,
            self.config.record_lengths(),
        );
        dispatcher.order(EpisodeOrder {
            ticket: self.ticket(0),
            epoch: Epoch(0),
            keep: KeptData::Latents,
            place: BatchPlace { batch: 0, index: 0 },
        });
        dispatcher
    }

    fn ticket(&self, episode: u64) -> Ticket {
        Ticket {
            run: self.identity.run,
            episode: EpisodeId(episode),
            attempt: Attempt(0),
            policy_version: PolicyVersion(0),
            course: CourseChoice::Training,
            start_level: 1,
            exploration: Exploration::Uniform,
            seed: episode,
            teacher_share: None,
            segment: None,
        }
    }

    /// Starts this test program as the peer of the ignored test `role`; returns once the peer is
    /// ready.
    fn peer(&self, role: &str) -> Peer {
        let mut process = Command::new(std::env::current_exe().unwrap())
            .args(["--exact", role, "--ignored", "--nocapture"])
            .env(RUN_DIRECTORY, self.directory.root())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(process.stdout.take().unwrap()).lines();
        let is_ready = lines.any(|line| line.unwrap().contains("ready"));
        assert!(is_ready, "{role} ended: {:?}", process.wait());
        Peer(process)
    }
}

/// A peer process to be killed.
struct Peer(Child);

impl Peer {
    fn kill(&mut self) {
        self.0.kill().unwrap();
        self.0.wait().unwrap();
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Returns the run for which this process was started.
fn run_of_peer() -> (RunDirectory, RunIdentity, Config, Presence) {
    let directory = RunDirectory::new(std::env::var_os(RUN_DIRECTORY).unwrap());
    let (identity, config) = directory.open().unwrap();
    let presence = Presence::enter(&identity).unwrap();
    (directory, identity, config, presence)
}

fn status(actor: ActorId, incarnation: ActorIncarnation) -> ActorStatus {
    ActorStatus {
        actor,
        incarnation,
        pid: std::process::id(),
        state: ActorState::Serving,
        newest_policy: None,
        episodes_flown: 0,
        times: StageTimes::default(),
    }
}

impl Run {
    /// Attaches `actor` to `dispatcher`, and returns its ticket.
    fn issued(&self, dispatcher: &mut Dispatcher, actor: ActorId, now: Instant) -> Ticket {
        dispatcher.on_status(&status(actor, INCARNATION), now);
        let messages = dispatcher.issue(now);
        let message = messages
            .iter()
            .find(|message| message.is_for(actor, INCARNATION))
            .unwrap();
        match message.read(self.identity.run) {
            Ok(Control::Fly(ticket)) => ticket,
            other => panic!("{other:?} is not a ticket"),
        }
    }
}

/// Sends the records `steps` of an episode that times out.
fn send(
    ports: &ActorPorts,
    ticket: &Ticket,
    actor: ActorId,
    incarnation: ActorIncarnation,
    steps: std::ops::RangeInclusive<u32>,
) {
    for step in steps {
        let mut record = ports.loan_transition().unwrap();
        record.begin(ticket, actor, incarnation, step);
        record.truncated = u8::from(step == STEPS - 1);
        if step == STEPS {
            record.kind = RecordKind::Closing.code();
            record.outcome = Outcome::TimedOut.code();
            record.course_walls = 5;
        }
        ports.send_transition(record).unwrap();
    }
}

/// Passes everything that has arrived to the dispatcher, and returns its result.
fn take_in(
    learner: &LearnerPorts,
    dispatcher: &mut Dispatcher,
    now: Instant,
) -> Vec<CommittedEpisode> {
    let mut committed = Vec::new();
    while let Some(record) = learner.receive_transition().unwrap() {
        committed.extend(
            dispatcher
                .on_record(&record, now)
                .unwrap()
                .map(|(_, episode)| episode),
        );
    }
    committed
}

/// Asserts that `actor` flies the first order after all, once.
fn assert_flown(
    run: &Run,
    learner: &LearnerPorts,
    dispatcher: &mut Dispatcher,
    actor: ActorId,
    now: Instant,
) {
    let ports = run.actor();
    learner.maintain().unwrap();
    let ticket = run.issued(dispatcher, actor, now);
    send(&ports, &ticket, actor, INCARNATION, 0..=STEPS);
    let committed = take_in(learner, dispatcher, now);
    assert_eq!(committed.len(), 1);
    assert_eq!(committed[0].steps(), STEPS as usize);
    assert_eq!(dispatcher.open_orders(), 0);
}

const FIRST: ActorId = ActorId(0);
const SECOND: ActorId = ActorId(1);

#[test]
#[ignore = "a process that other tests start and kill"]
fn learner_that_reads_nothing() {
    let (directory, identity, config, _presence) = run_of_peer();
    let lock = LearnerLock::take(&directory, &identity).unwrap();
    let ports = LearnerPorts::open(&identity, lock.incarnation(), &config).unwrap();
    println!("ready");
    let end = Instant::now() + 3 * PATIENCE;
    while Instant::now() < end {
        ports.maintain().unwrap();
        sleep(Duration::from_millis(10));
    }
}

/// By default, iceoryx2 waits until there is room, forever if its reader is dead.
#[test]
fn an_actor_whose_learner_reads_nothing_and_is_killed_is_not_held_up() {
    let (say, heard) = mpsc::channel();
    std::thread::spawn(move || {
        let run = Run::new();
        let mut learner = run.peer("learner_that_reads_nothing");
        let ports = run.actor();
        // Several times the learner's capacity.
        let flood = || {
            (0..50).for_each(|episode| {
                send(&ports, &run.ticket(episode), FIRST, INCARNATION, 0..=STEPS)
            })
        };
        flood();
        learner.kill();
        flood();
        ports.maintain().unwrap();
        flood();
        say.send(()).unwrap();
    });
    heard.recv_timeout(2 * PATIENCE).unwrap();
}

/// A send succeeds even if the learner does not know the sender yet. The data is lost if it never
/// does.
#[test]
fn an_episode_begun_over_a_connection_unknown_to_the_learner_is_flown_again() {
    let run = Run::new();
    let (learner, _lock) = run.learner();
    let mut dispatcher = run.dispatcher();
    let now = Instant::now();
    let ports = run.actor();
    let ticket = run.issued(&mut dispatcher, FIRST, now);
    send(&ports, &ticket, FIRST, INCARNATION, 0..=0);
    drop(ports);
    let ports = run.actor();
    send(&ports, &ticket, FIRST, INCARNATION, 1..=STEPS);
    assert!(take_in(&learner, &mut dispatcher, now).is_empty());
    assert_eq!(dispatcher.faults().reissued_by_reason()["has a hole"], 1);
    drop(ports);
    assert_flown(&run, &learner, &mut dispatcher, FIRST, now);
}

/// Data sent just before the sender ends arrives only if the learner knew the sender before.
#[test]
fn an_episode_whose_actor_ends_at_once_is_flown_by_another() {
    let run = Run::new();
    let (learner, _lock) = run.learner();
    let mut dispatcher = run.dispatcher();
    let now = Instant::now();
    let ports = run.actor();
    let ticket = run.issued(&mut dispatcher, FIRST, now);
    send(&ports, &ticket, FIRST, INCARNATION, 0..=STEPS);
    drop(ports);
    assert!(
        take_in(&learner, &mut dispatcher, now).is_empty(),
        "everything was lost"
    );
    let later = now + Duration::from_secs(2);
    dispatcher.on_time(later);
    assert_flown(&run, &learner, &mut dispatcher, SECOND, later);
}

/// A dead learner takes all its unread data with it.
#[test]
fn episodes_unread_by_a_killed_learner_are_flown_for_its_next_incarnation() {
    let run = Run::new();
    let mut former = run.peer("learner_that_reads_nothing");
    let ports = run.actor();
    sleep(Duration::from_millis(100));
    send(&ports, &run.ticket(0), FIRST, INCARNATION, 0..=STEPS);
    former.kill();
    let (learner, lock) = run.learner();
    assert_ne!(ports.incarnation(), lock.incarnation());
    let (mut dispatcher, now) = (run.dispatcher(), Instant::now());
    send(&ports, &run.ticket(0), FIRST, INCARNATION, 0..=STEPS);
    learner.maintain().unwrap();
    assert!(
        take_in(&learner, &mut dispatcher, now).is_empty(),
        "nothing meant for another incarnation arrives"
    );
    assert_flown(&run, &learner, &mut dispatcher, FIRST, now);
}

/// Sending without a learner succeeds, and the data is lost.
#[test]
fn episodes_sent_without_a_learner_are_flown_for_the_next_one() {
    let run = Run::new();
    let former = run.learner();
    let ports = run.actor();
    drop(former);
    send(&ports, &run.ticket(0), FIRST, INCARNATION, 0..=STEPS);
    let (learner, _lock) = run.learner();
    let (mut dispatcher, now) = (run.dispatcher(), Instant::now());
    learner.maintain().unwrap();
    assert!(take_in(&learner, &mut dispatcher, now).is_empty());
    assert_flown(&run, &learner, &mut dispatcher, FIRST, now);
}

/// Joins, reports readiness, and flies its tickets until it is killed.
#[test]
#[ignore = "a process that other tests start and kill"]
fn actor_that_flies() {
    let (_directory, identity, config, _presence) = run_of_peer();
    let mut is_ready = false;
    let end = Instant::now() + 3 * PATIENCE;
    while Instant::now() < end {
        let Ok(ports) = ActorPorts::join(&identity, &config) else {
            continue;
        };
        // The waiting test reads only the first of these lines.
        if !std::mem::replace(&mut is_ready, true) {
            println!("ready");
        }
        // Each join is another incarnation. Tickets for the previous one are lost with its
        // connection.
        let incarnation = ActorIncarnation(
            SystemTime::now()
                .duration_since(UNIX_EPOCH)
                .unwrap()
                .as_nanos() as u64,
        );
        for _ in 0..20 {
            ports.maintain().unwrap();
            let sign = StatusRecord::new(identity.run, &status(FIRST, incarnation));
            ports.send_status(sign).unwrap();
            ports.wake_learner().unwrap();
            while let Some(record) = ports.receive_control().unwrap() {
                if record.is_for(FIRST, incarnation)
                    && let Ok(Control::Fly(ticket)) = record.read(identity.run)
                {
                    send(&ports, &ticket, FIRST, incarnation, 0..=STEPS);
                }
            }
            // Else the connection may be over before the learner can answer.
            sleep(Duration::from_millis(1));
        }
    }
}

/// Killed actors leave half-made connections, half-made files, and occupied slots. Slots are few:
/// here four for two actors.
#[test]
fn many_actors_killed_at_any_moment_cost_no_slot_no_file_and_no_episode() {
    const EPISODES: u64 = 30;
    let run = Run::new();
    let lock = LearnerLock::take(&run.directory, &run.identity).unwrap();
    let mut receiver =
        EpisodeReceiver::start(&run.identity, lock.incarnation(), &run.config).unwrap();
    let files = run.files();
    let mut peer = run.peer("actor_that_flies");
    let tickets = (0..EPISODES).map(|episode| run.ticket(episode)).collect();
    let mut batch = receiver.fly(Epoch(0), KeptData::Latents, tickets).unwrap();
    for kill in 0..40 {
        sleep(Duration::from_millis(kill * 7 % 60));
        peer.kill();
        peer = run.peer("actor_that_flies");
    }
    let stop = Arc::new(AtomicBool::new(false));
    let stop_request = Arc::clone(&stop);
    std::thread::spawn(move || {
        sleep(PATIENCE);
        stop_request.store(true, Ordering::Relaxed);
    });
    let mut flown = Vec::new();
    while let Some(episode) = batch.next(&stop).unwrap() {
        flown.push(episode.episode.0);
    }
    assert_eq!(flown, (0..EPISODES).collect::<Vec<_>>());
    // The learner's own waker has one of the four slots. If a dead actor kept another, one of these
    // would be refused.
    drop(peer);
    let deadline = Instant::now() + PATIENCE;
    let mut actors = Vec::new();
    while actors.len() < 3 {
        match ActorPorts::join(&run.identity, &run.config) {
            Ok(ports) => actors.push(ports),
            Err(error) => {
                assert!(
                    Instant::now() < deadline,
                    "{} of 3 could join: {error}",
                    actors.len()
                );
                sleep(Duration::from_millis(20));
            }
        }
    }
    drop(actors);
    // Remains that cannot be distinguished from files in creation are kept for some seconds.
    let deadline = Instant::now() + PATIENCE;
    while run.files() != files {
        assert!(
            Instant::now() < deadline,
            "{files:?} became {:?}",
            run.files()
        );
        sleep(Duration::from_millis(100));
    }
    receiver.finish();
}
