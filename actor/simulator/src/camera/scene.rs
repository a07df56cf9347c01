//! A course's surfaces as the camera draws them.

use std::ops::Range;

use nalgebra::{Matrix3, Point3, Vector3};

use super::CameraSettings;
use super::canvas::{Canvas, ImagePoint, Nearness};
use super::settings::{MIDDLE_PX, View};
use crate::course::{Mesh, Surface, SurfaceKind};

/// Distance from its plane below which a surface is seen edge-on, metres: nothing of it then shows.
const EDGE_ON_M: f32 = 1e-6;

/// The surfaces of a mesh in parts, each skipped as a whole when it is out of sight.
pub(super) struct Scene {
    parts: Vec<Part>,
    /// Where the edges of a face meet the near plane; scratch memory.
    cuts: Vec<ImagePoint>,
}

/// The corridor's inside, or a wall.
struct Part {
    vertices: Vec<Point3<f32>>,
    faces: Vec<Face>,
    /// The box around the vertices: its middle and half its size, metres.
    middle: Point3<f32>,
    half_size: Vector3<f32>,
    /// The vertices as the camera sees them; scratch memory.
    seen: Vec<Seen>,
}

/// A flat face, seen from the side that its normal points to.
struct Face {
    normal: Vector3<f32>,
    offset_m: f32,
    /// Closed loops of vertex numbers, one after the other.
    corners: Vec<u32>,
    /// Where each loop lies in `corners`.
    loops: Vec<Range<usize>>,
}

/// A vertex in the optical frame and in the image.
#[derive(Clone, Copy)]
struct Seen {
    /// Right, down, forward of the lens, metres.
    at_m: Vector3<f32>,
    /// Meaningful beyond the near distance only.
    image: ImagePoint,
}

/// What every part needs of settings and pose.
struct Eye {
    at: Point3<f32>,
    camera_from_world: Matrix3<f32>,
    focal_px: f32,
    near_m: f32,
    range_m: f32,
}

impl Scene {
    pub(super) fn new(mesh: &Mesh) -> Self {
        let wall = |surface: &Surface| match surface.kind {
            SurfaceKind::Wall(place) => Some(place),
            SurfaceKind::Corridor | SurfaceKind::EndWall => None,
        };
        let parts = mesh.surfaces.chunk_by(|a, b| wall(a) == wall(b));
        let parts: Vec<_> = parts.map(|surfaces| Part::new(mesh, surfaces)).collect();
        let faces = parts.iter().flat_map(|part| &part.faces);
        let most_corners = faces.map(|face| face.corners.len()).max().unwrap_or(0);
        Self {
            parts,
            cuts: Vec::with_capacity(most_corners),
        }
    }

    /// Draws all surfaces in sight onto a clear canvas.
    #[inline(always)]
    pub(super) fn draw(&mut self, settings: &CameraSettings, view: &View, canvas: &mut Canvas) {
        let eye = Eye {
            at: view.eye,
            camera_from_world: view.camera_from_world(),
            focal_px: settings.focal_px(),
            near_m: settings.near_m,
            range_m: settings.range_m,
        };
        for part in &mut self.parts {
            if part.reaches_into_range(&eye) {
                part.look(&eye);
                part.draw(&eye, &mut self.cuts, canvas);
            }
        }
    }
}

impl Part {
    fn new(mesh: &Mesh, surfaces: &[Surface]) -> Self {
        let used = surfaces
            .iter()
            .flat_map(|surface| surface.loops.iter().flatten().copied());
        let first = used.clone().min().unwrap_or(0);
        let end = used.max().map_or(0, |last| last + 1);
        let vertices = mesh.vertices[first as usize..end as usize].to_vec();
        let least = vertices
            .iter()
            .copied()
            .reduce(|a, b| a.inf(&b))
            .unwrap_or_default();
        let most = vertices
            .iter()
            .copied()
            .reduce(|a, b| a.sup(&b))
            .unwrap_or_default();
        let nowhere = Seen {
            at_m: Vector3::zeros(),
            image: ImagePoint {
                column: 0.0,
                row: 0.0,
            },
        };
        Self {
            faces: surfaces
                .iter()
                .map(|surface| Face::new(surface, first))
                .collect(),
            middle: nalgebra::center(&least, &most),
            half_size: (most - least) / 2.0,
            seen: vec![nowhere; vertices.len()],
            vertices,
        }
    }

    /// Whether any point of the box can lie between the near distance and the range.
    #[inline(always)]
    fn reaches_into_range(&self, eye: &Eye) -> bool {
        let forward = eye.camera_from_world.row(2).transpose();
        let middle_m = forward.dot(&(self.middle - eye.at));
        let reach_m = forward.abs().dot(&self.half_size);
        middle_m + reach_m > eye.near_m && middle_m - reach_m < eye.range_m
    }

    /// Brings the vertices into the optical frame and the image.
    #[inline(always)]
    fn look(&mut self, eye: &Eye) {
        for (vertex, seen) in self.vertices.iter().zip(&mut self.seen) {
            let at_m = eye.camera_from_world * (vertex - eye.at);
            *seen = Seen {
                at_m,
                image: eye.project(at_m),
            };
        }
    }

    #[inline(always)]
    fn draw(&self, eye: &Eye, cuts: &mut Vec<ImagePoint>, canvas: &mut Canvas) {
        for face in &self.faces {
            let above_m = face.normal.dot(&eye.at.coords) - face.offset_m;
            // Written so that a pose that is not a number sees nothing.
            if above_m > EDGE_ON_M {
                face.outline(&self.seen, eye, cuts, canvas);
                canvas.fill(eye.nearness(face.normal, above_m));
            }
        }
    }
}

impl Face {
    /// `first`: number of the part's first vertex.
    fn new(surface: &Surface, first: u32) -> Self {
        let mut loops = Vec::new();
        let mut corners = Vec::new();
        for ring in &surface.loops {
            let begin = corners.len();
            corners.extend(ring.iter().map(|vertex| vertex - first));
            loops.push(begin..corners.len());
        }
        Self {
            normal: surface.normal,
            offset_m: surface.offset_m,
            corners,
            loops,
        }
    }

    /// Adds to the canvas what of the face's edges lies beyond the near distance, and what closes
    /// them there.
    ///
    /// `cuts`: scratch memory.
    #[inline(always)]
    fn outline(&self, seen: &[Seen], eye: &Eye, cuts: &mut Vec<ImagePoint>, canvas: &mut Canvas) {
        cuts.clear();
        for range in &self.loops {
            let ring = &self.corners[range.clone()];
            let Some(&last) = ring.last() else { continue };
            let mut from = seen[last as usize];
            for &corner in ring {
                let to = seen[corner as usize];
                match (from.at_m.z >= eye.near_m, to.at_m.z >= eye.near_m) {
                    (true, true) => canvas.add_edge(from.image, to.image),
                    (true, false) => {
                        let cut = eye.cross_near_plane(from.at_m, to.at_m);
                        canvas.add_edge(from.image, cut);
                        cuts.push(cut);
                    }
                    (false, true) => {
                        let cut = eye.cross_near_plane(to.at_m, from.at_m);
                        canvas.add_edge(cut, to.image);
                        cuts.push(cut);
                    }
                    (false, false) => {}
                }
                from = to;
            }
        }
        if !cuts.is_empty() {
            close_along_cuts(cuts, canvas);
        }
    }
}

/// Closes an outline along the near plane.
///
/// The cuts lie on one line, and the face between every other two of them. Closing each loop by
/// itself would lay edges of the rim and of the hole over each other, which cancel only as far as
/// their arithmetic agrees: a slit of near pixels remained.
fn close_along_cuts(cuts: &mut [ImagePoint], canvas: &mut Canvas) {
    let extent = |along: fn(&ImagePoint) -> f32| {
        let (least, most) = cuts
            .iter()
            .map(along)
            .fold((f32::INFINITY, f32::NEG_INFINITY), |(l, m), at| {
                (l.min(at), m.max(at))
            });
        most - least
    };
    let steep = extent(|cut| cut.row) > extent(|cut| cut.column);
    let along = |cut: &ImagePoint| if steep { cut.row } else { cut.column };
    cuts.sort_unstable_by(|a, b| along(a).total_cmp(&along(b)));
    for &[a, b] in cuts.as_chunks::<2>().0 {
        canvas.add_edge(a, b);
    }
}

impl Eye {
    #[inline(always)]
    fn project(&self, at_m: Vector3<f32>) -> ImagePoint {
        let scale = self.focal_px / at_m.z;
        ImagePoint {
            column: at_m.x * scale + MIDDLE_PX[0],
            row: at_m.y * scale + MIDDLE_PX[1],
        }
    }

    /// Where the way from `beyond` to `before` meets the near plane. Both faces at an edge ask with
    /// the same two points.
    #[inline(always)]
    fn cross_near_plane(&self, beyond: Vector3<f32>, before: Vector3<f32>) -> ImagePoint {
        let share = (beyond.z - self.near_m) / (beyond.z - before.z);
        let at_m = beyond + (before - beyond) * share;
        self.project(Vector3::new(at_m.x, at_m.y, self.near_m))
    }

    /// Of a plane with the world normal `normal`, `above_m` metres above which the lens is.
    #[inline(always)]
    fn nearness(&self, normal: Vector3<f32>, above_m: f32) -> Nearness {
        // A point of the plane: normal . (p - eye) = -above. With p - eye = depth * (column /
        // focal, row / focal, 1) in the optical frame, 1 / depth is affine in the image.
        let scaled = self.camera_from_world * normal * (-self.range_m / above_m);
        Nearness {
            per_column: scaled.x / self.focal_px,
            per_row: scaled.y / self.focal_px,
            in_middle: scaled.z,
        }
    }
}
