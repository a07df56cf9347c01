//! Invalid requests are refused with one line that names the remedy, and leave nothing behind.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use std::fs;
use std::path::Path;
use std::process::Command;

use skein_tests::{ProgramOutput, RunRecipe, program, repository, run_program};
use tempfile::TempDir;

/// A `skein run` with a configuration of its own, which must be refused.
struct Attempt {
    folder: TempDir,
}

impl Attempt {
    /// Prepares `tests/small.toml` with `more` appended.
    fn new(more: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let courses = repository().join("configs/courses");
        let text = fs::read_to_string(repository().join("tests/small.toml"))
            .unwrap()
            .replace("../configs/courses", courses.to_str().unwrap());
        fs::write(folder.path().join("mine.toml"), text + more).unwrap();
        Self { folder }
    }

    fn path(&self) -> &Path {
        self.folder.path()
    }

    fn run(&self, arguments: &[&str]) -> ProgramOutput {
        let (config, run) = (self.path().join("mine.toml"), self.path().join("run"));
        let basic = [
            "run",
            "--config",
            config.to_str().unwrap(),
            "--run-dir",
            run.to_str().unwrap(),
            "--actors",
            "1",
        ];
        run_program("skein", &[&basic, arguments].concat())
    }

    fn assert_refused(&self, arguments: &[&str], parts: &[&str]) {
        self.run(arguments).assert_refused(parts);
        assert!(
            !self.path().join("run").exists(),
            "a directory was created for an impossible run"
        );
    }
}

#[test]
fn a_directory_that_is_not_empty_is_refused() {
    let attempt = Attempt::new("");
    let run = attempt.path().join("run");
    fs::create_dir(&run).unwrap();
    fs::write(run.join("precious"), "data").unwrap();
    attempt
        .run(&[])
        .assert_refused(&[run.to_str().unwrap(), "not empty", "--run-dir"]);
    assert_eq!(
        fs::read_dir(&run).unwrap().count(),
        1,
        "something was written into the directory"
    );
}

#[test]
fn an_unknown_key_section_or_setting_is_refused() {
    Attempt::new("[replay]\ncapcity = 1000\n")
        .assert_refused(&[], &["mine.toml", "[replay]", "capcity"]);
    Attempt::new("[replays]\n").assert_refused(&[], &["mine.toml", "[replays]"]);
    Attempt::new("[simulator.camera]\nzoom = 2\n")
        .assert_refused(&[], &["mine.toml", "[simulator]", "zoom"]);
    let sound = Attempt::new("");
    sound.assert_refused(&["--set", "run.sede=1"], &["[run]", "sede"]);
    sound.assert_refused(&["--set", "seed=1"], &["--set seed=1", "section.key=value"]);
    sound.assert_refused(&["--set", "run.episodes=many"], &["[run]", "episodes"]);
    sound.assert_refused(
        &["--set", "learning.policy_lag=2"],
        &["learning.policy_lag = 2", "above 1"],
    );
}

#[test]
fn a_missing_configuration_or_course_is_refused() {
    let attempt = Attempt::new("");
    let missing = attempt.path().join("missing");
    let (config, course) = (missing.join("mine.toml"), missing.join("course.toml"));
    let (config, course) = (config.to_str().unwrap(), course.to_str().unwrap());
    attempt.assert_refused(&["--config", config], &[config]);
    attempt.assert_refused(&["--set", &format!("courses.training={course}")], &[course]);
}

#[test]
fn a_course_that_cannot_be_flown_is_refused() {
    let attempt = Attempt::new("");
    let shipped = fs::read_to_string(repository().join("configs/courses/training.toml")).unwrap();
    let bent = attempt.path().join("bent.toml");
    let set = format!("courses.training={}", bent.display());
    let refused = |from: &str, to: &str, parts: &[&str]| {
        let text = shipped.replacen(from, to, 1);
        assert_ne!(text, shipped, "`{from}` is not in the shipped course");
        fs::write(&bent, text).unwrap();
        attempt.assert_refused(&["--set", &set], &[&["bent.toml"], parts].concat());
    };
    refused(
        "width_m = 2.2",
        "width_m = 0.1",
        &["wall 1", "width_m = 0.1", "drone"],
    );
    refused(
        "centre_m = ",
        "centre_m = [2.9, 3.5] # ",
        &["wall 1", "centre_m"],
    );

    // An unknown key is shown in its context, on several lines.
    fs::write(&bent, shipped.replacen("width_m = 2.2", "girth_m = 2.2", 1)).unwrap();
    let output = attempt.run(&["--set", &set]);
    output.assert_refused(&["bent.toml", "wall 1"]);
    assert!(
        output.stderr.contains("unknown field `girth_m`"),
        "{}",
        output.stderr
    );
}

#[test]
fn a_device_that_this_machine_does_not_have_is_refused() {
    let run = RunRecipe::small().set("run.device=cuda:7").start().wait();
    assert_eq!(run.output.code, Some(1));
    run.output.assert_refused(&["cuda:7", "cpu"]);
    assert!(
        !run.directory.root().exists(),
        "the directory of a run that never began remains"
    );
    run.assert_nothing_is_left();
}

#[test]
fn an_actor_for_a_missing_or_complete_run_is_refused() {
    let empty = tempfile::tempdir().unwrap();
    let missing = empty.path().join("missing");
    let missing = missing.to_str().unwrap();
    run_program("skein", &["attach", "--run", missing]).assert_refused(&[missing]);
    let directory = empty.path().to_str().unwrap();
    run_program("skein", &["attach", "--run", directory]).assert_refused(&[directory]);
    let over = RunRecipe::small().set("run.episodes=1").finish();
    let directory = over.directory.root().to_str().unwrap();
    run_program("skein", &["attach", "--run", directory])
        .assert_refused(&[directory, "not under way"]);
}

#[test]
fn too_little_shared_memory_is_refused() {
    // A private mount, which not every machine allows.
    let attempt = Attempt::new("");
    let (config, run) = (attempt.path().join("mine.toml"), attempt.path().join("run"));
    let script = format!(
        "mount -t tmpfs -o size=8m tmpfs /dev/shm || exit 77; exec {} run --config {} --run-dir \
         {} --actors 2",
        program("skein").display(),
        config.display(),
        run.display()
    );
    let output = Command::new("unshare")
        .args(["--mount", "--map-root-user", "sh", "-c", &script])
        .output();
    let Ok(output) = output else {
        eprintln!("skipped: unshare is not installed");
        return;
    };
    let stderr = String::from_utf8_lossy(&output.stderr);
    if output.status.code() == Some(77) || stderr.contains("unshare") {
        eprintln!("skipped: this user may not mount: {stderr}");
        return;
    }
    assert_eq!(output.status.code(), Some(1), "{stderr}");
    for part in [
        "/dev/shm has 8 MiB free",
        "2 actors",
        "--actors",
        "remount,size=",
        "--shm-size=",
    ] {
        assert!(stderr.contains(part), "`{part}` is missing in {stderr}");
    }
    assert!(!run.exists());
}

/// Runs `command` in a shell that limits the address space of each process.
fn limited(kib: u64, command: &str) -> ProgramOutput {
    let output = Command::new("bash")
        .args(["-c", &format!("ulimit -v {kib}; exec {command}")])
        // With it, the standard library waited forever for memory to print where memory ran out.
        .env("RUST_BACKTRACE", "1")
        .output()
        .unwrap();
    ProgramOutput {
        code: output.status.code(),
        stdout: String::from_utf8_lossy(&output.stdout).into_owned(),
        stderr: String::from_utf8_lossy(&output.stderr).into_owned(),
    }
}

#[test]
fn a_run_whose_learner_has_too_little_memory_is_refused() {
    let attempt = Attempt::new("");
    let (config, run) = (attempt.path().join("mine.toml"), attempt.path().join("run"));
    let command = format!(
        "{} run --config {} --run-dir {} --actors 1",
        program("skein").display(),
        config.display(),
        run.display()
    );
    limited(500_000, &command).assert_refused(&["the learner needs", "488 MiB", "ulimit -v"]);
    assert!(!run.exists());
    let command = format!("{} encoder --help", program("skein").display());
    limited(400_000, &command).assert_refused(&["libtorch", "390 MiB", "ulimit -v"]);
}

/// Whatever fails first for want of memory: nothing waits, and who gets as far as to say something
/// names the limit.
#[test]
fn a_program_that_is_refused_memory_ends_at_once_and_names_the_limit() {
    let snapshot = repository().join("configs/snapshots/generalist.safetensors");
    let course = repository().join("configs/courses/training.toml");
    let command = format!(
        "timeout 60 {} --snapshot {} --course {} --episodes 1 --threads 1",
        program("skein-evaluate").display(),
        snapshot.display(),
        course.display()
    );
    let mut refused = 0;
    for kib in (10_000..=24_000).step_by(2_000) {
        let output = limited(kib, &command);
        assert_ne!(
            output.code,
            Some(124),
            "it hangs with {kib} KiB: {output:?}"
        );
        if output.stderr.contains("out of memory") {
            assert_eq!(output.code, Some(1), "{output:?}");
            output.assert_refused(&["skein-evaluate: out of memory", "MiB", "ulimit -v"]);
            refused += 1;
        }
    }
    assert!(refused > 0, "no limit was between too much and too little");
}

#[test]
fn an_impossible_resumption_is_refused() {
    let empty = tempfile::tempdir().unwrap();
    let directory = empty.path().to_str().unwrap();
    run_program("skein", &["run", "--resume", directory]).assert_refused(&[directory, "run.json"]);
    let with_config = run_program(
        "skein",
        &["run", "--resume", directory, "--set", "run.seed=2"],
    );
    assert_eq!(with_config.code, Some(2));
    assert!(
        with_config
            .stderr
            .contains("the configuration it was started with"),
        "{}",
        with_config.stderr
    );

    let mut running = RunRecipe::small().start();
    running.until_episodes(1);
    let root = running.directory().root().to_owned();
    let directory = root.to_str().unwrap();
    run_program("skein", &["run", "--resume", directory]).assert_refused(&[
        directory,
        "under way",
        "attach_actor.sh",
    ]);
    let _complete = running.finish();
    run_program("skein", &["run", "--resume", directory]).assert_refused(&[
        directory,
        "complete",
        "40 episodes",
    ]);
}

#[test]
fn an_evaluation_without_a_run_or_snapshot_is_refused() {
    let empty = tempfile::tempdir().unwrap();
    let missing = empty.path().join("missing");
    let missing = missing.to_str().unwrap();
    for option in ["--run", "--snapshot"] {
        run_program("skein-evaluate", &[option, missing]).assert_refused(&[missing]);
    }
}
