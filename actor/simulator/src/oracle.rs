//! A scripted expert that knows the course and never looks at the depth image. It proves that a
//! given drone can fly a course, and it can teach a policy.
//!
//! It uses nothing that a policy with a memory could not know: where the next opening is, and how
//! the drone moves. It keeps to an opening until the tail has left it, which a policy learns from
//! the images of the seconds before. Gusts, mass and latency are unknown to it.

use nalgebra::Vector3;
use skein_action::{ActionSpace, Axis};

use crate::course::{Course, DRONE_WIDTH_M, Wall};
use crate::vehicle::{Command, VehicleSettings, VehicleState};

/// How one axis is steered.
struct Steering {
    /// Commanded velocity per metre of distance to the target, 1/s.
    approach_per_sec: f32,
    /// Share of the current velocity subtracted from the command, so that a sluggish drone does not
    /// overshoot.
    damping: f32,
}

/// To the side and forward the drone lags 0.9 s. Damping brakes it early, so that it may approach
/// quickly. Of 500 episodes with all disturbances of `configs/evaluations/generalist.toml`, gains
/// of 0.8 and 0.5 on both axes lost two. These lost none of 1000.
const LEVEL: Steering = Steering {
    approach_per_sec: 1.0,
    damping: 1.0,
};

/// Upwards the drone hardly lags. Much damping of a late command would make it swing.
const UPWARDS: Steering = Steering {
    approach_per_sec: 0.6,
    damping: 0.4,
};

/// Turning rate commanded per radian of heading, 1/s: the oracle looks along the corridor.
const STRAIGHTEN_PER_SEC: f32 = 2.0;

impl Steering {
    /// Returns the velocity to command, m/s.
    fn velocity(&self, distance_m: f32, velocity_mps: f32) -> f32 {
        self.approach_per_sec * distance_m - self.damping * velocity_mps
    }

    /// Returns the velocity to command so that the drone soon has the velocity `wanted_mps`, m/s in
    /// [-1, 1].
    fn pursue(&self, wanted_mps: f32, velocity_mps: f32) -> f32 {
        (wanted_mps + self.damping * (wanted_mps - velocity_mps)).clamp(-1.0, 1.0)
    }
}

/// Distance that the tail has flown behind a wall before the oracle leaves its opening, m. A policy
/// that imitates the oracle knows only roughly where its tail is: too early is a crash, too late
/// costs a third of a second.
const HOLD_M: f32 = 0.3;

/// Distance of the nose from a wall where the oracle waits until it is in line with the opening, m.
/// From there the camera sees 1.3 m to either side.
const WAIT_M: f32 = 1.0;

/// Distance by which the oracle waits farther from the wall behind than [`HOLD_M`], m. It passes
/// that distance at some speed: a policy that imitates it then knows that it has. With 0.15 m,
/// policies turned aside too early and hit the wall behind with their tail.
const WAIT_MARGIN_M: f32 = 0.45;

/// Half the diagonal of the drone's cross-section, 0.98 x 0.29 m: what an opening must have room
/// for at any roll, m.
const BODY_RADIUS_M: f32 = 0.511;

/// Least distance of the nose from a wall where the oracle waits, m.
const LEAST_WAIT_M: f32 = 0.25;

/// Time over which the drone's drift is foreseen when its offset from an opening is judged, s.
const FORESIGHT_SECS: f32 = 0.5;

/// Least distance from the start to a wall for a drone that waits there, m.
pub(crate) const HOVER_BEHIND_START_M: f32 = DRONE_WIDTH_M / 2.0 + LEAST_WAIT_M;

/// Least distance between the back of a wall and the next one's front for a drone that waits
/// between them, m.
pub(crate) const HOVER_BEHIND_WALL_M: f32 = DRONE_WIDTH_M + HOLD_M + WAIT_MARGIN_M + LEAST_WAIT_M;

/// Distance that the oracle looks ahead along the way through a world, m.
const AHEAD_M: f32 = 2.0;

/// Least distance and speed with which it reckons when it will be there, m and m/s.
const NEAR_M: f32 = 0.5;
const SLOW_MPS: f32 = 0.5;

/// The expert on one course.
pub(crate) struct Oracle<'a> {
    pub(crate) course: &'a Course,
    pub(crate) vehicle: &'a VehicleSettings,
    /// Half the length of the drone's body, m.
    pub(crate) half_length_m: f32,
}

impl Oracle<'_> {
    /// Returns the motion to command in `state`, with the tail at `tail_x_m` along the corridor.
    ///
    /// It flies to the next opening's safe point, then, behind the last wall, to the middle of the
    /// corridor, where a gust has the longest way to blow it into anything. In a world, it flies
    /// along the way to the goal, as far ahead as nothing stands between. It takes no notice of
    /// what moves.
    pub(crate) fn command(&self, tail_x_m: f32, state: &VehicleState) -> Command {
        let turns = self.vehicle.action.axes().contains(&Axis::YawRate);
        let velocity = match turns {
            true => state.velocity_mps,
            false => state.heading_velocity_mps(),
        };
        let wanted = match self.course.aim_m(&state.position_m, AHEAD_M) {
            Some(aim_m) => self.along_way(&(aim_m - state.position_m), &velocity),
            None => self.through_openings(tail_x_m, state, &velocity),
        };
        if !turns {
            return Command {
                velocity_mps: wanted,
                yaw_rate_radps: 0.0,
            };
        }
        let (.., yaw_rad) = state.world_from_body.euler_angles();
        Command {
            velocity_mps: state.in_heading_frame(&wanted.map(|axis| axis.clamp(-1.0, 1.0))),
            yaw_rate_radps: -STRAIGHTEN_PER_SEC * yaw_rad,
        }
    }

    /// Returns the velocity towards a point of the way that lies `to_aim_m` away.
    fn along_way(&self, to_aim_m: &Vector3<f32>, velocity: &Vector3<f32>) -> Vector3<f32> {
        let secs = to_aim_m.x.max(NEAR_M) / velocity.x.max(SLOW_MPS);
        Vector3::new(
            self.forward(to_aim_m.x, velocity.x),
            LEVEL.pursue(to_aim_m.y / secs, velocity.y),
            UPWARDS.pursue(to_aim_m.z / secs, velocity.z),
        )
    }

    /// Returns the velocity through the next opening of a corridor.
    fn through_openings(
        &self,
        tail_x_m: f32,
        state: &VehicleState,
        velocity: &Vector3<f32>,
    ) -> Vector3<f32> {
        let at_m = &state.position_m;
        let walls_behind = self.course.walls_behind(at_m, tail_x_m - HOLD_M);
        let middle = [0.0, self.course.corridor().height_m / 2.0];
        let next = self.course.walls().get(walls_behind);
        let [y_m, z_m] = next.map_or(middle, Wall::safe_point);
        let ahead_m = self.stop_x_m(walls_behind, state) - at_m.x;
        Vector3::new(
            self.forward(ahead_m, velocity.x),
            LEVEL.velocity(y_m - at_m.y, velocity.y),
            UPWARDS.velocity(z_m - at_m.z, velocity.z),
        )
    }

    /// Returns the velocity forward for a drone that is to stop in `ahead_m`, if it can.
    fn forward(&self, ahead_m: f32, velocity_mps: f32) -> f32 {
        match self.vehicle.action {
            ActionSpace::Lateral => self.vehicle.forward_speed_mps,
            ActionSpace::Velocity | ActionSpace::VelocityYaw => {
                let most = self.vehicle.max_speed_mps;
                LEVEL.velocity(ahead_m, velocity_mps).min(most)
            }
        }
    }

    /// Returns where along the corridor the drone is to stop: before the first wall whose opening
    /// it is not in line with, else far behind the end. The more it is in line, the farther.
    fn stop_x_m(&self, walls_behind: usize, state: &VehicleState) -> f32 {
        let walls = self.course.walls();
        let beyond_m = 3.0 * self.vehicle.max_speed_mps;
        let end_m = self.course.corridor().length_m + beyond_m;
        walls[walls_behind..]
            .iter()
            .enumerate()
            .rev()
            .fold(end_m, |behind_m, (place, wall)| {
                let previous = (walls_behind + place).checked_sub(1);
                let wait_m = self.wait_x_m(previous.map(|place| &walls[place]), wall);
                wait_m + in_line(wall, state) * (behind_m - wait_m)
            })
    }

    /// Returns where the drone waits before `wall`: clear of the `previous` one.
    fn wait_x_m(&self, previous: Option<&Wall>, wall: &Wall) -> f32 {
        let nose_at = |distance_m: f32| wall.x_m() - distance_m - self.half_length_m;
        let clear_m = previous.map_or(f32::NEG_INFINITY, |previous| {
            let back_m = previous.x_m() + self.course.wall_thickness_m();
            back_m + self.half_length_m + HOLD_M + WAIT_MARGIN_M
        });
        nose_at(WAIT_M).max(clear_m.min(nose_at(LEAST_WAIT_M)))
    }
}

/// Returns how well a drone in `state` is in line with the opening of `wall`: 1 if it has half of
/// the room to spare, 0 if it has none.
fn in_line(wall: &Wall, state: &VehicleState) -> f32 {
    let at = state.position_m + state.velocity_mps * FORESIGHT_SECS;
    let [y_m, z_m] = wall.safe_point();
    let room_m = wall.clearance_m() - BODY_RADIUS_M;
    let offset_m = (y_m - at.y).hypot(z_m - at.z);
    (2.0 - 2.0 * offset_m / room_m).clamp(0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use std::f32::consts::FRAC_PI_2;
    use std::path::Path;
    use std::sync::Arc;

    use nalgebra::{Point3, UnitQuaternion};
    use rand::SeedableRng;
    use rand_pcg::Pcg64Mcg;
    use skein_action::Action;

    use super::*;
    use crate::course::test_course;
    use crate::simulator::{EpisodeOutcome, Simulator, SimulatorSettings};
    use crate::vehicle::Preset;

    /// Episodes per course and drone, spread over the levels; `examples/oracle_episode.rs` flies a
    /// hundred from each level.
    const EPISODES: u64 = 10;

    #[test]
    fn every_shipped_course_can_be_flown_from_every_level_with_every_drone() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/courses");
        let entries = |folder: &Path| {
            folder
                .read_dir()
                .unwrap()
                .map(|entry| entry.unwrap().path())
        };
        let (folders, mut files): (Vec<_>, Vec<_>) =
            entries(&folder).partition(|path| path.is_dir());
        files.extend(folders.iter().flat_map(|folder| entries(folder)));
        assert!(
            files.len() >= 12,
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

    fn action(course: &Course, vehicle: &VehicleSettings, state: &VehicleState) -> Action {
        let oracle = Oracle {
            course,
            vehicle,
            half_length_m: 0.49,
        };
        vehicle.action_for(&oracle.command(state.position_m.x - 0.49, state))
    }

    #[test]
    fn with_a_speed_of_its_own_it_stops_before_a_wall_and_backs_off_if_it_is_too_near() {
        let course = test_course();
        let vehicle = VehicleSettings {
            action: ActionSpace::Velocity,
            max_speed_mps: 2.0,
            ..Default::default()
        };
        let wall = &course.walls()[0];
        let [y_m, z_m] = wall.safe_point();
        let forward = |to_nose_m: f32, beside_m: f32| {
            let x_m = wall.x_m() - 0.49 - to_nose_m;
            let state = VehicleState::at_rest(Point3::new(x_m, y_m + beside_m, z_m));
            action(&course, &vehicle, &state)[0]
        };
        assert!(forward(WAIT_M, 2.0).abs() < 1e-5, "it waits");
        assert!(forward(WAIT_M - 0.5, 2.0) < -0.4, "it flies back");
        assert_eq!(forward(5.0, 2.0), 1.0, "it approaches");
        assert_eq!(forward(WAIT_M, 0.0), 1.0, "it flies through");
        let room_m = wall.clearance_m() - BODY_RADIUS_M;
        let nearly = forward(WAIT_M, 0.9 * room_m);
        assert!(nearly > 0.0 && nearly < 1.0, "it begins to: {nearly}");
    }

    #[test]
    fn a_drone_that_turned_is_turned_back_and_steered_in_its_own_frame() {
        let course = test_course();
        let vehicle = VehicleSettings {
            action: ActionSpace::VelocityYaw,
            ..Default::default()
        };
        let [y_m, z_m] = course.walls()[0].safe_point();
        let ahead = VehicleState {
            // The nose points to the left.
            world_from_body: UnitQuaternion::from_euler_angles(0.0, 0.0, FRAC_PI_2),
            ..VehicleState::at_rest(Point3::new(5.0, y_m, z_m))
        };
        let [forward, left, up, yaw_rate] = action(&course, &vehicle, &ahead);
        assert!(forward.abs() < 1e-5 && up.abs() < 1e-5);
        assert_eq!((left, yaw_rate), (-1.0, -1.0));
    }

    #[test]
    fn oracle_steers_towards_the_opening_and_brakes_before_it() {
        let course = test_course();
        let vehicle = VehicleSettings::default();
        let [y_m, z_m] = course.walls()[0].safe_point();
        let below_right = VehicleState::at_rest(Point3::new(5.0, y_m - 2.0, z_m - 2.0));
        assert_eq!(
            action(&course, &vehicle, &below_right),
            [1.0, 1.0, 0.0, 0.0]
        );
        let arriving = VehicleState {
            velocity_mps: Vector3::new(1.0, 1.0, 0.0),
            ..VehicleState::at_rest(Point3::new(5.0, y_m - 0.1, z_m))
        };
        assert!(action(&course, &vehicle, &arriving)[0] < 0.0);
    }
}
