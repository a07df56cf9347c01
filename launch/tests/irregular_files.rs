//! Pipes and devices in the place of files: each is refused by name, and none is waited for.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::thread::sleep;
use std::time::{Duration, Instant};

use skein_protocol::config::Config;
use skein_run::RunDirectory;

/// Time that a refusal may take; reading a pipe without a writer takes forever.
const DEADLINE: Duration = Duration::from_secs(30);

fn configs() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs")
}

/// A folder to work in, with `skein` and what it looks for beside itself.
struct Workplace(tempfile::TempDir);

impl Workplace {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        fs::create_dir(at("bin")).unwrap();
        fs::copy(env!("CARGO_BIN_EXE_skein"), at("bin/skein")).unwrap();
        // Every refusal comes before they start.
        for program in ["bin/skein-learner", "bin/skein-actor"] {
            File::create(at(program)).unwrap();
        }
        Self(folder)
    }

    fn at(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    /// Runs `skein`, which must fail within [`DEADLINE`] and name `file`.
    fn assert_refused(&self, arguments: &[&str], file: &str) {
        let mut child = Command::new(self.at("bin/skein"))
            .args(arguments)
            .current_dir(self.0.path())
            .stdout(File::create(self.at("shown")).unwrap())
            .stderr(File::create(self.at("said")).unwrap())
            .spawn()
            .unwrap();
        let end = Instant::now() + DEADLINE;
        let status = loop {
            match child.try_wait().unwrap() {
                Some(status) => break status,
                None if Instant::now() < end => sleep(Duration::from_millis(10)),
                None => {
                    child.kill().unwrap();
                    child.wait().unwrap();
                    panic!("skein {arguments:?} waits for {file}");
                }
            }
        };
        let said = fs::read_to_string(self.at("said")).unwrap();
        assert_eq!(status.code(), Some(1), "skein {arguments:?}: {said}");
        assert!(
            said.contains(file) && said.contains("not a regular file"),
            "skein {arguments:?} does not name {file}: {said}"
        );
    }
}

/// Puts a pipe without a writer at `path`.
fn make_pipe(path: &Path) {
    // There may be nothing to replace.
    let _ = fs::remove_file(path);
    assert!(Command::new("mkfifo").arg(path).status().unwrap().success());
}

#[test]
fn a_pipe_or_a_device_in_the_place_of_an_argument_is_refused() {
    let work = Workplace::new();
    make_pipe(&work.at("pipe"));
    let snapshot = configs().join("snapshots/generalist.safetensors");
    let snapshot = snapshot.to_str().unwrap();
    let smoke = configs().join("smoke.toml");
    let new_run = [
        "run",
        "--run-dir",
        "run",
        "--config",
        smoke.to_str().unwrap(),
    ];
    for file in ["pipe", "/dev/zero"] {
        let course = format!("courses.training={file}");
        let encoder = format!("vae.start_from={file}");
        let frozen = ["--set", "vae.train_steps=0", "--set", &encoder];
        for arguments in [
            vec!["evaluate", "--snapshot", file],
            vec!["evaluate", "--snapshot", snapshot, "--course", file],
            vec!["evaluate", "--snapshot", snapshot, "--suite", file],
            [&new_run[..], &["--config", file]].concat(),
            [&new_run[..], &["--set", &course]].concat(),
            [&new_run[..], &frozen].concat(),
        ] {
            work.assert_refused(&arguments, file);
        }
    }
    assert!(!work.at("run").exists());
}

#[test]
fn an_experiment_reads_no_pipe() {
    let work = Workplace::new();
    let arguments = ["experiment", "./test.toml", "--report", "--runs", "runs"];
    make_pipe(&work.at("pipe"));
    make_pipe(&work.at("test.toml"));
    work.assert_refused(&arguments, "test.toml");
    fs::remove_file(work.at("test.toml")).unwrap();
    let smoke = configs().join("smoke.toml");
    for (base, suite) in [(Path::new("pipe"), ""), (&smoke, "suite = \"pipe\"\n")] {
        let text = format!(
            "question = \"?\"\nbase = {base:?}\ntables = [\"suite\"]\ncurves = []\n{suite}\
             [[arm]]\nname = \"a\"\nlabel = \"A\"\n"
        );
        fs::write(work.at("test.toml"), text).unwrap();
        work.assert_refused(&arguments, "pipe");
    }
}

#[test]
fn a_pipe_in_a_run_is_refused_by_name() {
    let work = Workplace::new();
    let run = RunDirectory::new(work.at("run"));
    let mut config = Config::default();
    config.courses.training = configs().join("courses/training.toml");
    config.courses.evaluation = vec![config.courses.training.clone()];
    run.create(&config).unwrap();
    for (file, name) in [
        (run.episodes_csv(), "episodes.csv"),
        (run.evaluation_trajectories_csv(), "trajectories.csv"),
        (run.reconstructions(), "reconstructions.safetensors"),
    ] {
        make_pipe(&file);
        work.assert_refused(&["report", "--run", "run"], name);
        fs::remove_file(file).unwrap();
    }
    let snapshot = configs().join("snapshots/generalist.safetensors");
    fs::copy(snapshot, run.latest_snapshot()).unwrap();
    make_pipe(&run.best_snapshot());
    // The latest snapshot is another policy, and is not flown instead.
    let evaluation = ["evaluate", "--run", "run", "--episodes", "1"];
    work.assert_refused(&evaluation, "best.safetensors");
    for (file, name) in [(run.config(), "config.toml"), (run.identity(), "run.json")] {
        make_pipe(&file);
        for arguments in [
            ["report", "--run", "run"],
            ["attach", "--run", "run"],
            ["run", "--resume", "run"],
            ["evaluate", "--run", "run"],
        ] {
            work.assert_refused(&arguments, name);
        }
    }
}
