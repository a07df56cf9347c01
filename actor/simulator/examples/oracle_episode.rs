//! Flies the oracle through every shipped course with every drone and prints how many episodes
//! reach the end.
//!
//! `cargo run --release -p skein-simulator --example oracle_episode [episodes]` (100 per course,
//! drone and start level by default). Below 99 %, the course or the drone is wrong. The example
//! `oracle_suite` flies the oracle through an evaluation suite.

use std::error::Error;
use std::path::Path;
use std::sync::Arc;

use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use skein_simulator::course::Course;
use skein_simulator::simulator::{EpisodeOutcome, Simulator, SimulatorSettings};
use skein_simulator::vehicle::{Preset, VehicleSettings};

fn main() -> Result<(), Box<dyn Error>> {
    let episodes: u64 = std::env::args()
        .nth(1)
        .map_or(Ok(100), |argument| argument.parse())?;
    let mut files: Vec<_> =
        std::fs::read_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/courses"))?
            .map(|entry| entry.map(|entry| entry.path()))
            .collect::<Result<_, _>>()?;
    files.sort();

    println!(
        "{:<20} {:<12} arrived of {episodes}, from the start of each level",
        "course", "drone"
    );
    for file in &files {
        let course = Arc::new(Course::load(file)?);
        for preset in [Preset::Airsim, Preset::Hummingbird, Preset::Point] {
            let settings = SimulatorSettings {
                vehicle: VehicleSettings {
                    preset,
                    ..Default::default()
                },
                ..Default::default()
            };
            let mut simulator = Simulator::new(course.clone(), &settings)?;
            print!(
                "{:<20} {:<12}",
                course.name(),
                format!("{preset:?}").to_lowercase()
            );
            for level in 1..=course.levels() {
                let mut arrived = 0;
                for episode in 0..episodes {
                    if fly(&mut simulator, level, episode)? == EpisodeOutcome::ReachedEnd {
                        arrived += 1;
                    }
                }
                print!(" {arrived:>5}");
            }
            println!();
        }
    }
    Ok(())
}

fn fly(simulator: &mut Simulator, level: u8, seed: u64) -> Result<EpisodeOutcome, Box<dyn Error>> {
    let [mut start, mut calm] = [seed, 0].map(Pcg64Mcg::seed_from_u64);
    simulator.reset(level, &mut start, &mut calm)?;
    loop {
        let action = simulator.oracle_action();
        if let Some(outcome) = simulator.step(action)?.outcome {
            return Ok(outcome);
        }
    }
}
