//! A course's surfaces, prepared for drawing.

use std::ops::Range;

use nalgebra::{Matrix3, Point3, Vector3};

use super::CameraSettings;
use super::canvas::{DepthCanvas, ImagePoint, Nearness};
use super::settings::{CameraView, MIDDLE_PX};
use crate::course::{Mesh, MeshSurface, SurfaceKind};

/// Distance of the lens from a surface's plane below which the surface is edge-on and invisible,
/// metres.
const EDGE_ON_M: f32 = 1e-6;

/// Surfaces of a mesh, grouped into parts. A part out of sight is skipped as a whole.
pub(super) struct Scene {
    parts: Vec<ScenePart>,
    /// Points where a face's edges meet the near plane; scratch memory.
    cuts: Vec<ImagePoint>,
}

/// The inside of the corridor, or one wall.
struct ScenePart {
    vertices: Vec<Point3<f32>>,
    faces: Vec<SceneFace>,
    /// Middle of the box around the vertices, metres.
    middle: Point3<f32>,
    /// Half the size of that box, metres.
    half_size: Vector3<f32>,
    /// The vertices, projected; scratch memory.
    projected: Vec<ProjectedVertex>,
}

/// A flat face, visible from the side to which its normal points.
struct SceneFace {
    normal: Vector3<f32>,
    offset_m: f32,
    /// Vertex numbers of all closed loops, one loop after the other.
    corners: Vec<u32>,
    /// Range of each loop within `corners`.
    loops: Vec<Range<usize>>,
}

/// A vertex in the optical frame and in the image.
#[derive(Clone, Copy)]
struct ProjectedVertex {
    /// Position right, down and forward of the lens, metres.
    at_m: Vector3<f32>,
    /// Position in the image; meaningful only beyond the near distance.
    image: ImagePoint,
}

/// Projection of the world into the image, for one pose.
struct Projection {
    eye: Point3<f32>,
    camera_from_world: Matrix3<f32>,
    focal_px: f32,
    near_m: f32,
    range_m: f32,
}

impl Scene {
    pub(super) fn new(mesh: &Mesh) -> Self {
        let wall = |surface: &MeshSurface| match surface.kind {
            SurfaceKind::Wall(place) => Some(place),
            SurfaceKind::Corridor | SurfaceKind::EndWall => None,
        };
        let parts = mesh.surfaces.chunk_by(|a, b| wall(a) == wall(b));
        let parts: Vec<_> = parts
            .map(|surfaces| ScenePart::new(mesh, surfaces))
            .collect();
        let faces = parts.iter().flat_map(|part| &part.faces);
        let most_corners = faces.map(|face| face.corners.len()).max().unwrap_or(0);
        Self {
            parts,
            cuts: Vec::with_capacity(most_corners),
        }
    }

    /// Draws all surfaces in sight onto a clear canvas.
    #[inline(always)]
    pub(super) fn draw(
        &mut self,
        settings: &CameraSettings,
        view: &CameraView,
        canvas: &mut DepthCanvas,
    ) {
        let projection = Projection {
            eye: view.eye,
            camera_from_world: view.camera_from_world(),
            focal_px: settings.focal_px(),
            near_m: settings.near_m,
            range_m: settings.range_m,
        };
        for part in &mut self.parts {
            if part.reaches_into_range(&projection) {
                part.project(&projection);
                part.draw(&projection, &mut self.cuts, canvas);
            }
        }
    }
}

impl ScenePart {
    fn new(mesh: &Mesh, surfaces: &[MeshSurface]) -> Self {
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
        let nowhere = ProjectedVertex {
            at_m: Vector3::zeros(),
            image: ImagePoint {
                column: 0.0,
                row: 0.0,
            },
        };
        Self {
            faces: surfaces
                .iter()
                .map(|surface| SceneFace::new(surface, first))
                .collect(),
            middle: nalgebra::center(&least, &most),
            half_size: (most - least) / 2.0,
            projected: vec![nowhere; vertices.len()],
            vertices,
        }
    }

    /// Returns `true` if a point of the box can lie between the near distance and the range.
    #[inline(always)]
    fn reaches_into_range(&self, projection: &Projection) -> bool {
        let forward = projection.camera_from_world.row(2).transpose();
        let middle_m = forward.dot(&(self.middle - projection.eye));
        let reach_m = forward.abs().dot(&self.half_size);
        middle_m + reach_m > projection.near_m && middle_m - reach_m < projection.range_m
    }

    /// Projects the vertices into the optical frame and the image.
    #[inline(always)]
    fn project(&mut self, projection: &Projection) {
        for (vertex, projected) in self.vertices.iter().zip(&mut self.projected) {
            let at_m = projection.camera_from_world * (vertex - projection.eye);
            *projected = ProjectedVertex {
                at_m,
                image: projection.project(at_m),
            };
        }
    }

    #[inline(always)]
    fn draw(&self, projection: &Projection, cuts: &mut Vec<ImagePoint>, canvas: &mut DepthCanvas) {
        for face in &self.faces {
            let above_m = face.normal.dot(&projection.eye.coords) - face.offset_m;
            // Written so that nothing is drawn if the pose is NaN.
            if above_m > EDGE_ON_M {
                face.outline(&self.projected, projection, cuts, canvas);
                canvas.fill(projection.nearness(face.normal, above_m));
            }
        }
    }
}

impl SceneFace {
    /// `first`: number of the part's first vertex.
    fn new(surface: &MeshSurface, first: u32) -> Self {
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

    /// Adds the face's edges beyond the near distance to the canvas, and closes them along the near
    /// plane.
    ///
    /// `cuts`: scratch memory.
    #[inline(always)]
    fn outline(
        &self,
        projected: &[ProjectedVertex],
        projection: &Projection,
        cuts: &mut Vec<ImagePoint>,
        canvas: &mut DepthCanvas,
    ) {
        cuts.clear();
        for range in &self.loops {
            let ring = &self.corners[range.clone()];
            let Some(&last) = ring.last() else { continue };
            let mut from = projected[last as usize];
            for &corner in ring {
                let to = projected[corner as usize];
                match (
                    from.at_m.z >= projection.near_m,
                    to.at_m.z >= projection.near_m,
                ) {
                    (true, true) => canvas.add_edge(from.image, to.image),
                    (true, false) => {
                        let cut = projection.cross_near_plane(from.at_m, to.at_m);
                        canvas.add_edge(from.image, cut);
                        cuts.push(cut);
                    }
                    (false, true) => {
                        let cut = projection.cross_near_plane(to.at_m, from.at_m);
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
/// The cuts lie on one line, and the face lies between the first and second, the third and fourth,
/// and so on. Closing each loop separately would put edges of the rim and of the hole on top of
/// each other. They cancel only as far as their arithmetic agrees, which left a slit of near
/// pixels.
fn close_along_cuts(cuts: &mut [ImagePoint], canvas: &mut DepthCanvas) {
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

impl Projection {
    #[inline(always)]
    fn project(&self, at_m: Vector3<f32>) -> ImagePoint {
        let scale = self.focal_px / at_m.z;
        ImagePoint {
            column: at_m.x * scale + MIDDLE_PX[0],
            row: at_m.y * scale + MIDDLE_PX[1],
        }
    }

    /// Returns the point where the edge from `beyond` to `before` meets the near plane. Both faces
    /// of an edge pass the same two points.
    #[inline(always)]
    fn cross_near_plane(&self, beyond: Vector3<f32>, before: Vector3<f32>) -> ImagePoint {
        let share = (beyond.z - self.near_m) / (beyond.z - before.z);
        let at_m = beyond + (before - beyond) * share;
        self.project(Vector3::new(at_m.x, at_m.y, self.near_m))
    }

    /// Returns the nearness of a plane with the world normal `normal`; the lens is `above_m` metres
    /// above it.
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
