//! The assumption of `learning.mirror`: mirrored commands in a mirrored course give the mirror
//! image of the episode, image by image.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use std::sync::Arc;

use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use skein_learner::episode::{CommittedEpisode, StepObservation};
use skein_protocol::ids::{ActorId, EpisodeId, Epoch, PolicyVersion};
use skein_protocol::{ActionSpace, IMAGE_PIXELS, MAX_ACTION, MAX_LATENT, REWARD_TERMS};
use skein_simulator::course::{
    Corridor, Course, CourseLayout, Opening, Shape, StartArea, WallLabel, WallLayout,
};
use skein_simulator::simulator::{GroundTruth, OpeningAhead, Simulator, SimulatorSettings};

const STEPS: usize = 15;

/// Returns a course with two asymmetric openings, or its mirror image.
fn course(side: f32) -> Course {
    let wall = |label, x_m, centre_m: [f32; 2], points: [[f32; 2]; 5]| {
        let mut points_m: Vec<_> = points.map(|[y_m, z_m]| [side * y_m, z_m]).into();
        if side < 0.0 {
            points_m.reverse();
        }
        WallLayout {
            label: WallLabel(label),
            x_m,
            opening: Opening {
                shape: Shape::Polygon { points_m },
                centre_m: [side * centre_m[0], centre_m[1]],
                rotation_deg: 0.0,
            },
        }
    };
    let start = StartArea {
        jitter_y_m: 0.0,
        jitter_z_m: 0.0,
        ..StartArea::default()
    };
    let shape = [
        [-1.0, -1.2],
        [1.4, -1.0],
        [1.1, 0.9],
        [0.2, 1.5],
        [-1.3, 0.8],
    ];
    Course::new(CourseLayout {
        name: "mirror".to_owned(),
        corridor: Corridor::default(),
        start,
        wall_thickness_m: 0.3,
        walls: vec![
            wall(1, 10.0, [0.7, 3.9], shape),
            wall(2, 20.0, [-0.9, 3.0], shape.map(|[y, z]| [z, y])),
        ],
    })
    .expect("the course can be flown")
}

fn fly(side: f32, space: ActionSpace) -> CommittedEpisode {
    let mut settings = SimulatorSettings::default();
    settings.vehicle.action = space;
    let mut simulator =
        Simulator::new(Arc::new(course(side)), &settings).expect("the settings are sound");
    let [mut start, mut calm] = [1, 2].map(Pcg64Mcg::seed_from_u64);
    simulator
        .reset(1, &mut start, &mut calm)
        .expect("every course has a first level");
    let (mut observations, mut depth) = (Vec::new(), Vec::new());
    let (mut actions, mut teacher_actions) = (Vec::new(), Vec::new());
    for step in 0..=STEPS {
        let mut image = [0; IMAGE_PIXELS];
        simulator.render(&mut image);
        depth.extend_from_slice(&image);
        let state = simulator.state();
        observations.push(StepObservation {
            latent: [0.0; MAX_LATENT],
            velocity_mps: state.velocity_mps.into(),
            goal_m: simulator.goal_m(),
            position_m: state.position_m.coords.into(),
            orientation: state.world_from_body.coords.into(),
            ground_truth: simulator.ground_truth().numbers(),
        });
        if step < STEPS {
            let phase = step as f32;
            let taught = simulator.oracle_action();
            let (left, up) = (side * (0.7 * phase).sin(), (0.4 * phase).cos());
            let action = match space {
                ActionSpace::Lateral => [left, up, 0.0, 0.0],
                ActionSpace::Velocity => [0.5, left, up, 0.0],
                ActionSpace::VelocityYaw => [0.5, left, up, side * 0.1 * (0.3 * phase).sin()],
            };
            simulator.step(action).expect("nothing is hit so soon");
            actions.push(action);
            teacher_actions.push(taught);
        }
    }
    CommittedEpisode {
        episode: EpisodeId(0),
        epoch: Epoch(0),
        policy_version: PolicyVersion(0),
        actor: ActorId(0),
        level: 1,
        first_step: 0,
        action_before: [0.0; MAX_ACTION],
        observations,
        rewards: vec![0.0; STEPS],
        reward_terms: vec![[0.0; REWARD_TERMS]; STEPS],
        level_up: vec![false; STEPS],
        outcome: None,
        walls_passed: 0,
        course_walls: 0,
        hit_wall: None,
        depth: Some(depth),
        actions,
        teacher_actions,
    }
}

#[test]
fn the_mirror_image_of_an_episode_is_the_episode_through_the_mirrored_course() {
    for space in ActionSpace::ALL {
        assert_mirrored(space);
    }
}

/// Compares the mirror image of an episode with the episode through the mirrored course.
fn assert_mirrored(space: ActionSpace) {
    let (mirrored, flown) = (fly(1.0, space).mirrored(space), fly(-1.0, space));
    assert_eq!(mirrored.actions, flown.actions);
    for (one, other) in mirrored.teacher_actions.iter().zip(&flown.teacher_actions) {
        for (one, other) in one.iter().zip(other) {
            assert!((one - other).abs() < 2e-3, "teacher: {one} and {other}");
        }
    }
    for (step, (one, other)) in mirrored
        .observations
        .iter()
        .zip(&flown.observations)
        .enumerate()
    {
        for (what, one, other) in [
            ("position", &one.position_m[..], &other.position_m[..]),
            ("velocity", &one.velocity_mps, &other.velocity_mps),
            ("goal", &one.goal_m, &other.goal_m),
            ("orientation", &one.orientation, &other.orientation),
            ("ground truth", &one.ground_truth, &other.ground_truth),
        ] {
            let apart = one
                .iter()
                .zip(other)
                .map(|(one, other)| (one - other).abs());
            let most = apart.fold(0.0, f32::max);
            assert!(most < 2e-3, "step {step}: {what} {one:?} and {other:?}");
        }
    }
    let images = mirrored
        .depth
        .unwrap()
        .into_iter()
        .zip(flown.depth.unwrap());
    let off = images
        .filter(|(one, other)| one.abs_diff(*other) > 1)
        .count();
    // Silhouettes may fall on the other side of a pixel's centre.
    let pixels = (STEPS + 1) * IMAGE_PIXELS;
    assert!(off < pixels / 200, "{off} of {pixels} pixels differ");
}

#[test]
fn mirroring_swaps_left_and_right_and_nothing_else() {
    // `side` is 1 for the episode, -1 for its mirror image.
    let truth = |side: f32| {
        let ahead = |distance_m: f32| OpeningAhead {
            distance_m,
            offset_m: [side * 1.5, 2.5],
            clearance_m: 0.9,
        };
        GroundTruth {
            ahead: [ahead(4.0), ahead(14.0)],
            from_middle_m: [side * 0.3, 0.4],
            to_end_m: 50.0,
            mass_factor: 1.1,
            latency_periods: 1.0,
            gust_n: [0.1, side * 0.2, 0.3],
            half_section_m: [3.0, 3.5],
        }
    };
    let mut flown = fly(1.0, ActionSpace::Lateral);
    flown.observations[0].ground_truth = truth(1.0).numbers();
    assert_eq!(
        flown.mirrored(ActionSpace::Lateral).observations[0].ground_truth,
        truth(-1.0).numbers()
    );
}
