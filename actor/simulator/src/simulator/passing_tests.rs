//! A wall is passed once the whole body is clear of it: no step passes a wall and hits it.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use skein_action::ActionSpace;

use super::*;
use crate::course::{GeneratorRanges, test_course};
use crate::disturbances::GustSettings;
use crate::vehicle::{Preset, VehicleSettings};

/// Episodes per course, drone and air.
const EPISODES: u64 = 40;

/// How the episodes of one test ended.
#[derive(Debug, Default)]
struct Tally {
    hit_walls: u32,
    /// Hits with the centre already behind the wall: its tail met the opening's edge.
    hit_by_tail: u32,
    /// Hits of a wall that the drone had passed, or behind which it started.
    hit_behind: u32,
    reached_end: u32,
}

/// Returns two courses with wide openings and two with narrow ones.
fn courses() -> Vec<Arc<Course>> {
    let narrow = GeneratorRanges {
        clearance_m: [0.66, 0.75],
        ..Default::default()
    };
    let wide = GeneratorRanges::default();
    let mut courses = vec![test_course(), Course::generate(5, &wide).unwrap()];
    courses.extend([6, 7].map(|seed| Course::generate(seed, &narrow).unwrap()));
    courses.into_iter().map(Arc::new).collect()
}

/// Flies each kind of episode: at random, or with the oracle's actions and errors up to 1 m/s.
fn fly_all(tally: &mut Tally, preset: Preset, action: ActionSpace, gust_n: f32) {
    let mut settings = SimulatorSettings {
        vehicle: VehicleSettings {
            preset,
            action,
            ..Default::default()
        },
        ..Default::default()
    };
    settings.disturbances.gust = GustSettings {
        force_rms_n: gust_n,
        correlation_secs: 0.5,
    };
    for course in courses() {
        let mut simulator = Simulator::new(course, &settings).unwrap();
        for episode in 0..EPISODES {
            fly(&mut simulator, episode, tally);
        }
    }
}

fn fly(simulator: &mut Simulator, episode: u64, tally: &mut Tally) {
    let [mut start, mut air, mut rng] =
        [episode, !episode, episode + 1000].map(Pcg64Mcg::seed_from_u64);
    let level = rng.random_range(1..=simulator.course().levels());
    simulator.reset(level, &mut start, &mut air).unwrap();
    // Every fifth episode flies at random; the others err by up to 1 m/s.
    let skill = if episode.is_multiple_of(5) { 0.0 } else { 1.0 };
    let error_mps = rng.random_range(0.0..=1.0_f32).max(1.0 - skill);
    let numbers = simulator.vehicle_settings.action.numbers();
    let mut passed_before = 0;
    let report = loop {
        let mut action = simulator.oracle_action();
        for number in &mut action[..numbers] {
            *number = skill * *number + rng.random_range(-error_mps..=error_mps);
        }
        let report = simulator.step(action).unwrap();
        assert!(report.walls_passed >= passed_before, "a passed wall counts");
        if report.outcome.is_some() {
            break report;
        }
        passed_before = report.walls_passed;
    };
    match (report.outcome, report.hit) {
        (Some(EpisodeOutcome::Collided), Some(Obstacle::Wall(hit))) => {
            let next = level + report.walls_passed;
            assert!(hit <= next, "hit wall {hit} before wall {next}");
            // It may come back into a wall behind its start, or passed in an earlier step.
            let is_behind = hit < level + passed_before;
            assert!(hit == next || is_behind, "passed wall {hit} and hit it");
            tally.hit_behind += u32::from(is_behind);
            let wall = &simulator.course().walls()[usize::from(hit) - 1];
            let back_m = wall.x_m() + simulator.course().wall_thickness_m();
            tally.hit_walls += 1;
            tally.hit_by_tail += u32::from(simulator.state().position_m.x > back_m);
        }
        (Some(EpisodeOutcome::ReachedEnd), _) => {
            assert_eq!(level + report.walls_passed, simulator.course().levels() + 1);
            tally.reached_end += 1;
        }
        _ => {}
    }
}

#[test]
fn no_step_passes_a_wall_and_hits_it() {
    let mut tally = Tally::default();
    for preset in [Preset::Airsim, Preset::Hummingbird, Preset::Point] {
        fly_all(&mut tally, preset, ActionSpace::Lateral, 0.0);
    }
    // The episodes must be able to refute the claim.
    assert!(
        tally.hit_by_tail >= 5 && tally.reached_end >= 20,
        "{tally:?}"
    );
    assert_eq!(tally.hit_behind, 0, "it flies forward");
}

#[test]
fn nor_does_one_that_flies_back() {
    let mut tally = Tally::default();
    for preset in [Preset::Airsim, Preset::Hummingbird, Preset::Point] {
        fly_all(&mut tally, preset, ActionSpace::Velocity, 0.0);
    }
    assert!(tally.hit_walls >= 20 && tally.hit_behind >= 1, "{tally:?}");
}

#[test]
fn nor_does_one_that_a_storm_blows_back() {
    let mut tally = Tally::default();
    fly_all(&mut tally, Preset::Airsim, ActionSpace::Lateral, 6.0);
    assert!(tally.hit_by_tail >= 1 && tally.hit_walls >= 20, "{tally:?}");
}
