//! Courses and worlds: from a file, from a layout that a file may describe, and drawn from ranges.
//! An accepted course can be flown from every level.

use std::sync::Arc;

use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use skein_simulator::camera::IMAGE_PIXELS;
use skein_simulator::course::{
    Corridor, Course, CourseLayout, GeneratedShape, GeneratorRanges, Opening, Shape, StartArea,
    WallLabel, WallLayout,
};
use skein_simulator::reward::RewardTerms;
use skein_simulator::simulator::{EpisodeOutcome, Simulator, SimulatorSettings};
use skein_simulator::suite::Suite;

use super::{ReaderDecision, Target, USUAL, shipped, text};
use crate::script::Script;

pub(super) const FILE: Target = Target {
    name: "course_file",
    reads: "course files and world files",
    longest_bytes: 8192,
    weight: USUAL,
    samples: file_samples,
    run: |bytes| match text(bytes).map(|text| Course::parse(text, "fuzzed.toml")) {
        Some(Ok(course)) => assert_flyable(course),
        Some(Err(error)) => {
            assert!(error.to_string().contains("fuzzed.toml"), "{error}");
            ReaderDecision::Refused
        }
        None => ReaderDecision::Refused,
    },
};

pub(super) const LAYOUT: Target = Target {
    name: "course_layout",
    reads: "courses of any geometry, built from a script of choices",
    longest_bytes: 1024,
    weight: USUAL / 10,
    samples: layout_samples,
    run: |bytes| match Course::new(layout(&mut Script::new(bytes))) {
        Ok(course) => assert_flyable(course),
        Err(_) => ReaderDecision::Refused,
    },
};

pub(super) const GENERATOR: Target = Target {
    name: "generator",
    reads: "ranges of generated courses, built from a script of choices",
    longest_bytes: 256,
    weight: USUAL / 20,
    samples: generator_samples,
    run: |bytes| {
        let mut script = Script::new(bytes);
        let seed = script.u64();
        match Course::generate(seed, &ranges(&mut script)) {
            Ok(course) => assert_flyable(course),
            Err(_) => ReaderDecision::Refused,
        }
    },
};

pub(super) const SUITE: Target = Target {
    name: "suite_file",
    reads: "evaluation suites that may name the shipped course files",
    longest_bytes: 4096,
    weight: USUAL / 20,
    samples: suite_samples,
    run: |bytes| {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../configs/evaluations");
        let file = std::path::Path::new(folder).join("fuzzed.toml");
        match text(bytes).map(|text| Suite::parse(text, &file)) {
            Some(Ok(suite)) => {
                for entry in &suite.entries {
                    assert!(entry.episodes > 0);
                    for episode in [0, entry.episodes - 1] {
                        // A range may suit one seed but not another.
                        if let Ok(course) = entry.courses.of_episode(episode) {
                            assert!(course.levels() > 0);
                        }
                    }
                }
                ReaderDecision::Accepted
            }
            Some(Err(error)) => {
                assert!(error.to_string().contains("fuzzed.toml"), "{error}");
                ReaderDecision::Refused
            }
            None => ReaderDecision::Refused,
        }
    },
};

fn suite_samples() -> Vec<Vec<u8>> {
    vec![
        shipped("configs/evaluations/generalist.toml"),
        b"name = \"x\"\n[[entry]]\nname = \"one\"\nepisodes = 3\nfirst_seed = \
          18446744073709551615\n[entry.generated]\nshapes = [\"star\"]\n"
            .to_vec(),
    ]
}

fn file_samples() -> Vec<Vec<u8>> {
    [
        "training",
        "rearranged_34125",
        "rearranged_53412",
        "non_rectangular",
    ]
    .map(|name| shipped(&format!("configs/courses/{name}.toml")))
    .into_iter()
    .chain(["apartment", "hall"].map(|name| shipped(&format!("configs/worlds/{name}.toml"))))
    .collect()
}

/// Returns scripts whose choices are all average, or random.
fn layout_samples() -> Vec<Vec<u8>> {
    let mut samples = vec![[128; 60].to_vec()];
    samples.extend((0..24_u8).map(|seed| {
        let mut state = u32::from(seed) + 1;
        (0..120)
            .map(|_| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (state >> 24) as u8
            })
            .collect()
    }));
    samples
}

/// Returns scripts for one to four walls, each with one of three shapes, in the middle of all
/// ranges.
fn generator_samples() -> Vec<Vec<u8>> {
    let numbers = |count: usize| vec![128; 3 * count];
    (1..5_u8)
        .map(|walls| {
            let seed = [walls; 8];
            let shapes = [3, walls, walls + 1, walls + 2];
            // First two ranges, corridor, start and gap; then thickness and position of each wall.
            [
                &seed[..],
                &numbers(11),
                &[walls],
                &numbers(1 + usize::from(walls)),
                &shapes,
            ]
            .concat()
        })
        .collect()
}

/// Flies the first step from the first and the last level. No step panics, every number is finite,
/// and no episode begins in a wall.
pub(super) fn assert_flyable(course: Course) -> ReaderDecision {
    let settings = SimulatorSettings::default();
    let levels = course.levels();
    let mut simulator = Simulator::new(Arc::new(course), &settings).unwrap();
    fly(&mut simulator, &settings, 1);
    fly(&mut simulator, &settings, levels);
    ReaderDecision::Accepted
}

/// Flies two steps from `level`.
pub(super) fn fly(simulator: &mut Simulator, settings: &SimulatorSettings, level: u8) {
    let [mut start, mut disturbances] = [1, 2].map(Pcg64Mcg::seed_from_u64);
    simulator
        .reset(level, &mut start, &mut disturbances)
        .unwrap();
    let mut image = [0; IMAGE_PIXELS];
    for action in [[0.0, 0.0], [1.0, -1.0]] {
        simulator.render(&mut image);
        let report = simulator.step(action).unwrap();
        let state = simulator.state();
        let numbers = [
            state.position_m.coords,
            state.velocity_mps,
            state.body_rates_radps,
        ];
        assert!(
            numbers.iter().flatten().all(|value| value.is_finite()),
            "{state:?}"
        );
        assert!(
            state
                .world_from_body
                .coords
                .iter()
                .all(|value| value.is_finite()),
            "{state:?}"
        );
        simulator.render(&mut image);
        let reward = RewardTerms::of(&settings.reward, &report, &image);
        assert!(reward.total().is_finite(), "{reward:?}");
        if report.outcome.is_some() {
            // Half a second from the start, at the slow default speed, nothing can be hit.
            let defaults = settings.vehicle == SimulatorSettings::default().vehicle;
            assert!(
                !defaults
                    || action != [0.0, 0.0]
                    || report.outcome != Some(EpisodeOutcome::Collided)
            );
            break;
        }
    }
}

pub(super) fn layout(script: &mut Script<'_>) -> CourseLayout {
    let corridor = corridor(script);
    let start = start(script);
    let wall_thickness_m = script.number(0.05..=0.5);
    let gap_m = script.number(5.0..=20.0);
    let mut walls = Vec::new();
    while !script.is_over() && walls.len() < 8 {
        let number = walls.len() as u32 + 1;
        walls.push(WallLayout {
            label: WallLabel(if script.u8() == 255 { 1 } else { number }),
            x_m: gap_m * number as f32 + script.number(-1.0..=1.0),
            opening: Opening {
                shape: shape(script),
                centre_m: [script.number(-1.0..=1.0), script.number(2.5..=4.5)],
                rotation_deg: script.number(-360.0..=360.0),
            },
        });
    }
    CourseLayout {
        name: "fuzzed".to_owned(),
        corridor,
        start,
        wall_thickness_m,
        walls,
    }
}

fn corridor(script: &mut Script<'_>) -> Corridor {
    Corridor {
        length_m: script.number(20.0..=100.0),
        width_m: script.number(4.0..=8.0),
        height_m: script.number(5.0..=9.0),
    }
}

fn start(script: &mut Script<'_>) -> StartArea {
    StartArea {
        offset_m: script.number(1.0..=2.0),
        jitter_y_m: script.number(0.0..=1.0),
        jitter_z_m: script.number(0.0..=1.0),
    }
}

fn shape(script: &mut Script<'_>) -> Shape {
    let kind = script.u8() % 8;
    let mut length_m = || script.number(1.5..=4.0);
    let (width_m, height_m) = (length_m(), length_m());
    match kind {
        0 => Shape::Rectangle { width_m, height_m },
        1 => Shape::Circle {
            diameter_m: width_m,
        },
        2 => Shape::Triangle { width_m, height_m },
        3 => Shape::Diamond { width_m, height_m },
        4 => Shape::Cross {
            width_m,
            height_m,
            arm_m: length_m(),
        },
        5 => Shape::L {
            width_m,
            height_m,
            arm_m: length_m(),
        },
        _ => polygon(script),
    }
}

/// Returns corners around the centre or anywhere. Some polygons are simple, some are not, some have
/// coinciding corners.
fn polygon(script: &mut Script<'_>) -> Shape {
    let corners = script.u8() % 80;
    let round = script.u8() < 192;
    let points_m = (0..corners)
        .map(|corner| {
            if round {
                let angle = f32::from(corner) / f32::from(corners) * std::f32::consts::TAU;
                let radius_m = script.number(0.9..=2.0);
                [radius_m * angle.cos(), radius_m * angle.sin()]
            } else {
                [script.number(-2.0..=2.0), script.number(-2.0..=2.0)]
            }
        })
        .collect();
    Shape::Polygon { points_m }
}

fn ranges(script: &mut Script<'_>) -> GeneratorRanges {
    let mut range =
        |usual: std::ops::RangeInclusive<f32>| [script.number(usual.clone()), script.number(usual)];
    let (clearance_m, rotation_deg) = (range(0.6..=1.3), range(-360.0..=360.0));
    let (corridor, start) = (corridor(script), start(script));
    let gap_m = script.number(5.0..=20.0);
    let walls = script.u8() % 36;
    GeneratorRanges {
        corridor,
        start,
        wall_thickness_m: script.number(0.05..=0.5),
        wall_x_m: (1..=walls)
            .map(|wall| gap_m * f32::from(wall) + script.number(-1.0..=1.0))
            .collect(),
        shapes: (0..script.u8() % 4)
            .map(|_| {
                script.one_of(
                    &[
                        &GeneratedShape::TRAINED[..],
                        &GeneratedShape::HELD_OUT,
                        &GeneratedShape::UNTRIED,
                    ]
                    .concat(),
                )
            })
            .collect(),
        clearance_m,
        rotation_deg,
        layout: None,
        worlds: Vec::new(),
    }
}
