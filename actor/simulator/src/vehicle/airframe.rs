//! Data of the quadrotor presets: mass, rotors, drag, collision body, controller gains.
//!
//! One rotor model and one controller fly every preset, so another quadrotor is only another
//! constant here.

use std::f32::consts::PI;

use nalgebra::Vector3;

/// Standard gravity, m/s².
pub(crate) const GRAVITY_MPS2: f32 = 9.81;

/// All data in which one quadrotor differs from another. Four rotors in X layout; body frame x
/// forward, y left, z up.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Airframe {
    pub(crate) mass_kg: f32,
    /// Principal moments about x, y, z, kg·m².
    pub(crate) inertia_kgm2: Vector3<f32>,
    /// Distance from the centre to a rotor axis, m.
    pub(crate) arm_m: f32,
    /// Thrust of one rotor at full command, N.
    pub(crate) rotor_thrust_n: f32,
    /// Reaction torque of one rotor at full command, N·m.
    pub(crate) rotor_torque_nm: f32,
    /// Time constant of a rotor's first-order response to its command, s.
    pub(crate) rotor_lag_secs: f32,
    /// Quadratic drag along each body axis, N/(m/s)².
    pub(crate) drag_n_per_mps2: Vector3<f32>,
    /// Half of the collision cuboid's edge lengths, m.
    pub(crate) half_extents_m: Vector3<f32>,
    pub(crate) gains: Gains,
}

/// Gains of the cascade controller. Its outputs are rotor commands in [0, 1], its errors are in SI
/// units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Gains {
    /// Target tilt per m/s of horizontal velocity error, rad.
    pub(crate) tilt_per_mps: f32,
    /// Limit of the target roll and pitch, rad.
    pub(crate) tilt_limit_rad: f32,
    /// Target body rate per rad of attitude error, 1/s.
    pub(crate) rate_per_rad: f32,
    /// Limit of the target body rate, rad/s.
    pub(crate) rate_limit_radps: f32,
    /// Differential rotor command per rad/s of body rate error.
    pub(crate) command_per_radps: f32,
    /// Collective rotor command per m/s of climb error.
    pub(crate) throttle_per_mps: f32,
    /// Collective rotor command per metre of accumulated climb error.
    pub(crate) throttle_per_m: f32,
    /// Least collective command, so that a tilted drone always has the thrust to turn back.
    pub(crate) throttle_min: f32,
}

impl Airframe {
    /// AirSim's generic quadrotor under SimpleFlight, its default flight controller.
    ///
    /// Source: AirSim, `MultiRotorParams.hpp` (`setupFrameGenericQuad`), `RotorParams.hpp`,
    /// `simple_flight/firmware/Params.hpp`.
    pub(crate) const AIRSIM: Self = Self {
        mass_kg: 1.0,
        inertia_kgm2: Vector3::new(0.00672, 0.00804, 0.01428),
        arm_m: 0.2275,
        // C_T 0.109919, C_P 0.040164, diameter 0.2286 m, 6396.667 rpm, air 1.225 kg/m³.
        rotor_thrust_n: 4.179,
        rotor_torque_nm: 0.0556,
        rotor_lag_secs: 0.005,
        // Coefficient 0.325 / 2 · 1.225 kg/m³ times body box (0.18 × 0.11 × 0.04 m) and rotor areas
        // as AirSim counts them: front 0.0331 m², side 0.0359 m², top 0.6765 m².
        drag_n_per_mps2: Vector3::new(0.0066, 0.0071, 0.1347),
        // AirSim's collision mesh, 0.98 × 0.98 × 0.29 m; its physics frame is smaller.
        half_extents_m: Vector3::new(0.49, 0.49, 0.145),
        gains: Gains {
            // SimpleFlight's stages pass on numbers in [-1, 1], scaled by the next stage's limit:
            // velocity P 0.2 times the tilt limit π/5.5, level P 2.5 times the rate limit 2.5
            // rad/s. Its throttle is (1 + output) / 2, which halves the climb gains P 2 and I 2.
            tilt_per_mps: 0.2 * PI / 5.5,
            tilt_limit_rad: PI / 5.5,
            rate_per_rad: 2.5 * 2.5,
            rate_limit_radps: 2.5,
            command_per_radps: 0.25,
            throttle_per_mps: 1.0,
            throttle_per_m: 1.0,
            throttle_min: 0.3,
        },
    };

    /// AscTec Hummingbird with a quicker controller of our design.
    ///
    /// Source of mass, inertia, arm, rotor radius 0.1 m, thrust and torque coefficients, lag, drag:
    /// RotorPy, `hummingbird_params.py`. Its rotor speed limit, 1500 rad/s, would lift ten times
    /// the weight. We use the limit of RotorS' `hummingbird.xacro`, 838 rad/s, which lifts three
    /// times the weight. Height 0.12 m: RotorS.
    pub(crate) const HUMMINGBIRD: Self = Self {
        mass_kg: 0.5,
        inertia_kgm2: Vector3::new(3.65e-3, 3.68e-3, 7.03e-3),
        arm_m: 0.17,
        rotor_thrust_n: 5.57e-6 * 838.0 * 838.0,
        rotor_torque_nm: 1.36e-7 * 838.0 * 838.0,
        rotor_lag_secs: 0.005,
        drag_n_per_mps2: Vector3::new(0.005, 0.005, 0.01),
        // The square around the rotor discs, 2 · (0.17 m / √2 + 0.1 m) = 0.44 m.
        half_extents_m: Vector3::new(0.22, 0.22, 0.06),
        gains: Gains {
            // Poles placed by hand, each stage some four times as quick as the one above it:
            // velocity 2.5 /s (g · 0.255 rad per m/s), attitude 12 /s, rates 51 /s (one unit of
            // command turns 515 rad/s² about x), climb 7.8 /s.
            tilt_per_mps: 0.255,
            tilt_limit_rad: PI / 5.5,
            rate_per_rad: 12.0,
            rate_limit_radps: 5.0,
            command_per_radps: 0.1,
            throttle_per_mps: 0.25,
            throttle_per_m: 0.25,
            throttle_min: 0.1,
        },
    };

    /// Returns the rotor command at which the level drone neither climbs nor sinks.
    pub(crate) fn hover_command(&self) -> f32 {
        self.mass_kg * GRAVITY_MPS2 / (4.0 * self.rotor_thrust_n)
    }
}
