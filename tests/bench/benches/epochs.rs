//! Cost of epochs: microseconds of a run per environment step, against the length of epochs.
//!
//! The real programs run with two actors, which fly at random and learn nothing. Every run flies
//! the same episodes, and only the number of epochs differs. The cost beyond flying is ordering
//! episodes, waiting for the last of an epoch, and publishing a snapshot. Each figure is a line of
//! JSON; `--quick` flies few episodes.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use serde_json::json;
use skein_protocol::summary::RunSummary;
use skein_run::RunDirectory;

/// Settings of every run: nothing is learned, and hardly anything evaluated.
const SETTINGS: [&str; 11] = [
    "simulator.vehicle.preset=airsim",
    "learning.warmup_steps=100000",
    "learning.updates_per_step=0",
    "vae.train_steps=1",
    "vae.updates_per_step=1e-9",
    "sac.hidden_width=256",
    "evaluation.episodes=1",
    "evaluation.confirm_episodes=1",
    "evaluation.every_episodes=1000000",
    "checkpoints.every_episodes=1000000",
    "run.learner_threads=1",
];

fn main() {
    let quick = std::env::args().any(|argument| argument == "--quick");
    let (episodes, lengths) = if quick {
        (20, &[10][..])
    } else {
        (800, &[1, 2, 5, 10, 20, 50, 100, 200][..])
    };
    for length in lengths {
        let summary = run(episodes, *length);
        println!(
            "{}",
            json!({
                "name": format!("epochs/step/{length}"),
                "figure": summary.wall_secs / summary.steps as f64 * 1e6,
                "unit": "µs",
            })
        );
    }
}

/// Runs `episodes` in epochs of `length`.
fn run(episodes: u64, length: u64) -> RunSummary {
    let folder = tempfile::tempdir().expect("there is room for a run");
    let directory = folder.path().join("run");
    let mut command = Command::new(skein());
    command
        .args(["run", "--actors", "2", "--run-dir"])
        .arg(&directory);
    command.arg("--config").arg(smoke());
    let settings = SETTINGS.map(str::to_owned).into_iter();
    for setting in settings.chain([
        format!("run.episodes={episodes}"),
        format!("learning.episodes_per_epoch={length}"),
    ]) {
        command.args(["--set", &setting]);
    }
    let output = command
        .stdin(Stdio::null())
        .output()
        .expect("the programs are built before the benchmarks");
    assert!(
        output.status.success(),
        "the run failed: {}",
        String::from_utf8_lossy(&output.stderr)
    );
    RunDirectory::new(&directory)
        .summary()
        .expect("a finished run has a summary")
}

/// The program `skein` of the build that this benchmark belongs to.
fn skein() -> PathBuf {
    let this = std::env::current_exe().expect("the system names this program");
    // target/release/deps/epochs-0123456789abcdef
    let built = this
        .ancestors()
        .nth(2)
        .expect("benchmarks lie two folders deep");
    built.join("skein")
}

fn smoke() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/smoke.toml")
}
