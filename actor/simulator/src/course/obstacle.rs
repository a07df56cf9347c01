//! Obstacles of a world, as closed surfaces of flat faces.

use std::sync::Arc;

use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion};

use super::{Mesh, Motion, Opening};

/// Number of sides that stand for the round side of a cylinder or a sphere. It deviates from the
/// circle by 3.4 % of the radius.
pub const ROUND_SIDES: usize = 12;

/// Solid thing in a world.
#[derive(Debug, Clone, PartialEq)]
pub struct Obstacle {
    /// Shape around its middle.
    pub shape: ObstacleShape,
    /// Place of the middle, metres.
    pub centre_m: [f32; 3],
    /// Roll, pitch and yaw: turns about x, then y, then z of the world frame, degrees.
    pub rotation_deg: [f32; 3],
    /// Motion; `None` for an obstacle that stands still.
    pub motion: Option<Motion>,
}

/// Shape of an obstacle before it is turned and placed. Lengths are in metres.
#[derive(Debug, Clone, PartialEq)]
pub enum ObstacleShape {
    /// A box.
    Box {
        /// Along x, y and z.
        size_m: [f32; 3],
    },
    /// A cylinder along z, with [`ROUND_SIDES`] sides.
    Cylinder {
        /// Distance of the sides' edges from the axis.
        radius_m: f32,
        /// Along z.
        height_m: f32,
    },
    /// A sphere of flat faces, [`ROUND_SIDES`] around.
    Sphere {
        /// Distance of the corners from the middle.
        radius_m: f32,
    },
    /// A wall across x with openings. Their coordinates `[y, z]` are relative to the wall's middle.
    Wall {
        /// Thickness along x, width along y, height along z.
        size_m: [f32; 3],
        /// Openings, which do not touch each other or the wall's rim.
        openings: Vec<Opening>,
    },
    /// Triangles of a file.
    Mesh(Arc<TriangleMesh>),
}

/// Triangles whose corners run counter-clockwise seen from the free side.
#[derive(Debug, Clone, PartialEq)]
pub struct TriangleMesh {
    /// Corners, metres.
    pub vertices_m: Vec<[f32; 3]>,
    /// Vertex numbers.
    pub triangles: Vec<[u32; 3]>,
}

impl Obstacle {
    /// Returns an obstacle that stands upright and still.
    pub(crate) fn still(shape: ObstacleShape, centre_m: [f32; 3]) -> Self {
        Self {
            shape,
            centre_m,
            rotation_deg: [0.0; 3],
            motion: None,
        }
    }

    /// Returns its surfaces at its place, as seen from outside.
    pub(crate) fn mesh(&self) -> Mesh {
        let mut mesh = self.shape.mesh();
        let place = self.world_from_obstacle();
        for vertex in &mut mesh.vertices {
            *vertex = place * *vertex;
        }
        // Only now: turning a normal would round it differently from its corners.
        let faces = std::mem::take(&mut mesh.surfaces);
        for face in faces {
            mesh.add_face(face.loops);
        }
        mesh
    }

    fn world_from_obstacle(&self) -> Isometry3<f32> {
        let [roll, pitch, yaw] = self.rotation_deg.map(f32::to_radians);
        Isometry3::from_parts(
            Translation3::from(self.centre_m),
            UnitQuaternion::from_euler_angles(roll, pitch, yaw),
        )
    }
}

impl ObstacleShape {
    /// Returns the shape's name in world files.
    #[must_use]
    pub fn name(&self) -> &'static str {
        match self {
            Self::Box { .. } => "box",
            Self::Cylinder { .. } => "cylinder",
            Self::Sphere { .. } => "sphere",
            Self::Wall { .. } => "wall",
            Self::Mesh(_) => "mesh",
        }
    }

    fn mesh(&self) -> Mesh {
        match self {
            Self::Box { size_m } => {
                let [x, y, z] = size_m.map(|size| size / 2.0);
                let section = [[-x, -y], [x, -y], [x, y], [-x, y]];
                stacked([-z, z].map(|z| section.map(|[x, y]| Point3::new(x, y, z)).to_vec()))
            }
            Self::Cylinder { radius_m, height_m } => {
                let half = height_m / 2.0;
                stacked([-half, half].map(|z| circle(*radius_m, z)))
            }
            Self::Sphere { radius_m } => {
                let latitudes = 1..ROUND_SIDES / 2;
                stacked(latitudes.map(|number| {
                    let below = std::f32::consts::TAU / ROUND_SIDES as f32 * number as f32;
                    circle(radius_m * below.sin(), -radius_m * below.cos())
                }))
            }
            Self::Wall { size_m, openings } => wall(*size_m, openings),
            Self::Mesh(triangles) => triangles.mesh(),
        }
    }
}

impl TriangleMesh {
    fn mesh(&self) -> Mesh {
        let mut mesh = Mesh {
            vertices: self.vertices_m.iter().copied().map(Point3::from).collect(),
            surfaces: Vec::new(),
        };
        for triangle in &self.triangles {
            mesh.add_face(vec![triangle.to_vec()]);
        }
        mesh
    }
}

/// Returns a level ring, counter-clockwise seen from above.
fn circle(radius_m: f32, z_m: f32) -> Vec<Point3<f32>> {
    let corner = |number: usize| {
        let turn = std::f32::consts::TAU / ROUND_SIDES as f32 * (number as f32 + 0.5);
        Point3::new(radius_m * turn.cos(), radius_m * turn.sin(), z_m)
    };
    (0..ROUND_SIDES).map(corner).collect()
}

/// Returns the solid between level rings of equally many corners, from the lowest to the highest.
fn stacked(rings: impl IntoIterator<Item = Vec<Point3<f32>>>) -> Mesh {
    let mut mesh = Mesh::default();
    let rings: Vec<_> = rings
        .into_iter()
        .map(|ring| mesh.add_points(ring))
        .collect();
    for pair in rings.windows(2) {
        mesh.add_band(&pair[0], &pair[1]);
    }
    if let [lowest, .., highest] = rings.as_slice() {
        mesh.add_face(vec![lowest.iter().rev().copied().collect()]);
        mesh.add_face(vec![highest.clone()]);
    }
    mesh
}

/// Returns a wall across x with openings.
fn wall([thickness_m, width_m, height_m]: [f32; 3], openings: &[Opening]) -> Mesh {
    let (y, z) = (width_m / 2.0, height_m / 2.0);
    let rim = vec![[-y, -z], [y, -z], [y, z], [-y, z]];
    let outlines: Vec<_> = openings.iter().map(Opening::outline).collect();
    let mut mesh = Mesh::default();
    // Seen from +x, with y to the right, all loops run counter-clockwise.
    let mut loops_at = |x_m: f32| -> Vec<Vec<u32>> {
        let at = |ring: &Vec<[f32; 2]>| {
            mesh.add_points(ring.iter().map(|&[y, z]| Point3::new(x_m, y, z)))
        };
        std::iter::once(&rim).chain(&outlines).map(at).collect()
    };
    let (front, back) = (loops_at(-thickness_m / 2.0), loops_at(thickness_m / 2.0));
    let reversed = |ring: &Vec<u32>| ring.iter().rev().copied().collect();
    mesh.add_face(front.iter().map(reversed).collect());
    mesh.add_face(back.clone());
    mesh.add_band(&front[0], &back[0]);
    for (front, back) in front.iter().zip(&back).skip(1) {
        // The inside of an opening is seen from within.
        mesh.add_band(back, front);
    }
    mesh
}

impl Mesh {
    fn add_points(&mut self, points: impl IntoIterator<Item = Point3<f32>>) -> Vec<u32> {
        let first = self.vertices.len() as u32;
        self.vertices.extend(points);
        (first..self.vertices.len() as u32).collect()
    }

    /// Adds the faces between two rings of equally many corners, which run counter-clockwise seen
    /// from the far one.
    fn add_band(&mut self, near: &[u32], far: &[u32]) {
        for side in 0..near.len() {
            let next = (side + 1) % near.len();
            self.add_face(vec![vec![near[side], near[next], far[next], far[side]]]);
        }
    }
}
