//! The environment step, half a second of an episode: physics alone, and with the depth image.
//!
//! An iteration is a whole episode through the training course, flown by the oracle, with its
//! reset; so in a forest. `random_course` and `random_world` are what an episode on a new course
//! adds: to generate it, and to build its simulator.

use std::hint::black_box;
use std::path::Path;
use std::sync::Arc;

use criterion::{BenchmarkId, Criterion, Throughput};
use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use skein_simulator::camera::IMAGE_PIXELS;
use skein_simulator::course::{
    Course, ForestRanges, GatesRanges, GeneratorRanges, HallRanges, RoomsRanges, WorldRanges,
};
use skein_simulator::simulator::{Simulator, SimulatorSettings};
use skein_simulator::vehicle::{Preset, VehicleSettings};

/// Seed of the start position.
const START: u64 = 1;

#[derive(Clone, Copy)]
enum Camera {
    Off,
    On,
}

fn main() {
    let mut criterion = Criterion::default().configure_from_args();
    let courses = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/courses");
    let course = Arc::new(
        Course::load(courses.join("training.toml")).expect("shipped courses can be flown"),
    );
    let mut group = criterion.benchmark_group("environment_step");
    for (preset, name) in [
        (Preset::Airsim, "airsim"),
        (Preset::Hummingbird, "hummingbird"),
        (Preset::Point, "point"),
    ] {
        let settings = SimulatorSettings {
            vehicle: VehicleSettings {
                preset,
                ..Default::default()
            },
            ..Default::default()
        };
        let mut simulator =
            Simulator::new(Arc::clone(&course), &settings).expect("default settings are valid");
        group.throughput(Throughput::Elements(fly(&mut simulator, Camera::Off)));
        for (camera, what) in [(Camera::Off, "physics"), (Camera::On, "with_camera")] {
            group.bench_function(BenchmarkId::new(what, name), |bencher| {
                bencher.iter(|| fly(&mut simulator, camera));
            });
        }
    }
    group.finish();
    random_worlds(&mut criterion);
    random_course(&mut criterion);
    criterion.final_summary();
}

/// Steps in the densest default forest, and what a random world of each kind costs.
fn random_worlds(criterion: &mut Criterion) {
    let dense = ForestRanges {
        density_per_m2: [1.0 / 16.0; 2],
        ..Default::default()
    };
    let of = |world| GeneratorRanges {
        worlds: vec![world],
        ..Default::default()
    };
    let generate = |seed, ranges: &GeneratorRanges| {
        Course::generate(seed, ranges).expect("default ranges can be flown")
    };
    let forest = Arc::new(generate(1, &of(WorldRanges::Forest(dense.clone()))));
    let mut simulator =
        Simulator::new(forest, &SimulatorSettings::default()).expect("default settings are valid");
    let mut group = criterion.benchmark_group("environment_step");
    group.throughput(Throughput::Elements(fly(&mut simulator, Camera::Off)));
    for (camera, what) in [(Camera::Off, "physics"), (Camera::On, "with_camera")] {
        group.bench_function(BenchmarkId::new(what, "forest"), |bencher| {
            bencher.iter(|| fly(&mut simulator, camera));
        });
    }
    group.finish();
    let mut group = criterion.benchmark_group("random_world");
    for world in [
        WorldRanges::Forest(dense),
        WorldRanges::Hall(HallRanges::default()),
        WorldRanges::Rooms(RoomsRanges::default()),
        WorldRanges::Gates(GatesRanges::default()),
    ] {
        let (name, ranges, mut seeds) = (world.name(), of(world.clone()), 0..);
        group.bench_function(name, |bencher| {
            bencher.iter(|| generate(seeds.next().expect("seeds are endless"), &ranges));
        });
    }
    group.finish();
}

fn random_course(criterion: &mut Criterion) {
    let (ranges, settings) = (GeneratorRanges::default(), SimulatorSettings::default());
    let mut seeds = 0..;
    let mut generate = || {
        let seed = seeds.next().expect("seeds are endless");
        Course::generate(seed, &ranges).expect("default ranges can be flown")
    };
    let mut group = criterion.benchmark_group("random_course");
    let course = Arc::new(generate());
    group.bench_function("generate", |bencher| bencher.iter(&mut generate));
    group.bench_function("simulator", |bencher| {
        bencher.iter(|| Simulator::new(Arc::clone(&course), &settings).is_ok());
    });
    group.finish();
}

/// Flies once through the course and returns the number of steps.
fn fly(simulator: &mut Simulator, camera: Camera) -> u64 {
    let mut image = [0; IMAGE_PIXELS];
    let mut rng = Pcg64Mcg::seed_from_u64(START);
    simulator
        .reset(1, &mut rng.clone(), &mut rng)
        .expect("every course has a first level");
    for steps in 1.. {
        let action = simulator.oracle_action();
        let report = simulator
            .step(action)
            .expect("the oracle's commands are finite");
        if let Camera::On = camera {
            simulator.render(&mut image);
            black_box(&image);
        }
        if report.outcome.is_some() {
            return steps;
        }
    }
    unreachable!("the step limit ends every episode")
}
