//! How soon an actor's first record is there, and how much memory an actor takes: `cargo bench -p skein-tests --bench actor`, once the programs are built.
//!
//! A learner's reception, as in a run of `configs/local.toml`, and the real `skein-actor`. A flight has one step here, so that the first flight that is
//! committed is the first record and hardly more. Each figure is a line of JSON on standard output and one for people on standard error; `--quick` tries
//! once.

#![allow(clippy::unwrap_used, reason = "a benchmark fails by panicking, as tests do")]

use std::process::{Child, Command, Stdio};
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use skein_launch::inspection::processes_of;
use skein_launch::prepare::{Prepared, prepare};
use skein_learner::flights::assembly::Keep;
use skein_learner::flights::reception::{Batch, Reception};
use skein_protocol::ids::{Attempt, Epoch, FlightId, PolicyVersion};
use skein_protocol::run::LearnerSeat;
use skein_protocol::services::shared_memory_needed;
use skein_protocol::snapshot::{Snapshot, SnapshotLayout};
use skein_protocol::ticket::{CourseChoice, Exploration, Ticket};
use skein_tests::{program, repository};

/// Snapshots that there have been when an actor comes: as many as are kept for it.
const SNAPSHOTS: u64 = 4;
/// Snapshots that come while it is there: more than the learner has places for.
const MORE_SNAPSHOTS: u64 = 12;

struct Learner {
    prepared: Prepared,
    reception: Reception,
    next_flight: u64,
    newest: u64,
}

fn main() {
    let is_quick = std::env::args().any(|argument| argument == "--quick");
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path().canonicalize().unwrap().join("run");
    let one_step = ["simulator.max_steps=1".to_owned()];
    let prepared = prepare(&repository().join("configs/local.toml"), &one_step, &root, 1).unwrap();
    let seat = LearnerSeat::take(&prepared.run, &prepared.identity).unwrap();
    let mut learner = Learner {
        reception: Reception::start(&prepared.identity, seat.life(), &prepared.config).unwrap(),
        prepared,
        next_flight: 0,
        newest: 0,
    };
    (0..SNAPSHOTS).for_each(|version| learner.publish(version));

    let attempts = if is_quick { 1 } else { 11 };
    let starts = (0..attempts).map(|_| learner.start_of_an_actor());
    let empty = (0..attempts).map(|_| start_of_an_empty_process());
    let (start, empty) = (median(starts.collect()), median(empty.collect()));
    report(
        "start of an actor until its first flight of one step",
        start,
        "ms",
        ("the program itself, --version", empty),
    );

    let (resident, needed) = learner.memory_of_an_actor();
    report(
        "memory of an actor, at most",
        resident,
        "MB",
        ("its records and the snapshots it holds", needed),
    );
    learner.reception.finish();
}

impl Learner {
    fn publish(&mut self, version: u64) {
        let values = SnapshotLayout::of(&self.prepared.config).values();
        self.newest = version;
        self.reception
            .publish(Snapshot {
                version: PolicyVersion(version),
                values: vec![0.01; values],
            })
            .unwrap();
    }

    /// Orders a flight with the newest snapshot.
    fn order(&mut self) -> Batch {
        let ticket = Ticket {
            run: self.prepared.identity.run,
            flight: FlightId(self.next_flight),
            attempt: Attempt(0),
            policy_version: PolicyVersion(self.newest),
            course: CourseChoice::Training,
            start_level: 1,
            exploration: Exploration::Sample,
            seed: self.next_flight,
        };
        self.next_flight += 1;
        self.reception.fly(Epoch(0), Keep::Latents, vec![ticket]).unwrap()
    }

    fn start_actor(&self) -> Child {
        Command::new(program("skein-actor"))
            .arg("--run")
            .arg(self.prepared.run.root())
            .args(["--id", "0"])
            .stdin(Stdio::null())
            .spawn()
            .unwrap()
    }

    fn start_of_an_actor(&mut self) -> f64 {
        let flight = self.order();
        let began = Instant::now();
        let actor = self.start_actor();
        await_flight(flight);
        let took = began.elapsed();
        end(actor);
        // Its successor is not to find a learner that still has it.
        while !self.reception.shared().live_actors().is_empty() {
            std::thread::sleep(Duration::from_millis(5));
        }
        took.as_secs_f64() * 1e3
    }

    /// Megabytes that an actor had in its memory at most, and that its data take.
    fn memory_of_an_actor(&mut self) -> (f64, f64) {
        let actor = self.start_actor();
        for version in SNAPSHOTS..SNAPSHOTS + MORE_SNAPSHOTS {
            self.publish(version);
            await_flight(self.order());
        }
        let process = processes_of(&self.prepared.run)
            .into_iter()
            .find(|process| process.pid() == actor.id());
        let most = process.unwrap().usage().unwrap().most_resident_bytes;
        end(actor);
        let config = &self.prepared.config;
        let records = shared_memory_needed(config, 1) - shared_memory_needed(config, 0);
        let snapshots = SNAPSHOTS as usize * SnapshotLayout::of(config).values() * size_of::<f32>();
        (most as f64 / 1e6, (records as f64 + snapshots as f64) / 1e6)
    }
}

fn await_flight(mut batch: Batch) {
    batch.next(&AtomicBool::new(false)).unwrap().unwrap();
}

/// Ends an actor as its supervisor would.
fn end(mut actor: Child) {
    kill_process(Pid::from_child(&actor), Signal::TERM).unwrap();
    assert!(actor.wait().unwrap().success());
}

fn start_of_an_empty_process() -> f64 {
    let began = Instant::now();
    let status = Command::new(program("skein-actor"))
        .arg("--version")
        .stdout(Stdio::null())
        .status();
    assert!(status.unwrap().success());
    began.elapsed().as_secs_f64() * 1e3
}

fn median(mut figures: Vec<f64>) -> f64 {
    figures.sort_by(f64::total_cmp);
    figures[figures.len() / 2]
}

/// Tells the figure `name`, in `unit`, beside its `baseline`, by name and in the same unit.
fn report(name: &str, figure: f64, unit: &str, (baseline_name, baseline): (&str, f64)) {
    eprintln!("{name:<58} {figure:>12.2} {unit:<10} {baseline:>12.2} {baseline_name}");
    let line = serde_json::json!({ "name": name, "figure": figure, "unit": unit, "baseline": baseline, "baseline_name": baseline_name });
    println!("{line}");
}
