//! Early ends of a run: in order, immediately, or with its supervisor. Nothing is left behind.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use std::time::{Duration, Instant};

use rustix::process::Signal;
use skein_protocol::snapshot::Snapshot;
use skein_protocol::summary::RunEnding;
use skein_tests::{RunRecipe, RunningRun, leftovers, processes_of};

/// Exit status that a shell reports for a program ended by Ctrl-C: 128 + SIGINT.
const INTERRUPTED: i32 = 130;

/// Starts a run of many hours and lets it proceed a little.
fn long_run() -> RunningRun {
    let mut run = RunRecipe::small().set("run.episodes=1000000").start();
    run.until_episodes(20);
    run
}

#[test]
fn the_first_interruption_saves_everything_learned() {
    let run = long_run();
    run.signal(Signal::INT);
    let ended = run.wait();
    assert_eq!(
        ended.output.code,
        Some(INTERRUPTED),
        "{}",
        ended.output.stderr
    );
    ended.assert_nothing_is_left();

    let summary = ended.summary();
    assert_eq!(summary.ending, RunEnding::Interrupted);
    assert!(summary.episodes >= 20 && summary.updates > 0, "{summary:?}");
    let (latest, _) = Snapshot::load(&ended.directory.latest_snapshot()).unwrap();
    assert_eq!(latest.sha256(), summary.policy_sha256);
    assert_eq!(
        ended.episodes().len() as u64,
        summary.episodes,
        "the listed episodes are not those learned from"
    );
    let checkpoint = ended
        .directory
        .checkpoints()
        .join(format!("episode-{}", summary.episodes));
    assert!(
        checkpoint.join("manifest.json").is_file(),
        "no {checkpoint:?}"
    );
    for plot in ["return.png", "walls_passed.png"] {
        assert!(
            ended.directory.plots().join(plot).is_file(),
            "{plot} could have been drawn"
        );
    }
    assert!(
        ended.output.stdout.contains("Interrupted after"),
        "{}",
        ended.output.stdout
    );
}

#[test]
fn the_second_interruption_ends_the_run_immediately() {
    let mut run = long_run();
    // A frozen learner cannot stop in order.
    let processes = processes_of(run.directory());
    let learner = processes
        .iter()
        .find(|process| process.runs("skein-learner"))
        .unwrap();
    learner.signal(Signal::STOP);
    run.signal(Signal::INT);
    run.until("the first interruption was handled", |run| {
        run.stderr().contains("stopping: finishing").then_some(())
    });
    run.signal(Signal::INT);
    let begun = Instant::now();
    let ended = run.wait();
    assert_eq!(
        ended.output.code,
        Some(INTERRUPTED),
        "{}",
        ended.output.stderr
    );
    ended.assert_nothing_is_left();
    assert!(
        begun.elapsed() < Duration::from_secs(10),
        "it took {:?}",
        begun.elapsed()
    );
    assert!(!ended.directory.summary_json().exists());
}

#[test]
fn no_process_outlives_a_killed_supervisor_not_even_a_frozen_one() {
    let run = long_run();
    let directory = run.directory().clone();
    let processes = processes_of(&directory);
    assert_eq!(processes.len(), 4, "supervisor, learner, two actors");
    let learner = processes
        .iter()
        .find(|process| process.runs("skein-learner"))
        .unwrap();
    learner.signal(Signal::STOP);
    run.signal(Signal::KILL);
    let begun = Instant::now();
    while !processes_of(&directory).is_empty() {
        assert!(
            begun.elapsed() < Duration::from_secs(5),
            "still running: {:?}",
            leftovers(&directory)
        );
        std::thread::sleep(Duration::from_millis(10));
    }
}

#[test]
fn a_run_between_two_incarnations_of_its_learner_stops_in_order() {
    let mut run = long_run();
    let processes = processes_of(run.directory());
    let learner = processes
        .iter()
        .find(|process| process.runs("skein-learner"))
        .unwrap();
    learner.signal(Signal::KILL);
    run.until("the learner was restarted", |run| {
        run.stderr()
            .contains("the learner was killed by signal 9; restarting it now")
            .then_some(())
    });
    run.signal(Signal::INT);
    let ended = run.wait();
    assert_eq!(
        ended.output.code,
        Some(INTERRUPTED),
        "{}",
        ended.output.stderr
    );
    let last = ended.output.stderr.lines().last().unwrap_or_default();
    assert!(
        last.ends_with(&format!(
            "launch/run_local.sh --resume {}",
            ended.directory.root().display()
        )),
        "{last}"
    );
    ended.assert_nothing_is_left();
}
