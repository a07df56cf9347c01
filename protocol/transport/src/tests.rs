//! Tests of the services as two processes use them, over real shared memory.

use std::os::unix::fs::PermissionsExt;
use std::time::Duration;

use super::open::{OpenMode, Opener};
use super::*;
use skein_protocol::config::Config;
use skein_protocol::ids::{ActorId, ActorIncarnation, Attempt, EpisodeId, PolicyVersion, RunId};
use skein_protocol::snapshot::{Snapshot, SnapshotLayout};
use skein_protocol::ticket::{CourseChoice, Exploration, Ticket};
use skein_run::{LearnerLock, RunDirectory};

pub(super) struct Run {
    pub(super) identity: RunIdentity,
    pub(super) config: Config,
    pub(super) lock: LearnerLock,
    _directory: tempfile::TempDir,
}

impl Run {
    fn new() -> Self {
        Self::with(|_| {})
    }

    pub(super) fn with(change: impl FnOnce(&mut Config)) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        let mut config = Config::default();
        config.transport.max_actors = 2;
        config.sac.hidden_width = 8;
        change(&mut config);
        run.create(&config).unwrap();
        let (identity, config) = run.open().unwrap();
        Self {
            lock: LearnerLock::take(&run, &identity).unwrap(),
            identity,
            config,
            _directory: directory,
        }
    }

    fn learner(&self) -> Result<LearnerPorts, JoinError> {
        LearnerPorts::open(&self.identity, self.lock.incarnation(), &self.config)
    }

    fn actor(&self) -> Result<ActorPorts, JoinError> {
        ActorPorts::join(&self.identity, &self.config)
    }
}

fn ticket(run: RunId) -> Ticket {
    Ticket {
        run,
        episode: EpisodeId(1),
        attempt: Attempt(0),
        policy_version: PolicyVersion(0),
        course: CourseChoice::Training,
        start_level: 1,
        exploration: Exploration::Uniform,
        seed: 7,
        teacher_share: None,
        segment: None,
    }
}

#[test]
fn the_image_written_into_the_loan_is_the_image_received() {
    let run = Run::new();
    let (learner, actor) = (run.learner().unwrap(), run.actor().unwrap());
    learner.maintain().unwrap();
    let ticket = ticket(run.identity.run);
    let mut record = actor.loan_transition().unwrap();
    record.begin(&ticket, ActorId(0), ActorIncarnation(1), 0);
    record
        .depth
        .iter_mut()
        .enumerate()
        .for_each(|(index, pixel)| *pixel = index as u8);
    assert_eq!(
        record.depth.as_ptr() as usize % 64,
        0,
        "the image starts on a cache line"
    );
    actor.send_transition(record).unwrap();
    actor.wake_learner().unwrap();
    learner.wait(Duration::from_secs(1)).unwrap();
    let received = learner.receive_transition().unwrap().unwrap();
    received
        .check(&ticket, ActorId(0), ActorIncarnation(1), 0)
        .unwrap();
    assert!(
        received
            .depth
            .iter()
            .enumerate()
            .all(|(index, pixel)| *pixel == index as u8)
    );
}

#[test]
fn a_late_actor_gets_the_newest_snapshots() {
    let run = Run::new();
    let learner = run.learner().unwrap();
    let values = SnapshotLayout::of(&run.config).values();
    for version in 0..7 {
        let snapshot = Snapshot {
            version: PolicyVersion(version),
            values: vec![version as f32; values],
        };
        learner.publish(&snapshot).unwrap();
    }
    let actor = run.actor().unwrap();
    learner.maintain().unwrap();
    let mut versions = Vec::new();
    while let Some(snapshot) = actor.receive_snapshot().unwrap() {
        versions.push(snapshot.unwrap().version.0);
    }
    assert_eq!(versions, [3, 4, 5, 6]);
}

#[test]
fn the_largest_episode_of_every_ticket_fits_unread() {
    let run = Run::new();
    let (learner, actor) = (run.learner().unwrap(), run.actor().unwrap());
    learner.maintain().unwrap();
    let records =
        run.config.transport.max_records_per_episode * run.config.transport.tickets_per_actor;
    for step in 0..records {
        let mut record = actor.loan_transition().unwrap();
        record.begin(
            &ticket(run.identity.run),
            ActorId(0),
            ActorIncarnation(1),
            step as u32,
        );
        actor.send_transition(record).unwrap();
    }
    for step in 0..records {
        assert_eq!(
            learner.receive_transition().unwrap().unwrap().step,
            step as u32
        );
    }
}

#[test]
fn a_wait_of_zero_time_ends() {
    let (sender, receiver) = std::sync::mpsc::channel();
    std::thread::spawn(move || {
        let run = Run::new();
        let (learner, actor) = (run.learner().unwrap(), run.actor().unwrap());
        learner.wait(Duration::ZERO).unwrap();
        actor.wait(Duration::from_nanos(1)).unwrap();
        sender.send(()).unwrap();
    });
    receiver.recv_timeout(Duration::from_secs(5)).unwrap();
}

#[test]
fn a_process_that_was_stopped_and_continued_keeps_working() {
    let run = Run::new();
    let (learner, actor) = (run.learner().unwrap(), run.actor().unwrap());
    for wait in
        [&|time| learner.wait(time), &|time| actor.wait(time)] as [&dyn Fn(Duration) -> _; 2]
    {
        let mut stopper = std::process::Command::new("sh")
            .args([
                "-c",
                "sleep 0.1; kill -STOP $PPID; sleep 0.1; kill -CONT $PPID",
            ])
            .spawn()
            .unwrap();
        wait(Duration::from_secs(1)).unwrap();
        stopper.wait().unwrap();
    }
}

#[test]
fn an_actor_of_another_configuration_is_refused() {
    let mut run = Run::new();
    let _learner = run.learner().unwrap();
    run.identity.config_digest ^= 1;
    let refusal = run.actor().unwrap_err();
    assert!(refusal.is_final());
    assert!(
        refusal.to_string().contains("differ in configuration"),
        "{refusal}"
    );
}

#[test]
fn services_refuse_a_mismatch_that_the_announcement_missed() {
    let mut run = Run::new();
    let _learner = run.learner().unwrap();
    run.identity.config_digest ^= 1;
    let node = node(&run.identity, run.lock.incarnation(), "actor").unwrap();
    let open = Opener::new(&node, OpenMode::Join, &run.identity, &run.config).unwrap();
    let refusal = open.status().unwrap_err();
    assert!(refusal.is_final());
    assert!(
        refusal
            .to_string()
            .contains("differ in program version or configuration"),
        "{refusal}"
    );
}

#[test]
fn no_learner_can_be_joined_before_its_services_are_open_or_after_it_is_gone() {
    let run = Run::new();
    let no_learner = || matches!(run.actor(), Err(JoinError::NoLearner(_)));
    assert!(run.identity.is_learner_alive().unwrap());
    assert!(no_learner());
    let learner = run.learner().unwrap();
    assert_eq!(run.actor().unwrap().incarnation(), run.lock.incarnation());
    let Run {
        identity,
        config,
        lock,
        ..
    } = run;
    drop((learner, lock));
    assert!(!identity.is_learner_alive().unwrap());
    assert!(matches!(
        ActorPorts::join(&identity, &config),
        Err(JoinError::NoLearner(_))
    ));
    assert!(!identity.transport_folder().exists());
}

#[test]
fn only_the_user_can_access_a_runs_transport() {
    let run = Run::new();
    let (_learner, _actor) = (run.learner().unwrap(), run.actor().unwrap());
    let segments: Vec<_> = run.identity.shared_memory(run.lock.incarnation()).collect();
    assert!(segments.len() > 10, "{segments:?}");
    let folders = [
        run.identity.transport_folder(),
        run.identity.incarnation_folder(run.lock.incarnation()),
    ];
    for path in segments.iter().chain(&folders) {
        let about = std::fs::metadata(path).unwrap();
        assert_eq!(about.permissions().mode() & 0o077, 0, "{}", path.display());
    }
}
