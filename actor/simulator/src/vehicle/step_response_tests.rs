//! Step responses of the drones, against values derived by hand.
//!
//! Lateral motion: a velocity error e gives the target tilt k·e, the tilt follows with rate a, and
//! a tilt θ accelerates by g·θ. So the closed loop is s² + a·s + a·g·k = 0. For its poles p < q the
//! step response is 1 − (q·exp(−p·t) − p·exp(−q·t)) / (q − p).

use nalgebra::{Point3, Vector3};

use super::{Command, Preset, Vehicle, VehicleSettings, VehicleState};
use crate::course::test_course;
use crate::world::World;

/// Returns the step length, s, and the state after every physics step under a constant
/// `velocity_mps`, from hover at mid-height. Walls are ignored.
fn fly(preset: Preset, velocity_mps: Vector3<f32>, secs: f32) -> (f32, Vec<VehicleState>) {
    let command = Command {
        velocity_mps,
        yaw_rate_radps: 0.0,
    };
    turn(preset, &command, secs)
}

/// As [`fly`], under a constant `command`.
fn turn(preset: Preset, command: &Command, secs: f32) -> (f32, Vec<VehicleState>) {
    let settings = VehicleSettings {
        preset,
        ..Default::default()
    };
    let (_, dt_secs) = settings.physics_steps();
    let mut vehicle = Vehicle::trimmed(&settings);
    let mut world = World::new(&test_course(), vehicle.body(), dt_secs).unwrap();
    world.reset(&Point3::new(1.5, 0.0, 3.5), 1.0, 0);
    let states = (0..(secs / dt_secs) as usize)
        .map(|_| {
            let actuation = vehicle.actuate(&world.state(), command, dt_secs);
            world.advance(&actuation, None);
            world.state()
        })
        .collect();
    (dt_secs, states)
}

/// Returns the time at which the lateral velocity first reaches 63.2 % of a step to 1 m/s, s.
fn lateral_rise_secs(preset: Preset) -> f32 {
    let (dt_secs, states) = fly(preset, Vector3::new(1.0, 1.0, 0.0), 4.0);
    let risen = states
        .iter()
        .position(|s| s.velocity_mps.y >= 0.632)
        .unwrap();
    (risen + 1) as f32 * dt_secs
}

#[test]
fn airsim_responds_sideways_in_0_92_s() {
    // k = 0.2 · π/5.5, a = 6.25: poles 1.46 and 4.79 per s, mean lag 1/(g·k) = 0.89 s, 63.2 % after
    // 0.92 s.
    let rise_secs = lateral_rise_secs(Preset::Airsim);
    assert!((rise_secs - 0.924).abs() < 0.03, "{rise_secs}");
}

#[test]
fn hummingbird_responds_sideways_in_0_42_s() {
    // k = 0.255, a = 12: poles 3.55 and 8.45 per s, mean lag 0.40 s, 63.2 % after 0.42 s.
    let rise_secs = lateral_rise_secs(Preset::Hummingbird);
    assert!((rise_secs - 0.42).abs() < 0.03, "{rise_secs}");
}

#[test]
fn point_follows_its_lag_exactly() {
    let (dt_secs, states) = fly(Preset::Point, Vector3::new(1.0, 1.0, -1.0), 2.0);
    for (step, state) in states.iter().enumerate() {
        let expected = 1.0 - (-((step + 1) as f32) * dt_secs / 0.3).exp();
        assert!(
            (state.velocity_mps.y - expected).abs() < 1e-4,
            "step {step}: {}",
            state.velocity_mps.y
        );
        assert!((state.velocity_mps.z + expected).abs() < 1e-4);
        assert_eq!(state.world_from_body, nalgebra::UnitQuaternion::identity());
    }
}

#[test]
fn commanded_velocity_is_reached_on_every_axis() {
    for preset in [Preset::Airsim, Preset::Hummingbird, Preset::Point] {
        for command in [
            Vector3::new(1.0, 1.0, 1.0),
            Vector3::new(1.0, -1.0, -1.0),
            Vector3::new(1.0, -0.3, 0.5),
        ] {
            let (_, states) = fly(preset, command, 8.0);
            let reached = states.last().unwrap().velocity_mps;
            // No horizontal loop integrates, so drag keeps the drone a little slower.
            assert!(
                (reached - command).norm() < 0.02,
                "{preset:?}: {reached} instead of {command}"
            );
        }
    }
}

#[test]
fn airsim_falls_short_of_its_forward_command_by_what_drag_takes() {
    // 0.0066 N at 1 m/s on 1 kg, against g·k = 1.12 m/s² per m/s of error.
    let (_, states) = fly(Preset::Airsim, Vector3::new(1.0, 0.0, 0.0), 20.0);
    let missing = 1.0 - states.last().unwrap().velocity_mps.x;
    assert!((missing - 0.0066 / 1.12).abs() < 5e-4, "{missing}");
}

#[test]
fn hovering_forward_holds_altitude() {
    for preset in [Preset::Airsim, Preset::Hummingbird, Preset::Point] {
        let (_, states) = fly(preset, Vector3::new(1.0, 0.0, 0.0), 50.0);
        let worst = states
            .iter()
            .map(|s| (s.position_m.z - 3.5).abs())
            .fold(0.0, f32::max);
        assert!(worst < 0.03, "{preset:?} left its altitude by {worst} m");
    }
}

#[test]
fn airsim_climb_is_limited_by_its_rotors_then_overshoots_by_its_integral() {
    // Full thrust gives 16.72 N − 9.81 N on 1 kg: 6.9 m/s². The error accumulated while rising,
    // some 0.09 m, adds 9 % of throttle. At P = 1 per m/s that is 9 % of overshoot, which decays
    // with P / I = 1 s.
    let (dt_secs, states) = fly(Preset::Airsim, Vector3::new(0.0, 0.0, 1.0), 4.0);
    let climb = |secs: f32| states[(secs / dt_secs) as usize].velocity_mps.z;
    assert!((climb(0.08) - 6.9 * 0.08).abs() < 0.06, "{}", climb(0.08));
    let peak = states.iter().map(|s| s.velocity_mps.z).fold(0.0, f32::max);
    assert!((1.04..1.12).contains(&peak), "{peak}");
    assert!((climb(3.9) - 1.0).abs() < 0.01);
}

#[test]
fn tilt_limit_is_respected_and_used() {
    // An error of 10 m/s gives a target far above the limit.
    let (_, states) = fly(Preset::Airsim, Vector3::new(10.0, 0.0, 0.0), 3.0);
    let steepest = states
        .iter()
        .map(|s| s.world_from_body.euler_angles().1.to_degrees())
        .fold(0.0, f32::max);
    assert!((32.0..33.2).contains(&steepest), "{steepest}");
}

#[test]
fn yaw_stays_near_zero_under_every_command() {
    // Rolling and pitching at once turns the nose by at most half the product of the two tilts. The
    // controller corrects it.
    for (preset, tilt_rad) in [(Preset::Airsim, 0.114_f32), (Preset::Hummingbird, 0.255)] {
        for command in [
            Vector3::new(1.0, 1.0, 1.0),
            Vector3::new(1.0, -1.0, -1.0),
            Vector3::new(1.0, 0.0, 1.0),
        ] {
            let (_, states) = fly(preset, command, 8.0);
            let yaw_rad = |state: &VehicleState| state.world_from_body.euler_angles().2.abs();
            let worst_rad = states.iter().map(yaw_rad).fold(0.0, f32::max);
            assert!(
                worst_rad <= tilt_rad * tilt_rad / 2.0,
                "{preset:?} turned {worst_rad} rad under {command}"
            );
            assert!(yaw_rad(states.last().unwrap()) < 1e-3);
        }
    }
}

#[test]
fn yaw_returns_to_zero_after_tilting_both_ways_to_the_limit() {
    let (_, states) = fly(Preset::Airsim, Vector3::new(8.0, 8.0, 1.0), 20.0);
    let yaw_deg = states
        .last()
        .unwrap()
        .world_from_body
        .euler_angles()
        .2
        .to_degrees();
    assert!(yaw_deg.abs() < 0.1, "{yaw_deg}");
}

#[test]
fn a_commanded_turn_is_flown_and_the_velocity_turns_with_the_nose() {
    for preset in [Preset::Airsim, Preset::Hummingbird, Preset::Point] {
        for rate_radps in [1.0, -1.0] {
            let command = Command {
                velocity_mps: Vector3::new(0.5, 0.0, 0.0),
                yaw_rate_radps: rate_radps,
            };
            // More than a whole turn: the heading passes ±π.
            let (dt_secs, states) = turn(preset, &command, 8.0);
            let yaw_rad = |secs: f32| {
                let state = &states[(secs / dt_secs) as usize];
                state.world_from_body.euler_angles().2
            };
            // In 6.28 s, a whole turn.
            let missing_rad = (yaw_rad(7.8) - yaw_rad(7.8 - std::f32::consts::TAU)).abs();
            assert!(missing_rad < 0.03, "{preset:?}: {missing_rad}");
            let half_turn =
                (yaw_rad(4.0) - yaw_rad(4.0 - std::f32::consts::FRAC_PI_2)) * rate_radps;
            let quarter_rad = half_turn.rem_euclid(std::f32::consts::TAU);
            assert!(
                (quarter_rad - std::f32::consts::FRAC_PI_2).abs() < 0.03,
                "{preset:?}: {quarter_rad}"
            );
            // The drone flies where it looks, but for the lag: not along the corridor.
            let state = &states[(std::f32::consts::PI / dt_secs) as usize];
            assert!(state.heading_velocity_mps().x > 0.2, "{preset:?}");
            assert!(state.velocity_mps.x < 0.0, "{preset:?}");
        }
    }
}

#[test]
fn tilting_left_moves_left() {
    let (_, states) = fly(Preset::Airsim, Vector3::new(0.0, 1.0, 0.0), 0.4);
    let state = states.last().unwrap();
    let up_in_world = state.world_from_body * Vector3::z();
    assert!(
        up_in_world.y > 0.05 && state.velocity_mps.y > 0.05 && state.velocity_mps.x.abs() < 0.01
    );
}
