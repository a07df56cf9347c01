//! Signals to the program `skein-encoder`.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use std::fs;
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

/// Far more than a few small steps take, even beside other tests.
const TRAINED_WITHIN: Duration = Duration::from_secs(120);
/// Less than a measurement takes.
const ENDED_WITHIN: Duration = Duration::from_secs(3);
const SIGTERM: i32 = 15;

fn start(folder: &Path) -> Child {
    let config = folder.join("small.toml");
    let small =
        "[vae]\nlatent = 8\nbatch_size = 2\n[encoder]\nsteps = 2\n[run]\nlearner_threads = 1";
    fs::write(&config, small).unwrap();
    Command::new(env!("CARGO_BIN_EXE_skein-encoder"))
        .arg("--config")
        .arg(config)
        .arg("--output")
        .arg(folder.join("mine.safetensors"))
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap()
}

fn status_within(child: &mut Child, time: Duration) -> Option<ExitStatus> {
    let end = Instant::now() + time;
    loop {
        match child.try_wait().unwrap() {
            None if Instant::now() < end => sleep(Duration::from_millis(5)),
            status => return status,
        }
    }
}

#[test]
fn a_signal_ends_a_measurement_at_once_and_the_trained_encoder_stays() {
    let folder = tempfile::tempdir().unwrap();
    let mut child = start(folder.path());
    let encoder = folder.path().join("mine.safetensors");
    let deadline = Instant::now() + TRAINED_WITHIN;
    while !encoder.exists() && Instant::now() < deadline {
        sleep(Duration::from_millis(5));
    }
    let kill = ["-TERM", &child.id().to_string()].map(str::to_owned);
    assert!(Command::new("kill").args(kill).status().unwrap().success());
    let status = status_within(&mut child, ENDED_WITHIN);
    // Not left behind if the claim is false.
    let _ = child.kill();
    let _ = child.wait();
    assert_eq!(status.and_then(|status| status.signal()), Some(SIGTERM));
    assert!(encoder.exists());
}
