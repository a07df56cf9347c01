//! Errors of a stereo camera: noise that grows with depth, shadows beside near objects, patches
//! without a reading.
//!
//! A pixel's noise is computed from its number and the image's key, many pixels at a time. Shadows
//! and patches affect few pixels. All errors together cost less than drawing the scene.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use super::canvas::rounded;
use super::{CameraSettings, IMAGE_HEIGHT, IMAGE_PIXELS, IMAGE_WIDTH};
use crate::disturbances::{DepthModel, DepthNoiseSettings, mix, scrambled, standard_normal};

/// Grey level of a pixel without a reading.
pub(super) const NO_READING: u8 = 0;

/// Least grey level of a reading, so that it differs from [`NO_READING`].
const NEAREST_READING: f32 = 1.0;

/// Widest shadow, pixels: that of an object 0.2 m away. A stereo camera of this kind matches
/// nothing nearer.
const WIDEST_SHADOW_PX: usize = 16;

/// [`DepthNoiseSettings`] converted to pixels and grey levels.
#[derive(Debug, Clone)]
pub(super) struct StereoNoise {
    /// Coefficients of σ in grey levels as a polynomial of the grey level: quadratic, linear,
    /// constant.
    sigma: [f32; 3],
    /// Disparity of a point at the range, pixels.
    disparity_px: f32,
    /// Expected number of patches in an image.
    patches: f32,
    largest_patch_px: usize,
}

impl StereoNoise {
    /// Returns `None` if the model is off.
    pub(super) fn new(settings: &DepthNoiseSettings, camera: &CameraSettings) -> Option<Self> {
        if settings.model == DepthModel::Off {
            return None;
        }
        let levels_per_m = 255.0 / camera.range_m;
        let side_px = (1.0 + settings.dropout_patch_px as f32) / 2.0;
        Some(Self {
            sigma: [
                settings.sigma_quadratic_per_m / levels_per_m,
                settings.sigma_linear,
                settings.sigma_constant_m * levels_per_m,
            ],
            disparity_px: camera.focal_px() * settings.baseline_m / camera.range_m,
            patches: settings.dropout_share * IMAGE_PIXELS as f32 / (side_px * side_px),
            largest_patch_px: settings.dropout_patch_px as usize,
        })
    }

    /// Writes the image with errors as grey levels. `nearness`: range over depth, `[72, 128]`, 1 at
    /// the range or farther. Different values of `key` give different errors.
    #[inline(always)]
    pub(super) fn write(
        &self,
        nearness: &[[f32; IMAGE_WIDTH]; IMAGE_HEIGHT],
        key: u64,
        image: &mut [u8; IMAGE_PIXELS],
    ) {
        let key = scrambled(key);
        let (rows, _) = image.as_chunks_mut::<IMAGE_WIDTH>();
        for ((number, nearness), pixels) in (0u32..).zip(nearness).zip(rows) {
            self.write_row(nearness, number * IMAGE_WIDTH as u32, key, pixels);
            self.shade_row(nearness, pixels);
        }
        self.drop_patches(key, image);
    }

    /// Writes a row with noise. `first`: number of the row's first pixel in the image.
    #[inline(always)]
    fn write_row(
        &self,
        nearness: &[f32; IMAGE_WIDTH],
        first: u32,
        key: u64,
        pixels: &mut [u8; IMAGE_WIDTH],
    ) {
        let [quadratic, linear, constant] = self.sigma;
        let (low_key, high_key) = (key as u32, (key >> 32) as u32);
        // All arrays have one length, so that the compiler vectorises the loops.
        let mut normals = [0.0; IMAGE_WIDTH];
        for (column, normal) in normals.iter_mut().enumerate() {
            let low = mix((first + column as u32) ^ low_key);
            *normal = standard_normal(low, mix(low ^ high_key));
        }
        for ((pixel, nearness), normal) in pixels.iter_mut().zip(nearness).zip(&normals) {
            let level = 255.0 / nearness;
            let sigma = (quadratic * level + linear) * level + constant;
            // A surface out of range has no depth, so it has no error.
            let sigma = if *nearness > 1.0 { sigma } else { 0.0 };
            *pixel = rounded((level + sigma * normal).clamp(NEAREST_READING, 255.0));
        }
    }

    /// Removes the readings of points that only the left lens sees.
    ///
    /// A point lies `disparity` pixels farther left in the right image. It is hidden there if a
    /// nearer point, k pixels to its right, lands on it or left of it: if the disparity grows by k
    /// within k pixels. The test uses half a pixel less, so that a shadow's width is rounded and
    /// not truncated.
    #[inline(always)]
    fn shade_row(&self, nearness: &[f32; IMAGE_WIDTH], pixels: &mut [u8; IMAGE_WIDTH]) {
        let nearest = nearness.iter().copied().fold(1.0, f32::max);
        let reach_px = (nearest * self.disparity_px + 0.5) as usize;
        let reach_px = reach_px.min(WIDEST_SHADOW_PX);
        if reach_px == 0 {
            return;
        }
        // Pixels by which each point is hidden. Points beyond the right image's left edge are.
        let mut hidden_px = [0.0f32; IMAGE_WIDTH];
        for (column, (hidden, nearness)) in hidden_px.iter_mut().zip(nearness).enumerate() {
            *hidden = nearness * self.disparity_px - (column as f32 + 0.5);
        }
        for k in 1..=reach_px {
            let within = k as f32 - 0.5;
            for (hidden, (left, right)) in hidden_px
                .iter_mut()
                .zip(nearness.iter().zip(&nearness[k..]))
            {
                let overlap = (right - left) * self.disparity_px - within;
                *hidden = if overlap > *hidden { overlap } else { *hidden };
            }
        }
        for (pixel, hidden) in pixels.iter_mut().zip(hidden_px) {
            *pixel = if hidden > 0.0 { NO_READING } else { *pixel };
        }
    }

    /// Removes the readings of random rectangles.
    fn drop_patches(&self, key: u64, image: &mut [u8; IMAGE_PIXELS]) {
        let mut rng = Pcg64Mcg::seed_from_u64(key);
        // The fractional part is the probability of one more patch.
        let count = (self.patches + rng.random_range(0.0..1.0)) as usize;
        for _ in 0..count {
            let [width, height] = [IMAGE_WIDTH, IMAGE_HEIGHT].map(|most| {
                let side = rng.random_range(1..=self.largest_patch_px);
                side.min(most)
            });
            let left = rng.random_range(0..=IMAGE_WIDTH - width);
            let top = rng.random_range(0..=IMAGE_HEIGHT - height);
            for row in top..top + height {
                image[row * IMAGE_WIDTH + left..][..width].fill(NO_READING);
            }
        }
    }
}
