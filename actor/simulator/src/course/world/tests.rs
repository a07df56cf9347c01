use std::path::{Path, PathBuf};
use std::sync::Arc;

use nalgebra::{Point3, Vector3};
use proptest::prelude::*;
use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;

use super::file::UpAxis;
use super::mesh_file::MeshScale;
use super::*;
use crate::course::{GeneratorRanges, Motion, TriangleMesh};
use crate::simulator::{EpisodeOutcome, Obstacle as Hit, Simulator, SimulatorSettings};

/// A world of 20 x 10 x 4 m with `obstacles`.
fn layout(obstacles: Vec<Obstacle>) -> WorldLayout {
    WorldLayout {
        name: "test".into(),
        bounds: Corridor {
            length_m: 20.0,
            width_m: 10.0,
            height_m: 4.0,
        },
        sides: Sides::Closed,
        start: Region {
            centre_m: [2.0, 0.0, 2.0],
            size_m: [1.0, 4.0, 1.0],
        },
        goal: Region {
            centre_m: [18.0, 0.0, 2.0],
            size_m: [2.0, 10.0, 4.0],
        },
        obstacles,
    }
}

/// A wall across the world of `layout` with a gap of `gap_m` on the left side.
fn wall_with_gap(gap_m: f32) -> Obstacle {
    let shape = ObstacleShape::Box {
        size_m: [0.5, 10.0 - gap_m, 4.0],
    };
    Obstacle::still(shape, [10.0, -gap_m / 2.0, 2.0])
}

fn parsed(text: &str) -> Result<Course, String> {
    Course::parse(text, "w.toml").map_err(|error| error.to_string())
}

const FILE: &str = r#"
name = "by hand"
[bounds]
length_m = 20.0
width_m = 10.0
height_m = 4.0
[start]
centre_m = [2.0, 0.0, 2.0]
size_m = [1.0, 4.0, 1.0]
[goal]
centre_m = [18.0, 0.0, 2.0]
size_m = [2.0, 10.0, 4.0]
[[obstacle]]
shape = "box"
centre_m = [6.0, 1.0, 1.0]
size_m = [1.0, 1.0, 2.0]
[[obstacle]]
shape = "cylinder"
centre_m = [9.0, 0.0, 2.0]
radius_m = 0.3
height_m = 4.0
rotation_deg = [10.0, 0.0, 0.0]
[[obstacle]]
shape = "sphere"
centre_m = [11.0, 2.0, 2.0]
radius_m = 0.5
motion = { way = "to_and_fro", by_m = [0.0, -4.0, 0.0], speed_mps = 0.5 }
[[obstacle]]
shape = "wall"
centre_m = [14.0, 0.0, 2.0]
size_m = [0.2, 10.0, 4.0]
opening = [
    { centre_m = [-2.0, 0.0], width_m = 2.0, height_m = 2.0 },
    { centre_m = [2.0, 0.0], diameter_m = 2.0 },
]
"#;

#[test]
fn a_file_describes_every_shape_and_the_course_is_a_world() {
    let course = parsed(FILE).unwrap();
    let shapes: Vec<_> = course
        .obstacles()
        .iter()
        .map(|one| one.shape.name())
        .collect();
    assert_eq!(shapes, ["box", "cylinder", "sphere", "wall"]);
    assert!(course.is_world() && course.walls().is_empty());
    assert_eq!(course.levels(), STAGES);
    assert!(matches!(
        course.obstacles()[2].motion,
        Some(Motion::ToAndFro { .. })
    ));
}

#[test]
fn mistakes_are_refused_with_obstacle_key_and_remedy() {
    let refused = |from: &str, to: &str| {
        assert!(FILE.contains(from), "{from}");
        parsed(&FILE.replacen(from, to, 1)).unwrap_err()
    };
    for (from, to, parts) in [
        (
            "radius_m = 0.3\n",
            "",
            &["obstacle 2", "radius_m", "is missing"][..],
        ),
        (
            "radius_m = 0.3",
            "radius_m = 0.0",
            &["obstacle 2", "radius_m = 0", "0.02"],
        ),
        (
            "radius_m = 0.3",
            "radius_m = \"x\"",
            &["obstacle 2", "line 20", "radius_m"],
        ),
        (
            "radius_m = 0.3",
            "radius_m = 0.3\nsize_m = [1.0, 1.0, 1.0]",
            &["obstacle 2", "size_m", "remove it"],
        ),
        (
            "radius_m = 0.5",
            "radius_m = nan",
            &["obstacle 3", "radius_m"],
        ),
        (
            "speed_mps = 0.5",
            "speed_mps = 0.0",
            &["obstacle 3", "motion.speed_mps"],
        ),
        (
            "by_m = [0.0, -4.0, 0.0]",
            "radius_m = 1.0",
            &["obstacle 3", "motion.by_m", "missing"],
        ),
        ("to_and_fro", "around", &["obstacle 3", "around"]),
        (
            "width_m = 2.0, height_m = 2.0",
            "width_m = 2.0",
            &["obstacle 4", "opening 1"],
        ),
        (
            "centre_m = [-2.0, 0.0]",
            "centre_m = [1.5, 0.0]",
            &["obstacle 4", "opening 2", "beside"],
        ),
        (
            "centre_m = [2.0, 0.0], d",
            "centre_m = [4.5, 0.0], d",
            &["opening 2", "rim"],
        ),
        ("[goal]", "[target]", &["target"]),
        (
            "centre_m = [18.0, 0.0, 2.0]",
            "centre_m = [38.0, 0.0, 2.0]",
            &["[goal]", "not inside"],
        ),
        (
            "centre_m = [18.0, 0.0, 2.0]",
            "centre_m = [3.0, 0.0, 2.0]",
            &["[start]", "apart"],
        ),
        ("length_m = 20.0", "length_m = -20.0", &["bounds.length_m"]),
        ("name = \"by hand\"", "name = \"a | b\"", &["name", "|"]),
        (
            "centre_m = [11.0, 2.0, 2.0]",
            "centre_m = [2.0, 2.0, 2.0]",
            &["obstacle 3", "[start]", "motion"],
        ),
        (
            "centre_m = [6.0, 1.0, 1.0]",
            "centre_m = [2.0, 0.0, 2.0]",
            &["[start]", "not fit into"],
        ),
    ] {
        let error = refused(from, to);
        for part in ["w.toml"].iter().chain(parts) {
            assert!(error.contains(part), "`{part}` is missing in {error}");
        }
    }
}

#[test]
fn a_world_is_flown_through_a_gap_for_the_body_and_refused_without_one() {
    let with_gap = |gap_m| Course::of_world(layout(vec![wall_with_gap(gap_m)]));
    let course = with_gap(2.0).unwrap();
    let way = course.world.as_ref().unwrap();
    let middle = Point3::new(2.0, 0.0, 2.0);
    assert!(
        way.left_m(&middle) > way.straight_m() + 1.0,
        "around the wall"
    );
    assert_eq!(with_gap(1.0), Err(WorldFault::NoWay));
    let full = Obstacle::still(
        ObstacleShape::Box {
            size_m: [20.0, 10.0, 4.0],
        },
        [10.0, 0.0, 2.0],
    );
    // Its surfaces are those of the world itself: only its inside is in the way.
    assert_eq!(
        Course::of_world(layout(vec![full])),
        Err(WorldFault::Blocked { name: "start" })
    );
}

#[test]
fn stages_divide_the_way_and_every_level_starts_in_its_own() {
    let course = Course::of_world(layout(vec![wall_with_gap(3.0)])).unwrap();
    let mut rng = Pcg64Mcg::seed_from_u64(1);
    for level in 1..=STAGES {
        for _ in 0..20 {
            let at = course.start_position(level, &mut rng).unwrap();
            let behind = course.walls_behind(&at, 0.0);
            let own = usize::from(level) - 1;
            assert!(
                (own.saturating_sub(1)..=own + 1).contains(&behind),
                "level {level}: {behind}"
            );
        }
    }
    assert!(course.start_position(STAGES + 1, &mut rng).is_err());
    let goal = Point3::new(18.0, 0.0, 2.0);
    assert_eq!(course.walls_behind(&goal, 0.0), usize::from(STAGES));
}

fn flown(course: Course, seed: u64) -> (EpisodeOutcome, Option<Hit>, u8) {
    let settings = SimulatorSettings::default();
    let mut simulator = Simulator::new(Arc::new(course), &settings).unwrap();
    let [mut start, mut calm] = [seed, 0].map(Pcg64Mcg::seed_from_u64);
    simulator.reset(1, &mut start, &mut calm).unwrap();
    loop {
        let action = simulator.oracle_action();
        let report = simulator.step(action).unwrap();
        if let Some(outcome) = report.outcome {
            return (outcome, report.hit, report.walls_passed);
        }
    }
}

#[test]
fn the_goal_ends_an_episode_with_all_stages_passed_and_an_obstacle_ends_it_with_its_stage() {
    let free = Course::of_world(layout(Vec::new())).unwrap();
    assert_eq!(flown(free, 1), (EpisodeOutcome::ReachedEnd, None, STAGES));
    // A wall that moves to and fro faster than the drone leaves no way out, and the oracle takes no
    // notice of it.
    let wall = Obstacle {
        motion: Some(Motion::ToAndFro {
            by_m: [3.0, 0.0, 0.0],
            speed_mps: 3.0,
        }),
        ..wall_with_gap(0.0)
    };
    let (outcome, hit, passed) = flown(Course::of_world(layout(vec![wall])).unwrap(), 1);
    assert_eq!(outcome, EpisodeOutcome::Collided);
    assert_eq!(hit, Some(Hit::Wall(passed + 1)));
}

#[test]
fn the_goal_and_the_nearest_obstacle_are_measured_from_the_drone() {
    let course = Course::of_world(layout(vec![wall_with_gap(3.0)])).unwrap();
    let mut simulator = Simulator::new(Arc::new(course), &SimulatorSettings::default()).unwrap();
    let [mut start, mut calm] = [1, 0].map(Pcg64Mcg::seed_from_u64);
    simulator.reset(1, &mut start, &mut calm).unwrap();
    let to_goal_m = Point3::new(18.0, 0.0, 2.0) - simulator.state().position_m;
    assert!((Vector3::from(simulator.goal_m()) - to_goal_m).norm() < 1e-5);
    let report = loop {
        let report = simulator.step([0.0, 0.0]).unwrap();
        // The wall's front; half the drone's length before it, the episode ends.
        let to_wall_m = 9.75 - simulator.state().position_m.x;
        if to_wall_m < 1.3 {
            assert!((report.clearance_m - to_wall_m).abs() < 1e-3);
            break report;
        }
    };
    assert_eq!(report.outcome, None);
}

#[test]
fn an_episode_passes_the_stages_from_its_level_on() {
    let worlds = vec![
        WorldRanges::Forest(ForestRanges::default()),
        WorldRanges::Rooms(RoomsRanges::default()),
    ];
    let ranges = GeneratorRanges {
        worlds,
        ..Default::default()
    };
    let mut arrived = 0;
    for seed in 0..8 {
        let course = Arc::new(Course::generate(seed, &ranges).unwrap());
        let mut simulator = Simulator::new(course, &SimulatorSettings::default()).unwrap();
        for level in 1..=STAGES {
            let [mut start, mut calm] = [seed, 0].map(Pcg64Mcg::seed_from_u64);
            simulator.reset(level, &mut start, &mut calm).unwrap();
            assert_eq!((simulator.level(), simulator.walls_passed()), (level, 0));
            let report = loop {
                let action = simulator.oracle_action();
                let report = simulator.step(action).unwrap();
                if report.outcome.is_some() {
                    break report;
                }
            };
            let behind = level - 1 + report.walls_passed;
            match (report.outcome, report.hit) {
                (Some(EpisodeOutcome::ReachedEnd), _) => assert_eq!(behind, STAGES),
                (_, Some(Hit::Wall(stage))) => assert_eq!(stage, (behind + 1).min(STAGES)),
                _ => assert!(behind <= STAGES),
            }
            arrived += u32::from(report.outcome == Some(EpisodeOutcome::ReachedEnd));
        }
    }
    assert!(arrived > 20, "{arrived}");
}

#[test]
fn a_moving_obstacle_is_hit_where_it_is_and_nowhere_else() {
    let ball = |by_m: [f32; 3], y_m: f32| Obstacle {
        motion: Some(Motion::ToAndFro {
            by_m,
            speed_mps: 0.01,
        }),
        ..Obstacle::still(ObstacleShape::Sphere { radius_m: 1.0 }, [10.0, y_m, 2.0])
    };
    let outcome = |ball| {
        let layout = WorldLayout {
            start: Region {
                centre_m: [2.0, 0.0, 2.0],
                size_m: [0.0; 3],
            },
            ..layout(vec![ball])
        };
        (0..10).map(move |seed| flown(Course::of_world(layout.clone()).unwrap(), seed).0)
    };
    assert!(outcome(ball([0.2, 0.0, 0.0], 0.0)).all(|end| end == EpisodeOutcome::Collided));
    assert!(outcome(ball([0.0, 0.2, 0.0], 3.0)).all(|end| end == EpisodeOutcome::ReachedEnd));
    // Its seed decides where on a long way it is.
    let far = outcome(ball([0.0, 7.0, 0.0], -3.5)).filter(|end| *end == EpisodeOutcome::Collided);
    assert!((1..8).contains(&far.count()));
}

#[test]
fn the_oracle_flies_random_forests_halls_and_gates() {
    const FLIGHTS: u64 = 20;
    for (kind, least) in [
        (WorldRanges::Forest(ForestRanges::default()), 19),
        (WorldRanges::Hall(HallRanges::default()), 19),
        (WorldRanges::Gates(GatesRanges::default()), 19),
    ] {
        let ranges = GeneratorRanges {
            worlds: vec![kind.clone()],
            ..Default::default()
        };
        let reached = (0..FLIGHTS).filter(|&seed| {
            let course = Course::generate(seed, &ranges).unwrap();
            flown(course, seed).0 == EpisodeOutcome::ReachedEnd
        });
        let reached = reached.count();
        assert!(reached >= least, "{}: {reached} of {FLIGHTS}", kind.name());
    }
}

#[test]
fn a_seed_gives_the_same_world_and_every_kind_can_be_generated() {
    let kinds = [
        WorldRanges::Forest(ForestRanges::default()),
        WorldRanges::Hall(HallRanges {
            balls: [1, 4],
            ..Default::default()
        }),
        WorldRanges::Rooms(RoomsRanges::default()),
        WorldRanges::Gates(GatesRanges::default()),
    ];
    for kind in &kinds {
        for seed in 0..8 {
            let course = generate(seed, kind).unwrap();
            assert_eq!(course, generate(seed, kind).unwrap());
            assert!(!course.obstacles().is_empty(), "{}", course.name());
        }
    }
    let mixed = GeneratorRanges {
        worlds: kinds.to_vec(),
        ..Default::default()
    };
    let mut names: Vec<_> = (0..40)
        .map(|seed| Course::generate(seed, &mixed).unwrap().name().to_owned())
        .map(|name| name.split(' ').next().unwrap_or_default().to_owned())
        .collect();
    names.sort();
    names.dedup();
    assert_eq!(names, ["forest", "gates", "hall", "rooms"]);
}

#[test]
fn ranges_out_of_bounds_are_refused_by_key() {
    let refused = |ranges: WorldRanges| generate(0, &ranges).unwrap_err().to_string();
    let dense = refused(WorldRanges::Forest(ForestRanges {
        density_per_m2: [0.5, 0.1],
        ..Default::default()
    }));
    assert!(dense.contains("forest.density_per_m2"), "{dense}");
    let full = refused(WorldRanges::Forest(ForestRanges {
        density_per_m2: [1.0, 1.0],
        radius_m: [2.0, 2.0],
        ..Default::default()
    }));
    assert!(full.contains("no world drawn from forest"), "{full}");
    let both = GeneratorRanges {
        worlds: vec![WorldRanges::Hall(HallRanges::default())],
        clearance_m: [1.0, 1.0],
        ..Default::default()
    };
    let both = Course::generate(0, &both).unwrap_err().to_string();
    assert!(both.contains("worlds") && both.contains("remove"), "{both}");
}

/// A cube of side 1 around the origin, as a Wavefront file; `faces`: how many of its twelve
/// triangles.
fn cube_obj(faces: usize) -> String {
    let corner = |number: usize| {
        let side = |bit: usize| if number >> bit & 1 == 1 { 0.5 } else { -0.5 };
        format!("v {} {} {}\n", side(0), side(1), side(2))
    };
    let triangles = [
        [1, 3, 2],
        [2, 3, 4],
        [5, 6, 7],
        [6, 8, 7],
        [1, 2, 5],
        [2, 6, 5],
        [3, 7, 4],
        [4, 7, 8],
        [1, 5, 3],
        [3, 5, 7],
        [2, 4, 6],
        [4, 8, 6],
    ];
    let face = |[a, b, c]: [usize; 3]| format!("f {a} {b} {c}\n");
    let corners: String = (0..8).map(corner).collect();
    let faces: String = triangles.into_iter().take(faces).map(face).collect();
    corners + &faces
}

/// Returns the same cube as a binary STL file.
fn cube_stl() -> Vec<u8> {
    let mesh = Obstacle::still(ObstacleShape::Box { size_m: [1.0; 3] }, [0.0; 3]).mesh();
    let triangles = mesh.triangles();
    let mut bytes = vec![0; 80];
    bytes.extend((triangles.len() as u32).to_le_bytes());
    for (corners, _) in triangles {
        bytes.extend([0; 12]);
        for corner in corners.map(|corner| mesh.vertices[corner as usize]) {
            bytes.extend(corner.iter().flat_map(|value| value.to_le_bytes()));
        }
        bytes.extend([0; 2]);
    }
    bytes
}

/// Writes `bytes` as `name` into a new folder, and returns the world file there that names it with
/// the lines `keys`.
fn world_with_mesh(name: &str, bytes: &[u8], keys: &str) -> (PathBuf, String) {
    let folder = std::env::temp_dir().join(format!(
        "skein-world-{}-{name}-{}",
        std::process::id(),
        keys.len()
    ));
    std::fs::create_dir_all(&folder).unwrap();
    std::fs::write(folder.join(name), bytes).unwrap();
    let head = FILE.split("[[obstacle]]").next().unwrap();
    let text = format!(
        "{head}[[obstacle]]\nshape = \"mesh\"\ncentre_m = [10.0, 0.0, 2.0]\n\
         file = \"{name}\"\n{keys}\n"
    );
    (folder.join("w.toml"), text)
}

fn with_mesh(name: &str, bytes: &[u8], keys: &str) -> Result<Arc<TriangleMesh>, String> {
    let (path, text) = world_with_mesh(name, bytes, keys);
    let course = Course::parse(&text, &path).map_err(|error| error.to_string());
    std::fs::remove_dir_all(path.parent().unwrap()).unwrap();
    match &course?.obstacles()[0].shape {
        ObstacleShape::Mesh(mesh) => Ok(Arc::clone(mesh)),
        other => panic!("{other:?}"),
    }
}

#[test]
fn the_same_mesh_comes_from_every_format() {
    for (name, bytes) in [
        ("cube.obj", cube_obj(12).into_bytes()),
        ("cube.stl", cube_stl()),
    ] {
        let mesh = with_mesh(name, &bytes, "scale = 2.0").unwrap();
        assert_eq!(
            (mesh.vertices_m.len(), mesh.triangles.len()),
            (8, 12),
            "{name}"
        );
        let largest = mesh
            .vertices_m
            .iter()
            .flatten()
            .fold(0.0f32, |most, at| most.max(*at));
        assert_eq!(largest, 1.0, "{name}");
    }
}

#[test]
fn unusable_meshes_are_refused_with_the_file_and_the_remedy() {
    let cube = cube_obj(12).into_bytes();
    for (name, bytes, keys, parts) in [
        (
            "open.obj",
            cube_obj(11).into_bytes(),
            "",
            &["not closed", "with_holes"][..],
        ),
        (
            "huge.obj",
            cube.clone(),
            "scale = 1000.0",
            &["1000.000", "millimetres"],
        ),
        (
            "tiny.obj",
            cube.clone(),
            "scale = 0.001",
            &["0.001", "unit"],
        ),
        ("empty.obj", Vec::new(), "", &["no triangles"]),
        ("cube.ply", cube, "", &[".stl", "export"]),
        ("bad.stl", b"solid x\nfacet".to_vec(), "", &["bad.stl"]),
    ] {
        let error = with_mesh(name, &bytes, keys).unwrap_err();
        for part in [name, "obstacle 1"].iter().chain(parts) {
            assert!(error.contains(part), "`{part}` is missing in {error}");
        }
    }
    assert!(with_mesh("open.obj", cube_obj(11).as_bytes(), "with_holes = true").is_ok());
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 2000, ..ProptestConfig::default() })]

    #[test]
    fn no_byte_of_a_mesh_file_causes_a_panic(
        format in 0usize..2,
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..6),
        length in any::<prop::sample::Index>(),
        cut in any::<bool>(),
    ) {
        let (name, mut bytes) = match format {
            0 => ("a.obj", cube_obj(12).into_bytes()),
            _ => ("a.stl", cube_stl()),
        };
        for (place, byte) in changes {
            let place = place.index(bytes.len());
            bytes[place] = byte;
        }
        if cut {
            bytes.truncate(length.index(bytes.len()));
        }
        let scale = MeshScale { factor: 1.0, up: UpAxis::Z, with_holes: true };
        if let Ok(mesh) = mesh_file::parse(&bytes, Path::new(name), scale) {
            let vertices = mesh.vertices_m.len() as u32;
            prop_assert!(mesh.triangles.iter().flatten().all(|corner| *corner < vertices));
        }
    }
}
