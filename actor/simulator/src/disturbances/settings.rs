//! The disturbances' section of the configuration.

use serde::{Deserialize, Serialize};

use crate::camera::CameraSettings;
use crate::vehicle::{Preset, VehicleSettings};

/// What disturbs episodes. Section `[simulator.disturbances]`; everything is off by default.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DisturbanceSettings {
    /// Share of episodes that are disturbed, 0 to 1, drawn for each; the others are calm in every
    /// respect. A policy that met nothing but disturbed episodes would know no calm ones. Default
    /// 1.
    pub share: f32,
    /// Largest deviation of an episode's mass from the nominal one, as a share of it, 0 to 0.5;
    /// drawn uniformly for each episode. Inertia goes along; rotors and controller know nothing of
    /// it and begin trimmed for the nominal mass. Default 0.
    pub mass_spread: f32,
    /// Control periods from an action to its effect, 0 to 8; until the first takes effect nothing
    /// is commanded sideways or up. Counted in periods, because nothing is decided or seen between
    /// two of them. Default 0.
    pub latency_periods: u32,
    /// Gusts.
    pub gust: GustSettings,
    /// What the depth camera gets wrong.
    pub depth: DepthNoiseSettings,
}

/// A random force on the body's centre of mass, along each axis of the world by itself: a
/// first-order Gauss-Markov process.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GustSettings {
    /// Root mean square along each axis, N, 0 to 10. Default 0: calm air. Air that moves at 0.28
    /// m/s rms, a draughty hall, comes to 0.15 N on a quadrotor of 1 kg whose rotors drag at 0.54 N
    /// per m/s (Faessler, Franchi, Scaramuzza, RA-L 2018); by the drag of the `airsim` preset
    /// itself it takes a wind of 4.7 m/s.
    pub force_rms_n: f32,
    /// Time after which 1/e of a gust is left, s, 0.01 to 60. Default 1: as slow as the vehicle
    /// itself, where it disturbs most.
    pub correlation_secs: f32,
}

/// Whether and how the depth image deviates from the truth.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DepthModel {
    /// Not at all.
    #[default]
    Off,
    /// As a stereo camera's: noise that grows with the square of the depth, and pixels without a
    /// reading.
    Stereo,
}

/// A stereo camera's errors. The numbers' defaults are those of an Intel RealSense D435; they act
/// when `model` is `stereo`.
///
/// The noise of a reading at depth d has the standard deviation σ = a d² + b d + c, one pixel
/// independent of the other: an image pixel here covers six of the camera's, about the width over
/// which its matching correlates them. What lies at the range or farther stays so.
///
/// A pixel without a reading is 0, as RealSense's own images have it. Farthest would be the other
/// choice; but it would draw openings into walls, and 0 cannot be mistaken: the body keeps every
/// surface farther off than that, and a noisy reading is never less than 1.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DepthNoiseSettings {
    /// Whether any of this acts. Default `off`.
    pub model: DepthModel,
    /// a, 1/m. Default 0.003949. Source of a, b and c: Ahn, Chae, Shin, Nam, Hong, "Analysis and
    /// Noise Modeling of the Intel RealSense D435 for Mobile Robots", UR 2019. Intel's own formula,
    /// subpixel · d² / (focal length · baseline), gives 0.0038 with its usual 0.08 pixels, 424
    /// pixels and 0.05 m. Both were measured up to some metres; beyond the camera's nominal 10 m
    /// they are an extrapolation.
    pub sigma_quadratic_per_m: f32,
    /// b. Default 0.0007278.
    pub sigma_linear: f32,
    /// c, metres. Default 0.001063.
    pub sigma_constant_m: f32,
    /// Distance between the two lenses, metres, 0 to 0.5. Default 0.05. What the left one sees and
    /// the right one does not has no reading: a band at the left edge of every near object, and of
    /// the image, focal length · baseline · (1 / near − 1 / far) pixels wide. 0: no such bands.
    /// Source: Intel, D400 series data sheet, "invalid depth band".
    pub baseline_m: f32,
    /// Share of the image without a reading in patches anywhere (reflections, no texture), 0 to
    /// 0.5; patches that overlap count each. Default 0.02: twice what the data sheet allows on a
    /// white wall, a fill rate of 99 %.
    pub dropout_share: f32,
    /// Largest side of such a patch, pixels, 1 to 64; each side is drawn uniformly from 1 up.
    /// Default 12: a tenth of the image's width.
    pub dropout_patch_px: u32,
}

impl Default for DisturbanceSettings {
    fn default() -> Self {
        Self {
            share: 1.0,
            mass_spread: 0.0,
            latency_periods: 0,
            gust: GustSettings::default(),
            depth: DepthNoiseSettings::default(),
        }
    }
}

impl Default for GustSettings {
    fn default() -> Self {
        Self {
            force_rms_n: 0.0,
            correlation_secs: 1.0,
        }
    }
}

impl Default for DepthNoiseSettings {
    fn default() -> Self {
        Self {
            model: DepthModel::Off,
            sigma_quadratic_per_m: 0.003_949,
            sigma_linear: 0.000_727_8,
            sigma_constant_m: 0.001_063,
            baseline_m: 0.05,
            dropout_share: 0.02,
            dropout_patch_px: 12,
        }
    }
}

impl DepthNoiseSettings {
    /// Standard deviation of a reading at `depth_m`, metres.
    #[must_use]
    pub fn sigma_m(&self, depth_m: f32) -> f32 {
        (self.sigma_quadratic_per_m * depth_m + self.sigma_linear) * depth_m + self.sigma_constant_m
    }
}

/// A disturbance that makes no sense.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("disturbances: key {key} = {value} {problem}")]
pub struct DisturbanceFault {
    /// The key, from the section on.
    pub key: &'static str,
    /// The value found.
    pub value: f32,
    /// The bound, and what would go wrong.
    pub problem: String,
}

impl DisturbanceSettings {
    /// Whether a drone with these settings can be disturbed so.
    ///
    /// # Errors
    /// The first [`DisturbanceFault`].
    pub fn check(
        &self,
        vehicle: &VehicleSettings,
        camera: &CameraSettings,
    ) -> Result<(), DisturbanceFault> {
        let Self { gust, depth, .. } = self;
        for (key, value, least, most, consequence) in [
            ("share", self.share, 0.0, 1.0, "it is a share of episodes"),
            (
                "mass_spread",
                self.mass_spread,
                0.0,
                0.5,
                "a heavier drone could not hover",
            ),
            (
                "latency_periods",
                self.latency_periods as f32,
                0.0,
                8.0,
                "nobody could steer",
            ),
            (
                "gust.force_rms_n",
                gust.force_rms_n,
                0.0,
                10.0,
                "the drone would be blown away",
            ),
            (
                "gust.correlation_secs",
                gust.correlation_secs,
                0.01,
                60.0,
                "a gust would be no gust",
            ),
            (
                "depth.baseline_m",
                depth.baseline_m,
                0.0,
                0.5,
                "no drone carries such a camera",
            ),
            (
                "depth.dropout_share",
                depth.dropout_share,
                0.0,
                0.5,
                "nothing would be left to see",
            ),
            (
                "depth.dropout_patch_px",
                depth.dropout_patch_px as f32,
                1.0,
                64.0,
                "a patch must fit the image",
            ),
        ] {
            // Written so that a NaN is refused as well.
            if !(least..=most).contains(&value) {
                return Err(fault(
                    key,
                    value,
                    format!("is outside {least} to {most}: {consequence}"),
                ));
            }
        }
        depth.check_sigma(camera.range_m)?;
        self.check_against(vehicle)
    }

    /// The point drone has neither mass nor forces: what would silently do nothing is refused.
    fn check_against(&self, vehicle: &VehicleSettings) -> Result<(), DisturbanceFault> {
        let heavy = [
            ("mass_spread", self.mass_spread),
            ("gust.force_rms_n", self.gust.force_rms_n),
        ];
        match heavy.into_iter().find(|(_, value)| *value != 0.0) {
            Some((key, value)) if vehicle.preset == Preset::Point => {
                let problem = "does nothing to vehicle.preset = \"point\", which follows its commands whatever pulls at it: set it to 0, or choose another preset";
                Err(fault(key, value, problem.to_owned()))
            }
            _ => Ok(()),
        }
    }
}

impl DepthNoiseSettings {
    /// σ is a standard deviation everywhere up to the range: a number, not below 0, nor larger than
    /// the range.
    fn check_sigma(&self, range_m: f32) -> Result<(), DisturbanceFault> {
        for (key, value) in [
            ("depth.sigma_quadratic_per_m", self.sigma_quadratic_per_m),
            ("depth.sigma_linear", self.sigma_linear),
            ("depth.sigma_constant_m", self.sigma_constant_m),
        ] {
            if !value.is_finite() {
                return Err(fault(key, value, "is no number".to_owned()));
            }
        }
        if !(range_m > 0.0 && range_m.is_finite()) {
            return Err(fault(
                "depth.model",
                range_m,
                "cannot be drawn up to such a camera.range_m: give it a positive number".to_owned(),
            ));
        }
        // The vertex of the parabola, where σ is least or greatest, and both ends.
        let vertex_m =
            (-self.sigma_linear / (2.0 * self.sigma_quadratic_per_m)).clamp(0.0, range_m);
        let depths_m = [0.0, range_m, if vertex_m.is_nan() { 0.0 } else { vertex_m }];
        match depths_m
            .into_iter()
            .find(|&depth_m| !(0.0..=range_m).contains(&self.sigma_m(depth_m)))
        {
            None => Ok(()),
            Some(depth_m) => Err(fault(
                "depth.sigma_quadratic_per_m",
                self.sigma_quadratic_per_m,
                format!(
                    "with sigma_linear = {} and sigma_constant_m = {} makes the noise at {depth_m} m {} m, outside 0 to camera.range_m = {range_m}",
                    self.sigma_linear,
                    self.sigma_constant_m,
                    self.sigma_m(depth_m)
                ),
            )),
        }
    }
}

fn fault(key: &'static str, value: f32, problem: String) -> DisturbanceFault {
    DisturbanceFault {
        key,
        value,
        problem,
    }
}
