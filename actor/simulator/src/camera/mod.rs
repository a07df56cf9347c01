//! The depth camera.
//!
//! The image is the planar depth (along the optical axis, not along the ray) in 8 bits. It is
//! drawn, not traced: every surface of a course is flat, so a frame costs some hundred edges and a
//! few thousand vector operations. A tree of boxes keeps what is out of sight from costing
//! anything. [`ReferenceCamera`] traces the same surfaces ray by ray; a property test compares the
//! two.

mod canvas;
mod instructions;
mod noise;
mod reference;
mod scene;
mod settings;

#[cfg(test)]
mod agreement_tests;
#[cfg(test)]
mod noise_tests;

use nalgebra::Isometry3;

use crate::course::{Course, Moment};
use crate::disturbances::DepthNoiseSettings;

pub use instructions::InstructionSet;
pub use reference::ReferenceCamera;
pub use settings::{CameraSettings, CameraSettingsError};

/// Columns of the depth image.
pub const IMAGE_WIDTH: usize = 128;

/// Rows of the depth image.
pub const IMAGE_HEIGHT: usize = 72;

/// Pixels of the depth image, one byte each: row by row from the top, each row from the left.
pub const IMAGE_PIXELS: usize = IMAGE_WIDTH * IMAGE_HEIGHT;

/// Depth camera in one course. It keeps its scratch memory, so drawing allocates nothing.
pub struct DepthCamera {
    settings: CameraSettings,
    scene: scene::Scene,
    moment: Moment,
    canvas: canvas::DepthCanvas,
    noise: Option<noise::StereoNoise>,
    draw: instructions::DrawFunction,
}

/// Errors drawn into an image.
#[derive(Clone, Copy)]
enum ImageErrors {
    None,
    /// The errors that belong to this key.
    OfKey(u64),
}

impl DepthCamera {
    /// Builds a camera in this course.
    ///
    /// # Errors
    /// [`CameraSettingsError`] if a setting is out of bounds.
    pub fn new(settings: &CameraSettings, course: &Course) -> Result<Self, CameraSettingsError> {
        settings.validate()?;
        Ok(Self {
            settings: settings.clone(),
            scene: scene::Scene::new(course),
            moment: Moment::default(),
            canvas: canvas::DepthCanvas::new(),
            noise: None,
            draw: InstructionSet::best().draw(),
        })
    }

    /// Returns the same camera, with these errors in the images of
    /// [`DepthCamera::render_with_noise`].
    #[must_use]
    pub fn with_noise(mut self, settings: &DepthNoiseSettings) -> Self {
        self.noise = noise::StereoNoise::new(settings, &self.settings);
        self
    }

    /// Places the moving obstacles of a world for the images that follow. Without a call, they are
    /// where [`Moment::default`] has them.
    pub fn move_obstacles(&mut self, moment: Moment) {
        self.moment = moment;
    }

    /// Draws the depth image into `image`, with the body at `world_from_body`.
    ///
    /// A pixel is `round(255 * min(depth / range, 1))`, so larger is farther. Every pixel is
    /// written. Surfaces nearer than `near_m` and the backs of surfaces (from inside a wall) are
    /// invisible. If the pose is NaN, every pixel is 255.
    pub fn render(&mut self, world_from_body: &Isometry3<f32>, image: &mut [u8; IMAGE_PIXELS]) {
        let view = self.settings.view(world_from_body);
        (self.draw)(self, &view, ImageErrors::None, image);
    }

    /// Draws the same image with the camera's errors, if it has any; see [`DepthNoiseSettings`].
    /// The same `key`, pose and settings give the same errors.
    pub fn render_with_noise(
        &mut self,
        world_from_body: &Isometry3<f32>,
        key: u64,
        image: &mut [u8; IMAGE_PIXELS],
    ) {
        let view = self.settings.view(world_from_body);
        (self.draw)(self, &view, ImageErrors::OfKey(key), image);
    }
}

#[inline(always)]
fn draw(
    camera: &mut DepthCamera,
    view: &settings::CameraView,
    errors: ImageErrors,
    image: &mut [u8; IMAGE_PIXELS],
) {
    camera.canvas.clear();
    camera
        .scene
        .draw(&camera.settings, view, camera.moment, &mut camera.canvas);
    match (errors, &camera.noise) {
        (ImageErrors::OfKey(key), Some(noise)) => noise.write(camera.canvas.nearness(), key, image),
        _ => camera.canvas.write(image),
    }
}
