//! Environment steps per second on one core: physics alone, and with a depth image after every step.
//!
//! `cargo run --release -p skein-simulator --example step_rate [course.toml]`

use std::error::Error;
use std::hint::black_box;
use std::sync::Arc;
use std::time::{Duration, Instant};

use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use skein_simulator::camera::IMAGE_PIXELS;
use skein_simulator::course::Course;
use skein_simulator::oracle::Oracle;
use skein_simulator::simulator::{Simulator, SimulatorSettings};
use skein_simulator::vehicle::{Preset, VehicleSettings};

/// Long enough to average over whole flights.
const MEASURED: Duration = Duration::from_secs(2);

enum Camera {
    Off,
    On,
}

fn main() -> Result<(), Box<dyn Error>> {
    let default = concat!(env!("CARGO_MANIFEST_DIR"), "/../../configs/courses/training.toml");
    let course = Arc::new(Course::load(std::env::args().nth(1).as_deref().unwrap_or(default))?);
    println!(
        "{}: steps of 0.5 s per second of one core, the oracle flying",
        course.name()
    );
    println!("{:<12} {:>14} {:>14}", "drone", "physics alone", "with camera");
    for preset in [Preset::Airsim, Preset::Hummingbird, Preset::Point] {
        let settings = SimulatorSettings {
            vehicle: VehicleSettings {
                preset,
                ..Default::default()
            },
            ..Default::default()
        };
        let mut simulator = Simulator::new(course.clone(), &settings)?;
        let alone = steps_per_sec(&mut simulator, &Camera::Off)?;
        let with_camera = steps_per_sec(&mut simulator, &Camera::On)?;
        println!(
            "{:<12} {alone:>14.0} {with_camera:>14.0}",
            format!("{preset:?}").to_lowercase()
        );
    }
    Ok(())
}

fn steps_per_sec(simulator: &mut Simulator, camera: &Camera) -> Result<f64, Box<dyn Error>> {
    let mut image = Box::new([0; IMAGE_PIXELS]);
    let mut rng = Pcg64Mcg::seed_from_u64(1);
    let mut steps = 0_u32;
    let start = Instant::now();
    while start.elapsed() < MEASURED {
        simulator.reset(1, &mut rng)?;
        loop {
            let action = Oracle::act(simulator.course(), &simulator.state());
            let report = simulator.step(action)?;
            steps += 1;
            if let Camera::On = camera {
                simulator.render(&mut image);
                black_box(&image);
            }
            if report.outcome.is_some() {
                break;
            }
        }
    }
    Ok(f64::from(steps) / start.elapsed().as_secs_f64())
}
