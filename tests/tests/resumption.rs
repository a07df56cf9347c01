//! Runs that are cut off, resumed, and cleared away.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use std::process::{Command, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use rustix::process::Signal;
use skein_run::RunDirectory;
use skein_tests::{RunRecipe, episodes, leftovers, processes_of, program, repository};

fn recipe() -> RunRecipe {
    RunRecipe::small().set("run.episodes=80")
}

#[test]
fn a_run_cut_off_and_resumed_with_other_numbers_of_actors_has_the_same_result() {
    let calm = recipe().finish();

    let mut run = recipe().start();
    run.until_episodes(30);
    run.cut_off();
    run.resume(1);
    run.until_episodes(50);
    run.signal(Signal::INT);
    run.resume(3);
    let ended = run.finish();
    ended.assert_same_as(&calm);
    assert!(
        ended.output.stdout.contains("Completed after"),
        "{}",
        ended.output.stdout
    );
    for actor in ["actor-0", "actor-1", "actor-2"] {
        let log = ended.directory.logs().join(format!("{actor}.log"));
        assert!(log.is_file(), "{} should have been claimed", log.display());
    }
    assert!(
        !ended.directory.logs().join("actor-3.log").exists(),
        "ids of dead actors were not reused"
    );
}

#[test]
fn a_finished_run_that_is_lengthened_has_the_result_of_a_run_of_that_length() {
    let calm = recipe().finish();

    // 35 episodes end in the middle of an epoch.
    let mut run = RunRecipe::small().set("run.episodes=35").start();
    run.until_ended();
    run.resume_with(1, &["--episodes", "80"]);
    let ended = run.finish();
    ended.assert_same_as(&calm);
    assert!(
        ended
            .output
            .stderr
            .contains("end of the run of 35 episodes"),
        "{}",
        ended.output.stderr
    );
}

#[test]
fn a_run_whose_processes_die_one_after_another_has_the_same_result() {
    let calm = recipe().finish();

    let mut run = recipe().start();
    run.until_episodes(10);
    run.process("skein-learner").signal(Signal::KILL);
    run.until_episodes(30);
    run.process("skein-actor").signal(Signal::KILL);
    run.until_episodes(50);
    // Only the learner notices: its tickets go to the other actor.
    run.process("skein-actor").signal(Signal::STOP);
    run.until_episodes(60);
    run.process("skein-learner").signal(Signal::KILL);
    let ended = run.finish();
    ended.assert_same_as(&calm);
    assert_eq!(
        ended
            .output
            .stderr
            .matches("the learner was killed by signal 9")
            .count(),
        2,
        "{}",
        ended.output.stderr
    );
}

#[test]
fn the_next_start_removes_the_remains_of_a_killed_run_and_nothing_of_a_live_one() {
    let mut beside = RunRecipe::small().set("run.episodes=1000000").start();
    beside.until_episodes(1);

    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path().canonicalize().unwrap();
    let killed = RunDirectory::new(folder.join("killed"));
    let start = |directory: &RunDirectory, episodes: u64| {
        Command::new(program("skein"))
            .arg("run")
            .arg("--config")
            .arg(repository().join("tests/small.toml"))
            .arg("--run-dir")
            .arg(directory.root())
            .args([
                "--actors",
                "1",
                "--set",
                &format!("run.episodes={episodes}"),
            ])
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap()
    };
    let mut supervisor = start(&killed, 1_000_000);
    let deadline = Instant::now() + Duration::from_secs(60);
    while episodes(&killed).is_empty() {
        assert!(Instant::now() < deadline, "never an episode");
        sleep(Duration::from_millis(20));
    }
    for process in processes_of(&killed) {
        process.signal(Signal::KILL);
    }
    supervisor.wait().unwrap();
    while !processes_of(&killed).is_empty() {
        sleep(Duration::from_millis(5));
    }
    assert!(
        !leftovers(&killed).is_empty(),
        "without remains of the killed run the test shows nothing"
    );

    let flown = episodes(beside.directory()).len();
    assert!(
        start(&RunDirectory::new(folder.join("next")), 1)
            .wait()
            .unwrap()
            .success()
    );
    assert_eq!(leftovers(&killed), Vec::<String>::new());
    beside.until_episodes(flown + 20);
}
