use std::thread::JoinHandle;

use skein_protocol::config::Config;
use skein_protocol::ids::{Attempt, FlightId, PolicyVersion};
use skein_protocol::run::{RunDirectory, RunIdentity};
use skein_protocol::services::LearnerPorts;
use skein_protocol::snapshot::SnapshotLayout;
use skein_protocol::ticket::{ControlRecord, CourseChoice, Exploration};
use skein_protocol::transition::{Outcome, RecordKind};

use super::*;
use crate::agent::Agent;
use crate::courses::{Courses, Simulators};
use crate::testing::{config, random_snapshot};

const ACTOR: ActorId = ActorId(0);
const LIFE: Incarnation = Incarnation(77);
const PATIENCE: Duration = Duration::from_secs(20);

/// A run with a learner of the test's own and one actor on a thread.
struct Run {
    learner: LearnerPorts,
    told_to_end: Arc<AtomicBool>,
    actor: Option<JoinHandle<Ending>>,
    identity: RunIdentity,
    config: Config,
    _directory: tempfile::TempDir,
}

impl Run {
    fn start(learner_silence_secs: f64) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        let mut config = config("");
        config.transport.max_actors = 2;
        config.transport.learner_silence_secs = learner_silence_secs;
        run.create(&config).unwrap();
        let (identity, config) = run.open().unwrap();
        let learner = LearnerPorts::open(&identity, &config).unwrap();
        let told_to_end = Arc::new(AtomicBool::new(false));
        let actor = {
            let (identity, config, told_to_end) = (identity.clone(), config.clone(), Arc::clone(&told_to_end));
            std::thread::spawn(move || {
                let courses = Arc::new(Courses::of_run(&config).unwrap());
                let agent = Agent::new(config.learning.observation);
                let mut pilot = Pilot::new(ACTOR, LIFE, Simulators::new(courses), agent);
                let ports = ActorPorts::open(&identity, &config).unwrap();
                let weights = Weights::new(SnapshotLayout::of(&config));
                let mut line = LearnerLine::new(ports, ACTOR, LIFE, weights, &config.transport, &told_to_end);
                serve(&mut pilot, &mut line).unwrap()
            })
        };
        Self {
            learner,
            told_to_end,
            actor: Some(actor),
            identity,
            config,
            _directory: directory,
        }
    }

    fn ticket(&self, version: u64) -> Ticket {
        Ticket {
            run: self.identity.run,
            flight: FlightId(4),
            attempt: Attempt(0),
            policy_version: PolicyVersion(version),
            course: CourseChoice::Training,
            start_level: 1,
            exploration: Exploration::Sample,
            seed: 6,
        }
    }

    fn publish(&self, version: u64) {
        self.learner
            .publish(&random_snapshot(&SnapshotLayout::of(&self.config), version))
            .unwrap();
        self.learner.wake_actors().unwrap();
    }

    fn say(&self, record: ControlRecord) {
        self.learner.send_control(record).unwrap();
        self.learner.wake_actors().unwrap();
    }

    /// Looks for something until it is there.
    fn until<T>(&self, what: &str, mut look: impl FnMut() -> Option<T>) -> T {
        let start = Instant::now();
        loop {
            self.learner.maintain().unwrap();
            if let Some(found) = look() {
                return found;
            }
            assert!(start.elapsed() < PATIENCE, "waited too long for {what}");
            self.learner.wait(Duration::from_millis(20)).unwrap();
        }
    }

    fn until_status(&self, what: &str, holds: impl Fn(&ActorStatus) -> bool) -> ActorStatus {
        self.until(what, || {
            let status = self.learner.receive_status().unwrap()?.read(self.identity.run)?;
            holds(&status).then_some(status)
        })
    }

    fn ending(&mut self) -> Ending {
        self.actor.take().unwrap().join().unwrap()
    }
}

impl Drop for Run {
    fn drop(&mut self) {
        self.told_to_end.store(true, Ordering::Relaxed);
        if let Some(actor) = self.actor.take() {
            let _ = actor.join();
        }
        self.identity.remove_transport();
    }
}

#[test]
fn an_actor_flies_its_ticket_and_leaves_when_the_run_is_over() {
    let mut run = Run::start(30.0);
    run.until_status("an actor", |status| status.actor == ACTOR && status.incarnation == LIFE);
    run.publish(1);
    let ticket = run.ticket(1);
    // For another life of this actor: not to be flown.
    run.say(ControlRecord::fly(
        &Ticket {
            flight: FlightId(99),
            ..ticket
        },
        ACTOR,
        Incarnation(1),
    ));
    run.say(ControlRecord::fly(&ticket, ACTOR, LIFE));
    for step in 0.. {
        let record = run.until("a record", || run.learner.receive_transition().unwrap());
        if record.check(&ticket, ACTOR, LIFE, step) == Ok(RecordKind::Closing) {
            assert!(step > 3 && Outcome::from_code(record.outcome).is_some());
            break;
        }
        assert_eq!(record.check(&ticket, ACTOR, LIFE, step), Ok(RecordKind::Step));
    }
    run.say(ControlRecord::stop(run.identity.run));
    let last = run.until_status("the last word", |status| status.state == ActorState::Leaving);
    assert_eq!((last.flights_flown, last.newest_policy), (1, Some(PolicyVersion(1))));
    assert_eq!(run.ending(), Ending::Stopped);
    assert!(run.learner.receive_transition().unwrap().is_none());
}

#[test]
fn a_ticket_waits_for_its_snapshot_and_no_other_is_flown_in_its_stead() {
    let run = Run::start(30.0);
    run.until_status("an actor", |_| true);
    run.publish(1);
    run.say(ControlRecord::fly(&run.ticket(2), ACTOR, LIFE));
    run.until_status("the first snapshot", |status| {
        status.newest_policy == Some(PolicyVersion(1))
    });
    run.until_status("a sign of life later", |_| true);
    assert!(run.learner.receive_transition().unwrap().is_none());
    run.publish(2);
    let record = run.until("a record", || run.learner.receive_transition().unwrap());
    assert_eq!(record.check(&run.ticket(2), ACTOR, LIFE, 0), Ok(RecordKind::Step));
}

#[test]
fn a_learner_silent_for_too_long_is_left() {
    let mut run = Run::start(0.3);
    assert_eq!(run.ending(), Ending::LearnerSilent);
}

#[test]
fn heartbeats_keep_an_actor_and_a_signal_ends_it() {
    let mut run = Run::start(0.5);
    run.until_status("an actor", |_| true);
    let start = Instant::now();
    while start.elapsed() < Duration::from_millis(1200) {
        run.learner.maintain().unwrap();
        run.say(ControlRecord::heartbeat(run.identity.run));
        std::thread::sleep(Duration::from_millis(50));
    }
    assert!(!run.actor.as_ref().unwrap().is_finished());
    run.told_to_end.store(true, Ordering::Relaxed);
    assert_eq!(run.ending(), Ending::Signalled);
}
