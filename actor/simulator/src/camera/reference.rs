//! The depth image by ray casting: slow, but obviously correct.
//!
//! A ray through the middle of each pixel is cast against the course's triangles. Tests compare
//! the fast camera with it, pixel by pixel.

use nalgebra::{Isometry3, Vector3};
use parry3d::math::Vector;
use parry3d::query::{Ray, RayCullingMode};
use parry3d::shape::{TriMesh, TriMeshBuilderError};

use super::settings::{CameraView, MIDDLE_PX};
use super::{CameraSettings, IMAGE_PIXELS, IMAGE_WIDTH};
use crate::course::{Course, Moment};

/// Depth camera that casts rays, for comparison in tests and benchmarks.
pub struct ReferenceCamera {
    settings: CameraSettings,
    surfaces: TriMesh,
}

impl ReferenceCamera {
    /// Builds a camera in this course, with moving obstacles where they are at `moment`.
    ///
    /// # Errors
    /// [`TriMeshBuilderError`] if the course's surfaces form no triangle mesh.
    pub fn new(
        settings: &CameraSettings,
        course: &Course,
        moment: Moment,
    ) -> Result<Self, TriMeshBuilderError> {
        let mut mesh = course.mesh();
        for (number, obstacle) in course.obstacles().iter().enumerate() {
            let mut surfaces = obstacle.mesh();
            if let Some(motion) = obstacle.motion {
                let offset_m = motion.offset_m(number, moment);
                for vertex in &mut surfaces.vertices {
                    *vertex += offset_m;
                }
            }
            mesh.append(surfaces);
        }
        let vertices = mesh
            .vertices
            .iter()
            .map(|v| Vector::new(v.x, v.y, v.z))
            .collect();
        let triangles = mesh
            .triangles()
            .into_iter()
            .map(|(triangle, _)| triangle)
            .collect();
        Ok(Self {
            settings: settings.clone(),
            surfaces: TriMesh::new(vertices, triangles)?,
        })
    }

    /// Draws the depth image into `image`, with the body at `world_from_body`, like
    /// [`DepthCamera::render`](super::DepthCamera::render).
    pub fn render(&self, world_from_body: &Isometry3<f32>, image: &mut [u8; IMAGE_PIXELS]) {
        let view = self.settings.view(world_from_body);
        for (number, pixel) in image.iter_mut().enumerate() {
            let column = (number % IMAGE_WIDTH) as f32 + 0.5;
            let row = (number / IMAGE_WIDTH) as f32 + 0.5;
            *pixel = self.grey(&view, column, row);
        }
    }

    /// Returns the grey level at a point of the image, in pixels from its left and upper border.
    pub(super) fn grey(&self, view: &CameraView, column: f32, row: f32) -> u8 {
        let share = self.depth_m(view, column, row) / self.settings.range_m;
        (255.0 * share.min(1.0)).round() as u8
    }

    /// Returns the depth of the first surface beyond the near distance that faces the camera;
    /// infinite if none is in range.
    fn depth_m(&self, view: &CameraView, column: f32, row: f32) -> f32 {
        let focal = self.settings.focal_px();
        let [across, along] = [
            (column - MIDDLE_PX[0]) / focal,
            (row - MIDDLE_PX[1]) / focal,
        ];
        // One unit of this direction is one metre of depth, so the time of impact is a depth.
        let direction = view.forward + view.right * across + view.down * along;
        let begin = view.eye + direction * self.settings.near_m;
        let to_parry = |v: Vector3<f32>| Vector::new(v.x, v.y, v.z);
        let ray = Ray::new(to_parry(begin.coords), to_parry(direction));
        let left_m = self.settings.range_m - self.settings.near_m;
        self.surfaces
            .cast_local_ray_with_culling(&ray, left_m, RayCullingMode::IgnoreBackfaces)
            .map_or(f32::INFINITY, |hit| {
                self.settings.near_m + hit.time_of_impact
            })
    }
}
