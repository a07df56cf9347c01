//! Early ends of a run: in order, immediately, or with its supervisor. Nothing is left behind.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use std::fs::OpenOptions;
use std::io::Write;
use std::process::{Command, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use rustix::fs::{OFlags, fcntl_getfl, fcntl_setfl};
use rustix::process::{Pid, Signal, kill_process};
use skein_protocol::snapshot::Snapshot;
use skein_protocol::summary::RunEnding;
use skein_run::RunDirectory;
use skein_tests::{RunRecipe, RunningRun, episodes, leftovers, processes_of, program, repository};

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

/// As `nohup skein run … >/dev/full 2>&1 &` in a script, whose terminal then closes.
#[test]
fn a_run_whose_terminal_is_lost_completes_and_ignored_signals_stay_ignored() {
    let folder = tempfile::tempdir().unwrap();
    let directory = RunDirectory::new(folder.path().canonicalize().unwrap().join("run"));
    let full = || OpenOptions::new().write(true).open("/dev/full").unwrap();
    let mut supervisor = Command::new("sh")
        .args(["-c", "trap '' HUP INT TERM; exec \"$@\"", "sh"])
        .arg(program("skein"))
        .args(["run", "--actors", "1", "--config"])
        .arg(repository().join("tests/small.toml"))
        .arg("--run-dir")
        .arg(directory.root())
        .stdout(full())
        .stderr(full())
        .spawn()
        .unwrap();
    let deadline = Instant::now() + Duration::from_secs(120);
    while episodes(&directory).len() < 10 {
        assert!(Instant::now() < deadline, "never ten episodes");
        assert_eq!(supervisor.try_wait().unwrap(), None, "the run ended");
        sleep(Duration::from_millis(20));
    }
    let pid = Pid::from_raw(supervisor.id().cast_signed()).unwrap();
    for signal in [Signal::HUP, Signal::INT, Signal::TERM] {
        kill_process(pid, signal).unwrap();
    }
    assert!(supervisor.wait().unwrap().success());
    let summary = directory.summary().unwrap();
    assert_eq!(summary.ending, RunEnding::Completed);
    assert!(directory.evaluation_json().is_file());
}

/// As behind Ctrl-S, or a connection that hangs: a write to such a terminal waits for ever.
#[test]
fn a_run_whose_terminal_takes_no_more_completes() {
    let folder = tempfile::tempdir().unwrap();
    let directory = RunDirectory::new(folder.path().canonicalize().unwrap().join("run"));
    let (_reader, mut pipe) = std::io::pipe().unwrap();
    let flags = fcntl_getfl(&pipe).unwrap();
    fcntl_setfl(&pipe, flags | OFlags::NONBLOCK).unwrap();
    while pipe.write(&[b'x'; 4096]).is_ok() {}
    fcntl_setfl(&pipe, flags).unwrap();
    let mut supervisor = Command::new(program("skein"))
        .args(["run", "--actors", "1", "--config"])
        .arg(repository().join("tests/small.toml"))
        .arg("--run-dir")
        .arg(directory.root())
        .stdout(Stdio::null())
        .stderr(pipe)
        .spawn()
        .unwrap();
    let deadline = Instant::now() + Duration::from_secs(120);
    let status = loop {
        if let Some(status) = supervisor.try_wait().unwrap() {
            break status;
        }
        if Instant::now() >= deadline {
            supervisor.kill().unwrap();
            panic!("it waits for its terminal");
        }
        sleep(Duration::from_millis(20));
    };
    assert!(status.success());
    assert_eq!(directory.summary().unwrap().ending, RunEnding::Completed);
}

/// As Ctrl-Z, and later fg. The processes of the run are not stopped: each leads its own group.
#[test]
fn a_supervisor_stopped_for_longer_than_its_deadlines_continues_where_it_was() {
    let mut run = RunRecipe::small()
        .set("run.episodes=1000000")
        .set("transport.learner_silence_secs=6")
        .start();
    run.until_episodes(10);
    run.signal(Signal::STOP);
    // Longer than the 5 s after which it takes a silent learner for frozen.
    sleep(Duration::from_secs(7));
    run.signal(Signal::CONT);
    let flown = episodes(run.directory()).len();
    run.until_episodes(flown + 20);
    run.signal(Signal::INT);
    let ended = run.wait();
    assert_eq!(ended.output.code, Some(INTERRUPTED));
    for blame in ["killing it", "restarting", "found no learner"] {
        assert!(
            !ended.output.stderr.contains(blame),
            "{}",
            ended.output.stderr
        );
    }
}

#[test]
fn a_run_whose_directory_is_removed_says_so() {
    let run = long_run();
    // Moved, not removed: that is done at once, whatever the processes create meanwhile.
    let root = run.directory().root().to_owned();
    std::fs::rename(&root, root.with_extension("moved")).unwrap();
    let ended = run.wait();
    assert!(!root.exists(), "a checkpoint made the folder again");
    ended
        .output
        .assert_refused(&["was removed", "start a new run"]);
    assert!(
        !ended.output.stderr.contains("--resume"),
        "{}",
        ended.output.stderr
    );
}
