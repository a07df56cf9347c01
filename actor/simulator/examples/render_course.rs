//! Writes depth images from before each wall of a course, or from where each stage of a world
//! starts, as PNG files.
//!
//! ```text
//! cargo run --release -p skein-simulator --example render_course -- \
//!     configs/courses/training.toml pictures/
//! ```

use std::error::Error;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use nalgebra::{Isometry3, Translation3, UnitQuaternion};
use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use skein_simulator::camera::{
    CameraSettings, DepthCamera, IMAGE_HEIGHT, IMAGE_PIXELS, IMAGE_WIDTH,
};
use skein_simulator::course::Course;
use skein_simulator::simulator::{Simulator, SimulatorSettings};

/// Distance of the camera before a wall, metres.
const BEFORE_M: f32 = 4.0;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<PathBuf> = std::env::args_os().skip(1).map(PathBuf::from).collect();
    let [course, folder] = arguments.as_slice() else {
        return Err("give a course file and a folder for the images".into());
    };
    let course = Course::load(course)?;
    std::fs::create_dir_all(folder)?;
    if course.is_world() {
        return render_stages(course, folder);
    }
    let mut camera = DepthCamera::new(&CameraSettings::default(), &course)?;
    let mut image = [0; IMAGE_PIXELS];
    for wall in course.walls() {
        let middle =
            Translation3::new(wall.x_m() - BEFORE_M, 0.0, course.corridor().height_m / 2.0);
        let poses = [
            ("level", UnitQuaternion::identity()),
            // The attitude of an AirSim quadrotor that moves sideways at full command.
            ("tilted", UnitQuaternion::from_euler_angles(0.4, 0.1, 0.0)),
        ];
        for (name, turn) in poses {
            camera.render(&Isometry3::from_parts(middle, turn), &mut image);
            let path = folder.join(format!("wall{}_{name}.png", wall.label()));
            write_png(&path, &image)?;
            println!("{}", path.display());
        }
    }
    Ok(())
}

/// Writes the image from where each stage of a world starts.
fn render_stages(course: Course, folder: &Path) -> Result<(), Box<dyn Error>> {
    let levels = course.levels();
    let mut simulator = Simulator::new(Arc::new(course), &SimulatorSettings::default())?;
    let mut image = [0; IMAGE_PIXELS];
    for level in 1..=levels {
        let [mut start, mut calm] = [1, 2].map(Pcg64Mcg::seed_from_u64);
        simulator.reset(level, &mut start, &mut calm)?;
        simulator.render(&mut image);
        let path = folder.join(format!("stage{level}.png"));
        write_png(&path, &image)?;
        println!("{}", path.display());
    }
    Ok(())
}

fn write_png(path: &Path, image: &[u8]) -> Result<(), Box<dyn Error>> {
    let mut encoder =
        png::Encoder::new(File::create(path)?, IMAGE_WIDTH as u32, IMAGE_HEIGHT as u32);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.write_header()?.write_image_data(image)?;
    Ok(())
}
