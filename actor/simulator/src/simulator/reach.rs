//! Distance that an episode can fly, against the length of the course.

use super::SimulatorSettings;
use crate::course::{Corridor, DRONE_WIDTH_M, StartArea};

/// The end of a course lies farther than an episode can fly.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error(
    "corridor.length_m = {length_m}: the end lies {needed_m:.1} m from the start, but an episode \
     flies at most {reach_m:.1} m ([simulator] vehicle.{speed_key} = {speed_mps} · \
     vehicle.control_period_secs = {period_secs} · max_steps = {max_steps}): set \
     simulator.max_steps to {enough_steps} or more, fly faster, or shorten the course"
)]
pub struct OutOfReach {
    length_m: f32,
    needed_m: f64,
    reach_m: f64,
    speed_key: &'static str,
    speed_mps: f32,
    period_secs: f32,
    max_steps: u32,
    enough_steps: f64,
}

impl SimulatorSettings {
    /// Checks that an episode from `start` can reach the end of `corridor` within `max_steps`. A
    /// drone that reaches its commanded velocity only after a while needs more than this.
    ///
    /// # Errors
    /// [`OutOfReach`] has the distances, their keys and the remedy.
    pub fn check_reach(&self, corridor: Corridor, start: StartArea) -> Result<(), OutOfReach> {
        let (speed_mps, period_secs) = (
            self.vehicle.top_speed_mps(),
            self.vehicle.control_period_secs,
        );
        let step_m = f64::from(speed_mps) * f64::from(period_secs);
        // The front of the body touches the end, not its centre.
        let needed_m = f64::from(corridor.length_m - start.offset_m - DRONE_WIDTH_M / 2.0);
        let reach_m = step_m * f64::from(self.max_steps);
        if reach_m >= needed_m {
            return Ok(());
        }
        Err(OutOfReach {
            length_m: corridor.length_m,
            needed_m,
            reach_m,
            speed_key: match self.vehicle.action.has_speed() {
                true => "max_speed_mps",
                false => "forward_speed_mps",
            },
            speed_mps,
            period_secs,
            max_steps: self.max_steps,
            enough_steps: (needed_m / step_m).ceil(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_course_that_no_episode_can_finish_is_refused_with_the_distances_and_keys() {
        let check = |set: fn(&mut SimulatorSettings)| {
            let mut settings = SimulatorSettings::default();
            set(&mut settings);
            settings
                .check_reach(Corridor::default(), StartArea::default())
                .map_err(|error| error.to_string())
        };
        assert_eq!(check(|_| ()), Ok(()));
        let slow = check(|settings| settings.vehicle.forward_speed_mps = 0.3).unwrap_err();
        for part in [
            "corridor.length_m = 60",
            "58.0 m from the start",
            "at most 24.0 m",
            "vehicle.forward_speed_mps = 0.3",
            "control_period_secs = 0.5",
            "max_steps = 160",
            "max_steps to 387 or more",
        ] {
            assert!(slow.contains(part), "`{part}` is missing in {slow}");
        }
        let short = check(|settings| settings.vehicle.control_period_secs = 0.1).unwrap_err();
        assert!(short.contains("at most 16.0 m"), "{short}");
        check(|settings| settings.max_steps = 116).unwrap_err();
        assert_eq!(check(|settings| settings.max_steps = 117), Ok(()));
    }
}
