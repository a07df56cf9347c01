//! Vector instruction sets for drawing images, chosen once at run time.

use std::fmt;

use super::{DepthCamera, IMAGE_PIXELS, ImageErrors, draw, settings};

/// [`draw`], compiled for an instruction set.
pub(super) type DrawFunction =
    fn(&mut DepthCamera, &settings::CameraView, ImageErrors, &mut [u8; IMAGE_PIXELS]);

/// A vector instruction set for which drawing is compiled.
///
/// All of them do the same arithmetic in the same order: wider registers change no bit of the
/// image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InstructionSet {
    /// The instructions that every processor has.
    Portable,
    /// AVX2, 256 bits.
    Avx2,
    /// AVX-512 F, BW, DQ and VL, 512 bits.
    Avx512,
}

impl InstructionSet {
    /// All instruction sets, the widest last.
    pub const ALL: [Self; 3] = [Self::Portable, Self::Avx2, Self::Avx512];

    /// Returns the widest set of this machine, which every camera uses.
    pub fn best() -> Self {
        let mut all = Self::ALL.into_iter().rev();
        all.find(|set| set.is_available()).unwrap_or(Self::Portable)
    }

    /// Returns `true` if this machine has the set.
    pub fn is_available(self) -> bool {
        match self {
            Self::Portable => true,
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => is_x86_feature_detected!("avx2"),
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => {
                is_x86_feature_detected!("avx512f")
                    && is_x86_feature_detected!("avx512bw")
                    && is_x86_feature_detected!("avx512dq")
                    && is_x86_feature_detected!("avx512vl")
            }
            #[cfg(not(target_arch = "x86_64"))]
            Self::Avx2 | Self::Avx512 => false,
        }
    }

    /// Returns the drawing function for this set.
    ///
    /// # Panics
    /// If this machine does not have the set.
    pub(super) fn draw(self) -> DrawFunction {
        assert!(self.is_available(), "this machine has no {self}");
        match self {
            Self::Portable => draw,
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => {
                // SAFETY: the assertion above checked that the machine has the features for which
                // the function is compiled.
                |camera, view, errors, image| unsafe { draw_avx2(camera, view, errors, image) }
            }
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => {
                // SAFETY: the same assertion holds.
                |camera, view, errors, image| unsafe { draw_avx512(camera, view, errors, image) }
            }
            #[cfg(not(target_arch = "x86_64"))]
            Self::Avx2 | Self::Avx512 => draw,
        }
    }
}

impl fmt::Display for InstructionSet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Portable => "portable",
            Self::Avx2 => "AVX2",
            Self::Avx512 => "AVX-512",
        })
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
fn draw_avx512(
    camera: &mut DepthCamera,
    view: &settings::CameraView,
    errors: ImageErrors,
    image: &mut [u8; IMAGE_PIXELS],
) {
    draw(camera, view, errors, image);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn draw_avx2(
    camera: &mut DepthCamera,
    view: &settings::CameraView,
    errors: ImageErrors,
    image: &mut [u8; IMAGE_PIXELS],
) {
    draw(camera, view, errors, image);
}
