use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;

use skein_protocol::ids::{Attempt, EpisodeId, PolicyVersion};
use skein_protocol::snapshot::{Snapshot, SnapshotLayout};
use skein_protocol::stages::{Stage, ThreadRole};
use skein_protocol::status::ActorStatus;
use skein_protocol::ticket::{ControlRecord, CourseChoice, Exploration};
use skein_protocol::transition::{Outcome, RecordKind};
use skein_run::{LearnerLock, Presence, RunDirectory};
use skein_transport::LearnerPorts;

use super::*;
use skein_rollout::agent::Agent;
use skein_rollout::courses::{Courses, Simulators};

const ACTOR: ActorId = ActorId(0);
const PATIENCE: Duration = Duration::from_secs(20);

/// Run whose learner is the test itself, with one actor on a thread.
struct Run {
    learner: Option<(LearnerPorts, LearnerLock)>,
    exit_requested: Arc<AtomicBool>,
    actor: Option<JoinHandle<Result<ExitReason, JoinError>>>,
    identity: RunIdentity,
    config: Config,
    directory: tempfile::TempDir,
}

impl Run {
    fn start(learner_silence_secs: f64) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        let mut config = Config::default();
        config.sac.hidden_width = 16;
        let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs");
        for path in config.courses.paths_mut() {
            *path = configs.join(&*path);
        }
        config.transport.max_actors = 2;
        config.transport.learner_silence_secs = learner_silence_secs;
        run.create(&config).unwrap();
        let (identity, config) = run.open().unwrap();
        let exit_requested = Arc::new(AtomicBool::new(false));
        let mut started = Self {
            learner: None,
            exit_requested: Arc::clone(&exit_requested),
            actor: None,
            identity: identity.clone(),
            config: config.clone(),
            directory,
        };
        started.begin_incarnation();
        started.actor = Some(std::thread::spawn(move || {
            let _presence = Presence::enter(&identity).unwrap();
            let courses = Arc::new(Courses::of_run(&config).unwrap());
            let agent = Agent::new(config.observation_layout());
            let mut environment_loop =
                EnvironmentLoop::new(ACTOR, ActorIncarnation(0), Simulators::new(courses), agent);
            let exit_requested = || exit_requested.load(Ordering::Relaxed);
            Service::new(&identity, &config, ACTOR, &exit_requested).serve(&mut environment_loop)
        }));
        started
    }

    fn begin_incarnation(&mut self) {
        let directory = RunDirectory::new(self.directory.path());
        let lock = LearnerLock::take(&directory, &self.identity).unwrap();
        let ports = LearnerPorts::open(&self.identity, lock.incarnation(), &self.config).unwrap();
        self.learner = Some((ports, lock));
    }

    fn learner(&self) -> &LearnerPorts {
        &self.learner.as_ref().unwrap().0
    }

    fn ticket(&self, version: u64) -> Ticket {
        Ticket {
            run: self.identity.run,
            episode: EpisodeId(4),
            attempt: Attempt(0),
            policy_version: PolicyVersion(version),
            course: CourseChoice::Training,
            start_level: 1,
            exploration: Exploration::Sample,
            seed: 6,
            teacher_share: None,
            segment: None,
        }
    }

    fn publish(&self, version: u64) {
        let snapshot = Snapshot {
            version: PolicyVersion(version),
            values: vec![0.01; SnapshotLayout::of(&self.config).values()],
        };
        self.learner().publish(&snapshot).unwrap();
        self.learner().wake_actors().unwrap();
    }

    fn send(&self, record: ControlRecord) {
        self.learner().send_control(record).unwrap();
        self.learner().wake_actors().unwrap();
    }

    /// Repeats `look` until it succeeds.
    fn until<T>(&self, what: &str, mut look: impl FnMut() -> Option<T>) -> T {
        let start = Instant::now();
        loop {
            self.learner().maintain().unwrap();
            if let Some(found) = look() {
                return found;
            }
            assert!(start.elapsed() < PATIENCE, "waited too long for {what}");
            self.learner().wait(Duration::from_millis(20)).unwrap();
        }
    }

    fn until_status(&self, what: &str, holds: impl Fn(&ActorStatus) -> bool) -> ActorStatus {
        self.until(what, || {
            let status = self
                .learner()
                .receive_status()
                .unwrap()?
                .read(self.identity.run)?;
            holds(&status).then_some(status)
        })
    }

    fn joined(&self) -> ActorIncarnation {
        self.until_status("an actor", |status| status.state == ActorState::Serving)
            .incarnation
    }

    fn ending(&mut self) -> ExitReason {
        self.actor.take().unwrap().join().unwrap().unwrap()
    }
}

impl Drop for Run {
    fn drop(&mut self) {
        self.exit_requested.store(true, Ordering::Relaxed);
        if let Some(actor) = self.actor.take() {
            let _ = actor.join();
        }
    }
}

#[test]
fn an_actor_flies_its_ticket_and_leaves_when_the_run_is_over() {
    let begun = Instant::now();
    let mut run = Run::start(30.0);
    let incarnation = run.joined();
    run.publish(1);
    let ticket = run.ticket(1);
    // For another incarnation of this actor: not to be flown.
    let other = Ticket {
        episode: EpisodeId(99),
        ..ticket.clone()
    };
    run.send(ControlRecord::fly(&other, ACTOR, ActorIncarnation(1)));
    run.send(ControlRecord::fly(&ticket, ACTOR, incarnation));
    let mut steps = 0;
    for step in 0.. {
        steps = u64::from(step);
        let record = run.until("a record", || run.learner().receive_transition().unwrap());
        if record.check(&ticket, ACTOR, incarnation, step) == Ok(RecordKind::Closing) {
            assert!(step > 3 && Outcome::from_code(record.outcome).is_some());
            break;
        }
        assert_eq!(
            record.check(&ticket, ACTOR, incarnation, step),
            Ok(RecordKind::Step)
        );
    }
    run.send(ControlRecord::stop(run.identity.run));
    let last = run.until_status("the last status", |status| {
        status.state == ActorState::Leaving
    });
    assert_eq!(
        (last.episodes_flown, last.newest_policy),
        (1, Some(PolicyVersion(1)))
    );
    let done = [
        Stage::TakeSnapshot,
        Stage::Reset,
        Stage::Physics,
        Stage::Camera,
        Stage::Encoder,
        Stage::Policy,
        Stage::Send,
    ]
    .map(|stage| last.times.of(stage).count);
    assert_eq!(done, [1, 1, steps, steps + 1, steps + 1, steps, steps + 1]);
    let total = Duration::from_nanos(last.times.total_nanos(ThreadRole::Actors));
    assert!(total <= begun.elapsed() && total > Duration::ZERO);
    assert_eq!(run.ending(), ExitReason::Stopped);
    assert!(run.learner().receive_transition().unwrap().is_none());
}

#[test]
fn a_ticket_waits_for_its_snapshot_and_is_flown_with_no_other() {
    let run = Run::start(30.0);
    let incarnation = run.joined();
    run.publish(1);
    run.send(ControlRecord::fly(&run.ticket(2), ACTOR, incarnation));
    run.until_status("the first snapshot", |status| {
        status.newest_policy == Some(PolicyVersion(1))
    });
    run.until_status("a heartbeat later", |_| true);
    assert!(run.learner().receive_transition().unwrap().is_none());
    run.publish(2);
    let record = run.until("a record", || run.learner().receive_transition().unwrap());
    assert_eq!(
        record.check(&run.ticket(2), ACTOR, incarnation, 0),
        Ok(RecordKind::Step)
    );
}

#[test]
fn an_actor_exits_when_the_learner_is_silent_for_too_long() {
    let mut run = Run::start(0.3);
    assert_eq!(run.ending(), ExitReason::LearnerSilent);
}

#[test]
fn an_actor_exits_when_the_learner_is_gone_for_too_long() {
    let mut run = Run::start(1.0);
    run.joined();
    run.learner = None;
    assert_eq!(run.ending(), ExitReason::LearnerSilent);
    assert!(
        !run.identity.transport_folder().exists(),
        "the last process removes it"
    );
}

#[test]
fn an_actor_without_a_learner_ends_at_a_signal() {
    let mut run = Run::start(30.0);
    run.joined();
    run.learner = None;
    std::thread::sleep(3 * JOIN_INTERVAL);
    run.exit_requested.store(true, Ordering::Relaxed);
    let requested = Instant::now();
    assert_eq!(run.ending(), ExitReason::Signalled);
    assert!(requested.elapsed() < Duration::from_secs(2));
}

#[test]
fn heartbeats_keep_an_actor_and_a_signal_ends_it() {
    let mut run = Run::start(0.5);
    run.joined();
    let start = Instant::now();
    while start.elapsed() < Duration::from_millis(1200) {
        run.learner().maintain().unwrap();
        run.send(ControlRecord::heartbeat(run.identity.run));
        std::thread::sleep(Duration::from_millis(50));
    }
    assert!(!run.actor.as_ref().unwrap().is_finished());
    run.exit_requested.store(true, Ordering::Relaxed);
    assert_eq!(run.ending(), ExitReason::Signalled);
}

#[test]
fn an_actor_joins_the_next_learner_incarnation_with_empty_state() {
    let mut run = Run::start(30.0);
    let former = run.joined();
    // This ticket waits for a snapshot. If the next incarnation kept it, it would be flown there.
    run.send(ControlRecord::fly(&run.ticket(2), ACTOR, former));
    run.publish(1);
    run.until_status("the first snapshot", |status| {
        status.newest_policy == Some(PolicyVersion(1))
    });
    run.learner = None;
    run.begin_incarnation();
    let status = run.until_status("the actor in the next incarnation", |_| true);
    assert!(status.incarnation > former);
    assert_eq!(status.newest_policy, None);
    run.publish(2);
    run.until_status("the second snapshot", |status| {
        status.newest_policy == Some(PolicyVersion(2))
    });
    run.until_status("a heartbeat later", |_| true);
    assert!(run.learner().receive_transition().unwrap().is_none());
    run.send(ControlRecord::fly(
        &run.ticket(2),
        ACTOR,
        status.incarnation,
    ));
    let record = run.until("a record", || run.learner().receive_transition().unwrap());
    assert_eq!(
        record.check(&run.ticket(2), ACTOR, status.incarnation, 0),
        Ok(RecordKind::Step)
    );
}
