//! The drawn image compared with the traced one, for random poses in random courses.

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use super::{
    CameraSettings, DepthCamera, IMAGE_PIXELS, IMAGE_WIDTH, ImageErrors, InstructionSet,
    ReferenceCamera,
};
use crate::course::{
    Course, ForestRanges, GatesRanges, GeneratorRanges, HallRanges, Moment, RoomsRanges, Sides,
    WorldRanges, test_course,
};

/// Grey levels by which a pixel may differ, due to rounding.
const ROUNDING: u8 = 1;

/// Distance in pixels within which a silhouette excuses a difference: the tolerance of an edge's
/// position.
const SILHOUETTE_PX: f32 = 0.02;

/// Most pixels that a silhouette may excuse. An image holds some 500 silhouette pixels. One in 25
/// of them has its middle within [`SILHOUETTE_PX`] of the edge, and few of these differ.
const MOST_EXCUSED: usize = IMAGE_PIXELS / 500;

/// Differences between two images of the same pose.
struct ImageComparison {
    /// Number of pixels that differ but lie on a silhouette.
    excused: usize,
    /// All other pixels that differ: column, row, drawn, traced.
    wrong: Vec<(usize, usize, u8, u8)>,
}

fn compare(
    course: &Course,
    settings: &CameraSettings,
    world_from_body: &Isometry3<f32>,
) -> ImageComparison {
    compare_at(Moment::default(), course, settings, world_from_body)
}

fn compare_at(
    moment: Moment,
    course: &Course,
    settings: &CameraSettings,
    world_from_body: &Isometry3<f32>,
) -> ImageComparison {
    let reference = ReferenceCamera::new(settings, course, moment).unwrap();
    let mut drawn = [0; IMAGE_PIXELS];
    let mut traced = [0; IMAGE_PIXELS];
    let mut camera = DepthCamera::new(settings, course).unwrap();
    camera.move_obstacles(moment);
    camera.render(world_from_body, &mut drawn);
    reference.render(world_from_body, &mut traced);

    let view = settings.view(world_from_body);
    let mut comparison = ImageComparison {
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
            .map(|(right, down)| {
                reference.grey(&view, column as f32 + 0.5 + right, row as f32 + 0.5 + down)
            })
            .collect();
        let (least, most) = around
            .iter()
            .fold((255, 0), |(l, m), &g| (g.min(l), g.max(m)));
        if (least.saturating_sub(ROUNDING)..=most.saturating_add(ROUNDING)).contains(&drawn) {
            comparison.excused += 1;
        } else {
            comparison.wrong.push((column, row, drawn, traced));
        }
    }
    comparison
}

/// Region of the corridor for a lens.
#[derive(Debug, Clone, Copy)]
enum Spot {
    /// Between a wall and the previous one.
    BetweenWalls,
    /// In an opening, just before it or just behind it.
    Opening,
    /// Inside a wall, where a body that hit it may be: the backs of its faces are invisible.
    InsideWall,
}

/// Returns a lens position at a spot of wall `number`. `share`: position within the spot, each
/// from 0 to 1.
fn lens(course: &Course, number: usize, spot: Spot, share: [f32; 3]) -> [f32; 3] {
    const MARGIN_M: f32 = 0.05;
    let between = |least: f32, most: f32, share: f32| least + (most - least) * share;
    let corridor = course.corridor();
    let half = corridor.width_m / 2.0;
    let wall = &course.walls()[number];
    let back_m = wall.x_m() + course.wall_thickness_m();
    let begin_m = match number {
        0 => 0.0,
        _ => course.walls()[number - 1].x_m() + course.wall_thickness_m(),
    };
    let x = match spot {
        Spot::BetweenWalls => between(begin_m + MARGIN_M, wall.x_m() - MARGIN_M, share[0]),
        Spot::Opening => between(wall.x_m() - 0.5, back_m + 0.5, share[0]),
        Spot::InsideWall => between(wall.x_m() + MARGIN_M, back_m - MARGIN_M, share[0]),
    };
    match spot {
        Spot::BetweenWalls | Spot::InsideWall => [
            x,
            between(MARGIN_M - half, half - MARGIN_M, share[1]),
            between(MARGIN_M, corridor.height_m - MARGIN_M, share[2]),
        ],
        Spot::Opening => {
            let radius = (wall.clearance_m() - MARGIN_M) * share[1].sqrt();
            let (sin, cos) = (share[2] * std::f32::consts::TAU).sin_cos();
            let [y, z] = wall.safe_point();
            [x, y + radius * cos, z + radius * sin]
        }
    }
}

/// Returns settings with the lens at the body's origin, so that the pose is the lens's pose.
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
    fn the_drawn_image_equals_the_traced_one(
        seed in any::<u64>(),
        wall in 0usize..5,
        share in prop::array::uniform3(0.0f32..1.0),
        spot in prop_oneof![Just(Spot::BetweenWalls), Just(Spot::Opening), Just(Spot::InsideWall)],
        quaternion in prop::array::uniform4(-1.0f32..1.0)
            .prop_filter("too short to turn by", |q| q.iter().map(|c| c * c).sum::<f32>() > 0.1),
        horizontal_fov_deg in 40.0f32..120.0,
        mount_pitch_deg in -30.0f32..30.0,
    ) {
        let course = Course::generate(seed, &GeneratorRanges::default()).unwrap();
        let middle = lens_in_the_middle();
        let settings = CameraSettings { horizontal_fov_deg, mount_pitch_deg, ..middle };
        let world_from_body = pose(lens(&course, wall, spot, share), quaternion);
        let comparison = compare(&course, &settings, &world_from_body);
        prop_assert!(comparison.wrong.is_empty(), "{:?}", comparison.wrong);
        prop_assert!(comparison.excused <= MOST_EXCUSED, "{} excused", comparison.excused);
    }
}

/// Returns ranges of a kind of world: all shapes, still and moving, leaning and open.
fn any_world() -> impl Strategy<Value = WorldRanges> {
    let forest = ForestRanges {
        density_per_m2: [0.02, 0.1],
        lean_deg: 30.0,
        branches: [0, 4],
        sides: Sides::Open,
        ..Default::default()
    };
    let hall = HallRanges {
        balls: [2, 8],
        ..Default::default()
    };
    prop_oneof![
        Just(WorldRanges::Forest(forest)),
        Just(WorldRanges::Hall(hall)),
        Just(WorldRanges::Rooms(RoomsRanges::default())),
        Just(WorldRanges::Gates(GatesRanges::default())),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, ..ProptestConfig::default() })]

    #[test]
    fn the_drawn_image_of_a_world_equals_the_traced_one(
        world in any_world(),
        seed in any::<u64>(),
        share in prop::array::uniform3(0.02f32..0.98),
        quaternion in prop::array::uniform4(-1.0f32..1.0)
            .prop_filter("too short to turn by", |q| q.iter().map(|c| c * c).sum::<f32>() > 0.1),
        horizontal_fov_deg in 40.0f32..120.0,
        secs in 0.0f32..60.0,
    ) {
        let ranges = GeneratorRanges { worlds: vec![world], ..Default::default() };
        let course = Course::generate(seed, &ranges).unwrap();
        let middle = lens_in_the_middle();
        let settings = CameraSettings { horizontal_fov_deg, ..middle };
        let bounds = course.corridor();
        // Anywhere, also inside an obstacle: the backs of its faces are invisible.
        let at = [
            bounds.length_m * share[0],
            bounds.width_m * (share[1] - 0.5),
            bounds.height_m * share[2],
        ];
        let moment = Moment { secs, seed };
        let comparison = compare_at(moment, &course, &settings, &pose(at, quaternion));
        prop_assert!(comparison.wrong.is_empty(), "{:?}", comparison.wrong);
        prop_assert!(comparison.excused <= MOST_EXCUSED, "{} excused", comparison.excused);
    }
}

#[test]
fn images_agree_for_poses_of_an_episode() {
    // As in an episode: tilted by up to the vehicle's limit, with little yaw.
    let course = test_course();
    for step in 0..40 {
        let phase = step as f32;
        let turn = UnitQuaternion::from_euler_angles(
            0.57 * phase.sin(),
            0.3 * (1.7 * phase).cos(),
            0.05 * phase.sin(),
        );
        let at = Translation3::new(
            0.5 + 1.24 * phase,
            0.8 * (0.7 * phase).sin(),
            3.5 + 0.8 * phase.cos(),
        );
        let pose = Isometry3::from_parts(at, turn);
        let at_wall = course
            .walls()
            .iter()
            .any(|wall| (wall.x_m() - 0.5..wall.x_m() + 0.5).contains(&at.vector.x));
        if !at_wall {
            let comparison = compare(&course, &CameraSettings::default(), &pose);
            assert!(
                comparison.wrong.is_empty(),
                "step {step}: {:?}",
                comparison.wrong
            );
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
    // The lens is 8 m before the end wall and faces it: every pixel of it has the same depth.
    let course = test_course();
    let pose = Isometry3::translation(52.0, 0.0, 3.5);
    let settings = CameraSettings {
        range_m: 10.0,
        ..lens_in_the_middle()
    };
    let mut image = [0; IMAGE_PIXELS];
    DepthCamera::new(&settings, &course)
        .unwrap()
        .render(&pose, &mut image);
    let at = |column: usize, row: usize| image[row * IMAGE_WIDTH + column];
    // 255 * 8 m / 10 m = 204; the end wall reaches 3 / 8 * 64 = 24 pixels to each side.
    assert!(
        (41..87).all(|column| at(column, 36) == 204),
        "{:?}",
        &image[36 * IMAGE_WIDTH..37 * IMAGE_WIDTH]
    );
    // The left border is at 45 degrees, so the side, 3 m away, has a depth of 3 m up to half a
    // pixel.
    assert_eq!(at(0, 36), (25.5f32 * 3.0 * 64.0 / 63.5).round() as u8);
    // The ceiling, 3.5 m above, and the floor, 3.5 m below, are symmetric.
    assert_eq!(at(64, 0), at(64, 71));
}

#[test]
fn roll_turns_the_image_and_nose_down_brings_the_floor_nearer() {
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
    let mut upside_down = render(UnitQuaternion::from_euler_angles(
        std::f32::consts::PI,
        0.0,
        0.0,
    ));
    upside_down.reverse();
    let off = level
        .iter()
        .zip(&upside_down)
        .filter(|(a, b)| a.abs_diff(**b) > 1)
        .count();
    assert!(off < 20, "{off} pixels differ");

    // Nose down is a turn about the leftward axis.
    let nose_down = render(UnitQuaternion::from_euler_angles(0.0, 0.5, 0.0));
    let middle = 36 * IMAGE_WIDTH + 64;
    assert!(nose_down[middle] < level[middle]);
}

#[test]
fn no_pixel_is_near_in_the_middle_of_an_opening() {
    // With the lens in the plane of a face, the near plane cuts the face all along its hole. In no
    // attitude may a pixel of that cut line be visible.
    let course = test_course();
    let mut camera = DepthCamera::new(&lens_in_the_middle(), &course).unwrap();
    let mut image = [0; IMAGE_PIXELS];
    let mut rng = Pcg64Mcg::seed_from_u64(1);
    for number in 0..4000 {
        let wall = &course.walls()[number % course.walls().len()];
        let [y, z] = wall.safe_point();
        let x = wall.x_m() + rng.random_range(-0.03..0.03);
        let quaternion = std::array::from_fn(|_| rng.random_range(-1.0..1.0));
        camera.render(&pose([x, y, z], quaternion), &mut image);
        // The nearest surface is `clearance_m` away, at most 49 degrees off the optical axis.
        let least = (255.0 * 0.65 * wall.clearance_m() / 20.0) as u8;
        let nearest = image.iter().copied().min().unwrap();
        assert!(
            nearest >= least,
            "wall {}, x = {x}, {quaternion:?}: {nearest}",
            wall.label()
        );
    }
}

#[test]
fn instruction_sets_change_no_bit_of_the_image() {
    let course = test_course();
    let settings = lens_in_the_middle();
    let mut camera = DepthCamera::new(&settings, &course).unwrap();
    let [mut portable, mut wider] = [[0; IMAGE_PIXELS]; 2];
    let mut rng = Pcg64Mcg::seed_from_u64(2);
    for number in 0..500 {
        let share = std::array::from_fn(|_| rng.random_range(0.0..1.0));
        let quaternion = std::array::from_fn(|_| rng.random_range(-1.0..1.0));
        let spot = [Spot::BetweenWalls, Spot::Opening][number % 2];
        let view = settings.view(&pose(lens(&course, number % 5, spot, share), quaternion));
        super::draw(&mut camera, &view, ImageErrors::None, &mut portable);
        for set in InstructionSet::ALL
            .into_iter()
            .filter(|set| set.is_available())
        {
            set.draw()(&mut camera, &view, ImageErrors::None, &mut wider);
            assert!(portable == wider, "{set}, {view:?}");
        }
    }
}

#[test]
fn a_nan_pose_gives_an_empty_image() {
    let mut camera = DepthCamera::new(&CameraSettings::default(), &test_course()).unwrap();
    let mut image = [0; IMAGE_PIXELS];
    camera.render(&Isometry3::translation(f32::NAN, 0.0, 3.5), &mut image);
    assert!(image.iter().all(|&pixel| pixel == 255));
}

#[test]
fn settings_out_of_bounds_are_refused_by_key() {
    let settings = CameraSettings {
        range_m: f32::NAN,
        ..Default::default()
    };
    let Err(fault) = DepthCamera::new(&settings, &test_course()) else {
        panic!("accepted")
    };
    assert_eq!(fault.key, "range_m");
}
