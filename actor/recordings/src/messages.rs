//! Foxglove's messages, as far as recordings use them, in Protobuf's encoding.
//!
//! Source of names and numbers: the schemas in `actor/recordings/schemas/`.

use prost::{Enumeration, Message};
use skein_protocol::{IMAGE_HEIGHT, IMAGE_WIDTH};

pub(crate) const WORLD: &str = "world";
pub(crate) const BODY: &str = "body";
pub(crate) const CAMERA: &str = "camera";

/// `google.protobuf.Timestamp`: time since the beginning of the recording.
#[derive(Clone, Copy, PartialEq, Message)]
pub(crate) struct Timestamp {
    #[prost(int64, tag = "1")]
    seconds: i64,
    #[prost(int32, tag = "2")]
    nanos: i32,
}

const NANOS: i64 = 1_000_000_000;

impl Timestamp {
    pub(crate) fn from_secs(secs: f64) -> Self {
        let nanos = (secs * NANOS as f64).round() as i64;
        Self {
            seconds: nanos / NANOS,
            nanos: (nanos % NANOS) as i32,
        }
    }

    pub(crate) fn nanos(self) -> u64 {
        (self.seconds * NANOS + i64::from(self.nanos)).unsigned_abs()
    }

    pub(crate) fn secs(self) -> f64 {
        self.nanos() as f64 / NANOS as f64
    }
}

/// `foxglove.Vector3` and `foxglove.Point3`.
#[derive(Clone, Copy, PartialEq, Message)]
pub(crate) struct Vector3 {
    #[prost(double, tag = "1")]
    pub(crate) x: f64,
    #[prost(double, tag = "2")]
    pub(crate) y: f64,
    #[prost(double, tag = "3")]
    pub(crate) z: f64,
}

impl From<Vector3> for [f32; 3] {
    fn from(vector: Vector3) -> Self {
        [vector.x, vector.y, vector.z].map(|value| value as f32)
    }
}

impl From<[f32; 3]> for Vector3 {
    fn from(values: [f32; 3]) -> Self {
        let [x, y, z] = values.map(f64::from);
        Self { x, y, z }
    }
}

/// `foxglove.Quaternion`.
#[derive(Clone, Copy, PartialEq, Message)]
pub(crate) struct Quaternion {
    #[prost(double, tag = "1")]
    pub(crate) x: f64,
    #[prost(double, tag = "2")]
    pub(crate) y: f64,
    #[prost(double, tag = "3")]
    pub(crate) z: f64,
    #[prost(double, tag = "4")]
    pub(crate) w: f64,
}

impl From<[f32; 4]> for Quaternion {
    fn from(values: [f32; 4]) -> Self {
        let [x, y, z, w] = values.map(f64::from);
        Self { x, y, z, w }
    }
}

/// `foxglove.Pose`.
#[derive(Clone, Copy, PartialEq, Message)]
pub(crate) struct Pose {
    #[prost(message, optional, tag = "1")]
    pub(crate) position: Option<Vector3>,
    #[prost(message, optional, tag = "2")]
    pub(crate) orientation: Option<Quaternion>,
}

impl Pose {
    /// The pose of the frame itself.
    pub(crate) fn origin() -> Self {
        Self {
            position: Some([0.0; 3].into()),
            orientation: Some([0.0, 0.0, 0.0, 1.0].into()),
        }
    }
}

/// `foxglove.Color`.
#[derive(Clone, Copy, PartialEq, Message)]
pub(crate) struct Color {
    #[prost(double, tag = "1")]
    r: f64,
    #[prost(double, tag = "2")]
    g: f64,
    #[prost(double, tag = "3")]
    b: f64,
    #[prost(double, tag = "4")]
    a: f64,
}

impl Color {
    pub(crate) fn rgba([r, g, b, a]: [f64; 4]) -> Self {
        Self { r, g, b, a }
    }
}

/// `foxglove.FrameTransform`.
#[derive(Clone, PartialEq, Message)]
pub(crate) struct FrameTransform {
    #[prost(message, optional, tag = "1")]
    pub(crate) timestamp: Option<Timestamp>,
    #[prost(string, tag = "2")]
    pub(crate) parent_frame_id: String,
    #[prost(string, tag = "3")]
    pub(crate) child_frame_id: String,
    #[prost(message, optional, tag = "4")]
    pub(crate) translation: Option<Vector3>,
    #[prost(message, optional, tag = "5")]
    pub(crate) rotation: Option<Quaternion>,
}

/// `foxglove.FrameTransforms`.
#[derive(Clone, PartialEq, Message)]
pub(crate) struct FrameTransforms {
    #[prost(message, repeated, tag = "1")]
    pub(crate) transforms: Vec<FrameTransform>,
}

/// `foxglove.RawImage`.
#[derive(Clone, PartialEq, Message)]
pub(crate) struct RawImage {
    #[prost(message, optional, tag = "1")]
    timestamp: Option<Timestamp>,
    #[prost(fixed32, tag = "2")]
    width: u32,
    #[prost(fixed32, tag = "3")]
    height: u32,
    #[prost(string, tag = "4")]
    encoding: String,
    #[prost(fixed32, tag = "5")]
    step: u32,
    #[prost(bytes = "vec", tag = "6")]
    pub(crate) data: Vec<u8>,
    #[prost(string, tag = "7")]
    frame_id: String,
}

impl RawImage {
    /// The depth image's own bytes; 255 is the camera's range or farther.
    pub(crate) fn of_depth(depth: &[u8], at: Timestamp) -> Self {
        Self::new("mono8", 1, depth.to_vec(), at)
    }

    /// The depth image in whole millimetres.
    pub(crate) fn in_millimetres(depth: &[u8], range_m: f32, at: Timestamp) -> Self {
        let millimetres = |&depth: &u8| {
            let metres = f32::from(depth) / 255.0 * range_m;
            // A range of more than 65 m does not fit.
            ((metres * 1000.0).round().min(65535.0) as u16).to_le_bytes()
        };
        Self::new("16UC1", 2, depth.iter().flat_map(millimetres).collect(), at)
    }

    fn new(encoding: &str, bytes_per_pixel: u32, data: Vec<u8>, at: Timestamp) -> Self {
        Self {
            timestamp: Some(at),
            width: IMAGE_WIDTH as u32,
            height: IMAGE_HEIGHT as u32,
            encoding: encoding.to_owned(),
            step: IMAGE_WIDTH as u32 * bytes_per_pixel,
            data,
            frame_id: CAMERA.to_owned(),
        }
    }
}

/// `foxglove.CameraCalibration`.
#[derive(Clone, PartialEq, Message)]
pub(crate) struct CameraCalibration {
    #[prost(message, optional, tag = "1")]
    timestamp: Option<Timestamp>,
    #[prost(fixed32, tag = "2")]
    width: u32,
    #[prost(fixed32, tag = "3")]
    height: u32,
    #[prost(string, tag = "4")]
    distortion_model: String,
    #[prost(double, repeated, tag = "5")]
    distortion: Vec<f64>,
    #[prost(double, repeated, tag = "6")]
    intrinsic: Vec<f64>,
    #[prost(double, repeated, tag = "7")]
    rectification: Vec<f64>,
    #[prost(double, repeated, tag = "8")]
    projection: Vec<f64>,
    #[prost(string, tag = "9")]
    frame_id: String,
}

impl CameraCalibration {
    /// A camera without distortion. Pixels have their whole numbers in their middle, as in OpenCV.
    pub(crate) fn of(focal_px: f32, at: Timestamp) -> Self {
        let focal = f64::from(focal_px);
        let [x, y] = [IMAGE_WIDTH, IMAGE_HEIGHT].map(|pixels| pixels as f64 / 2.0 - 0.5);
        Self {
            timestamp: Some(at),
            width: IMAGE_WIDTH as u32,
            height: IMAGE_HEIGHT as u32,
            distortion_model: "plumb_bob".to_owned(),
            distortion: vec![0.0; 5],
            intrinsic: vec![focal, 0.0, x, 0.0, focal, y, 0.0, 0.0, 1.0],
            rectification: vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            projection: vec![focal, 0.0, x, 0.0, 0.0, focal, y, 0.0, 0.0, 0.0, 1.0, 0.0],
            frame_id: CAMERA.to_owned(),
        }
    }
}

/// `foxglove.LogLevel`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Enumeration)]
#[repr(i32)]
pub(crate) enum Level {
    Unknown = 0,
    Debug = 1,
    Info = 2,
    Warning = 3,
    Error = 4,
}

/// `foxglove.Log`.
#[derive(Clone, PartialEq, Message)]
pub(crate) struct Log {
    #[prost(message, optional, tag = "1")]
    timestamp: Option<Timestamp>,
    #[prost(enumeration = "Level", tag = "2")]
    level: i32,
    #[prost(string, tag = "3")]
    pub(crate) message: String,
    #[prost(string, tag = "4")]
    name: String,
}

impl Log {
    pub(crate) fn new(level: Level, message: String, at: Timestamp) -> Self {
        Self {
            timestamp: Some(at),
            level: level as i32,
            message,
            name: "skein".to_owned(),
        }
    }
}

/// `foxglove.SceneEntityDeletion`.
#[derive(Clone, PartialEq, Message)]
pub(crate) struct SceneEntityDeletion {
    #[prost(message, optional, tag = "1")]
    pub(crate) timestamp: Option<Timestamp>,
    /// 1 deletes all entities.
    #[prost(int32, tag = "2")]
    pub(crate) kind: i32,
}

/// `foxglove.CubePrimitive`.
#[derive(Clone, PartialEq, Message)]
pub(crate) struct CubePrimitive {
    #[prost(message, optional, tag = "1")]
    pub(crate) pose: Option<Pose>,
    #[prost(message, optional, tag = "2")]
    pub(crate) size: Option<Vector3>,
    #[prost(message, optional, tag = "3")]
    pub(crate) color: Option<Color>,
}

/// `foxglove.LinePrimitive`.
#[derive(Clone, PartialEq, Message)]
pub(crate) struct LinePrimitive {
    /// 0 is a strip, 1 a loop.
    #[prost(int32, tag = "1")]
    pub(crate) kind: i32,
    #[prost(message, optional, tag = "2")]
    pub(crate) pose: Option<Pose>,
    #[prost(double, tag = "3")]
    pub(crate) thickness: f64,
    #[prost(bool, tag = "4")]
    pub(crate) scale_invariant: bool,
    #[prost(message, repeated, tag = "5")]
    pub(crate) points: Vec<Vector3>,
    #[prost(message, optional, tag = "6")]
    pub(crate) color: Option<Color>,
}

/// `foxglove.TriangleListPrimitive`.
#[derive(Clone, PartialEq, Message)]
pub(crate) struct TriangleListPrimitive {
    #[prost(message, optional, tag = "1")]
    pub(crate) pose: Option<Pose>,
    #[prost(message, repeated, tag = "2")]
    pub(crate) points: Vec<Vector3>,
    #[prost(message, optional, tag = "3")]
    pub(crate) color: Option<Color>,
}

/// `foxglove.SceneEntity`.
#[derive(Clone, PartialEq, Message)]
pub(crate) struct SceneEntity {
    #[prost(message, optional, tag = "1")]
    pub(crate) timestamp: Option<Timestamp>,
    #[prost(string, tag = "2")]
    pub(crate) frame_id: String,
    #[prost(string, tag = "3")]
    pub(crate) id: String,
    /// The entity moves with its frame.
    #[prost(bool, tag = "5")]
    pub(crate) frame_locked: bool,
    #[prost(message, repeated, tag = "8")]
    pub(crate) cubes: Vec<CubePrimitive>,
    #[prost(message, repeated, tag = "11")]
    pub(crate) lines: Vec<LinePrimitive>,
    #[prost(message, repeated, tag = "12")]
    pub(crate) triangles: Vec<TriangleListPrimitive>,
}

/// `foxglove.SceneUpdate`.
#[derive(Clone, PartialEq, Message)]
pub(crate) struct SceneUpdate {
    #[prost(message, repeated, tag = "1")]
    pub(crate) deletions: Vec<SceneEntityDeletion>,
    #[prost(message, repeated, tag = "2")]
    pub(crate) entities: Vec<SceneEntity>,
}
