//! The drawn image against the traced one, over random poses in random courses.

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};
use proptest::prelude::*;

use super::{CameraSettings, DepthCamera, IMAGE_PIXELS, IMAGE_WIDTH, ReferenceCamera};
use crate::course::{Course, GeneratorRanges, test_course};

/// Grey levels by which a pixel may differ: one rounding.
const ROUNDING: u8 = 1;

/// Pixels about which a silhouette is looked for when the middles disagree: how exactly an edge must lie.
const SILHOUETTE_PX: f32 = 0.02;

/// Share of the pixels that a silhouette may excuse. An image holds some 500 silhouette pixels, one in 25 of which has its
/// middle within [`SILHOUETTE_PX`] of the edge; of these, few disagree.
const MOST_EXCUSED: usize = IMAGE_PIXELS / 500;

/// How two images of the same pose compare.
struct Comparison {
    /// Pixels that differ and lie on a silhouette.
    excused: usize,
    /// Pixels that differ without excuse: column, row, drawn, traced.
    wrong: Vec<(usize, usize, u8, u8)>,
}

fn compare(course: &Course, settings: &CameraSettings, world_from_body: &Isometry3<f32>) -> Comparison {
    let reference = ReferenceCamera::new(settings, course).unwrap();
    let mut drawn = [0; IMAGE_PIXELS];
    let mut traced = [0; IMAGE_PIXELS];
    DepthCamera::new(settings, course)
        .unwrap()
        .render(world_from_body, &mut drawn);
    reference.render(world_from_body, &mut traced);

    let view = settings.view(world_from_body);
    let mut comparison = Comparison {
        excused: 0,
        wrong: Vec::new(),
    };
    for (number, (&drawn, &traced)) in drawn.iter().zip(&traced).enumerate() {
        if drawn.abs_diff(traced) <= ROUNDING {
            continue;
        }
        let (column, row) = (number % IMAGE_WIDTH, number / IMAGE_WIDTH);
        let offsets = [-SILHOUETTE_PX, 0.0, SILHOUETTE_PX];
        let around: Vec<u8> = offsets
            .into_iter()
            .flat_map(|down| offsets.map(|right| (right, down)))
            .map(|(right, down)| reference.grey(&view, column as f32 + 0.5 + right, row as f32 + 0.5 + down))
            .collect();
        let (least, most) = around.iter().fold((255, 0), |(l, m), &g| (g.min(l), g.max(m)));
        if (least.saturating_sub(ROUNDING)..=most.saturating_add(ROUNDING)).contains(&drawn) {
            comparison.excused += 1;
        } else {
            comparison.wrong.push((column, row, drawn, traced));
        }
    }
    comparison
}

/// Where in the free space a lens is put.
#[derive(Debug, Clone, Copy)]
enum Spot {
    BetweenWalls,
    WithinOpening,
}

/// A lens in free space.
fn free_point(course: &Course, share: [f32; 3], spot: Spot) -> [f32; 3] {
    const MARGIN_M: f32 = 0.05;
    let corridor = course.corridor();
    let between = |least: f32, most: f32, share: f32| least + (most - least) * share;
    let walls = course.walls();
    let choice = share[0] * (walls.len() + 1) as f32;
    let (number, along) = (choice as usize, choice.fract());
    if matches!(spot, Spot::WithinOpening) && number < walls.len() {
        let wall = &walls[number];
        let radius = (wall.clearance_m() - MARGIN_M) * share[1].sqrt();
        let (sin, cos) = (share[2] * std::f32::consts::TAU).sin_cos();
        let [y, z] = wall.safe_point();
        let x = between(wall.x_m(), wall.x_m() + course.wall_thickness_m(), along);
        return [x, y + radius * cos, z + radius * sin];
    }
    let number = number.min(walls.len());
    let begin = if number == 0 {
        0.0
    } else {
        walls[number - 1].x_m() + course.wall_thickness_m()
    };
    let end = walls.get(number).map_or(corridor.length_m, |wall| wall.x_m());
    let half = corridor.width_m / 2.0;
    [
        between(begin + MARGIN_M, end - MARGIN_M, along),
        between(MARGIN_M - half, half - MARGIN_M, share[1]),
        between(MARGIN_M, corridor.height_m - MARGIN_M, share[2]),
    ]
}

/// Settings whose lens sits at the body's origin, so that the pose decides where it is.
fn lens_in_the_middle() -> CameraSettings {
    CameraSettings {
        mount_m: [0.0; 3],
        ..Default::default()
    }
}

fn pose(at: [f32; 3], quaternion: [f32; 4]) -> Isometry3<f32> {
    let [w, i, j, k] = quaternion;
    let turn = UnitQuaternion::from_quaternion(Quaternion::new(w, i, j, k));
    Isometry3::from_parts(Translation3::new(at[0], at[1], at[2]), turn)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, ..ProptestConfig::default() })]

    #[test]
    fn drawn_image_equals_the_traced_one(
        seed in any::<u64>(),
        share in prop::array::uniform3(0.0f32..1.0),
        spot in prop_oneof![Just(Spot::BetweenWalls), Just(Spot::WithinOpening)],
        quaternion in prop::array::uniform4(-1.0f32..1.0)
            .prop_filter("too short to turn by", |q| q.iter().map(|c| c * c).sum::<f32>() > 0.1),
        horizontal_fov_deg in 40.0f32..120.0,
        mount_pitch_deg in -30.0f32..30.0,
    ) {
        let course = Course::generate(seed, &GeneratorRanges::default()).unwrap();
        let settings = CameraSettings { horizontal_fov_deg, mount_pitch_deg, ..lens_in_the_middle() };
        let world_from_body = pose(free_point(&course, share, spot), quaternion);
        let comparison = compare(&course, &settings, &world_from_body);
        prop_assert!(comparison.wrong.is_empty(), "{:?}", comparison.wrong);
        prop_assert!(comparison.excused <= MOST_EXCUSED, "{} excused", comparison.excused);
    }
}

#[test]
fn flight_poses_agree_too() {
    // As flown: level or tilted by up to the vehicle's limit, with little yaw.
    let course = test_course();
    for step in 0..40 {
        let phase = step as f32;
        let turn = UnitQuaternion::from_euler_angles(0.57 * phase.sin(), 0.3 * (1.7 * phase).cos(), 0.05 * phase.sin());
        let at = Translation3::new(0.5 + 1.24 * phase, 0.8 * (0.7 * phase).sin(), 3.5 + 0.8 * phase.cos());
        let pose = Isometry3::from_parts(at, turn);
        let at_wall = course
            .walls()
            .iter()
            .any(|wall| (wall.x_m() - 0.5..wall.x_m() + 0.5).contains(&at.vector.x));
        if !at_wall {
            let comparison = compare(&course, &CameraSettings::default(), &pose);
            assert!(comparison.wrong.is_empty(), "step {step}: {:?}", comparison.wrong);
            assert!(
                comparison.excused <= MOST_EXCUSED,
                "step {step}: {} excused",
                comparison.excused
            );
        }
    }
}

#[test]
fn depth_is_planar_and_in_steps_of_the_range() {
    // 12 m before the end wall, looking straight at it: the same depth at every pixel that shows it.
    let course = test_course();
    let pose = Isometry3::translation(52.0, 0.0, 3.5);
    let settings = CameraSettings {
        range_m: 10.0,
        ..lens_in_the_middle()
    };
    let mut image = [0; IMAGE_PIXELS];
    DepthCamera::new(&settings, &course).unwrap().render(&pose, &mut image);
    let at = |column: usize, row: usize| image[row * IMAGE_WIDTH + column];
    // 255 * 8 m / 10 m = 204; the end wall is 3 / 8 * 64 = 24 pixels wide to each side.
    assert!(
        (41..87).all(|column| at(column, 36) == 204),
        "{:?}",
        &image[36 * IMAGE_WIDTH..37 * IMAGE_WIDTH]
    );
    // The left border looks along 45 degrees: the side, 3 m away, at a depth of 3 m but for half a pixel.
    assert_eq!(at(0, 36), (25.5f32 * 3.0 * 64.0 / 63.5).round() as u8);
    // Up is up: the ceiling, 3.5 m above, and the floor, 3.5 m below, mirror each other.
    assert_eq!(at(64, 0), at(64, 71));
}

#[test]
fn roll_turns_the_image_and_pitch_lifts_it() {
    let course = test_course();
    let mut camera = DepthCamera::new(&lens_in_the_middle(), &course).unwrap();
    let mut render = |turn: UnitQuaternion<f32>| {
        let mut image = [0; IMAGE_PIXELS];
        camera.render(
            &Isometry3::from_parts(Translation3::new(52.0, 1.0, 2.0), turn),
            &mut image,
        );
        image
    };
    let level = render(UnitQuaternion::identity());
    let mut upside_down = render(UnitQuaternion::from_euler_angles(std::f32::consts::PI, 0.0, 0.0));
    upside_down.reverse();
    let off = level
        .iter()
        .zip(&upside_down)
        .filter(|(a, b)| a.abs_diff(**b) > 1)
        .count();
    assert!(off < 20, "{off} pixels differ");

    // Nose down (about the leftward axis) brings the floor nearer in the image's middle.
    let nose_down = render(UnitQuaternion::from_euler_angles(0.0, 0.5, 0.0));
    let middle = 36 * IMAGE_WIDTH + 64;
    assert!(nose_down[middle] < level[middle]);
}

#[test]
fn a_pose_that_is_not_a_number_sees_nothing() {
    let mut camera = DepthCamera::new(&CameraSettings::default(), &test_course()).unwrap();
    let mut image = [0; IMAGE_PIXELS];
    camera.render(&Isometry3::translation(f32::NAN, 0.0, 3.5), &mut image);
    assert!(image.iter().all(|&pixel| pixel == 255));
}

#[test]
fn settings_without_sense_are_refused_by_key() {
    let settings = CameraSettings {
        range_m: f32::NAN,
        ..Default::default()
    };
    let Err(fault) = DepthCamera::new(&settings, &test_course()) else {
        panic!("accepted")
    };
    assert_eq!(fault.key, "range_m");
}
