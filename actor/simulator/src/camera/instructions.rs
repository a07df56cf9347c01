//! Which vector instructions images are drawn with, chosen once at run time.

use std::fmt;

use super::{DepthCamera, Errors, IMAGE_PIXELS, draw, settings};

/// [`draw`], compiled for some instructions.
pub(super) type Draw = fn(&mut DepthCamera, &settings::View, Errors, &mut [u8; IMAGE_PIXELS]);

/// A set of vector instructions that drawing is compiled for.
///
/// The same arithmetic in the same order whichever is chosen: wider registers do not change a bit
/// of the image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Instructions {
    /// Those that every processor has.
    Portable,
    /// 256 bits.
    Avx2,
    /// 512 bits: AVX-512 F, BW, DQ and VL.
    Avx512,
}

impl Instructions {
    /// All of them, the widest last.
    pub const ALL: [Self; 3] = [Self::Portable, Self::Avx2, Self::Avx512];

    /// The widest that this machine has, with which every camera draws.
    pub fn best() -> Self {
        let mut all = Self::ALL.into_iter().rev();
        all.find(|set| set.is_available()).unwrap_or(Self::Portable)
    }

    /// Whether this machine has them.
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

    /// How to draw with them.
    ///
    /// # Panics
    /// When this machine does not have them.
    pub(super) fn draw(self) -> Draw {
        assert!(self.is_available(), "this machine has no {self}");
        match self {
            Self::Portable => draw,
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => {
                // SAFETY: the machine has the features that the function is compiled for, as just
                // asked.
                |camera, view, errors, image| unsafe { draw_avx2(camera, view, errors, image) }
            }
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => {
                // SAFETY: as above.
                |camera, view, errors, image| unsafe { draw_avx512(camera, view, errors, image) }
            }
            #[cfg(not(target_arch = "x86_64"))]
            Self::Avx2 | Self::Avx512 => draw,
        }
    }
}

impl fmt::Display for Instructions {
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
    view: &settings::View,
    errors: Errors,
    image: &mut [u8; IMAGE_PIXELS],
) {
    draw(camera, view, errors, image);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn draw_avx2(
    camera: &mut DepthCamera,
    view: &settings::View,
    errors: Errors,
    image: &mut [u8; IMAGE_PIXELS],
) {
    draw(camera, view, errors, image);
}
