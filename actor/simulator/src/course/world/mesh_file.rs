//! Mesh files: OBJ and STL.

use std::collections::HashMap;
use std::ffi::OsStr;
use std::path::Path;

use super::MAX_TRIANGLES;
use super::file::UpAxis;
use crate::course::TriangleMesh;
use crate::text::read_file;

/// Most bytes of a mesh file.
const MOST_BYTES: u64 = 256 << 20;
/// Sizes outside which the unit must be wrong, metres.
const SMALLEST_M: f32 = 0.05;
const LARGEST_M: f32 = 500.0;
/// Share of a mesh's size below which a triangle's height is none.
const FLAT: f32 = 1e-6;

/// Reading of a file's numbers.
#[derive(Clone, Copy)]
pub(super) struct MeshScale {
    /// Metres of a unit of the file.
    pub(super) factor: f32,
    pub(super) up: UpAxis,
    /// Accepts a surface that is not closed.
    pub(super) with_holes: bool,
}

/// Vertices, and triangles as their numbers.
type Triangles = (Vec<[f32; 3]>, Vec<[u32; 3]>);

/// Reads a mesh.
///
/// # Errors
/// The problem and its remedy.
pub(super) fn load(path: &Path, scale: MeshScale) -> Result<TriangleMesh, String> {
    let bytes = read_file(path, MOST_BYTES).map_err(|error| format!("cannot be read: {error}"))?;
    parse(&bytes, path, scale)
}

/// Reads a mesh from the bytes of a file; the end of `path` names its format.
///
/// # Errors
/// As [`load`].
pub(super) fn parse(bytes: &[u8], path: &Path, scale: MeshScale) -> Result<TriangleMesh, String> {
    let (vertices, triangles) = match path.extension().and_then(OsStr::to_str) {
        Some("obj" | "stl") => read_obj_or_stl(bytes, path)?,
        _ => return Err("is no .obj or .stl file: export it as one of them".to_owned()),
    };
    if triangles.len() > MAX_TRIANGLES {
        return Err(format!(
            "has {} triangles: simplify it to at most {MAX_TRIANGLES}",
            triangles.len()
        ));
    }
    let placed = vertices.into_iter().map(|[x, y, z]| {
        let upright = match scale.up {
            UpAxis::Z => [x, y, z],
            UpAxis::Y => [x, -z, y],
        };
        upright.map(|value| value * scale.factor)
    });
    let mesh = welded(placed.collect(), &triangles)?;
    check_size(&mesh, scale.factor)?;
    if !scale.with_holes {
        check_closed(&mesh)?;
    }
    Ok(mesh)
}

fn read_obj_or_stl(bytes: &[u8], path: &Path) -> Result<Triangles, String> {
    // Materials of an OBJ file, which are files of their own, are of no use here.
    let nothing = |_: &Path| Ok(Vec::new());
    let scene = mesh_loader::Loader::default()
        .load_from_slice_with_reader(bytes, path, nothing)
        .map_err(|error| format!("cannot be read: {error}"))?;
    let (mut vertices, mut triangles) = (Vec::new(), Vec::new());
    for mesh in scene.meshes {
        let first = vertices.len() as u32;
        vertices.extend(mesh.vertices);
        triangles.extend(
            mesh.faces
                .iter()
                .map(|face| face.map(|corner| corner + first)),
        );
    }
    Ok((vertices, triangles))
}

/// Joins vertices at the same place, as STL has them, and leaves out triangles without an area.
fn welded(vertices_m: Vec<[f32; 3]>, triangles: &[[u32; 3]]) -> Result<TriangleMesh, String> {
    if !vertices_m.iter().flatten().all(|value| value.is_finite()) {
        return Err("has a coordinate that is not finite: export it again".to_owned());
    }
    let mut places = HashMap::new();
    let mut mesh = TriangleMesh {
        vertices_m: Vec::new(),
        triangles: Vec::new(),
    };
    let numbers: Vec<u32> = vertices_m
        .iter()
        .map(|vertex| {
            // -0 is 0.
            let key = vertex.map(|value| (value + 0.0).to_bits());
            *places.entry(key).or_insert_with(|| {
                mesh.vertices_m.push(*vertex);
                mesh.vertices_m.len() as u32 - 1
            })
        })
        .collect();
    let triangle = |corners: &[u32; 3]| {
        let find = |corner: u32| numbers.get(corner as usize).copied();
        Some([find(corners[0])?, find(corners[1])?, find(corners[2])?])
    };
    for corners in triangles {
        let corners = triangle(corners).ok_or("names vertices that it does not have")?;
        let [a, b, c] =
            corners.map(|corner| nalgebra::Point3::from(mesh.vertices_m[corner as usize]));
        let (twice_area, longest) = (
            (b - a).cross(&(c - a)).norm(),
            (b - a).norm().max((c - b).norm()).max((a - c).norm()),
        );
        if twice_area > FLAT * longest * longest {
            mesh.triangles.push(corners);
        }
    }
    Ok(mesh)
}

fn check_size(mesh: &TriangleMesh, scale: f32) -> Result<(), String> {
    if mesh.triangles.is_empty() {
        return Err("has no triangles: export a mesh".to_owned());
    }
    let extent = |axis: usize| {
        let along = mesh.vertices_m.iter().map(|vertex| vertex[axis]);
        let least = along.clone().fold(f32::INFINITY, f32::min);
        along.fold(f32::NEG_INFINITY, f32::max) - least
    };
    let size_m = [0, 1, 2].map(extent);
    let largest_m = size_m.into_iter().fold(0.0, f32::max);
    match (SMALLEST_M..=LARGEST_M).contains(&largest_m) {
        true => Ok(()),
        false => Err(format!(
            "is {:.3} x {:.3} x {:.3} m large with scale = {scale}: its unit is not the metre; set \
             scale to 0.001 for millimetres, 0.01 for centimetres, 0.0254 for inches",
            size_m[0], size_m[1], size_m[2]
        )),
    }
}

/// Checks that every edge belongs to two triangles that run along it in opposite directions.
fn check_closed(mesh: &TriangleMesh) -> Result<(), String> {
    let mut open = HashMap::new();
    for &[a, b, c] in &mesh.triangles {
        for (from, to) in [(a, b), (b, c), (c, a)] {
            let (key, along) = if from < to {
                ((from, to), 1)
            } else {
                ((to, from), -1)
            };
            *open.entry(key).or_insert(0i32) += along;
        }
    }
    let open = open.values().filter(|balance| **balance != 0).count();
    match open {
        0 => Ok(()),
        _ => Err(format!(
            "is not closed: {open} edges belong to one triangle, or to two that face opposite \
             sides; the camera would look through it from behind. Close it, or set with_holes = \
             true if the drone sees it from one side alone"
        )),
    }
}
