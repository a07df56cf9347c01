//! Checks the claims of `configs/evaluations/slalom.toml`: who can fly it, and who cannot.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use std::path::PathBuf;

use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use skein_simulator::ActionSpace;
use skein_simulator::simulator::{EpisodeOutcome, Simulator, SimulatorSettings};
use skein_simulator::suite::Suite;
use skein_simulator::vehicle::Preset;

/// Episodes of each entry.
const EPISODES: u64 = 100;

fn configs(file: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
        .join("../../configs")
        .join(file)
}

/// Returns the simulator's settings in `configs/slalom.toml`.
fn settings() -> SimulatorSettings {
    let text = std::fs::read_to_string(configs("slalom.toml")).unwrap();
    let mut config: toml::Table = toml::from_str(&text).unwrap();
    config.remove("simulator").unwrap().try_into().unwrap()
}

/// Returns the share of the suite's episodes that the oracle completes.
fn completed(settings: &SimulatorSettings) -> f64 {
    let suite = Suite::load(configs("evaluations/slalom.toml")).unwrap();
    let mut arrived = 0;
    for entry in &suite.entries {
        let settings = entry.settings(settings);
        for episode in 0..EPISODES {
            let course = entry.courses.of_episode(episode).unwrap();
            let mut simulator = Simulator::new(course, &settings).unwrap();
            let [mut start, mut calm] = [episode, !episode].map(Pcg64Mcg::seed_from_u64);
            simulator.reset(1, &mut start, &mut calm).unwrap();
            let outcome = loop {
                let action = simulator.oracle_action();
                if let Some(outcome) = simulator.step(action).unwrap().outcome {
                    break outcome;
                }
            };
            arrived += u64::from(outcome == EpisodeOutcome::ReachedEnd);
        }
    }
    arrived as f64 / (EPISODES * suite.entries.len() as u64) as f64
}

#[test]
fn at_a_constant_speed_the_oracle_completes_less_than_a_twentieth() {
    let mut settings = settings();
    settings.vehicle.action = ActionSpace::Lateral;
    let completed = completed(&settings);
    assert!(completed < 0.05, "{completed}");
}

#[test]
fn with_a_speed_of_its_own_the_oracle_completes_nearly_all() {
    for action in [ActionSpace::Velocity, ActionSpace::VelocityYaw] {
        for (preset, max_speed_mps) in [
            (Preset::Airsim, 1.0),
            (Preset::Airsim, 3.0),
            (Preset::Hummingbird, 1.0),
            (Preset::Point, 1.0),
        ] {
            let mut settings = settings();
            settings.vehicle.preset = preset;
            settings.vehicle.action = action;
            settings.vehicle.max_speed_mps = max_speed_mps;
            let completed = completed(&settings);
            assert!(
                completed >= 0.99,
                "{preset:?}, {action:?}, {max_speed_mps} m/s: {completed}"
            );
        }
    }
}
