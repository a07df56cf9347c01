//! Disturbed episodes: each disturbance has its effect when it is on and none when it is off.

use std::sync::Arc;

use nalgebra::Vector3;
use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;

use super::*;
use crate::camera::{CameraSettings, IMAGE_PIXELS};
use crate::course::{Course, test_course};
use crate::simulator::{EpisodeOutcome, Simulator, SimulatorSettings};
use crate::vehicle::{Preset, VehicleSettings, VehicleState};

/// Returns all disturbances at once, and strong.
fn stormy() -> DisturbanceSettings {
    toml::from_str(
        "mass_spread = 0.2\nlatency_periods = 1\ngust.force_rms_n = 0.15\n\
         depth.model = \"stereo\"\ndepth.dropout_share = 0.1\n",
    )
    .unwrap()
}

fn of(preset: Preset) -> VehicleSettings {
    VehicleSettings {
        preset,
        ..Default::default()
    }
}

fn simulator(preset: Preset, disturbances: DisturbanceSettings) -> Simulator {
    let settings = SimulatorSettings {
        vehicle: of(preset),
        disturbances,
        ..Default::default()
    };
    Simulator::new(Arc::new(test_course()), &settings).unwrap()
}

fn reset(simulator: &mut Simulator, disturbances_seed: u64) {
    let [mut start, mut disturbances] = [1, disturbances_seed].map(Pcg64Mcg::seed_from_u64);
    simulator.reset(1, &mut start, &mut disturbances).unwrap();
}

/// Returns state and image before each step of `actions`, and after the last.
fn flown(
    simulator: &mut Simulator,
    disturbances_seed: u64,
    actions: &[[f32; 2]],
) -> Vec<(VehicleState, Box<[u8; IMAGE_PIXELS]>)> {
    reset(simulator, disturbances_seed);
    let look = |simulator: &mut Simulator| {
        let mut image = Box::new([0; IMAGE_PIXELS]);
        simulator.render(&mut image);
        (simulator.state(), image)
    };
    let mut seen = vec![look(simulator)];
    for &action in actions {
        simulator.step(action).unwrap();
        seen.push(look(simulator));
    }
    seen
}

#[test]
fn a_disturbed_episode_depends_on_its_seeds_and_not_on_earlier_episodes() {
    let actions = [[0.5, 0.2]; 8];
    let mut used = simulator(Preset::Airsim, stormy());
    let first = flown(&mut used, 5, &actions);
    let other = flown(&mut used, 6, &actions);
    let again = flown(&mut used, 5, &actions);
    let fresh = flown(&mut simulator(Preset::Airsim, stormy()), 5, &actions);
    assert!(first == again && first == fresh);
    assert!(first != other);
}

#[test]
fn a_share_of_episodes_is_disturbed_and_the_others_are_calm_in_every_respect() {
    let actions = [[0.5, 0.2]; 4];
    let now_and_then = DisturbanceSettings {
        share: 0.3,
        ..stormy()
    };
    let mut simulators = [DisturbanceSettings::default(), stormy(), now_and_then]
        .map(|disturbances| simulator(Preset::Airsim, disturbances));
    let mut disturbed = 0;
    for seed in 0..100 {
        let [calm, stormy, found] = simulators
            .each_mut()
            .map(|simulator| flown(simulator, seed, &actions));
        assert!(found == calm || found == stormy, "seed {seed}");
        disturbed += usize::from(found == stormy);
    }
    // Four standard deviations of a binomial count.
    assert!((12..=48).contains(&disturbed), "{disturbed} of 100");
}

#[test]
fn the_disturbances_generator_has_no_influence_with_disturbances_off() {
    let actions = [[0.5, 0.2]; 8];
    for preset in [Preset::Airsim, Preset::Hummingbird, Preset::Point] {
        let mut calm = simulator(preset, DisturbanceSettings::default());
        assert!(
            flown(&mut calm, 5, &actions) == flown(&mut calm, 6, &actions),
            "{preset:?}"
        );
    }
}

/// Compares a hundred steps of the oracle's undisturbed episode with recorded ones. Positions may
/// differ by a millimetre and sums by a part in 10,000, because mathematical functions of different
/// system libraries may differ in the last bit.
#[test]
fn undisturbed_episodes_equal_the_recorded_ones() {
    const STEPS: usize = 100;
    let course = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../../configs/courses/training.toml"
    );
    let course = Arc::new(Course::load(course).unwrap());
    for (preset, end_m, grey) in RECORDED {
        let settings = SimulatorSettings {
            vehicle: of(preset),
            ..Default::default()
        };
        let mut simulator = Simulator::new(Arc::clone(&course), &settings).unwrap();
        reset(&mut simulator, 3);
        let mut image = [0; IMAGE_PIXELS];
        let mut sum = 0.0;
        for _ in 0..STEPS {
            simulator.render(&mut image);
            sum += image.iter().copied().map(f64::from).sum::<f64>();
            let action = simulator.oracle_action();
            simulator.step(action).unwrap();
        }
        let end = simulator.state().position_m.coords;
        assert!(
            (end - Vector3::from(end_m)).norm() < 1e-3 && (sum / grey - 1.0).abs() < 1e-4,
            "{preset:?}: {end} {sum}"
        );
    }
}

/// Final position in metres, sum of all pixels.
const RECORDED: [(Preset, [f32; 3], f64); 3] = [
    (Preset::Airsim, [50.32047, 1.6861643, 2.9394774], 60794721.0),
    (
        Preset::Hummingbird,
        [50.946087, 1.6853168, 2.9255474],
        61127236.0,
    ),
    (Preset::Point, [51.204174, 1.6835145, 2.9146352], 61046583.0),
];

#[test]
fn latency_shifts_the_response_by_exactly_its_periods() {
    let actions = [
        [0.8, -0.4],
        [-0.3, 0.6],
        [0.1, 0.1],
        [1.0, 0.0],
        [0.0, 0.5],
        [0.2, 0.0],
    ];
    let late = |latency_periods, actions: &[[f32; 2]]| {
        let disturbances = DisturbanceSettings {
            latency_periods,
            ..Default::default()
        };
        flown(&mut simulator(Preset::Airsim, disturbances), 1, actions)
    };
    for periods in [1, 2] {
        // The same episode as without latency, after waiting as long.
        let waiting = [vec![[0.0, 0.0]; periods as usize], actions.to_vec()].concat();
        assert!(late(periods, &actions) == late(0, &waiting)[..=actions.len()]);
        assert!(late(periods, &actions) != late(0, &actions));
    }
}

#[test]
fn a_pending_command_does_not_reach_the_next_episode() {
    let disturbances = DisturbanceSettings {
        latency_periods: 2,
        ..Default::default()
    };
    let mut used = simulator(Preset::Airsim, disturbances);
    let first = flown(&mut used, 1, &[[0.0, 0.0]; 2]);
    flown(&mut used, 1, &[[1.0, 1.0]; 2]);
    assert!(first == flown(&mut used, 1, &[[0.0, 0.0]; 2]));
}

/// Lets a drone of `factor` times the nominal mass hover. Returns its rise after each period,
/// metres, and its final climb rate, m/s.
fn hover(preset: Preset, factor: f32) -> (Vec<f32>, f32) {
    let mut simulator = simulator(
        preset,
        DisturbanceSettings {
            mass_spread: 0.5,
            ..Default::default()
        },
    );
    let seed = (0..)
        .find(|&seed| {
            let drawn = DrawnDisturbances::draw(
                &DisturbanceSettings {
                    mass_spread: 0.5,
                    ..Default::default()
                },
                &mut Pcg64Mcg::seed_from_u64(seed),
            );
            (drawn.mass_factor - factor).abs() < 0.01
        })
        .unwrap();
    let seen = flown(&mut simulator, seed, &[[0.0, 0.0]; 14]);
    let start_m = seen[0].0.position_m.z;
    let rises = seen
        .iter()
        .map(|(state, _)| state.position_m.z - start_m)
        .collect();
    (rises, seen.last().unwrap().0.velocity_mps.z)
}

#[test]
fn a_heavier_drone_sinks_first_a_lighter_one_rises_and_both_reach_hover() {
    for preset in [Preset::Airsim, Preset::Hummingbird] {
        let (heavy, heavy_mps) = hover(preset, 1.2);
        let (light, light_mps) = hover(preset, 0.8);
        assert!(heavy[1] < -0.01, "{preset:?}: {heavy:?}");
        assert!(light[1] > 0.01, "{preset:?}: {light:?}");
        assert!(
            heavy_mps.abs() < 0.02 && light_mps.abs() < 0.02,
            "{preset:?}: {heavy_mps} {light_mps}"
        );
    }
}

#[test]
fn masses_are_spread_evenly_over_the_range_and_do_not_depend_on_gusts() {
    let settings = stormy();
    let calm = DisturbanceSettings {
        mass_spread: 0.2,
        ..Default::default()
    };
    let factors: Vec<f32> = (0..4000)
        .map(|seed| {
            DrawnDisturbances::draw(&settings, &mut Pcg64Mcg::seed_from_u64(seed)).mass_factor
        })
        .collect();
    assert!(factors.iter().all(|factor| (0.8..=1.2).contains(factor)));
    for quarter in 0..4 {
        let from = 0.8 + 0.1 * quarter as f32;
        let share = factors
            .iter()
            .filter(|&&f| f >= from && f < from + 0.1)
            .count();
        assert!((900..1100).contains(&share), "{share} of 4000 from {from}");
    }
    let first = DrawnDisturbances::draw(&calm, &mut Pcg64Mcg::seed_from_u64(0)).mass_factor;
    assert_eq!(first, factors[0]);
}

#[test]
fn a_gust_moves_a_hovering_drone_aside() {
    let aside = |force_rms_n| {
        let disturbances = DisturbanceSettings {
            gust: GustSettings {
                force_rms_n,
                ..Default::default()
            },
            ..Default::default()
        };
        let mut simulator = simulator(Preset::Airsim, disturbances);
        let blown_m = |seed| {
            let seen = flown(&mut simulator, seed, &[[0.0, 0.0]; 10]);
            seen[10].0.position_m.y - seen[0].0.position_m.y
        };
        let sum: f32 = (0..20).map(blown_m).map(|m| m * m).sum();
        (sum / 20.0).sqrt()
    };
    assert!(aside(0.0) < 1e-3);
    // Twice the force moves the drone twice as far.
    let ratio = aside(0.3) / aside(0.15);
    assert!(
        aside(0.3) > 0.1 && (1.8..2.2).contains(&ratio),
        "{} m, {ratio}",
        aside(0.3)
    );
}

#[test]
fn the_oracle_still_arrives_under_strong_disturbances() {
    let mut simulator = simulator(Preset::Airsim, stormy());
    let arrived = (0..20)
        .filter(|&seed| {
            reset(&mut simulator, seed);
            loop {
                let action = simulator.oracle_action();
                if let Some(outcome) = simulator.step(action).unwrap().outcome {
                    return outcome == EpisodeOutcome::ReachedEnd;
                }
            }
        })
        .count();
    assert!(arrived >= 17, "{arrived} of 20");
}

#[test]
fn a_setting_out_of_bounds_or_without_effect_is_refused_by_key() {
    let refusal = |text: &str, preset| {
        let settings: DisturbanceSettings = toml::from_str(text).unwrap();
        let refused = settings.validate(&of(preset), CameraSettings::default().range_m);
        refused.map_err(|fault| fault.to_string())
    };
    for (text, expected) in [
        ("mass_spread = 0.6", "mass_spread = 0.6 is outside 0 to 0.5"),
        ("mass_spread = nan", "mass_spread = NaN"),
        (
            "latency_periods = 9",
            "latency_periods = 9 is outside 0 to 8",
        ),
        ("gust.force_rms_n = -1.0", "gust.force_rms_n = -1"),
        ("gust.correlation_secs = 0.0", "gust.correlation_secs = 0"),
        ("depth.baseline_m = 1.0", "depth.baseline_m = 1"),
        ("depth.dropout_share = 0.9", "depth.dropout_share = 0.9"),
        ("depth.dropout_patch_px = 0", "depth.dropout_patch_px = 0"),
        (
            "depth.sigma_constant_m = inf",
            "depth.sigma_constant_m = inf",
        ),
        ("depth.sigma_linear = -0.1", "makes the noise at"),
        (
            "depth.sigma_quadratic_per_m = 1.0",
            "makes the noise at 20 m 400",
        ),
    ] {
        let message = refusal(text, Preset::Airsim).unwrap_err();
        assert!(message.contains(expected), "{message}");
        assert!(message.starts_with("disturbances: key "), "{message}");
    }
    for text in ["mass_spread = 0.2", "gust.force_rms_n = 0.2"] {
        assert_eq!(refusal(text, Preset::Airsim), Ok(()));
        let message = refusal(text, Preset::Point).unwrap_err();
        assert!(message.contains("vehicle.preset = \"point\""), "{message}");
    }
    assert_eq!(
        refusal(
            "latency_periods = 1\ndepth.model = \"stereo\"",
            Preset::Point
        ),
        Ok(())
    );
    let unknown = toml::from_str::<DisturbanceSettings>("gust.rms = 1.0").unwrap_err();
    assert!(unknown.to_string().contains("rms"), "{unknown}");
}
