//! Benchmark of an actor process: time from its start to the first record, and its memory.
//!
//! The benchmark is the learner and answers at once, so it measures only the actor. Each result is
//! a line of JSON; `--quick` runs once.

mod common;

use std::fs;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::json;
use skein_protocol::ids::{ActorId, ActorIncarnation, PolicyVersion};
use skein_protocol::snapshot::Snapshot;
use skein_protocol::ticket::{ControlRecord, Ticket};
use skein_protocol::transition::{RecordKind, TransitionRecord};

use common::{Learner, ticket};

/// Longer than any machine needs for a step.
const PATIENCE: Duration = Duration::from_secs(20);
/// Episodes before memory is measured, each with a new snapshot: then the actor's cache is full and
/// has dropped snapshots.
const EPISODES: u64 = 12;
const ACTOR: ActorId = ActorId(0);

fn main() {
    let starts = if std::env::args().any(|argument| argument == "--quick") {
        1
    } else {
        15
    };
    let learner = Learner::open();
    let mut version = 0;
    learner.publish(version);
    let mut start_secs = Vec::new();
    let mut resident_bytes = 0;
    for _ in 0..starts {
        let (secs, bytes) = learner.watch_an_actor(&mut version);
        start_secs.push(secs);
        resident_bytes = resident_bytes.max(bytes);
    }
    start_secs.sort_by(f64::total_cmp);
    let print_result = |name, figure, unit| {
        println!(
            "{}",
            json!({ "name": name, "figure": figure, "unit": unit })
        )
    };
    print_result("actor_process/start", start_secs[starts / 2] * 1e3, "ms");
    print_result("actor_process/resident", resident_bytes as f64 / 1e6, "MB");
}

impl Learner {
    fn publish(&self, version: u64) {
        let snapshot = Snapshot {
            version: PolicyVersion(version),
            ..self.snapshot()
        };
        self.ports.publish(&snapshot).expect("there is memory");
    }

    /// Starts an actor and lets it fly, first with the snapshot of this `version`, then with newer
    /// ones. Returns the seconds until its first record, and its peak resident bytes.
    fn watch_an_actor(&self, version: &mut u64) -> (f64, u64) {
        let started = Instant::now();
        let actor = Actor::start(self.directory.path());
        let incarnation = self.until(|| {
            let status = self
                .ports
                .receive_status()
                .expect("the actor's memory can be mapped")?;
            // Skips late status records of the previous actor.
            let status = status.read(self.identity.run)?;
            (status.pid == actor.0.id()).then_some(status.incarnation)
        });
        self.fly(0, *version, incarnation);
        self.until(|| self.record(incarnation));
        let secs = started.elapsed().as_secs_f64();
        for episode in 1..EPISODES {
            self.until(|| {
                Some(self.record(incarnation)?.kind == RecordKind::Closing.code())
                    .filter(|closed| *closed)
            });
            *version += 1;
            self.publish(*version);
            self.fly(episode, *version, incarnation);
        }
        (secs, actor.resident_bytes())
    }

    fn fly(&self, episode: u64, version: u64, incarnation: ActorIncarnation) {
        let ticket = Ticket {
            policy_version: PolicyVersion(version),
            ..ticket(self.identity.run, episode, 1)
        };
        self.ports
            .maintain()
            .expect("the actor's memory can be mapped");
        self.ports
            .send_control(ControlRecord::fly(&ticket, ACTOR, incarnation))
            .expect("there is memory");
        self.ports.wake_actors().expect("the event can be raised");
    }

    fn record(&self, incarnation: ActorIncarnation) -> Option<TransitionRecord> {
        let record = self
            .ports
            .receive_transition()
            .expect("the actor's memory can be mapped")?;
        (record.incarnation == incarnation.0).then_some(*record)
    }

    /// Repeats `look` until it succeeds.
    fn until<T>(&self, mut look: impl FnMut() -> Option<T>) -> T {
        let start = Instant::now();
        loop {
            if let Some(found) = look() {
                return found;
            }
            assert!(start.elapsed() < PATIENCE, "the actor does not answer");
            self.ports
                .wait(Duration::from_micros(100))
                .expect("events can be waited for");
        }
    }
}

/// An actor process, killed when this value is dropped.
struct Actor(Child);

impl Actor {
    fn start(run: &Path) -> Self {
        let child = Command::new(env!("CARGO_BIN_EXE_skein-actor"))
            .args(["--id", "0", "--run"])
            .arg(run)
            .stdin(Stdio::null())
            .spawn();
        Self(child.expect("the actor is built with its benchmarks"))
    }

    /// Returns the peak resident memory, private and shared, as the kernel counts it.
    fn resident_bytes(&self) -> u64 {
        let status = fs::read_to_string(format!("/proc/{}/status", self.0.id()))
            .expect("the process exists");
        let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
        let kib: Option<u64> = line.and_then(|line| line.split_whitespace().next()?.parse().ok());
        kib.expect("the kernel reports it in KiB") << 10
    }
}

impl Drop for Actor {
    fn drop(&mut self) {
        // The process may have ended already.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}
