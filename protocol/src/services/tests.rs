//! The services as two processes would use them, over real shared memory.

use std::thread::sleep;
use std::time::Duration;

use super::joining::JOIN_INTERVAL;
use super::*;
use crate::config::Config;
use crate::ids::{ActorId, Attempt, FlightId, Incarnation, PolicyVersion, RunId};
use crate::run::RunDirectory;
use crate::snapshot::{Snapshot, SnapshotLayout};
use crate::ticket::{CourseChoice, Exploration, Ticket};

struct Run {
    identity: RunIdentity,
    config: Config,
    _directory: tempfile::TempDir,
}

impl Run {
    fn new() -> Self {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        let mut config = Config::default();
        config.transport.max_actors = 2;
        config.sac.hidden_width = 8;
        run.create(&config).unwrap();
        let (identity, config) = run.open().unwrap();
        Self {
            identity,
            config,
            _directory: directory,
        }
    }

    fn learner(&self) -> Result<LearnerPorts, ServiceError> {
        LearnerPorts::open(&self.identity, &self.config)
    }

    fn actor(&self) -> Result<ActorPorts, JoinError> {
        ActorPorts::open(&self.identity, &self.config)
    }
}

impl Drop for Run {
    fn drop(&mut self) {
        self.identity.remove_transport();
    }
}

fn ticket(run: RunId) -> Ticket {
    Ticket {
        run,
        flight: FlightId(1),
        attempt: Attempt(0),
        policy_version: PolicyVersion(0),
        course: CourseChoice::Training,
        start_level: 1,
        exploration: Exploration::Uniform,
        seed: 7,
    }
}

#[test]
fn the_image_written_into_the_loan_is_the_image_received() {
    let run = Run::new();
    let (learner, actor) = (run.learner().unwrap(), run.actor().unwrap());
    learner.maintain().unwrap();
    let ticket = ticket(run.identity.run);
    let mut record = actor.loan_transition().unwrap();
    record.begin(&ticket, ActorId(0), Incarnation(1), 0);
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
    received.check(&ticket, ActorId(0), Incarnation(1), 0).unwrap();
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
fn the_largest_flight_of_every_ticket_fits_unread() {
    let run = Run::new();
    let (learner, actor) = (run.learner().unwrap(), run.actor().unwrap());
    learner.maintain().unwrap();
    let records = run.config.transport.max_records_per_flight * run.config.transport.tickets_per_actor;
    for step in 0..records {
        let mut record = actor.loan_transition().unwrap();
        record.begin(&ticket(run.identity.run), ActorId(0), Incarnation(1), step as u32);
        actor.send_transition(record).unwrap();
    }
    for step in 0..records {
        assert_eq!(learner.receive_transition().unwrap().unwrap().step, step as u32);
    }
}

#[test]
fn a_wait_of_no_time_ends() {
    let (say, heard) = std::sync::mpsc::channel();
    std::thread::spawn(move || {
        let run = Run::new();
        let (learner, actor) = (run.learner().unwrap(), run.actor().unwrap());
        learner.wait(Duration::ZERO).unwrap();
        actor.wait(Duration::from_nanos(1)).unwrap();
        say.send(()).unwrap();
    });
    heard.recv_timeout(Duration::from_secs(5)).unwrap();
}

#[test]
fn a_process_that_was_stopped_and_continued_goes_on() {
    let run = Run::new();
    let (learner, actor) = (run.learner().unwrap(), run.actor().unwrap());
    for wait in [&|time| learner.wait(time), &|time| actor.wait(time)] as [&dyn Fn(Duration) -> _; 2] {
        let mut stopper = std::process::Command::new("sh")
            .args(["-c", "sleep 0.1; kill -STOP $PPID; sleep 0.1; kill -CONT $PPID"])
            .spawn()
            .unwrap();
        wait(Duration::from_secs(1)).unwrap();
        stopper.wait().unwrap();
    }
}

#[test]
fn a_second_learner_is_refused() {
    let run = Run::new();
    let _first = run.learner().unwrap();
    let refusal = run.learner().unwrap_err().to_string();
    assert!(refusal.contains("the other learner of this run"), "{refusal}");
}

#[test]
fn an_actor_of_another_configuration_is_refused() {
    let mut run = Run::new();
    let _learner = run.learner().unwrap();
    run.identity.config_digest ^= 1;
    let refusal = run.actor().unwrap_err().to_string();
    assert!(
        refusal.contains("differ in program version or configuration"),
        "{refusal}"
    );
}

#[test]
fn an_actor_waits_for_the_learner() {
    let run = Run::new();
    let (identity, config) = (run.identity.clone(), run.config.clone());
    let actor = std::thread::spawn(move || ActorPorts::open(&identity, &config).map(drop));
    sleep(3 * JOIN_INTERVAL);
    assert!(!actor.is_finished(), "the actor did not wait");
    let _learner = run.learner().unwrap();
    actor.join().unwrap().unwrap();
}

#[test]
fn an_actor_of_a_run_that_is_over_leaves_nothing_behind() {
    let run = Run::new();
    drop(run.learner().unwrap());
    run.identity.remove_transport();
    assert!(!is_learner_alive(&run.identity).unwrap());
    let refusal = ActorPorts::open_within(2 * JOIN_INTERVAL, &run.identity, &run.config).unwrap_err();
    assert!(matches!(refusal, JoinError::NoLearner { .. }), "{refusal}");
    assert!(!run.identity.transport_root.exists());
}

#[test]
fn a_transport_folder_alone_is_no_learner() {
    let run = Run::new();
    let learner = run.learner().unwrap();
    let _waker = LearnerWaker::open(&run.identity, &run.config).unwrap();
    assert!(is_learner_alive(&run.identity).unwrap());
    drop(learner);
    assert!(run.identity.transport_root.exists());
    assert!(!is_learner_alive(&run.identity).unwrap());
}
