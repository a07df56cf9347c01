//! The `[simulator.disturbances]` section of the configuration.

use serde::{Deserialize, Serialize};

use crate::vehicle::{Preset, VehicleSettings};

/// Disturbances of episodes: section `[simulator.disturbances]`. All are off by default.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DisturbanceSettings {
    /// Share of episodes that are disturbed, 0 to 1, drawn for each episode. The others are calm in
    /// every respect: trained on disturbed episodes alone, a policy would never meet calm ones.
    /// Default 1.
    pub share: f32,
    /// Largest deviation of an episode's mass, as a share of the nominal mass, 0 to 0.5. It is
    /// drawn uniformly for each episode, and inertia scales with it. Rotors and controller stay
    /// trimmed for the nominal mass. Default 0.
    pub mass_spread: f32,
    /// Control periods from an action to its effect, 0 to 8. Until the first action takes effect,
    /// the command sideways and up is zero. The unit is a period because nothing is decided or seen
    /// between two of them. Default 0.
    pub latency_periods: u32,
    /// Gusts.
    pub gust: GustSettings,
    /// Errors of the depth camera.
    pub depth: DepthNoiseSettings,
}

/// A random force on the centre of mass, independent along each axis of the world: a first-order
/// Gauss-Markov process.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GustSettings {
    /// Root mean square along each axis, N, 0 to 10. Default 0: calm air. For scale: air that moves
    /// at 0.28 m/s rms, as in a draughty hall, pushes with 0.15 N on a quadrotor of 1 kg whose
    /// rotors drag at 0.54 N per m/s (Faessler, Franchi, Scaramuzza, RA-L 2018). With the drag of
    /// the `airsim` preset alone, 0.15 N takes a wind of 4.7 m/s.
    pub force_rms_n: f32,
    /// Time after which 1/e of a gust is left, s, 0.01 to 60. Default 1: as slow as the vehicle,
    /// where a gust disturbs most.
    pub correlation_secs: f32,
}

/// Model of the depth image's errors.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DepthModel {
    /// No errors.
    #[default]
    Off,
    /// Errors of a stereo camera: noise that grows with the square of the depth, and pixels without
    /// a reading.
    Stereo,
}

/// Errors of a stereo camera. They apply if `model` is `stereo`; the defaults are those of an Intel
/// RealSense D435.
///
/// The noise of a reading at depth d has the standard deviation σ = a d² + b d + c. Pixels are
/// independent: a pixel here covers six of the camera's, about the width over which its matching
/// correlates them. A surface at the range or farther has no noise.
///
/// A pixel without a reading is 0, as in RealSense's own images. The other choice, the farthest
/// value, would draw openings into walls. 0 is unambiguous: the body keeps every surface farther
/// away than that, and a noisy reading is never less than 1.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DepthNoiseSettings {
    /// Model of the errors; `off` disables all other settings of this section. Default `off`.
    pub model: DepthModel,
    /// Coefficient a of σ, 1/m. Default 0.003949. Source of a, b and c: Ahn, Chae, Shin, Nam, Hong,
    /// "Analysis and Noise Modeling of the Intel RealSense D435 for Mobile Robots", UR 2019.
    /// Intel's own formula, subpixel · d² / (focal length · baseline), gives 0.0038 with its usual
    /// 0.08 pixels, 424 pixels and 0.05 m. Both were measured up to some metres; beyond the
    /// camera's nominal 10 m they are extrapolated.
    pub sigma_quadratic_per_m: f32,
    /// Coefficient b of σ, no unit. Default 0.0007278.
    pub sigma_linear: f32,
    /// Coefficient c of σ, metres. Default 0.001063.
    pub sigma_constant_m: f32,
    /// Distance between the two lenses, metres, 0 to 0.5. A point that only the left lens sees has
    /// no reading. This gives a band at the left edge of every near object, and of the image,
    /// focal length · baseline · (1 / near − 1 / far) pixels wide. 0 gives no bands. Default 0.05.
    /// Source: Intel, D400 series data sheet, "invalid depth band".
    pub baseline_m: f32,
    /// Share of the image that loses its reading in random patches (reflections, no texture), 0 to
    /// 0.5. Overlapping patches both count. Default 0.02: twice the loss that the data sheet allows
    /// on a white wall (fill rate 99 %).
    pub dropout_share: f32,
    /// Largest side of a patch, pixels, 1 to 64; each side is drawn uniformly from 1 to this.
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
    /// Returns the standard deviation σ of a reading at `depth_m`, metres.
    pub(crate) fn sigma_m(&self, depth_m: f32) -> f32 {
        (self.sigma_quadratic_per_m * depth_m + self.sigma_linear) * depth_m + self.sigma_constant_m
    }
}

/// A disturbance setting that is out of bounds or without effect.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("disturbances: key {key} = {value} {problem}")]
pub struct DisturbanceSettingsError {
    /// The key, relative to the section.
    pub key: &'static str,
    /// The value found.
    pub value: f32,
    /// The bound and the consequence.
    pub problem: String,
}

impl DisturbanceSettings {
    /// Checks every value against its bounds, for a drone with settings `vehicle` and a camera with
    /// the range `camera_range_m`.
    ///
    /// # Errors
    /// [`DisturbanceSettingsError`] names the first key at fault.
    pub fn validate(
        &self,
        vehicle: &VehicleSettings,
        camera_range_m: f32,
    ) -> Result<(), DisturbanceSettingsError> {
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
                "the policy could not steer",
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
                "the force would be white noise or a constant",
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
                "too little of the image would be left",
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
        depth.validate_sigma(camera_range_m)?;
        self.validate_for(vehicle)
    }

    /// Refuses settings that would silently have no effect: the point drone has neither mass nor
    /// forces.
    fn validate_for(&self, vehicle: &VehicleSettings) -> Result<(), DisturbanceSettingsError> {
        let heavy = [
            ("mass_spread", self.mass_spread),
            ("gust.force_rms_n", self.gust.force_rms_n),
        ];
        match heavy.into_iter().find(|(_, value)| *value != 0.0) {
            Some((key, value)) if vehicle.preset == Preset::Point => {
                let problem = "has no effect on vehicle.preset = \"point\", which has no mass and \
                               feels no force: set it to 0 or choose another preset";
                Err(fault(key, value, problem.to_owned()))
            }
            _ => Ok(()),
        }
    }
}

impl DepthNoiseSettings {
    /// Checks that σ is between 0 and the range at every depth up to the range.
    fn validate_sigma(&self, range_m: f32) -> Result<(), DisturbanceSettingsError> {
        for (key, value) in [
            ("depth.sigma_quadratic_per_m", self.sigma_quadratic_per_m),
            ("depth.sigma_linear", self.sigma_linear),
            ("depth.sigma_constant_m", self.sigma_constant_m),
        ] {
            if !value.is_finite() {
                return Err(fault(key, value, "is not a finite number".to_owned()));
            }
        }
        if !(range_m > 0.0 && range_m.is_finite()) {
            return Ok(()); // the camera refuses it
        }
        // σ is least or greatest at the parabola's vertex or at an end of the range.
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
                    "with sigma_linear = {} and sigma_constant_m = {} makes the noise at \
                     {depth_m} m {} m, outside 0 to camera.range_m = {range_m}",
                    self.sigma_linear,
                    self.sigma_constant_m,
                    self.sigma_m(depth_m)
                ),
            )),
        }
    }
}

fn fault(key: &'static str, value: f32, problem: String) -> DisturbanceSettingsError {
    DisturbanceSettingsError {
        key,
        value,
        problem,
    }
}
