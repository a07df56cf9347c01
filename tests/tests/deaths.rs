//! A run has the same results and leaves nothing behind, whichever of its processes die, freeze or
//! are cut off, and however often.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use std::fs;
use std::path::PathBuf;
use std::process::Command;
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::thread::sleep;
use std::time::{Duration, Instant};

use rustix::process::Signal;
use skein_chaos::{Footprint, footprint};
use skein_run::RunIdentity;
use skein_tests::{EndedRun, Role, RunRecipe, RunningRun, episodes, run_program};

/// A run long enough to be disturbed several times.
fn recipe() -> RunRecipe {
    RunRecipe::small().set("run.episodes=100")
}

/// Returns the undisturbed run, shared by all tests that run at the same time. A test must request
/// it before it starts its own run, which would block it.
fn calm() -> Arc<EndedRun> {
    static CALM: Mutex<Weak<EndedRun>> = Mutex::new(Weak::new());
    let mut known = CALM.lock().unwrap_or_else(PoisonError::into_inner);
    known.upgrade().unwrap_or_else(|| {
        let ended = Arc::new(recipe().finish());
        *known = Arc::downgrade(&ended);
        ended
    })
}

#[test]
fn a_learner_killed_three_times_resumes_from_its_checkpoints() {
    let calm = calm();
    let mut run = recipe().start();
    for episodes in [10, 30, 70] {
        run.kill_learner_after(episodes);
    }
    let disturbed = run.finish();
    disturbed.assert_same_as(&calm);
    let deaths = disturbed
        .output
        .stderr
        .matches("killed by signal 9")
        .count();
    assert_eq!(deaths, 3, "{}", disturbed.output.stderr);
}

#[test]
fn a_run_whose_supervisor_was_killed_is_resumed_with_another_number_of_actors() {
    let calm = calm();
    let mut run = recipe().start();
    run.until_episodes(50);
    run.kill_supervisor();
    run.resume(3);
    run.finish().assert_same_as(&calm);
}

#[test]
fn after_a_power_cut_a_damaged_checkpoint_is_named_and_the_one_before_it_used() {
    let calm = calm();
    let mut run = recipe().start();
    run.until("there were two checkpoints", |run| {
        (checkpoints(run).len() >= 2).then_some(())
    });
    run.cut_off();
    let newest = checkpoints(&run).pop().unwrap();
    let file = newest.join("tensors.safetensors");
    let mut bytes = fs::read(&file).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    fs::write(&file, bytes).unwrap();
    run.resume(2);
    let resumed = run.finish();
    resumed.assert_same_as(&calm);
    let name = newest.file_name().unwrap().to_str().unwrap();
    let terminal = &resumed.output.stderr;
    let printed = |words: [&str; 2]| {
        terminal
            .lines()
            .any(|line| words.iter().all(|word| line.contains(word)))
    };
    assert!(
        printed([name, "damaged"]),
        "no warning about {name}:\n{terminal}"
    );
    assert!(printed(["resuming after episode", ""]), "{terminal}");
}

/// Returns the complete checkpoints, oldest first.
fn checkpoints(run: &RunningRun) -> Vec<PathBuf> {
    let number = |path: &PathBuf| -> Option<u64> {
        path.file_name()?
            .to_str()?
            .strip_prefix("episode-")?
            .parse()
            .ok()
    };
    let mut found: Vec<_> = fs::read_dir(run.directory().checkpoints())
        .into_iter()
        .flatten()
        .map(|entry| entry.unwrap().path())
        .filter(|path| number(path).is_some())
        .collect();
    found.sort_by_key(number);
    found
}

/// Asserts that a run survives the loss of a part of its transport, removed by `remove`.
fn survives_loss_of(remove: impl Fn(&RunningRun, &RunIdentity)) {
    let calm = calm();
    let mut run = recipe().start();
    run.until_episodes(30);
    remove(&run, &run.directory().open().unwrap().0);
    let disturbed = run.finish();
    disturbed.assert_same_as(&calm);
    assert!(disturbed.summary().resumes > 0, "{:?}", disturbed.summary());
    let terminal = &disturbed.output.stderr;
    assert!(
        terminal.contains("was removed") && terminal.contains("do not remove skein's files"),
        "{terminal}"
    );
}

#[test]
fn a_run_whose_folder_is_removed_makes_another() {
    survives_loss_of(|_, identity| fs::remove_dir_all(identity.transport_folder()).unwrap());
}

#[test]
fn a_run_whose_shared_memory_is_removed_makes_another() {
    survives_loss_of(|run, identity| {
        let prefix = format!("skein_{:016x}_", identity.run.0);
        for entry in fs::read_dir("/dev/shm").unwrap() {
            let entry = entry.unwrap();
            if entry.file_name().to_str().unwrap().starts_with(&prefix) {
                // An actor may remove its own at any time.
                let _ = fs::remove_file(entry.path());
            }
        }
        // Processes that have mapped it continue; new ones find nothing.
        run.processes(Role::Actor)
            .iter()
            .for_each(|actor| actor.signal(Signal::KILL));
    });
}

#[test]
fn a_copy_of_a_runs_directory_is_not_resumed_while_the_run_is_under_way() {
    let calm = calm();
    let mut run = recipe().start();
    run.until_episodes(30);
    let copies = tempfile::tempdir().unwrap();
    let copy = copies.path().join("copy");
    // cp complains about files that a live run replaces meanwhile, and copies the rest.
    let copied = Command::new("cp")
        .arg("-r")
        .arg(run.directory().root())
        .arg(&copy)
        .status();
    assert!(copied.is_ok(), "{copied:?}");
    // The copy is refused even between two incarnations of the learner.
    run.process("skein-learner").signal(Signal::KILL);
    let refused = run_program(
        "skein",
        &["run", "--resume", copy.to_str().unwrap(), "--actors", "1"],
    );
    refused.assert_refused(&["under way in another directory", "copy"]);
    run.finish().assert_same_as(&calm);
}

#[test]
fn late_records_of_an_actor_frozen_too_long_are_refused() {
    let calm = calm();
    let mut run = recipe().set("transport.actor_silence_secs=0.5").start();
    run.until_episodes(10);
    let sleeper = run.processes(Role::Actor).remove(0);
    sleeper.signal(Signal::STOP);
    // The other actor flies its tickets; otherwise no further epoch would follow.
    run.until_episodes(30);
    sleeper.signal(Signal::CONT);
    let disturbed = run.finish();
    disturbed.assert_same_as(&calm);
    assert!(
        disturbed.summary().tickets_reissued > 0,
        "{:?}",
        disturbed.summary()
    );
}

#[test]
fn a_frozen_learner_continues_where_it_was() {
    let calm = calm();
    let mut run = recipe()
        .set("transport.learner_silence_secs=2")
        .set("transport.actor_silence_secs=1")
        .start();
    run.until_episodes(30);
    let learner = run.process("skein-learner");
    learner.signal(Signal::STOP);
    // Longer than actors wait, so that all of them leave.
    run.until("the actors gave the learner up", |run| {
        run.processes(Role::Actor).is_empty().then_some(())
    });
    learner.signal(Signal::CONT);
    run.finish().assert_same_as(&calm);
}

#[test]
fn a_learner_slowed_down_ten_times_holds_the_actors_back_and_nothing_is_lost() {
    let calm = calm();
    let mut run = recipe().actors(4).start();
    run.until_episodes(10);
    let learner = run.process("skein-learner");
    let end = Instant::now() + Duration::from_secs(6);
    while Instant::now() < end {
        learner.signal(Signal::STOP);
        sleep(Duration::from_millis(45));
        learner.signal(Signal::CONT);
        sleep(Duration::from_millis(5));
    }
    assert!(
        learner.is_alive(),
        "the run ended before the learner was slowed down"
    );
    let slowed = run.finish();
    slowed.assert_same_as(&calm);
    let summary = slowed.summary();
    assert_eq!(
        (summary.tickets_reissued, summary.records_refused),
        (0, 0),
        "{summary:?}"
    );
}

#[test]
fn sixty_four_actors_lose_nothing_and_take_bounded_memory() {
    let calm = calm();
    // More actors than this machine has cores for; long deadlines allow for that.
    let mut run = recipe()
        .actors(64)
        .set("transport.actor_silence_secs=60")
        .set("transport.learner_silence_secs=60")
        .set("transport.episode_deadline_secs=600")
        .start();
    let mut most = Footprint::default();
    let id = run.until("the run had an identity", |run| {
        Some(run.directory().open().ok()?.0.run)
    });
    run.until("all actors were there", |run| {
        let now = footprint(id);
        most.segment_bytes = most.segment_bytes.max(now.segment_bytes);
        (run.processes(Role::Actor).len() == 64 && episodes_begun(run)).then_some(())
    });
    let ended = run.finish();
    ended.assert_same_as(&calm);
    let summary = ended.summary();
    assert_eq!(
        (summary.tickets_reissued, summary.records_refused),
        (0, 0),
        "{summary:?}"
    );
    assert!(most.segment_bytes < 64 * 5_200_000 + 64_000_000, "{most:?}");
}

fn episodes_begun(run: &RunningRun) -> bool {
    !episodes(run.directory()).is_empty()
}

#[test]
fn two_runs_side_by_side_never_meet() {
    let calm = calm();
    let one = recipe().start();
    let other = recipe().set("run.seed=2").start_beside(&one);
    let (one, other) = (one.finish(), other.finish());
    one.assert_same_as(&calm);
    assert_eq!(other.episodes().len(), 100);
    for run in [&one, &other] {
        let summary = run.summary();
        assert_eq!(
            (summary.tickets_reissued, summary.records_refused),
            (0, 0),
            "{summary:?}"
        );
    }
}

#[test]
fn a_second_learner_of_a_run_is_refused_and_the_first_continues() {
    let calm = calm();
    let mut run = recipe().start();
    run.until_episodes(10);
    // So that the run is not over before the second one asks.
    let first = run.process("skein-learner");
    first.signal(Signal::STOP);
    let second = run_program(
        "skein-learner",
        &["--run", run.directory().root().to_str().unwrap()],
    );
    first.signal(Signal::CONT);
    second.assert_refused(&["another learner"]);
    run.finish().assert_same_as(&calm);
}
