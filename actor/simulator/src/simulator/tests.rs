//! Episodes from start to end: determinism, counting, outcomes, refusals.

use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;

use super::*;
use crate::course::test_course;
use crate::vehicle::{Preset, VehicleSettings};

const PRESETS: [Preset; 3] = [Preset::Airsim, Preset::Hummingbird, Preset::Point];

fn simulator(preset: Preset) -> Simulator {
    let vehicle = VehicleSettings {
        preset,
        ..Default::default()
    };
    let settings = SimulatorSettings {
        vehicle,
        ..Default::default()
    };
    Simulator::new(Arc::new(test_course()), &settings).unwrap()
}

fn rng(seed: u64) -> Pcg64Mcg {
    Pcg64Mcg::seed_from_u64(seed)
}

/// Flies `choose_action` to the end and returns each step's state and report.
fn fly<const N: usize>(
    simulator: &mut Simulator,
    level: u8,
    seed: u64,
    choose_action: impl Fn(&Simulator) -> [f32; N],
) -> Vec<(VehicleState, StepReport)> {
    simulator
        .reset(level, &mut rng(seed), &mut rng(!seed))
        .unwrap();
    let mut steps = Vec::new();
    loop {
        let action = choose_action(simulator);
        let report = simulator.step(action).unwrap();
        steps.push((simulator.state(), report));
        if report.outcome.is_some() {
            return steps;
        }
    }
}

fn bits(steps: &[(VehicleState, StepReport)]) -> Vec<u32> {
    let numbers = |s: &VehicleState| {
        let parts = [
            s.position_m.coords.as_slice(),
            s.velocity_mps.as_slice(),
            s.body_rates_radps.as_slice(),
        ];
        [parts.concat(), s.world_from_body.coords.as_slice().to_vec()].concat()
    };
    steps
        .iter()
        .flat_map(|(state, _)| numbers(state))
        .map(f32::to_bits)
        .collect()
}

#[test]
fn episode_after_another_episode_is_bit_equal_to_one_in_a_fresh_simulator() {
    for preset in PRESETS {
        let mut used = simulator(preset);
        // One episode collides in a wild attitude, the other reaches the end.
        fly(&mut used, 3, 7, |_| [1.0, -1.0]);
        fly(&mut used, 1, 8, Simulator::oracle_action);
        let again = fly(&mut used, 2, 9, Simulator::oracle_action);
        let fresh = fly(&mut simulator(preset), 2, 9, Simulator::oracle_action);
        assert_eq!(bits(&again), bits(&fresh), "{preset:?}");
    }
}

#[test]
fn whole_course_passes_every_wall_once_and_reaches_the_end() {
    for preset in PRESETS {
        let mut simulator = simulator(preset);
        let steps = fly(&mut simulator, 1, 1, Simulator::oracle_action);
        let (state, last) = steps.last().unwrap();
        assert_eq!(
            last.outcome,
            Some(EpisodeOutcome::ReachedEnd),
            "{preset:?} at {}",
            state.position_m
        );
        assert_eq!(
            (last.walls_passed, simulator.level(), last.hit),
            (5, 6, None)
        );
        assert_eq!(
            steps
                .iter()
                .filter(|(_, report)| report.level_up == LevelUp::Yes)
                .count(),
            5
        );
    }
}

#[test]
fn later_start_level_counts_only_the_walls_that_remain() {
    let mut simulator = simulator(Preset::Point);
    simulator.reset(4, &mut rng(1), &mut rng(2)).unwrap();
    assert_eq!((simulator.level(), simulator.walls_passed()), (4, 0));
    let steps = fly(&mut simulator, 4, 1, Simulator::oracle_action);
    assert_eq!(steps.last().unwrap().1.walls_passed, 2);
}

#[test]
fn a_wall_counts_when_the_tail_leaves_its_back_face() {
    let mut simulator = simulator(Preset::Point);
    let steps = fly(&mut simulator, 1, 1, Simulator::oracle_action);
    let back_m = simulator.course().walls()[0].x_m() + simulator.course().wall_thickness_m();
    for (state, report) in steps {
        assert_eq!(
            report.walls_passed >= 1,
            state.position_m.x - 0.49 > back_m,
            "at x = {}",
            state.position_m.x
        );
    }
}

#[test]
fn straight_episode_ends_at_the_first_wall_with_the_nose_on_it() {
    // The test course's first opening does not cover the middle.
    let steps = fly(&mut simulator(Preset::Point), 1, 1, |_| [0.0, 0.0]);
    let (state, last) = steps.last().unwrap();
    assert_eq!(
        (last.outcome, last.walls_passed),
        (Some(EpisodeOutcome::Collided), 0)
    );
    assert_eq!(last.hit, Some(Obstacle::Wall(1)));
    let nose_m = state.position_m.x + 0.49;
    assert!((10.0..10.01).contains(&nose_m), "{nose_m}");
}

#[test]
fn floor_ceiling_and_sides_are_solid() {
    for action in [[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]] {
        let steps = fly(&mut simulator(Preset::Airsim), 1, 1, move |_| action);
        let (state, last) = steps.last().unwrap();
        assert_eq!(
            (last.outcome, last.hit),
            (Some(EpisodeOutcome::Collided), Some(Obstacle::Corridor))
        );
        assert!(
            state.position_m.x < 9.0,
            "went to x = {} under {action:?}",
            state.position_m.x
        );
    }
}

#[test]
fn step_limit_ends_the_episode_as_timed_out() {
    let settings = SimulatorSettings {
        max_steps: 3,
        ..Default::default()
    };
    let mut simulator = Simulator::new(Arc::new(test_course()), &settings).unwrap();
    let steps = fly(&mut simulator, 1, 1, |_| [0.0, 0.0]);
    assert_eq!(steps.len(), 3);
    assert_eq!(
        (steps[2].1.outcome, steps[2].1.hit),
        (Some(EpisodeOutcome::TimedOut), None)
    );
    assert_eq!(simulator.step([0.0, 0.0]), Err(SimulationError::NotFlying));
}

#[test]
fn actions_beyond_the_range_are_clamped() {
    let mut simulator = simulator(Preset::Point);
    let within = fly(&mut simulator, 1, 1, |_| [1.0, -1.0]);
    let beyond = fly(&mut simulator, 1, 1, |_| [50.0, f32::MIN]);
    assert_eq!(bits(&within), bits(&beyond));
}

#[test]
fn action_that_is_not_a_number_ends_the_episode_with_an_error() {
    let mut simulator = simulator(Preset::Airsim);
    simulator.reset(1, &mut rng(1), &mut rng(2)).unwrap();
    simulator.step([0.0, 0.0]).unwrap();
    let error = simulator.step([0.0, f32::NAN]);
    assert_eq!(
        error,
        Err(SimulationError::NonFinite {
            what: "action",
            step: 2
        })
    );
    assert_eq!(simulator.step([0.0, 0.0]), Err(SimulationError::NotFlying));
}

#[test]
fn physics_that_is_not_a_number_ends_the_episode_with_an_error() {
    for preset in PRESETS {
        let mut simulator = simulator(preset);
        simulator.reset(1, &mut rng(1), &mut rng(2)).unwrap();
        match &mut simulator.vehicle {
            Vehicle::Point { time_constant_secs } => *time_constant_secs = f32::NAN,
            Vehicle::Quadrotor { airframe, .. } => airframe.rotor_thrust_n = f32::NAN,
        }
        let error = simulator.step([0.0, 0.0]);
        let what = "the body's pose or velocity";
        assert_eq!(
            error,
            Err(SimulationError::NonFinite { what, step: 1 }),
            "{preset:?}"
        );
        // A new episode starts clean.
        assert!(!fly(&mut simulator, 1, 1, Simulator::oracle_action).is_empty());
    }
}

#[test]
fn empty_section_gives_the_defaults_and_unknown_keys_are_refused() {
    assert_eq!(
        toml::from_str::<SimulatorSettings>("").unwrap(),
        SimulatorSettings::default()
    );
    let error = toml::from_str::<SimulatorSettings>("[vehicle]\nmass = 3").unwrap_err();
    assert!(error.to_string().contains("mass"), "{error}");
}

#[test]
fn settings_out_of_bounds_are_refused_by_key() {
    let vehicle = VehicleSettings {
        physics_hz: 50.0,
        ..Default::default()
    };
    let settings = SimulatorSettings {
        vehicle,
        ..Default::default()
    };
    let error = Simulator::new(Arc::new(test_course()), &settings)
        .err()
        .unwrap()
        .to_string();
    assert!(error.contains("physics_hz = 50"), "{error}");
    let settings = SimulatorSettings {
        max_steps: 0,
        ..Default::default()
    };
    let error = Simulator::new(Arc::new(test_course()), &settings)
        .err()
        .unwrap()
        .to_string();
    assert!(error.contains("max_steps = 0"), "{error}");
}

#[test]
fn level_beyond_the_course_is_refused() {
    let error = simulator(Preset::Point)
        .reset(6, &mut rng(1), &mut rng(2))
        .unwrap_err();
    assert_eq!((error.level, error.levels), (6, 5));
}

#[test]
fn the_ground_truth_holds_the_disturbances_of_an_episode_and_none_in_a_calm_one() {
    let mut settings = SimulatorSettings::default();
    let mut ground_truth = |share: f32| {
        settings.disturbances.share = share;
        settings.disturbances.mass_spread = 0.2;
        settings.disturbances.latency_periods = 2;
        settings.disturbances.gust.force_rms_n = 0.15;
        let mut simulator = Simulator::new(Arc::new(test_course()), &settings).unwrap();
        simulator.reset(1, &mut rng(1), &mut rng(2)).unwrap();
        simulator.step([0.0, 0.0]).unwrap();
        simulator.ground_truth()
    };
    let (calm, disturbed) = (ground_truth(0.0), ground_truth(1.0));
    assert_eq!(
        (calm.mass_factor, calm.latency_periods, calm.gust_n),
        (1.0, 0.0, [0.0; 3])
    );
    assert_eq!(disturbed.latency_periods, 2.0);
    let deviation = (disturbed.mass_factor - 1.0).abs();
    assert!(
        deviation > 0.001 && deviation <= 0.2,
        "{}",
        disturbed.mass_factor
    );
    assert!(
        disturbed.gust_n.iter().all(|force_n| *force_n != 0.0),
        "{:?}",
        disturbed.gust_n
    );
}
