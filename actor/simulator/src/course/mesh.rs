//! Surfaces of a course. The camera draws and the body hits the same surfaces.
//!
//! A surface is flat and one-sided: its normal points into the free space. Neighbouring surfaces
//! share their vertices, so that no crack can open between them.

use earcut::Earcut;
use nalgebra::{Point3, Vector3};

use super::{Course, Sides, Wall};

/// Part of the course to which a surface belongs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) enum SurfaceKind {
    /// Floor, ceiling and sides of the corridor, and the end behind the start.
    Corridor,
    /// The wall at the corridor's end: the destination.
    EndWall,
    /// A wall with an opening, by its place in course order from 0: its front, its back and the
    /// inside of its opening.
    Wall(usize),
    /// An obstacle of a world.
    Obstacle,
}

/// A flat face, visible from the side to which its normal points.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct MeshSurface {
    /// Part of the course to which it belongs.
    pub(crate) kind: SurfaceKind,
    /// Closed loops of vertex numbers: the rim and, in a wall, the opening. They do not touch each
    /// other.
    pub(crate) loops: Vec<Vec<u32>>,
    /// Unit vector into the free space, world frame.
    pub(crate) normal: Vector3<f32>,
    /// `normal . p` for every point `p` of the surface, metres.
    pub(crate) offset_m: f32,
}

/// Surfaces of a course or of an obstacle, and their corners in the world frame.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Mesh {
    /// Corners, metres.
    pub(crate) vertices: Vec<Point3<f32>>,
    /// Faces.
    pub(crate) surfaces: Vec<MeshSurface>,
}

impl Mesh {
    pub(super) fn of(course: &Course) -> Self {
        let mut mesh = Self::default();
        match course.sides() {
            Sides::Closed => mesh.add_corridor(course),
            Sides::Open => mesh.add_floor(course),
        }
        for (place, wall) in course.walls().iter().enumerate() {
            mesh.add_wall(course, place, wall);
        }
        mesh
    }

    /// Returns the triangles as vertex numbers, counter-clockwise seen from the free side, each
    /// with the number of its surface.
    pub(crate) fn triangles(&self) -> Vec<([u32; 3], usize)> {
        let mut earcut = Earcut::new();
        let mut corners: Vec<u32> = Vec::new();
        let mut triangles = Vec::new();
        for (number, surface) in self.surfaces.iter().enumerate() {
            let rim: Vec<u32> = surface.loops.concat();
            let holes: Vec<u32> = surface
                .loops
                .iter()
                .scan(0, |start, ring| {
                    *start += ring.len() as u32;
                    Some(*start)
                })
                .take(surface.loops.len() - 1)
                .collect();
            let flat = rim
                .iter()
                .map(|&v| surface.flatten(self.vertices[v as usize]));
            earcut.earcut(flat, &holes, &mut corners);
            for &[a, b, c] in corners.as_chunks::<3>().0 {
                let [a, b, c] = [a, b, c].map(|corner| rim[corner as usize]);
                let faces_out = self.triangle_normal([a, b, c]).dot(&surface.normal) > 0.0;
                triangles.push((if faces_out { [a, b, c] } else { [a, c, b] }, number));
            }
        }
        triangles
    }

    /// Adds the surfaces of another mesh.
    pub(crate) fn append(&mut self, other: Self) {
        let first = self.vertices.len() as u32;
        self.vertices.extend(other.vertices);
        self.surfaces
            .extend(other.surfaces.into_iter().map(|mut surface| {
                for vertex in surface.loops.iter_mut().flatten() {
                    *vertex += first;
                }
                surface
            }));
    }

    fn triangle_normal(&self, triangle: [u32; 3]) -> Vector3<f32> {
        let [a, b, c] = triangle.map(|v| self.vertices[v as usize]);
        (b - a).cross(&(c - a))
    }

    fn add_corridor(&mut self, course: &Course) {
        let corridor = course.corridor();
        let first = self.add_ring(0.0, &rim_of(course));
        let last = self.add_ring(corridor.length_m, &rim_of(course));
        let end = match course.is_world() {
            true => SurfaceKind::Corridor,
            false => SurfaceKind::EndWall,
        };
        self.add_surface(SurfaceKind::Corridor, vec![first.clone()], Vector3::x());
        self.add_surface(end, vec![last.clone()], -Vector3::x());
        // The rim runs along the floor, up the left side, back along the ceiling and down the right
        // side.
        let inwards = [Vector3::z(), -Vector3::y(), -Vector3::z(), Vector3::y()];
        for (side, inward) in inwards.into_iter().enumerate() {
            self.add_surface(
                SurfaceKind::Corridor,
                vec![band(&first, &last, side)],
                inward,
            );
        }
    }

    fn add_floor(&mut self, course: &Course) {
        let first = self.add_ring(0.0, &rim_of(course));
        let last = self.add_ring(course.corridor().length_m, &rim_of(course));
        let floor = vec![band(&first, &last, 0)];
        self.add_surface(SurfaceKind::Corridor, floor, Vector3::z());
    }

    /// Adds a face of an obstacle. Its first loop runs counter-clockwise seen from the free side,
    /// the others, if any, are holes.
    pub(super) fn add_face(&mut self, loops: Vec<Vec<u32>>) {
        let normal = self.newell_normal(&loops[0]);
        self.add_surface(SurfaceKind::Obstacle, loops, normal);
    }

    /// Returns the unit normal of a loop, towards the side from which it runs counter-clockwise.
    fn newell_normal(&self, ring: &[u32]) -> Vector3<f32> {
        // Relative to the first corner: far from the origin, the products would lose their digits.
        let origin = self.vertices[ring[0] as usize];
        let from = ring
            .iter()
            .map(|&corner| self.vertices[corner as usize] - origin);
        let to = from.clone().cycle().skip(1);
        let twice_area: Vector3<f32> = from.zip(to).map(|(a, b)| a.cross(&b)).sum();
        twice_area.normalize()
    }

    fn add_wall(&mut self, course: &Course, place: usize, wall: &Wall) {
        let kind = SurfaceKind::Wall(place);
        let (front_m, back_m) = (wall.x_m(), wall.x_m() + course.wall_thickness_m());
        let front_rim = self.add_ring(front_m, &rim_of(course));
        let back_rim = self.add_ring(back_m, &rim_of(course));
        let front_hole = self.add_ring(front_m, wall.outline());
        let back_hole = self.add_ring(back_m, wall.outline());
        self.add_surface(kind, vec![front_rim, front_hole.clone()], -Vector3::x());
        self.add_surface(kind, vec![back_rim, back_hole.clone()], Vector3::x());
        for (side, (a, b)) in super::polygon::edges(wall.outline()).enumerate() {
            // The outline runs counter-clockwise, so the free space lies to its left.
            let inward = Vector3::new(0.0, a[1] - b[1], b[0] - a[0]).normalize();
            self.add_surface(kind, vec![band(&front_hole, &back_hole, side)], inward);
        }
    }

    fn add_ring(&mut self, x_m: f32, points: &[[f32; 2]]) -> Vec<u32> {
        let first = self.vertices.len() as u32;
        self.vertices
            .extend(points.iter().map(|&[y, z]| Point3::new(x_m, y, z)));
        (first..self.vertices.len() as u32).collect()
    }

    fn add_surface(&mut self, kind: SurfaceKind, loops: Vec<Vec<u32>>, normal: Vector3<f32>) {
        let offset_m = normal.dot(&self.vertices[loops[0][0] as usize].coords);
        self.surfaces.push(MeshSurface {
            kind,
            loops,
            normal,
            offset_m,
        });
    }
}

impl MeshSurface {
    /// Projects a point to two coordinates by dropping the axis nearest to the normal.
    fn flatten(&self, point: Point3<f32>) -> [f32; 2] {
        match self.normal.iamax() {
            0 => [point.y, point.z],
            1 => [point.z, point.x],
            _ => [point.x, point.y],
        }
    }
}

/// Returns the corridor's cross-section, counter-clockwise from the right end of the floor.
fn rim_of(course: &Course) -> [[f32; 2]; 4] {
    let corridor = course.corridor();
    let (half, top) = (corridor.width_m / 2.0, corridor.height_m);
    [[-half, 0.0], [half, 0.0], [half, top], [-half, top]]
}

/// Returns the quad between the same side of two rings.
fn band(near: &[u32], far: &[u32], side: usize) -> Vec<u32> {
    let next = (side + 1) % near.len();
    vec![near[side], near[next], far[next], far[side]]
}

#[cfg(test)]
mod tests {
    use super::super::test_course;
    use super::*;

    #[test]
    fn every_vertex_lies_on_its_surfaces_planes() {
        let mesh = test_course().mesh();
        for surface in &mesh.surfaces {
            for &v in surface.loops.iter().flatten() {
                let off = surface.normal.dot(&mesh.vertices[v as usize].coords) - surface.offset_m;
                assert!(off.abs() < 1e-5, "{:?} off by {off}", surface.kind);
            }
        }
    }

    #[test]
    fn normals_point_into_the_free_space() {
        let course = test_course();
        let mesh = course.mesh();
        let corridor = course.corridor();
        for surface in &mesh.surfaces {
            let ring = &surface.loops[0];
            let [a, c] = [ring[0], ring[2]].map(|v| mesh.vertices[v as usize].coords);
            let within = a * 0.6 + c * 0.4;
            // A small step along the normal from a point of the surface must end in air.
            let at = match surface.loops.len() {
                1 => within + surface.normal * 0.05,
                _ => {
                    mesh.vertices[ring[0] as usize].coords
                        + surface.normal * 0.05
                        + Vector3::new(0.0, 0.05, 0.05)
                }
            };
            assert!(
                (0.0..=corridor.length_m).contains(&at.x)
                    && at.y.abs() <= 3.0
                    && (0.0..=7.0).contains(&at.z)
            );
            let in_wall = course.walls().iter().any(|wall| {
                (wall.x_m()..wall.x_m() + course.wall_thickness_m()).contains(&at.x)
                    && super::super::polygon::signed_distance(wall.outline(), [at.y, at.z]) < 0.0
            });
            assert!(!in_wall, "{:?} {at}", surface.kind);
        }
    }

    #[test]
    fn triangles_cover_each_surface_exactly() {
        let course = test_course();
        let mesh = course.mesh();
        let mut areas = vec![0.0; mesh.surfaces.len()];
        for (triangle, surface) in mesh.triangles() {
            let normal = mesh.triangle_normal(triangle);
            assert!(
                normal.dot(&mesh.surfaces[surface].normal) > 0.0,
                "the triangle faces the wrong way"
            );
            areas[surface] += normal.norm() / 2.0;
        }
        for (surface, area) in mesh.surfaces.iter().zip(areas) {
            if let (SurfaceKind::Wall(place), 2) = (surface.kind, surface.loops.len()) {
                let hole = super::super::polygon::signed_area(course.walls()[place].outline());
                assert!((area - (42.0 - hole)).abs() < 1e-3, "wall {place}: {area}");
            }
        }
    }
}
