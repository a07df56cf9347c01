//! Scene that a viewer draws in 3-D: the corridor, its walls, still obstacles, the drone and its
//! trail, the frames.

use skein_protocol::transition::TransitionRecord;
use skein_simulator::camera::CameraSettings;
use skein_simulator::course::{Course, DRONE_WIDTH_M};

use crate::messages::{
    BODY, CAMERA, Color, CubePrimitive, FrameTransform, LinePrimitive, Pose, SceneEntity,
    SceneEntityDeletion, SceneUpdate, Timestamp, TriangleListPrimitive, Vector3, WORLD,
};

/// Beginnings of the entities' names.
pub(crate) const CORRIDOR: &str = "corridor";
pub(crate) const WALL: &str = "wall";
/// Name of the entity of all obstacles that stand still.
pub(crate) const OBSTACLES: &str = "obstacles";

/// Height of the drone's body, metres. Source: as for [`DRONE_WIDTH_M`].
const DRONE_HEIGHT_M: f32 = 0.29;
const ALL: i32 = 1;
const STRIP: i32 = 0;
const LOOP: i32 = 1;

const WALL_COLOUR: [f64; 4] = [0.45, 0.5, 0.58, 0.75];
const EDGE: [f64; 4] = [0.2, 0.22, 0.26, 1.0];
const DRONE: [f64; 4] = [0.78, 0.33, 0.11, 1.0];
const TRAIL: [f64; 4] = [0.12, 0.37, 0.66, 1.0];

/// Returns the scene of an episode: it replaces everything of the one before.
pub(crate) fn of_course(course: &Course, title: &str, at: Timestamp) -> SceneUpdate {
    let mut entities = vec![corridor(course, at), drone(at)];
    let walls = course.walls().iter().zip(course.wall_triangles());
    for (number, (wall, triangles)) in (1..).zip(walls) {
        entities.push(SceneEntity {
            triangles: vec![TriangleListPrimitive {
                pose: Some(Pose::origin()),
                points: triangles.into_iter().flatten().map(Vector3::from).collect(),
                color: Some(Color::rgba(WALL_COLOUR)),
            }],
            lines: vec![line(
                LOOP,
                wall.outline()
                    .iter()
                    .map(|&[y_m, z_m]| [wall.x_m(), y_m, z_m]),
                EDGE,
            )],
            ..entity(WORLD, format!("{WALL} {number}"), at)
        });
    }
    let obstacles = course.obstacle_triangles();
    if !obstacles.is_empty() {
        entities.push(SceneEntity {
            triangles: vec![TriangleListPrimitive {
                pose: Some(Pose::origin()),
                points: obstacles.into_iter().flatten().map(Vector3::from).collect(),
                color: Some(Color::rgba(WALL_COLOUR)),
            }],
            ..entity(WORLD, OBSTACLES.to_owned(), at)
        });
    }
    if let Some(first) = entities.first_mut() {
        first.id = format!("{CORRIDOR}: {title}");
    }
    SceneUpdate {
        deletions: vec![SceneEntityDeletion {
            timestamp: Some(at),
            kind: ALL,
        }],
        entities,
    }
}

/// Returns the way of the drone within one step.
pub(crate) fn trail(step: u32, from_m: [f32; 3], to_m: [f32; 3], at: Timestamp) -> SceneUpdate {
    let way = SceneEntity {
        lines: vec![line(STRIP, [from_m, to_m], TRAIL)],
        ..entity(WORLD, format!("trail {step}"), at)
    };
    SceneUpdate {
        deletions: Vec::new(),
        entities: vec![way],
    }
}

/// Returns the frames at an observation: the body in the world, and the camera in the body.
///
/// The axes of the body are forward, left, up, those of the camera right, down, forward.
pub(crate) fn frames(
    record: &TransitionRecord,
    camera: &CameraSettings,
    at: Timestamp,
) -> Vec<FrameTransform> {
    let transform =
        |parent: &str, child: &str, translation: [f32; 3], rotation: [f32; 4]| FrameTransform {
            timestamp: Some(at),
            parent_frame_id: parent.to_owned(),
            child_frame_id: child.to_owned(),
            translation: Some(translation.into()),
            rotation: Some(rotation.into()),
        };
    vec![
        transform(WORLD, BODY, record.position_m, record.orientation),
        transform(BODY, CAMERA, camera.mount_m, body_from_camera(camera)),
    ]
}

/// Returns the rotation of the camera in the body (i, j, k, w): a camera that looks forward,
/// pitched up about the body's axis to the left.
fn body_from_camera(camera: &CameraSettings) -> [f32; 4] {
    // Upwards is against the axis to the left.
    let (sin, cos) = (-camera.mount_pitch_deg.to_radians() / 2.0).sin_cos();
    // The level camera: (-1/2, 1/2, -1/2, 1/2).
    [-cos - sin, cos + sin, sin - cos, cos - sin].map(|part| part / 2.0)
}

fn corridor(course: &Course, at: Timestamp) -> SceneEntity {
    let corridor = course.corridor();
    let half_m = corridor.width_m / 2.0;
    let section = [
        [half_m, 0.0],
        [half_m, corridor.height_m],
        [-half_m, corridor.height_m],
        [-half_m, 0.0],
    ];
    let ring = |x_m: f32| line(LOOP, section.map(|[y_m, z_m]| [x_m, y_m, z_m]), EDGE);
    let along = section.map(|[y_m, z_m]| {
        let ends = [[0.0, y_m, z_m], [corridor.length_m, y_m, z_m]];
        line(STRIP, ends, EDGE)
    });
    let rings = [ring(0.0), ring(corridor.length_m)];
    SceneEntity {
        lines: rings.into_iter().chain(along).collect(),
        ..entity(WORLD, CORRIDOR.to_owned(), at)
    }
}

fn drone(at: Timestamp) -> SceneEntity {
    SceneEntity {
        frame_locked: true,
        cubes: vec![CubePrimitive {
            pose: Some(Pose::origin()),
            size: Some([DRONE_WIDTH_M, DRONE_WIDTH_M, DRONE_HEIGHT_M].into()),
            color: Some(Color::rgba(DRONE)),
        }],
        ..entity(BODY, "drone".to_owned(), at)
    }
}

fn entity(frame: &str, id: String, at: Timestamp) -> SceneEntity {
    SceneEntity {
        timestamp: Some(at),
        frame_id: frame.to_owned(),
        id,
        ..SceneEntity::default()
    }
}

fn line(
    kind: i32,
    points_m: impl IntoIterator<Item = [f32; 3]>,
    colour: [f64; 4],
) -> LinePrimitive {
    LinePrimitive {
        kind,
        pose: Some(Pose::origin()),
        thickness: 2.0,
        scale_invariant: true,
        points: points_m.into_iter().map(Vector3::from).collect(),
        color: Some(Color::rgba(colour)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns `vector` turned by the unit quaternion `(i, j, k, w)`.
    fn turned([i, j, k, w]: [f32; 4], vector: [f32; 3]) -> [f32; 3] {
        let cross = |a: [f32; 3], b: [f32; 3]| {
            [
                a[1] * b[2] - a[2] * b[1],
                a[2] * b[0] - a[0] * b[2],
                a[0] * b[1] - a[1] * b[0],
            ]
        };
        let twice = cross([i, j, k], vector).map(|part| 2.0 * part);
        let inner = cross([i, j, k], twice);
        std::array::from_fn(|axis| vector[axis] + w * twice[axis] + inner[axis])
    }

    #[test]
    fn the_camera_looks_forward_and_its_pitch_is_upwards() {
        for (pitch_deg, forward) in [(0.0, [1.0, 0.0, 0.0]), (90.0, [0.0, 0.0, 1.0])] {
            let camera = CameraSettings {
                mount_pitch_deg: pitch_deg,
                ..CameraSettings::default()
            };
            let rotation = body_from_camera(&camera);
            let close = |got: [f32; 3], expected: [f32; 3]| {
                let far = (0..3).any(|axis| (got[axis] - expected[axis]).abs() > 1e-6);
                assert!(!far, "{pitch_deg}: {got:?} is not {expected:?}");
            };
            close(turned(rotation, [0.0, 0.0, 1.0]), forward);
            close(turned(rotation, [1.0, 0.0, 0.0]), [0.0, -1.0, 0.0]);
        }
    }
}
