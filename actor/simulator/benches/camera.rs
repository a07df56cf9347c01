//! The depth camera: frames per second when drawn, drawn with a stereo camera's errors, and traced
//! ray by ray.
//!
//! An iteration renders the poses of an episode through the whole course, tilted like a drone, so
//! that near walls and open space occur as in training. Beside two corridors, there are a forest of
//! 300 trees and a hilly mesh of 100,000 triangles.

use std::hint::black_box;
use std::path::Path;
use std::sync::Arc;

use criterion::{BenchmarkId, Criterion, Throughput};
use nalgebra::{Isometry3, Translation3, UnitQuaternion};
use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use skein_simulator::camera::{CameraSettings, DepthCamera, IMAGE_PIXELS, ReferenceCamera};
use skein_simulator::course::{
    Corridor, Course, ForestRanges, GeneratorRanges, Moment, Obstacle, ObstacleShape, Region,
    Sides, TriangleMesh, WorldLayout, WorldRanges,
};
use skein_simulator::disturbances::{DepthModel, DepthNoiseSettings};
use skein_simulator::simulator::{Simulator, SimulatorSettings};

/// Poses drawn in an iteration.
const DRAWN: usize = 240;
/// Poses traced in an iteration: every twelfth of those drawn.
const TRACED: usize = DRAWN / 12;

fn main() {
    let mut criterion = Criterion::default().configure_from_args();
    for name in ["training", "non_rectangular"] {
        let courses = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/courses");
        let course = Course::load(courses.join(name).with_extension("toml"))
            .expect("shipped courses can be flown");
        let poses: Vec<_> = (0..DRAWN).map(|number| pose(&course, number)).collect();
        camera(&mut criterion, name, &course, &poses);
    }
    for (name, course) in [("forest_300", forest()), ("mesh_100k", hills())] {
        let poses = flown(&course);
        camera(&mut criterion, name, &course, &poses);
    }
    criterion.final_summary();
}

fn camera(criterion: &mut Criterion, name: &str, course: &Course, poses: &[Isometry3<f32>]) {
    let settings = CameraSettings::default();
    let mut camera = DepthCamera::new(&settings, course)
        .expect("default settings are valid")
        .with_noise(&DepthNoiseSettings {
            model: DepthModel::Stereo,
            ..Default::default()
        });
    let reference = ReferenceCamera::new(&settings, course, Moment::default())
        .expect("a course's surfaces form a mesh");
    let mut image = [0; IMAGE_PIXELS];

    let mut group = criterion.benchmark_group("camera");
    group.throughput(Throughput::Elements(DRAWN as u64));
    group.bench_function(BenchmarkId::new("drawn", name), |bencher| {
        bencher.iter(|| {
            for pose in poses {
                camera.render(black_box(pose), &mut image);
                black_box(&image);
            }
        });
    });
    group.bench_function(BenchmarkId::new("noisy", name), |bencher| {
        bencher.iter(|| {
            for (pose, key) in poses.iter().zip(0..) {
                camera.render_with_noise(black_box(pose), key, &mut image);
                black_box(&image);
            }
        });
    });
    group.throughput(Throughput::Elements(TRACED as u64));
    group.bench_function(BenchmarkId::new("traced", name), |bencher| {
        bencher.iter(|| {
            for pose in poses.iter().step_by(DRAWN / TRACED) {
                reference.render(black_box(pose), &mut image);
                black_box(&image);
            }
        });
    });
    group.finish();
}

/// Returns a pose of an episode that flies through each opening in turn.
fn pose(course: &Course, number: usize) -> Isometry3<f32> {
    let x = 1.0 + (course.corridor().length_m - 2.0) * number as f32 / DRAWN as f32;
    let ahead = course
        .walls()
        .iter()
        .find(|wall| wall.x_m() + course.wall_thickness_m() > x);
    let [y, z] = ahead.map_or([0.0, course.corridor().height_m / 2.0], |wall| {
        wall.safe_point()
    });
    tilted([x, y, z], number)
}

/// Returns poses along the oracle's flight through a world.
fn flown(course: &Course) -> Vec<Isometry3<f32>> {
    let settings = SimulatorSettings::default();
    let mut simulator =
        Simulator::new(Arc::new(course.clone()), &settings).expect("default settings are valid");
    let mut rng = Pcg64Mcg::seed_from_u64(1);
    simulator
        .reset(1, &mut rng.clone(), &mut rng)
        .expect("every course has a first level");
    let mut places = Vec::new();
    let mut outcome = None;
    while outcome.is_none() {
        places.push(simulator.state().position_m);
        let action = simulator.oracle_action();
        let report = simulator.step(action);
        outcome = report.expect("the oracle's commands are finite").outcome;
    }
    let place = |number: usize| places[number * places.len() / DRAWN].coords.into();
    (0..DRAWN)
        .map(|number| tilted(place(number), number))
        .collect()
}

fn tilted([x, y, z]: [f32; 3], number: usize) -> Isometry3<f32> {
    let wave = number as f32 * 0.25;
    let turn = UnitQuaternion::from_euler_angles(0.4 * wave.sin(), 0.1 * wave.cos(), 0.0);
    Isometry3::from_parts(Translation3::new(x, y, z), turn)
}

/// Returns a forest of 300 trees, one in 16 square metres, without branches.
fn forest() -> Course {
    let ranges = ForestRanges {
        size_m: [86.0, 60.0, 6.0],
        density_per_m2: [1.0 / 16.0; 2],
        branches: [0, 0],
        sides: Sides::Open,
        ..Default::default()
    };
    Course::generate(
        1,
        &GeneratorRanges {
            worlds: vec![WorldRanges::Forest(ranges)],
            ..Default::default()
        },
    )
    .expect("the default forest can be flown")
}

/// Returns a world whose ground is one mesh of hills with 100,352 triangles.
fn hills() -> Course {
    const SIDE: u32 = 224;
    let (length_m, width_m) = (46.0, 40.0);
    let share = |number: u32| number as f32 / SIDE as f32;
    let height_m = |x_m: f32, y_m: f32| 0.8 + 0.5 * (0.7 * x_m).sin() + 0.3 * (1.3 * y_m).cos();
    let numbers = (0..=SIDE).flat_map(|x| (0..=SIDE).map(move |y| (x, y)));
    let vertices_m = numbers
        .map(|(x, y)| {
            let (x_m, y_m) = (length_m * (share(x) - 0.5), width_m * (share(y) - 0.5));
            [x_m, y_m, height_m(x_m, y_m)]
        })
        .collect();
    let cells = (0..SIDE).flat_map(|x| (0..SIDE).map(move |y| x * (SIDE + 1) + y));
    let triangles = cells.flat_map(|at| {
        let (right, ahead) = (at + SIDE + 1, at + 1);
        [[at, right, ahead], [right, right + 1, ahead]]
    });
    let mesh = TriangleMesh {
        vertices_m,
        triangles: triangles.collect(),
    };
    Course::of_world(WorldLayout {
        name: "hills".into(),
        bounds: Corridor {
            length_m,
            width_m,
            height_m: 6.0,
        },
        sides: Sides::Open,
        start: Region {
            centre_m: [1.5, 0.0, 3.0],
            size_m: [0.0; 3],
        },
        goal: Region {
            centre_m: [length_m - 1.5, 0.0, 3.0],
            size_m: [3.0, width_m, 6.0],
        },
        obstacles: vec![Obstacle {
            shape: ObstacleShape::Mesh(Arc::new(mesh)),
            centre_m: [length_m / 2.0, 0.0, 0.0],
            rotation_deg: [0.0; 3],
            motion: None,
        }],
    })
    .expect("hills can be flown over")
}
