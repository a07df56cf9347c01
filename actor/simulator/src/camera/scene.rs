//! A course's surfaces, prepared for drawing.
//!
//! Surfaces are grouped into parts, and a tree of boxes holds the parts: whatever is out of sight
//! is passed over, a whole branch at a time. A part that moves has its own coordinates, in which
//! the camera moves instead.

use std::ops::Range;

use nalgebra::{Matrix3, Point3, Vector3};
use parry3d::bounding_volume::Aabb;
use parry3d::math::Vector;
use parry3d::partitioning::{Bvh, BvhBuildStrategy};

use super::CameraSettings;
use super::canvas::{DepthCanvas, ImagePoint, Nearness};
use super::settings::{CameraView, MIDDLE_PX};
use crate::course::{Course, Mesh, MeshSurface, Moment, Motion, SurfaceKind};

/// Distance of the lens from a surface's plane below which the surface is edge-on and invisible,
/// metres.
const EDGE_ON_M: f32 = 1e-6;

/// Most surfaces of a part of an obstacle.
const MOST_FACES: usize = 64;

/// Distance by which a box may lie out of sight and still be drawn, metres: more than rounding.
const MARGIN_M: f32 = 1e-3;

/// Surfaces of a course, grouped into parts.
pub(super) struct Scene {
    still: Vec<ScenePart>,
    /// Boxes of the parts that stand still, by their place.
    tree: Bvh,
    moving: Vec<MovingPart>,
    scratch: Scratch,
}

/// Memory for one part at a time.
struct Scratch {
    /// The part's vertices, projected.
    projected: Vec<ProjectedVertex>,
    /// Points where a face's edges meet the near plane, or the corners of a convex face.
    cuts: Vec<ImagePoint>,
}

/// The inside of the corridor, one wall, or some neighbouring faces of an obstacle.
struct ScenePart {
    vertices: Vec<Point3<f32>>,
    faces: Vec<SceneFace>,
    /// Vertex numbers of all closed loops of all faces, one loop after the other.
    corners: Vec<u32>,
    /// Range of each loop within `corners`.
    loops: Vec<Range<u32>>,
    bounds: PartBounds,
}

/// The box around a part.
#[derive(Clone, Copy)]
struct PartBounds {
    /// Middle, metres.
    middle: Point3<f32>,
    /// Half the size, metres.
    half_size: Vector3<f32>,
}

/// A part of an obstacle that moves.
struct MovingPart {
    part: ScenePart,
    motion: Motion,
    /// Place among the course's obstacles.
    number: usize,
}

/// A flat face, visible from the side to which its normal points.
struct SceneFace {
    normal: Vector3<f32>,
    offset_m: f32,
    /// Its loops among those of the part.
    loops: Range<u32>,
    outline: Outline,
}

/// Kind of a face's outline.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Outline {
    /// One loop that bends to one side: a face of an obstacle without openings.
    Convex,
    /// Anything.
    General,
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
#[derive(Clone, Copy)]
struct Projection {
    eye: Point3<f32>,
    camera_from_world: Matrix3<f32>,
    focal_px: f32,
    near_m: f32,
    range_m: f32,
    /// Normals of the planes around what is in sight, inwards: through the eye, and of the image's
    /// four sides. Not of unit length.
    sides: [Vector3<f32>; 4],
}

impl Scene {
    pub(super) fn new(course: &Course) -> Self {
        let wall = |surface: &MeshSurface| match surface.kind {
            SurfaceKind::Wall(place) => Some(place),
            SurfaceKind::Corridor | SurfaceKind::EndWall | SurfaceKind::Obstacle => None,
        };
        let mesh = course.mesh();
        let parts = mesh.surfaces.chunk_by(|a, b| wall(a) == wall(b));
        let mut still: Vec<_> = parts
            .map(|surfaces| ScenePart::new(&mesh, surfaces))
            .collect();
        let mut moving = Vec::new();
        for (number, obstacle) in course.obstacles().iter().enumerate() {
            let mesh = obstacle.mesh();
            let mut clusters = Vec::new();
            cluster(&mesh, mesh.surfaces.clone(), &mut clusters);
            let parts = clusters.iter().map(|faces| ScenePart::new(&mesh, faces));
            match obstacle.motion {
                None => still.extend(parts),
                Some(motion) => moving.extend(parts.map(|part| MovingPart {
                    part,
                    motion,
                    number,
                })),
            }
        }
        let all = || still.iter().chain(moving.iter().map(|moving| &moving.part));
        let most_vertices = all().map(|part| part.vertices.len()).max();
        let most_corners = all().map(|part| part.corners.len()).max();
        let boxes: Vec<_> = still.iter().map(|part| part.bounds.aabb()).collect();
        Self {
            tree: Bvh::from_leaves(BvhBuildStrategy::Binned, &boxes),
            scratch: Scratch {
                projected: Vec::with_capacity(most_vertices.unwrap_or(0)),
                // The near plane cuts a convex face twice.
                cuts: Vec::with_capacity(most_corners.unwrap_or(0) + 2),
            },
            still,
            moving,
        }
    }

    /// Draws all surfaces in sight at a moment onto a clear canvas.
    #[inline(always)]
    pub(super) fn draw(
        &mut self,
        settings: &CameraSettings,
        view: &CameraView,
        moment: Moment,
        canvas: &mut DepthCanvas,
    ) {
        let projection = Projection::of(settings, view);
        let is_in_sight = |bounds: PartBounds| projection.reaches(bounds);
        for place in self.tree.leaves(|node| is_in_sight(node.aabb().into())) {
            let part = &self.still[place as usize];
            part.draw(&projection, &mut self.scratch, canvas);
        }
        for moving in &self.moving {
            let projection = Projection {
                eye: view.eye - moving.motion.offset_m(moving.number, moment),
                ..projection
            };
            if projection.reaches(moving.part.bounds) {
                moving.part.draw(&projection, &mut self.scratch, canvas);
            }
        }
    }
}

/// Divides faces into clusters of neighbours, halving them along their longest extent.
fn cluster(mesh: &Mesh, mut faces: Vec<MeshSurface>, clusters: &mut Vec<Vec<MeshSurface>>) {
    if faces.len() <= MOST_FACES {
        clusters.push(faces);
        return;
    }
    let place = |face: &MeshSurface| mesh.vertices[face.loops[0][0] as usize];
    let places = || faces.iter().map(place);
    let least = places().reduce(|a, b| a.inf(&b)).unwrap_or_default();
    let most = places().reduce(|a, b| a.sup(&b)).unwrap_or_default();
    let axis = (most - least).imax();
    let half = faces.len() / 2;
    faces.select_nth_unstable_by(half, |a, b| place(a)[axis].total_cmp(&place(b)[axis]));
    let others = faces.split_off(half);
    cluster(mesh, faces, clusters);
    cluster(mesh, others, clusters);
}

impl PartBounds {
    fn aabb(&self) -> Aabb {
        let parry = |v: Vector3<f32>| Vector::new(v.x, v.y, v.z);
        Aabb::from_half_extents(parry(self.middle.coords), parry(self.half_size))
    }
}

impl From<Aabb> for PartBounds {
    #[inline(always)]
    fn from(bounds: Aabb) -> Self {
        let (middle, half) = (bounds.center(), bounds.half_extents());
        Self {
            middle: Point3::new(middle.x, middle.y, middle.z),
            half_size: Vector3::new(half.x, half.y, half.z),
        }
    }
}

impl ScenePart {
    fn new(mesh: &Mesh, surfaces: &[MeshSurface]) -> Self {
        let mut used: Vec<u32> = surfaces
            .iter()
            .flat_map(|surface| surface.loops.iter().flatten().copied())
            .collect();
        used.sort_unstable();
        used.dedup();
        let vertices: Vec<_> = used
            .iter()
            .map(|&vertex| mesh.vertices[vertex as usize])
            .collect();
        let corner = |vertex: &u32| used.partition_point(|other| other < vertex) as u32;
        let (mut faces, mut corners, mut loops) = (Vec::new(), Vec::new(), Vec::new());
        for surface in surfaces {
            let first = loops.len() as u32;
            for ring in &surface.loops {
                let begin = corners.len() as u32;
                corners.extend(ring.iter().map(corner));
                loops.push(begin..corners.len() as u32);
            }
            faces.push(SceneFace {
                normal: surface.normal,
                offset_m: surface.offset_m,
                loops: first..loops.len() as u32,
                outline: match (surface.kind, surface.loops.len()) {
                    (SurfaceKind::Obstacle, 1) => Outline::Convex,
                    _ => Outline::General,
                },
            });
        }
        let all = || vertices.iter().copied();
        let least = all().reduce(|a, b| a.inf(&b)).unwrap_or_default();
        let most = all().reduce(|a, b| a.sup(&b)).unwrap_or_default();
        Self {
            faces,
            corners,
            loops,
            bounds: PartBounds {
                middle: nalgebra::center(&least, &most),
                half_size: (most - least) / 2.0,
            },
            vertices,
        }
    }

    #[inline(always)]
    fn draw(&self, projection: &Projection, scratch: &mut Scratch, canvas: &mut DepthCanvas) {
        scratch.projected.clear();
        scratch.projected.extend(self.vertices.iter().map(|vertex| {
            let at_m = projection.camera_from_world * (vertex - projection.eye);
            ProjectedVertex {
                at_m,
                image: projection.project(at_m),
            }
        }));
        for face in &self.faces {
            let above_m = face.normal.dot(&projection.eye.coords) - face.offset_m;
            // Written so that nothing is drawn if the pose is NaN.
            if above_m > EDGE_ON_M {
                let nearness = || projection.nearness(face.normal, above_m);
                match face.outline {
                    Outline::Convex => {
                        self.corners(face, projection, scratch);
                        canvas.fill_convex(&scratch.cuts, nearness);
                    }
                    Outline::General => {
                        self.outline(face, projection, scratch, canvas);
                        canvas.fill(nearness());
                    }
                }
            }
        }
    }

    /// Leaves the corners of a convex face's part beyond the near distance in `scratch.cuts`.
    #[inline(always)]
    fn corners(
        &self,
        face: &SceneFace,
        projection: &Projection,
        Scratch { projected, cuts }: &mut Scratch,
    ) {
        cuts.clear();
        let range = &self.loops[face.loops.start as usize];
        let ring = &self.corners[range.start as usize..range.end as usize];
        let Some(&last) = ring.last() else { return };
        let mut from = projected[last as usize];
        for &corner in ring {
            let to = projected[corner as usize];
            let [from_beyond, to_beyond] = [from, to].map(|at| at.at_m.z >= projection.near_m);
            match (from_beyond, to_beyond) {
                (true, false) => cuts.push(projection.cross_near_plane(from.at_m, to.at_m)),
                (false, true) => cuts.push(projection.cross_near_plane(to.at_m, from.at_m)),
                _ => {}
            }
            if to_beyond {
                cuts.push(to.image);
            }
            from = to;
        }
    }

    /// Adds the face's edges beyond the near distance to the canvas, and closes them along the near
    /// plane.
    #[inline(always)]
    fn outline(
        &self,
        face: &SceneFace,
        projection: &Projection,
        Scratch { projected, cuts }: &mut Scratch,
        canvas: &mut DepthCanvas,
    ) {
        cuts.clear();
        for range in &self.loops[face.loops.start as usize..face.loops.end as usize] {
            let ring = &self.corners[range.start as usize..range.end as usize];
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
    fn of(settings: &CameraSettings, view: &CameraView) -> Self {
        let [across, along] = settings.half_view();
        Self {
            eye: view.eye,
            camera_from_world: view.camera_from_world(),
            focal_px: settings.focal_px(),
            near_m: settings.near_m,
            range_m: settings.range_m,
            sides: [
                view.forward * across - view.right,
                view.forward * across + view.right,
                view.forward * along - view.down,
                view.forward * along + view.down,
            ],
        }
    }

    /// Returns `true` if a point of a box can be in sight: between the near distance and the range,
    /// and within the image's sides.
    #[inline(always)]
    fn reaches(&self, bounds: PartBounds) -> bool {
        let forward = self.camera_from_world.row(2).transpose();
        let middle = bounds.middle - self.eye;
        let (middle_m, reach_m) = (
            forward.dot(&middle),
            forward.abs().dot(&bounds.half_size) + MARGIN_M,
        );
        middle_m + reach_m > self.near_m
            && middle_m - reach_m < self.range_m
            && self
                .sides
                .iter()
                .all(|side| side.dot(&middle) + side.abs().dot(&bounds.half_size) + MARGIN_M > 0.0)
    }

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
