//! A scripted expert that knows the course and never looks at the depth image. It proves that a
//! given drone can fly a course, and it can teach a policy.
//!
//! It uses nothing that a policy with a memory could not know: where the next opening is, and how
//! the drone moves. It keeps to an opening until the tail has left it, which a policy learns from
//! the images of the seconds before. Gusts, mass and latency are unknown to it.

use crate::course::{Course, Wall};
use crate::vehicle::VehicleState;

/// How one axis is steered.
struct Steering {
    /// Commanded velocity per metre of distance to the safe point, 1/s.
    approach_per_sec: f32,
    /// Share of the current velocity subtracted from the command, so that a sluggish drone does not
    /// overshoot.
    damping: f32,
}

/// To the side the drone lags 0.9 s. Damping brakes it early, so that it may approach quickly.
/// Of 500 episodes with all disturbances of `configs/evaluations/generalist.toml`, gains of 0.8 and
/// 0.5 on both axes lost two. These lost none of 1000.
const SIDEWAYS: Steering = Steering {
    approach_per_sec: 1.0,
    damping: 1.0,
};

/// Upwards the drone hardly lags. Much damping of a late command would make it swing.
const UPWARDS: Steering = Steering {
    approach_per_sec: 0.6,
    damping: 0.4,
};

impl Steering {
    /// Returns the velocity to command, m/s in [-1, 1].
    fn command(&self, distance_m: f32, velocity_mps: f32) -> f32 {
        (self.approach_per_sec * distance_m - self.damping * velocity_mps).clamp(-1.0, 1.0)
    }
}

/// Distance that the tail has flown behind a wall before the oracle leaves its opening, m. A policy
/// that imitates the oracle knows only roughly where its tail is: too early is a crash, too late
/// costs a third of a second.
pub(crate) const HOLD_M: f32 = 0.3;

/// Returns the action `[v_y, v_z]` for a drone that has left `walls_behind` walls, m/s in the
/// heading frame, each in [-1, 1].
///
/// It flies to the next opening's safe point, then, behind the last wall, to the middle of the
/// corridor, where a gust has the longest way to blow it into anything.
pub(crate) fn action(course: &Course, walls_behind: usize, state: &VehicleState) -> [f32; 2] {
    let middle = [0.0, course.corridor().height_m / 2.0];
    let next = course.walls().get(walls_behind);
    let [y_m, z_m] = next.map_or(middle, Wall::safe_point);
    let velocity = state.heading_velocity_mps();
    [
        SIDEWAYS.command(y_m - state.position_m.y, velocity.y),
        UPWARDS.command(z_m - state.position_m.z, velocity.z),
    ]
}

#[cfg(test)]
mod tests {
    use std::path::Path;
    use std::sync::Arc;

    use nalgebra::{Point3, Vector3};
    use rand::SeedableRng;
    use rand_pcg::Pcg64Mcg;

    use super::*;
    use crate::course::test_course;
    use crate::simulator::{EpisodeOutcome, Simulator, SimulatorSettings};
    use crate::vehicle::{Preset, VehicleSettings};

    /// Episodes per course and drone, spread over the levels; `examples/oracle_episode.rs` flies a
    /// hundred from each level.
    const EPISODES: u64 = 10;

    #[test]
    fn every_shipped_course_can_be_flown_from_every_level_with_every_drone() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/courses");
        let files: Vec<_> = folder
            .read_dir()
            .unwrap()
            .map(|entry| entry.unwrap().path())
            .collect();
        assert!(
            files.len() >= 4,
            "the shipped courses are missing: {files:?}"
        );
        for file in files {
            let course = Arc::new(Course::load(&file).unwrap());
            for preset in [Preset::Airsim, Preset::Hummingbird, Preset::Point] {
                let vehicle = VehicleSettings {
                    preset,
                    ..Default::default()
                };
                let settings = SimulatorSettings {
                    vehicle,
                    ..Default::default()
                };
                let mut simulator = Simulator::new(course.clone(), &settings).unwrap();
                for episode in 0..EPISODES {
                    let level = 1 + (episode % u64::from(course.levels())) as u8;
                    let [mut start, mut calm] = [episode, 0].map(Pcg64Mcg::seed_from_u64);
                    simulator.reset(level, &mut start, &mut calm).unwrap();
                    let outcome = fly(&mut simulator);
                    let at = simulator.state().position_m;
                    assert_eq!(
                        outcome,
                        EpisodeOutcome::ReachedEnd,
                        "{}, {preset:?}, level {level}: at {at}",
                        course.name()
                    );
                }
            }
        }
    }

    fn fly(simulator: &mut Simulator) -> EpisodeOutcome {
        loop {
            let action = simulator.oracle_action();
            if let Some(outcome) = simulator.step(action).unwrap().outcome {
                return outcome;
            }
        }
    }

    #[test]
    fn oracle_steers_towards_the_opening_and_brakes_before_it() {
        let course = test_course();
        let [y_m, z_m] = course.walls()[0].safe_point();
        let below_right = VehicleState::at_rest(Point3::new(5.0, y_m - 2.0, z_m - 2.0));
        assert_eq!(action(&course, 0, &below_right), [1.0, 1.0]);
        let arriving = VehicleState {
            velocity_mps: Vector3::new(1.0, 1.0, 0.0),
            ..VehicleState::at_rest(Point3::new(5.0, y_m - 0.1, z_m))
        };
        assert!(action(&course, 0, &arriving)[0] < 0.0);
    }
}
