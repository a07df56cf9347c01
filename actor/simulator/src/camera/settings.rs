//! The `[simulator.camera]` section of the configuration.

use nalgebra::{Isometry3, Matrix3, Point3, Vector3};
use serde::{Deserialize, Serialize};

use super::{IMAGE_HEIGHT, IMAGE_WIDTH};
use crate::text::exactly;

/// The depth camera's optics and mounting: section `[simulator.camera]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CameraSettings {
    /// Angle between the image's left and right border, degrees. Pixels are square. Default 90,
    /// AirSim's default.
    pub horizontal_fov_deg: f32,
    /// Depth shown as 255, metres; everything farther looks the same. Default 20: the camera sees
    /// the next two walls, and one step of the 8 bits is 8 cm. The paper does not give it.
    pub range_m: f32,
    /// Depth below which a surface is invisible, metres. Default 0.02: the lens sits inside the
    /// body, which would have collided before.
    pub near_m: f32,
    /// Position of the lens in the body frame (forward, left, up), metres. The default
    /// `[0.2, 0, 0]` lies inside the body of every vehicle preset.
    #[serde(deserialize_with = "exactly")]
    pub mount_m: [f32; 3],
    /// Angle of the optical axis above the body's forward axis, degrees. Default 0.
    pub mount_pitch_deg: f32,
}

impl Default for CameraSettings {
    fn default() -> Self {
        Self {
            horizontal_fov_deg: 90.0,
            range_m: 20.0,
            near_m: 0.02,
            mount_m: [0.2, 0.0, 0.0],
            mount_pitch_deg: 0.0,
        }
    }
}

/// A camera setting that is out of bounds.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("[simulator.camera] {key} = {value} is outside {least} to {most}")]
pub struct CameraSettingsError {
    /// The key.
    pub key: &'static str,
    /// The value found.
    pub value: f32,
    /// Smallest value accepted.
    pub least: f32,
    /// Largest value accepted.
    pub most: f32,
}

impl CameraSettings {
    /// Checks every value against its bounds.
    ///
    /// # Errors
    /// [`CameraSettingsError`] names the first key at fault.
    pub fn validate(&self) -> Result<(), CameraSettingsError> {
        let [x, y, z] = self.mount_m;
        let bounds = [
            ("horizontal_fov_deg", self.horizontal_fov_deg, 10.0, 150.0),
            ("near_m", self.near_m, 0.001, 1.0),
            // Above 1000 m a step of the 8 bits would be 4 m, too coarse to fly by; a range within
            // the near distance would show nothing.
            ("range_m", self.range_m, 2.0 * self.near_m, 1000.0),
            ("mount_m[0]", x, -2.0, 2.0),
            ("mount_m[1]", y, -2.0, 2.0),
            ("mount_m[2]", z, -2.0, 2.0),
            ("mount_pitch_deg", self.mount_pitch_deg, -90.0, 90.0),
        ];
        for (key, value, least, most) in bounds {
            // Written so that a NaN is refused as well.
            if !(least..=most).contains(&value) {
                return Err(CameraSettingsError {
                    key,
                    value,
                    least,
                    most,
                });
            }
        }
        Ok(())
    }

    /// Returns the tangents of half the angles of view, horizontal and vertical.
    pub(crate) fn half_view(&self) -> [f32; 2] {
        MIDDLE_PX.map(|middle_px| middle_px / self.focal_px())
    }

    /// Returns the focal length in pixels: a point at `(right, down, forward)` falls `focal * right
    /// / forward` pixels to the right of the image's middle.
    #[must_use]
    pub fn focal_px(&self) -> f32 {
        IMAGE_WIDTH as f32 / 2.0 / (self.horizontal_fov_deg.to_radians() / 2.0).tan()
    }

    /// Returns the lens and the image's axes, with the body at `world_from_body`.
    pub(super) fn view(&self, world_from_body: &Isometry3<f32>) -> CameraView {
        let (sin, cos) = self.mount_pitch_deg.to_radians().sin_cos();
        let in_world = |body: Vector3<f32>| world_from_body.rotation * body;
        CameraView {
            eye: world_from_body * Point3::from(self.mount_m),
            right: in_world(-Vector3::y()),
            down: in_world(Vector3::new(sin, 0.0, -cos)),
            forward: in_world(Vector3::new(cos, 0.0, sin)),
        }
    }
}

/// Position of the lens and the image's axes, in the world frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct CameraView {
    /// Position of the lens, metres.
    pub eye: Point3<f32>,
    /// Unit vector along the image's rows.
    pub right: Vector3<f32>,
    /// Unit vector along the image's columns.
    pub down: Vector3<f32>,
    /// Unit vector along the optical axis, along which depth is measured.
    pub forward: Vector3<f32>,
}

impl CameraView {
    /// Returns the rotation from the world frame to the optical frame.
    pub(super) fn camera_from_world(&self) -> Matrix3<f32> {
        Matrix3::from_rows(&[
            self.right.transpose(),
            self.down.transpose(),
            self.forward.transpose(),
        ])
    }
}

/// Point of the image on the optical axis, pixels from its left and upper border.
pub(super) const MIDDLE_PX: [f32; 2] = [IMAGE_WIDTH as f32 / 2.0, IMAGE_HEIGHT as f32 / 2.0];
