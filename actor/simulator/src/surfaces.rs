//! Surfaces that a body may touch, as triangles in a tree of boxes.

use nalgebra::{Point3, Vector3};
use rapier3d::math::Pose;
use rapier3d::parry::bounding_volume::Aabb;
use rapier3d::parry::query::{DefaultQueryDispatcher, PointQuery, QueryDispatcher};
use rapier3d::parry::shape::{Cuboid, TriMesh, TriMeshBuilderError, TriMeshFlags};

use crate::body::glam;
use crate::course::Mesh;

/// Surfaces of a wall or of obstacles. They are hollow: a body inside touches nothing.
pub(crate) struct Surfaces {
    triangles: TriMesh,
}

impl Surfaces {
    /// Takes all surfaces of `mesh`.
    ///
    /// # Errors
    /// parry's reason if they form no triangle mesh. Such surfaces would be air.
    pub(crate) fn of(mesh: &Mesh) -> Result<Self, TriMeshBuilderError> {
        let triangles = mesh.triangles().into_iter().map(|(triangle, _)| triangle);
        Self::of_triangles(mesh, triangles.collect())
    }

    /// Takes `triangles` of `mesh`, with their own vertices alone.
    ///
    /// # Errors
    /// As [`Self::of`].
    pub(crate) fn of_triangles(
        mesh: &Mesh,
        mut triangles: Vec<[u32; 3]>,
    ) -> Result<Self, TriMeshBuilderError> {
        let used = triangles.iter().flatten().copied();
        let first = used.clone().min().unwrap_or(0);
        let end = used.max().map_or(0, |last| last + 1);
        for corner in triangles.iter_mut().flatten() {
            *corner -= first;
        }
        let vertices = &mesh.vertices[first as usize..end as usize];
        let triangles = TriMesh::new(
            vertices.iter().map(|vertex| glam(&vertex.coords)).collect(),
            triangles,
        )?;
        Ok(Self { triangles })
    }

    /// Returns the box around them.
    pub(crate) fn bounds(&self) -> Aabb {
        self.triangles.local_aabb()
    }

    /// Returns `true` if a point lies inside them. Surfaces with holes hold nothing.
    pub(crate) fn hold(&self, point_m: &Point3<f32>) -> bool {
        let mut oriented = self.triangles.clone();
        oriented.set_flags(TriMeshFlags::ORIENTED).is_ok()
            && oriented.contains_local_point(glam(&point_m.coords))
    }

    /// Returns `true` if a body of `shape` at `world_from_body` touches them.
    pub(crate) fn touch(&self, world_from_body: &Pose, shape: &Cuboid) -> bool {
        DefaultQueryDispatcher
            .intersection_test(&world_from_body.inverse(), shape, &self.triangles)
            // Fails for unsupported shapes alone. A failure must never mean "no contact".
            .expect("parry tests a cuboid against a triangle mesh")
            .intersecting
    }

    /// Returns the distance of a point, m.
    pub(crate) fn distance_m(&self, point_m: &Point3<f32>) -> f32 {
        let point_m = glam(&point_m.coords);
        self.triangles.distance_to_local_point(point_m, false).abs()
    }

    /// Returns `true` if an upright box touches them. `half_m`: half its size, metres.
    pub(crate) fn touch_box(&self, middle_m: &Point3<f32>, half_m: &Vector3<f32>) -> bool {
        let pose = Pose::from_translation(glam(&middle_m.coords));
        self.touch(&pose, &Cuboid::new(glam(half_m)))
    }
}
