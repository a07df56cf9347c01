//! Runs `skein-chaos` at the size of a test: a storm of all disturbances, and a death at every
//! fault point.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use skein_tests::{repository, run_program};

/// Runs `skein-chaos` over `tests/small.toml` with `settings`. Asserts that all disturbances
/// happened, nothing differs and nothing is left.
fn storm(settings: &[&str], arguments: &[&str]) -> String {
    let folder = tempfile::tempdir().unwrap();
    let config = repository().join("tests/small.toml");
    let basic = [
        "--config",
        config.to_str().unwrap(),
        "--run-dir",
        folder.path().to_str().unwrap(),
    ];
    let settings: Vec<_> = settings
        .iter()
        .flat_map(|setting| ["--set", setting])
        .collect();
    let output = run_program(
        "skein-chaos",
        &[&basic, settings.as_slice(), arguments].concat(),
    );
    assert_eq!(output.code, Some(0), "{}\n{}", output.stdout, output.stderr);
    output.stdout
}

#[test]
fn kills_freezes_and_attachments_change_nothing() {
    // Silences short enough to be exceeded by the freezes of a short run.
    let settings = [
        "run.episodes=200",
        "transport.actor_silence_secs=1",
        "transport.learner_silence_secs=6",
    ];
    storm(
        &settings,
        &[
            "--actor-kills",
            "20",
            "--learner-kills",
            "3",
            "--supervisor-kills",
            "2",
        ],
    );
}

#[test]
fn kills_change_nothing_with_policy_lag() {
    let settings = ["run.episodes=120", "learning.policy_lag=1"];
    let kills = [
        "--actor-kills",
        "8",
        "--learner-kills",
        "3",
        "--supervisor-kills",
        "1",
    ];
    storm(
        &settings,
        &[&kills[..], &["--freezes", "0", "--attachments", "0"]].concat(),
    );
}

#[test]
fn a_death_at_any_fault_point_changes_nothing() {
    // Enough episodes to reach every point again after all previous deaths.
    storm(&["run.episodes=400"], &["--points"]);
}
