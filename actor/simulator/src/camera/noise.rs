//! What a stereo camera makes of the scene: noise that grows with depth, shadows beside near
//! objects, patches without a reading.
//!
//! A pixel's noise is computed from its number and the image's key, many pixels at a time; shadows
//! and patches touch few pixels. All of it together costs less than drawing the scene.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use super::canvas::rounded;
use super::{CameraSettings, IMAGE_HEIGHT, IMAGE_PIXELS, IMAGE_WIDTH};
use crate::disturbances::{DepthModel, DepthNoiseSettings, mix, scrambled, standard_normal};

/// A pixel without a reading.
pub(super) const NO_READING: u8 = 0;

/// The nearest reading: what has one is never taken for what has none.
const NEAREST_READING: f32 = 1.0;

/// Widest shadow, pixels: that of an object 0.2 m away, nearer than which no stereo camera of this
/// kind matches anything.
const WIDEST_SHADOW_PX: usize = 16;

/// Everything of [`DepthNoiseSettings`] that a pixel needs, in its units.
#[derive(Debug, Clone)]
pub(super) struct StereoNoise {
    /// σ in grey levels as a polynomial of the grey level: quadratic, linear, constant.
    sigma: [f32; 3],
    /// Disparity in pixels of what lies at the range.
    disparity_px: f32,
    /// Expected number of patches.
    patches: f32,
    largest_patch_px: usize,
}

impl StereoNoise {
    /// `None` if the image shall be true.
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

    /// Grey levels of what is seen with errors. `nearness`: range over depth, `[72, 128]`, 1 at the
    /// range or farther. `key`: another one, other errors.
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

    /// Noise of one row, the first pixel of which is number `first` of the image.
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
        // Loops over arrays of one length, so that they are done in registers full of pixels.
        let mut normals = [0.0; IMAGE_WIDTH];
        for (column, normal) in normals.iter_mut().enumerate() {
            let low = mix((first + column as u32) ^ low_key);
            *normal = standard_normal(low, mix(low ^ high_key));
        }
        for ((pixel, nearness), normal) in pixels.iter_mut().zip(nearness).zip(&normals) {
            let level = 255.0 / nearness;
            let sigma = (quadratic * level + linear) * level + constant;
            // What is out of range has no depth to be wrong about.
            let sigma = if *nearness > 1.0 { sigma } else { 0.0 };
            *pixel = rounded((level + sigma * normal).clamp(NEAREST_READING, 255.0));
        }
    }

    /// Takes the readings from what the left lens sees and the right one does not.
    ///
    /// A point `disparity` pixels farther left in the right image is hidden there when a nearer
    /// one, k pixels to its right, lands on it or left of it: when the disparity grows by k within
    /// k pixels. Half a pixel less, so that a shadow's width is rounded and not cut.
    #[inline(always)]
    fn shade_row(&self, nearness: &[f32; IMAGE_WIDTH], pixels: &mut [u8; IMAGE_WIDTH]) {
        let nearest = nearness.iter().copied().fold(1.0, f32::max);
        let reach_px = (nearest * self.disparity_px + 0.5) as usize;
        let reach_px = reach_px.min(WIDEST_SHADOW_PX);
        if reach_px == 0 {
            return;
        }
        // By how many pixels each is hidden; beyond the left edge of the right image everything is.
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

    /// Rectangles without a reading, anywhere in the image.
    fn drop_patches(&self, key: u64, image: &mut [u8; IMAGE_PIXELS]) {
        let mut rng = Pcg64Mcg::seed_from_u64(key);
        // The fraction left over is the chance of one more.
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
