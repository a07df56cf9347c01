//! Four rotors in X layout: mixing with saturation, first-order lag, thrust and reaction torque.
//!
//! The lag acts on thrust, as in AirSim. At 5 ms, a lag on rotor speed would make no visible
//! difference.

use nalgebra::Vector3;

use super::airframe::Airframe;

/// Position of a rotor (signs of x and y), and sign of its reaction torque on the body about z.
struct RotorMount {
    x: f32,
    y: f32,
    reaction: f32,
}

/// The four rotors. Front right and rear left spin counter-clockwise seen from above, so their
/// reaction on the body is clockwise (−z); the other two spin clockwise.
const MOUNTS: [RotorMount; 4] = [
    RotorMount {
        x: 1.0,
        y: -1.0,
        reaction: -1.0,
    },
    RotorMount {
        x: -1.0,
        y: 1.0,
        reaction: -1.0,
    },
    RotorMount {
        x: 1.0,
        y: 1.0,
        reaction: 1.0,
    },
    RotorMount {
        x: -1.0,
        y: -1.0,
        reaction: 1.0,
    },
];

/// Command of the controller to the four rotors together.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct RotorCommand {
    /// Collective, [0, 1].
    pub(crate) throttle: f32,
    /// Differential about body x, y, z, each in [-1, 1].
    pub(crate) turn: Vector3<f32>,
}

/// Force and torque of all rotors, in the body frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct RotorWrench {
    /// Along body z, N.
    pub(crate) thrust_n: f32,
    /// About body x, y, z, N·m.
    pub(crate) torque_nm: Vector3<f32>,
}

/// State of the rotors: the share of full thrust that each gives.
#[derive(Debug, Clone)]
pub(crate) struct Rotors {
    thrusts: [f32; 4],
}

impl Rotors {
    /// Returns rotors that have settled at `command`, as in steady hover.
    pub(crate) fn at(command: f32) -> Self {
        Self {
            thrusts: [command; 4],
        }
    }

    /// Advances the rotors by `dt_secs` under `command` and returns their wrench at the end.
    pub(crate) fn advance(
        &mut self,
        airframe: &Airframe,
        command: &RotorCommand,
        dt_secs: f32,
    ) -> RotorWrench {
        let reached = 1.0 - (-dt_secs / airframe.rotor_lag_secs).exp();
        for (thrust, target) in self.thrusts.iter_mut().zip(mix(command)) {
            *thrust += reached * (target - *thrust);
        }
        self.wrench(airframe)
    }

    fn wrench(&self, airframe: &Airframe) -> RotorWrench {
        let lever_m = airframe.arm_m * std::f32::consts::FRAC_1_SQRT_2;
        let mut wrench = RotorWrench {
            thrust_n: 0.0,
            torque_nm: Vector3::zeros(),
        };
        for (share, mount) in self.thrusts.iter().zip(&MOUNTS) {
            let thrust_n = share * airframe.rotor_thrust_n;
            wrench.thrust_n += thrust_n;
            // r × F for a force along z at (x, y), plus the reaction to the spin.
            wrench.torque_nm += Vector3::new(
                mount.y * lever_m * thrust_n,
                -mount.x * lever_m * thrust_n,
                mount.reaction * share * airframe.rotor_torque_nm,
            );
        }
        wrench
    }
}

/// Returns the commands of the four rotors, each in [0, 1].
///
/// In saturation, turning has priority over climbing, as in SimpleFlight: a rotor below 0 raises
/// all four, a rotor above 1 scales all four down.
fn mix(command: &RotorCommand) -> [f32; 4] {
    let mut outputs = MOUNTS.each_ref().map(|mount| {
        command.throttle + mount.y * command.turn.x - mount.x * command.turn.y
            + mount.reaction * command.turn.z
    });
    let least = outputs.iter().copied().fold(0.0, f32::min);
    let most = outputs.iter().copied().fold(f32::NEG_INFINITY, f32::max) - least;
    let scale = most.max(1.0);
    for output in &mut outputs {
        *output = ((*output - least) / scale).clamp(0.0, 1.0);
    }
    outputs
}

#[cfg(test)]
mod tests {
    use super::*;

    fn settled(turn: Vector3<f32>) -> RotorWrench {
        let mut rotors = Rotors::at(0.5);
        rotors.advance(
            &Airframe::AIRSIM,
            &RotorCommand {
                throttle: 0.5,
                turn,
            },
            1.0,
        )
    }

    #[test]
    fn thrust_and_torques_equal_values_derived_by_hand() {
        let airframe = &Airframe::AIRSIM;
        // Half throttle: 2 · 4.179 N. Command 0.1 about x: 4 rotors · 0.1 · 4.179 N · 0.2275/√2 m =
        // 0.2689 N·m.
        let roll = settled(Vector3::new(0.1, 0.0, 0.0));
        assert!((roll.thrust_n - 8.358).abs() < 1e-4);
        assert!((roll.torque_nm - Vector3::new(0.2689, 0.0, 0.0)).norm() < 1e-4);
        let pitch = settled(Vector3::new(0.0, 0.1, 0.0));
        assert!((pitch.torque_nm - Vector3::new(0.0, 0.2689, 0.0)).norm() < 1e-4);
        let yaw = settled(Vector3::new(0.0, 0.0, 0.1));
        assert!(
            (yaw.torque_nm - Vector3::new(0.0, 0.0, 0.4 * airframe.rotor_torque_nm)).norm() < 1e-6
        );
    }

    #[test]
    fn rotor_reaches_63_percent_after_one_lag() {
        let airframe = &Airframe::AIRSIM;
        let mut rotors = Rotors::at(0.0);
        let command = RotorCommand {
            throttle: 1.0,
            turn: Vector3::zeros(),
        };
        let wrench = rotors.advance(airframe, &command, airframe.rotor_lag_secs);
        assert!((wrench.thrust_n / (4.0 * airframe.rotor_thrust_n) - 0.632).abs() < 1e-3);
    }

    #[test]
    fn saturated_rotors_still_turn_the_body() {
        for throttle in [0.0, 1.0] {
            let outputs = mix(&RotorCommand {
                throttle,
                turn: Vector3::new(0.3, 0.0, 0.0),
            });
            assert!(outputs.iter().all(|o| (0.0..=1.0).contains(o)));
            let left_over_right = outputs[1] + outputs[2] - outputs[0] - outputs[3];
            assert!(left_over_right > 0.5, "{throttle}: {outputs:?}");
        }
    }

    #[test]
    fn hover_commands_equal_those_of_the_sources() {
        assert!((Airframe::AIRSIM.hover_command() - 0.587).abs() < 1e-3);
        assert!((Airframe::HUMMINGBIRD.hover_command() - 0.3135).abs() < 1e-3);
    }
}
