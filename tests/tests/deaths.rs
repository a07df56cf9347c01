//! Whoever dies, freezes or is cut off, and however often: the run comes to what it would have come
//! to, and leaves nothing behind.

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
use skein_tests::{Ended, Recipe, Role, Running, episodes, run_program};

/// Long enough to be disturbed several times.
fn recipe() -> Recipe {
    Recipe::small().set("run.episodes=100")
}

/// What it comes to when nobody disturbs it. Run once for all tests that are under way at a time;
/// to be asked for before one's own run is started, which would be waited for.
fn calm() -> Arc<Ended> {
    static CALM: Mutex<Weak<Ended>> = Mutex::new(Weak::new());
    let mut known = CALM.lock().unwrap_or_else(PoisonError::into_inner);
    known.upgrade().unwrap_or_else(|| {
        let ended = Arc::new(recipe().finish());
        *known = Arc::downgrade(&ended);
        ended
    })
}

#[test]
fn a_learner_killed_three_times_goes_on_from_its_checkpoints() {
    let calm = calm();
    let mut run = recipe().start();
    for episodes in [10, 30, 70] {
        run.kill_learner_after(episodes);
    }
    let disturbed = run.finish();
    disturbed.assert_same_as(&calm);
    let told = disturbed
        .output
        .stderr
        .matches("killed by signal 9")
        .count();
    assert_eq!(told, 3, "{}", disturbed.output.stderr);
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
    let told = |words: [&str; 2]| {
        terminal
            .lines()
            .any(|line| words.iter().all(|word| line.contains(word)))
    };
    assert!(
        told([name, "damaged"]),
        "nobody was warned of {name}:\n{terminal}"
    );
    assert!(told(["resuming after episode", ""]), "{terminal}");
}

/// The checkpoints that are in their place, oldest first.
fn checkpoints(run: &Running) -> Vec<PathBuf> {
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

/// Lets `remove` take something of the transport from under a run.
fn goes_on_without(remove: impl Fn(&Running, &RunIdentity)) {
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
    goes_on_without(|_, identity| fs::remove_dir_all(identity.transport_folder()).unwrap());
}

#[test]
fn a_run_whose_shared_memory_is_removed_makes_another() {
    goes_on_without(|run, identity| {
        let prefix = format!("skein_{:016x}_", identity.run.0);
        for entry in fs::read_dir("/dev/shm").unwrap() {
            let entry = entry.unwrap();
            if entry.file_name().to_str().unwrap().starts_with(&prefix) {
                // An actor's may go by itself.
                let _ = fs::remove_file(entry.path());
            }
        }
        // Who has mapped it goes on with it; who comes then finds nothing.
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
    // It complains of files that a living run replaces meanwhile, and copies the rest.
    let copied = Command::new("cp")
        .arg("-r")
        .arg(run.directory().root())
        .arg(&copy)
        .status();
    assert!(copied.is_ok(), "{copied:?}");
    // Between two incarnations of the learner, too.
    run.process("skein-learner").signal(Signal::KILL);
    let refused = run_program(
        "skein",
        &["run", "--resume", copy.to_str().unwrap(), "--actors", "1"],
    );
    refused.assert_refused(&["under way in another directory", "copy"]);
    run.finish().assert_same_as(&calm);
}

#[test]
fn an_actor_that_was_frozen_too_long_is_not_mixed_in_when_it_wakes() {
    let calm = calm();
    let mut run = recipe().set("transport.actor_silence_secs=0.5").start();
    run.until_episodes(10);
    let sleeper = run.processes(Role::Actor).remove(0);
    sleeper.signal(Signal::STOP);
    // Whatever it was about to fly is flown by the other: else there would be no further epoch.
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
fn a_frozen_learner_goes_on_where_it_was() {
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
    assert!(learner.is_alive(), "it was over before it was slow");
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
    // Far more than this machine has cores for: patience is all they need.
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

fn episodes_begun(run: &Running) -> bool {
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
fn a_second_learner_of_a_run_is_refused_and_the_first_goes_on() {
    let calm = calm();
    let mut run = recipe().start();
    run.until_episodes(10);
    let second = run_program(
        "skein-learner",
        &["--run", run.directory().root().to_str().unwrap()],
    );
    second.assert_refused(&["another learner"]);
    run.finish().assert_same_as(&calm);
}
