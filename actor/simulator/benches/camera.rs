//! The depth camera: frames per second when drawn, drawn with a stereo camera's errors, and traced
//! ray by ray.
//!
//! An iteration renders the poses of an episode through the whole corridor, tilted like a drone, so
//! that near walls and open corridor occur as in training.

use std::hint::black_box;
use std::path::Path;

use criterion::{BenchmarkId, Criterion, Throughput};
use nalgebra::{Isometry3, Translation3, UnitQuaternion};
use skein_simulator::camera::{CameraSettings, DepthCamera, IMAGE_PIXELS, ReferenceCamera};
use skein_simulator::course::Course;
use skein_simulator::disturbances::{DepthModel, DepthNoiseSettings};

/// Poses drawn in an iteration.
const DRAWN: usize = 240;
/// Poses traced in an iteration: every twelfth of those drawn.
const TRACED: usize = DRAWN / 12;

fn main() {
    let mut criterion = Criterion::default().configure_from_args();
    for course in ["training", "non_rectangular"] {
        camera(&mut criterion, course);
    }
    criterion.final_summary();
}

fn camera(criterion: &mut Criterion, name: &str) {
    let courses = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/courses");
    let course = Course::load(courses.join(name).with_extension("toml"))
        .expect("shipped courses can be flown");
    let settings = CameraSettings::default();
    let mut camera = DepthCamera::new(&settings, &course)
        .expect("default settings are valid")
        .with_noise(&DepthNoiseSettings {
            model: DepthModel::Stereo,
            ..Default::default()
        });
    let reference =
        ReferenceCamera::new(&settings, &course).expect("a course's surfaces form a mesh");
    let poses: Vec<_> = (0..DRAWN).map(|number| pose(&course, number)).collect();
    let mut image = [0; IMAGE_PIXELS];

    let mut group = criterion.benchmark_group("camera");
    group.throughput(Throughput::Elements(DRAWN as u64));
    group.bench_function(BenchmarkId::new("drawn", name), |bencher| {
        bencher.iter(|| {
            for pose in &poses {
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
    let wave = number as f32 * 0.25;
    let turn = UnitQuaternion::from_euler_angles(0.4 * wave.sin(), 0.1 * wave.cos(), 0.0);
    Isometry3::from_parts(Translation3::new(x, y, z), turn)
}
