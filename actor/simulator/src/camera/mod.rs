//! The depth camera: what the drone sees of a course.
//!
//! The image is the planar depth (along the optical axis, not along the ray) in 8 bits. It is
//! drawn, not traced: every surface of a course is flat, so a frame costs some hundred edges and a
//! few thousand vector operations. The [`reference`](ReferenceCamera) traces the same surfaces ray
//! by ray; a property test holds the two together.

mod canvas;
mod instructions;
mod noise;
mod reference;
mod scene;
mod settings;

#[cfg(test)]
mod agreement;
#[cfg(test)]
mod noise_tests;

use nalgebra::Isometry3;

use crate::course::Course;
use crate::disturbances::DepthNoiseSettings;

pub use instructions::Instructions;
pub use reference::ReferenceCamera;
pub use settings::{CameraFault, CameraSettings};

/// Columns of the depth image.
pub const IMAGE_WIDTH: usize = 128;

/// Rows of the depth image.
pub const IMAGE_HEIGHT: usize = 72;

/// Pixels of the depth image, a byte each: row by row from the top, each from the left.
pub const IMAGE_PIXELS: usize = IMAGE_WIDTH * IMAGE_HEIGHT;

/// Draws depth images of one course. Holds its scratch memory: drawing allocates nothing.
pub struct DepthCamera {
    settings: CameraSettings,
    scene: scene::Scene,
    canvas: canvas::Canvas,
    noise: Option<noise::StereoNoise>,
    draw: instructions::Draw,
}

/// Which errors an image has.
#[derive(Clone, Copy)]
enum Errors {
    None,
    /// Those of this key.
    OfKey(u64),
}

impl DepthCamera {
    /// A camera in this course.
    ///
    /// # Errors
    /// [`CameraFault`] if the settings make no sense.
    pub fn new(settings: &CameraSettings, course: &Course) -> Result<Self, CameraFault> {
        settings.check()?;
        Ok(Self {
            settings: settings.clone(),
            scene: scene::Scene::new(&course.mesh()),
            canvas: canvas::Canvas::new(),
            noise: None,
            draw: Instructions::best().draw(),
        })
    }

    /// The same camera with errors as a real one has them, in what
    /// [`DepthCamera::render_with_noise`] draws.
    #[must_use]
    pub fn with_noise(mut self, settings: &DepthNoiseSettings) -> Self {
        self.noise = noise::StereoNoise::new(settings, &self.settings);
        self
    }

    /// Draws what the camera sees with the body at `world_from_body`, straight into `image`.
    ///
    /// A pixel is `round(255 * min(depth / range, 1))`, so larger is farther. Every pixel is
    /// written. Surfaces nearer than `near_m` and the backs of surfaces (from inside a wall) are
    /// not seen. A pose that is not a number sees nothing: all 255.
    pub fn render(&mut self, world_from_body: &Isometry3<f32>, image: &mut [u8; IMAGE_PIXELS]) {
        let view = self.settings.view(world_from_body);
        (self.draw)(self, &view, Errors::None, image);
    }

    /// Draws the same with the camera's errors, if it has any. The same `key`, pose and settings
    /// give the same ones; see [`DepthNoiseSettings`].
    pub fn render_with_noise(
        &mut self,
        world_from_body: &Isometry3<f32>,
        key: u64,
        image: &mut [u8; IMAGE_PIXELS],
    ) {
        let view = self.settings.view(world_from_body);
        (self.draw)(self, &view, Errors::OfKey(key), image);
    }
}

#[inline(always)]
fn draw(
    camera: &mut DepthCamera,
    view: &settings::View,
    errors: Errors,
    image: &mut [u8; IMAGE_PIXELS],
) {
    camera.canvas.clear();
    camera
        .scene
        .draw(&camera.settings, view, &mut camera.canvas);
    match (errors, &camera.noise) {
        (Errors::OfKey(key), Some(noise)) => noise.write(camera.canvas.nearness(), key, image),
        _ => camera.canvas.write(image),
    }
}
