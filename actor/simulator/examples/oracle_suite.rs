//! Flies the oracle through an evaluation suite, for comparison with a policy.
//!
//! `cargo run --release -p skein-simulator --example oracle_suite [suite] [episodes] [config]`
//! (by default configs/evaluations/generalist.toml, its number of episodes, and the default drone;
//! else the drone of this configuration's `[simulator]`).
//!
//! The gap between a policy and the oracle is what the policy could still learn. The gap between
//! the oracle and 100 % is due to the drone or to the oracle's simple rule. Depth noise has no
//! effect on the oracle, because it does not use the image.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use skein_simulator::simulator::{
    EpisodeOutcome, Obstacle, Simulator, SimulatorSettings, StepReport,
};
use skein_simulator::suite::{Suite, SuiteEntry};

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let shipped =
        || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/evaluations/generalist.toml");
    let suite = Suite::load(arguments.next().map_or_else(shipped, PathBuf::from))?;
    let episodes: Option<u64> = arguments
        .next()
        .map(|argument| argument.parse())
        .transpose()?;
    let settings = arguments
        .next()
        .map_or(Ok(SimulatorSettings::default()), settings_of)?;
    println!(
        "{:<34} {:>7} {:>9} {:>7}  hit wall, hit corridor, timed out",
        "entry", "episodes", "completed", "R"
    );
    for entry in &suite.entries {
        println!(
            "{}",
            row(entry, episodes.unwrap_or(entry.episodes), &settings)?
        );
    }
    Ok(())
}

/// Reads the simulator's settings from a configuration.
fn settings_of(config: String) -> Result<SimulatorSettings, Box<dyn Error>> {
    let mut config: toml::Table = toml::from_str(&std::fs::read_to_string(config)?)?;
    let section = config
        .remove("simulator")
        .unwrap_or(toml::Table::new().into());
    Ok(section.try_into()?)
}

/// Flies an entry and returns its row of the table.
fn row(
    entry: &SuiteEntry,
    episodes: u64,
    settings: &SimulatorSettings,
) -> Result<String, Box<dyn Error>> {
    let settings = entry.settings(settings);
    let (mut arrived, mut passed, mut walls) = (0, 0, 0);
    let (mut hit_wall, mut hit_corridor, mut timed_out) = (0, 0, 0);
    for episode in 0..episodes {
        let course = entry.courses.of_episode(episode)?;
        walls += u64::from(course.levels());
        let report = fly(Simulator::new(Arc::clone(&course), &settings)?, episode)?;
        passed += u64::from(report.walls_passed);
        match (report.outcome, report.hit) {
            (Some(EpisodeOutcome::ReachedEnd), _) => arrived += 1,
            (_, Some(Obstacle::Wall(_))) => hit_wall += 1,
            (_, Some(Obstacle::Corridor)) => hit_corridor += 1,
            (_, None) => timed_out += 1,
        }
    }
    Ok(format!(
        "{:<34} {episodes:>7} {:>7.1} % {:>7.3}  {hit_wall}, {hit_corridor}, {timed_out}",
        entry.name,
        100.0 * f64::from(arrived) / episodes as f64,
        passed as f64 / walls as f64,
    ))
}

/// Flies an episode from the start of level 1 and returns the report of its last step.
fn fly(mut simulator: Simulator, seed: u64) -> Result<StepReport, Box<dyn Error>> {
    let [mut start, mut disturbances] = [seed, !seed].map(Pcg64Mcg::seed_from_u64);
    simulator.reset(1, &mut start, &mut disturbances)?;
    loop {
        let action = simulator.oracle_action();
        let report = simulator.step(action)?;
        if report.outcome.is_some() {
            return Ok(report);
        }
    }
}
