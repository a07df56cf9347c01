//! Checks the claims of the comments in `configs/courses/` and `configs/worlds/`.

use std::path::{Path, PathBuf};

use skein_simulator::course::{Course, DRONE_WIDTH_M, Shape};

fn shipped(name: &str) -> Course {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR"))
        .join("../../configs/courses")
        .join(name);
    Course::load(path).unwrap_or_else(|error| panic!("{error}"))
}

fn order(course: &Course) -> Vec<u32> {
    course.walls().iter().map(|wall| wall.label().0).collect()
}

#[test]
fn rearranged_courses_hold_the_walls_of_training() {
    let training = shipped("training.toml");
    assert_eq!(order(&training), [1, 2, 3, 4, 5]);
    for (name, expected) in [
        ("rearranged_34125.toml", [3, 4, 1, 2, 5]),
        ("rearranged_53412.toml", [5, 3, 4, 1, 2]),
    ] {
        let course = shipped(name);
        assert_eq!(order(&course), expected);
        assert_eq!(
            (course.corridor(), course.start()),
            (training.corridor(), training.start())
        );
        for wall in course.walls() {
            let same = training
                .walls()
                .iter()
                .find(|other| other.label() == wall.label())
                .unwrap();
            assert_eq!(
                wall.opening(),
                same.opening(),
                "{name}: wall {}",
                wall.label()
            );
        }
    }
}

#[test]
fn walls_stand_every_ten_metres() {
    for name in [
        "training.toml",
        "rearranged_34125.toml",
        "rearranged_53412.toml",
        "non_rectangular.toml",
    ] {
        let course = shipped(name);
        let places: Vec<f32> = course.walls().iter().map(|wall| wall.x_m()).collect();
        assert_eq!(places, [10.0, 20.0, 30.0, 40.0, 50.0], "{name}");
        assert_eq!(course.corridor().length_m, 60.0);
    }
}

#[test]
fn every_opening_leaves_about_the_same_free_space() {
    for name in ["training.toml", "non_rectangular.toml"] {
        for wall in shipped(name).walls() {
            assert!(
                (1.05..=1.10).contains(&wall.clearance_m()),
                "{name}: wall {}: {}",
                wall.label(),
                wall.clearance_m()
            );
        }
    }
    let gates = shipped("non_rectangular.toml");
    assert!(
        gates
            .walls()
            .iter()
            .all(|wall| !matches!(wall.opening().shape, Shape::Rectangle { .. }))
    );
}

#[test]
fn an_episode_straight_ahead_passes_no_wall() {
    for name in ["training.toml", "non_rectangular.toml"] {
        let course = shipped(name);
        let start = course.start();
        let middle_z = course.corridor().height_m / 2.0;
        // From no start position does the whole body fit: some end of it meets the wall.
        for (i, j) in (-10..=10).flat_map(|i| (-10..=10).map(move |j| (i, j))) {
            let y = start.jitter_y_m * i as f32 / 10.0;
            let z = middle_z + start.jitter_z_m * j as f32 / 10.0;
            let half = DRONE_WIDTH_M / 2.0;
            for wall in course.walls() {
                let passes = [-half, 0.0, half]
                    .into_iter()
                    .all(|off| inside(wall.outline(), [y + off, z]));
                assert!(!passes, "{name}: wall {} at y = {y}, z = {z}", wall.label());
            }
        }
    }
}

/// Returns `true` if the point lies in the polygon, by the parity of crossings.
fn inside(points: &[[f32; 2]], [y, z]: [f32; 2]) -> bool {
    let edges = points.iter().zip(points.iter().cycle().skip(1));
    edges
        .filter(|(a, b)| (a[1] > z) != (b[1] > z))
        .filter(|(a, b)| y < a[0] + (b[0] - a[0]) * (z - a[1]) / (b[1] - a[1]))
        .count()
        % 2
        == 1
}

#[test]
fn every_shipped_world_has_a_start_a_goal_and_a_way_between() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/worlds");
    for (name, moving) in [("forest", 0), ("hall", 3), ("apartment", 0)] {
        let course = Course::load(folder.join(name).with_extension("toml")).unwrap();
        assert_eq!(course.name(), name);
        assert!(course.is_world() && course.goal().is_some());
        let obstacles = course.obstacles().iter();
        let moves = obstacles.filter(|obstacle| obstacle.motion.is_some());
        assert_eq!(moves.count(), moving, "{name}");
    }
}
