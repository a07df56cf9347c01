//! The action: the numbers that a policy chooses in each step.
//!
//! [`ActionSpace`] is the setting `simulator.vehicle.action`. Simulator, records, networks and
//! recordings all follow it; none of them defines a number of its own.

use serde::{Deserialize, Serialize};

/// Most numbers of an action. Records have room for as many.
pub const MAX_ACTION: usize = 4;

/// An action: the numbers of its [`ActionSpace::axes`] in order, each in [-1, 1], then zeros.
pub type Action = [f32; MAX_ACTION];

/// Speed of flying backwards at -1, m/s.
pub const REVERSE_MPS: f32 = 1.0;

/// The numbers of an action.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub enum ActionSpace {
    /// Left and up. The drone flies forward at a constant speed, as in the paper.
    #[default]
    #[serde(rename = "lateral")]
    Lateral,
    /// Forward, left and up. The drone may slow down, hover and fly backwards.
    #[serde(rename = "velocity")]
    Velocity,
    /// Forward, left, up and yaw rate. The drone may also turn.
    #[serde(rename = "velocity+yaw")]
    VelocityYaw,
}

/// One number of an action. Velocities are in the heading frame: x where the nose points, y to its
/// left, z up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Axis {
    /// Velocity forward: 0 hovers, 1 is `vehicle.max_speed_mps`, -1 is [`REVERSE_MPS`] backwards.
    Forward,
    /// Velocity to the left, m/s.
    Left,
    /// Velocity upwards, m/s.
    Up,
    /// Turning rate of the nose, to the left, rad/s.
    YawRate,
}

impl ActionSpace {
    /// All spaces.
    pub const ALL: [Self; 3] = [Self::Lateral, Self::Velocity, Self::VelocityYaw];

    /// Returns the numbers, in order.
    #[must_use]
    pub fn axes(self) -> &'static [Axis] {
        match self {
            Self::Lateral => &[Axis::Left, Axis::Up],
            Self::Velocity => &[Axis::Forward, Axis::Left, Axis::Up],
            Self::VelocityYaw => &[Axis::Forward, Axis::Left, Axis::Up, Axis::YawRate],
        }
    }

    /// Returns the number of numbers.
    #[must_use]
    pub fn numbers(self) -> usize {
        self.axes().len()
    }

    /// Returns the name in the configuration.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Lateral => "lateral",
            Self::Velocity => "velocity",
            Self::VelocityYaw => "velocity+yaw",
        }
    }

    /// Returns the names of the numbers, joined by commas.
    #[must_use]
    pub fn axis_names(self) -> String {
        let names: Vec<_> = self.axes().iter().map(|axis| axis.name()).collect();
        names.join(", ")
    }

    /// Returns `true` if the policy chooses the speed forward.
    #[must_use]
    pub fn has_speed(self) -> bool {
        self.axes().contains(&Axis::Forward)
    }

    /// Returns the action as a mirror shows it: left and right change places.
    #[must_use]
    pub fn mirrored(self, action: &Action) -> Action {
        let mut mirrored = *action;
        for (number, axis) in mirrored.iter_mut().zip(self.axes()) {
            if axis.is_mirrored() {
                *number = -*number;
            }
        }
        mirrored
    }
}

impl Axis {
    /// Returns the name, in lower case.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Forward => "forward",
            Self::Left => "left",
            Self::Up => "up",
            Self::YawRate => "yaw_rate",
        }
    }

    /// Returns the unit of [`Axis::command`].
    #[must_use]
    pub fn unit(self) -> &'static str {
        match self {
            Self::Forward | Self::Left | Self::Up => "m/s",
            Self::YawRate => "rad/s",
        }
    }

    /// Returns what -1 and 1 command, in the axis' unit. `max_speed_mps`: largest speed forward.
    #[must_use]
    pub fn limits(self, max_speed_mps: f32) -> [f32; 2] {
        match self {
            Self::Forward => [-REVERSE_MPS, max_speed_mps],
            Self::Left | Self::Up | Self::YawRate => [-1.0, 1.0],
        }
    }

    /// Returns what `number`, in [-1, 1], commands, in the axis' unit. 0 always commands 0.
    #[must_use]
    pub fn command(self, number: f32, max_speed_mps: f32) -> f32 {
        let [least, most] = self.limits(max_speed_mps);
        if number < 0.0 {
            -number * least
        } else {
            number * most
        }
    }

    /// Returns the number in [-1, 1] that commands `command`, or the limit that is nearest to it.
    #[must_use]
    pub fn number(self, command: f32, max_speed_mps: f32) -> f32 {
        let [least, most] = self.limits(max_speed_mps);
        let number = if command < 0.0 {
            -command / least
        } else {
            command / most
        };
        number.clamp(-1.0, 1.0)
    }

    /// Returns `true` if a mirror changes the number's sign.
    #[must_use]
    pub fn is_mirrored(self) -> bool {
        match self {
            Self::Left | Self::YawRate => true,
            Self::Forward | Self::Up => false,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_and_its_command_are_inverse_up_to_the_limits() {
        for axis in [Axis::Forward, Axis::Left, Axis::Up, Axis::YawRate] {
            let [least, most] = axis.limits(3.0);
            assert_eq!(
                [-1.0, 0.0, 1.0].map(|number| axis.command(number, 3.0)),
                [least, 0.0, most]
            );
            for number in [-1.0, -0.25, 0.0, 0.5, 1.0] {
                assert_eq!(axis.number(axis.command(number, 3.0), 3.0), number);
            }
            assert_eq!(axis.number(2.0 * most, 3.0), 1.0);
            assert_eq!(axis.number(2.0 * least, 3.0), -1.0);
        }
    }

    #[test]
    fn a_mirror_turns_left_and_yaw_round_and_nothing_else() {
        let action = [0.1, 0.2, 0.3, 0.4];
        let mirrored = ActionSpace::ALL.map(|space| space.mirrored(&action));
        assert_eq!(
            mirrored,
            [
                [-0.1, 0.2, 0.3, 0.4],
                [0.1, -0.2, 0.3, 0.4],
                [0.1, -0.2, 0.3, -0.4],
            ]
        );
    }

    #[test]
    fn every_space_has_room_in_a_record() {
        for space in ActionSpace::ALL {
            assert!((1..=MAX_ACTION).contains(&space.numbers()), "{space:?}");
        }
    }
}
