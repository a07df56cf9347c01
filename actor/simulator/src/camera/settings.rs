//! What the camera is and where it sits.

use nalgebra::{Isometry3, Matrix3, Point3, Vector3};
use serde::{Deserialize, Serialize};

use super::{IMAGE_HEIGHT, IMAGE_WIDTH};

/// The depth camera's optics and mounting. Section `[camera]` of the simulator's settings.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CameraSettings {
    /// Angle between the image's left and right border, degrees. Pixels are square. Source:
    /// AirSim's default, 90.
    pub horizontal_fov_deg: f32,
    /// Depth that is shown as 255, metres: whatever is farther looks the same. Two walls ahead are
    /// seen at 20 m; 8 bits are then 8 cm each. The paper does not give it.
    pub range_m: f32,
    /// Depth below which nothing is seen, metres. The lens sits inside the body, which would have
    /// collided before.
    pub near_m: f32,
    /// Lens in the body frame (forward, left, up), metres. The default lies inside the body of
    /// every vehicle preset.
    pub mount_m: [f32; 3],
    /// How far the optical axis points above the body's forward axis, degrees.
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

/// A camera setting that makes no sense.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("camera: key {key} = {value} must lie between {least} and {most}")]
pub struct CameraFault {
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
    /// Whether a camera can be built to these settings.
    ///
    /// # Errors
    /// The first [`CameraFault`].
    pub fn check(&self) -> Result<(), CameraFault> {
        let [x, y, z] = self.mount_m;
        let bounds = [
            ("horizontal_fov_deg", self.horizontal_fov_deg, 10.0, 150.0),
            ("near_m", self.near_m, 0.001, 1.0),
            // An 8-bit step of 4 m would show nothing; a range within the near distance nothing at
            // all.
            ("range_m", self.range_m, 2.0 * self.near_m, 1000.0),
            ("mount_m[0]", x, -2.0, 2.0),
            ("mount_m[1]", y, -2.0, 2.0),
            ("mount_m[2]", z, -2.0, 2.0),
            ("mount_pitch_deg", self.mount_pitch_deg, -90.0, 90.0),
        ];
        for (key, value, least, most) in bounds {
            // Written so that a NaN is refused as well.
            if !(least..=most).contains(&value) {
                return Err(CameraFault {
                    key,
                    value,
                    least,
                    most,
                });
            }
        }
        Ok(())
    }

    /// Distance of the image plane in pixels: a point at `(right, down, forward)` falls `focal *
    /// right / forward` pixels to the right of the image's middle.
    pub(super) fn focal_px(&self) -> f32 {
        IMAGE_WIDTH as f32 / 2.0 / (self.horizontal_fov_deg.to_radians() / 2.0).tan()
    }

    /// Where the lens is, and the image's axes, when the body is at `world_from_body`.
    pub(super) fn view(&self, world_from_body: &Isometry3<f32>) -> View {
        let (sin, cos) = self.mount_pitch_deg.to_radians().sin_cos();
        let in_world = |body: Vector3<f32>| world_from_body.rotation * body;
        View {
            eye: world_from_body * Point3::from(self.mount_m),
            right: in_world(-Vector3::y()),
            down: in_world(Vector3::new(sin, 0.0, -cos)),
            forward: in_world(Vector3::new(cos, 0.0, sin)),
        }
    }
}

/// The lens in the world, and the image's axes as unit vectors of the world.
#[derive(Debug, Clone, Copy)]
pub(super) struct View {
    /// The lens, metres.
    pub eye: Point3<f32>,
    /// Along the image's rows.
    pub right: Vector3<f32>,
    /// Along the image's columns.
    pub down: Vector3<f32>,
    /// Along the optical axis: depth is measured along it.
    pub forward: Vector3<f32>,
}

impl View {
    /// World vector to the optical frame.
    pub(super) fn camera_from_world(&self) -> Matrix3<f32> {
        Matrix3::from_rows(&[
            self.right.transpose(),
            self.down.transpose(),
            self.forward.transpose(),
        ])
    }
}

/// Where the optical axis meets the image, pixels from its left and upper border.
pub(super) const MIDDLE_PX: [f32; 2] = [IMAGE_WIDTH as f32 / 2.0, IMAGE_HEIGHT as f32 / 2.0];
