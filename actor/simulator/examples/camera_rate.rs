//! Measures frames per second of the depth camera, and of the ray-casting reference, on one core.
//!
//! ```text
//! cargo run --release -p skein-simulator --example camera_rate -- configs/courses/*.toml
//! ```

use std::error::Error;
use std::hint::black_box;
use std::path::PathBuf;
use std::time::Instant;

use nalgebra::{Isometry3, Translation3, UnitQuaternion};
use skein_simulator::camera::{CameraSettings, DepthCamera, IMAGE_PIXELS, ReferenceCamera};
use skein_simulator::course::Course;

/// Poses along a flight through the whole corridor.
const POSES: usize = 1200;

/// Times the poses are flown; the fastest counts, as others may be using the machine.
const ROUNDS: usize = 10;

fn main() -> Result<(), Box<dyn Error>> {
    let files: Vec<PathBuf> = std::env::args_os().skip(1).map(PathBuf::from).collect();
    if files.is_empty() {
        return Err("give one or more course files".into());
    }
    println!("{:<20} {:>14} {:>14} {:>10}", "course", "drawn/s", "traced/s", "ratio");
    for file in files {
        let course = Course::load(file)?;
        let settings = CameraSettings::default();
        let mut camera = DepthCamera::new(&settings, &course)?;
        let reference = ReferenceCamera::new(&settings, &course)?;
        let poses: Vec<_> = (0..POSES).map(|number| pose(&course, number)).collect();
        let few: Vec<_> = poses.iter().copied().step_by(POSES / 20).collect();

        let drawn = frames_per_second(&poses, ROUNDS, |pose, image| camera.render(pose, image));
        let traced = frames_per_second(&few, 2, |pose, image| reference.render(pose, image));
        println!(
            "{:<20} {drawn:>14.0} {traced:>14.1} {:>10.0}",
            course.name(),
            drawn / traced
        );
    }
    Ok(())
}

fn frames_per_second(
    poses: &[Isometry3<f32>],
    rounds: usize,
    mut render: impl FnMut(&Isometry3<f32>, &mut [u8; IMAGE_PIXELS]),
) -> f64 {
    let mut image = [0; IMAGE_PIXELS];
    let round = |_| {
        let begin = Instant::now();
        for pose in poses {
            render(pose, &mut image);
            black_box(&image);
        }
        begin.elapsed().as_secs_f64()
    };
    let fastest_secs = (0..rounds).map(round).fold(f64::INFINITY, f64::min);
    poses.len() as f64 / fastest_secs
}

/// A pose of a flight that goes to each opening in turn, leaning as it does so.
fn pose(course: &Course, number: usize) -> Isometry3<f32> {
    let x = 1.0 + (course.corridor().length_m - 2.0) * number as f32 / POSES as f32;
    let ahead = course
        .walls()
        .iter()
        .find(|wall| wall.x_m() + course.wall_thickness_m() > x);
    let [y, z] = ahead.map_or([0.0, course.corridor().height_m / 2.0], |wall| wall.safe_point());
    let wave = number as f32 * 0.05;
    let turn = UnitQuaternion::from_euler_angles(0.4 * wave.sin(), 0.1 * wave.cos(), 0.0);
    Isometry3::from_parts(Translation3::new(x, y, z), turn)
}
