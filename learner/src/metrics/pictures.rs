//! Pictures for TensorBoard.

use skein_protocol::{IMAGE_HEIGHT, IMAGE_PIXELS, IMAGE_WIDTH};

/// Name of the picture of depth images above their reconstructions.
pub(super) const TAG: &str = "vae/depth_above_reconstruction";
/// White pixels between two images.
const GAP: usize = 4;

/// A grey picture as PNG.
pub(super) struct Picture {
    /// Width, height.
    pub(super) size: [usize; 2],
    pub(super) png: Vec<u8>,
}

/// Draws images, `[n, 72, 128]`, side by side, each above its reconstruction.
///
/// # Errors
/// Of the PNG encoder.
pub(super) fn above_each_other(
    depth: &[u8],
    reconstruction: &[u8],
) -> Result<Picture, png::EncodingError> {
    let count = (depth.len() / IMAGE_PIXELS).max(1);
    let size = [count * (IMAGE_WIDTH + GAP) - GAP, 2 * IMAGE_HEIGHT + GAP];
    let [width, height] = size;
    let mut pixels = vec![u8::MAX; width * height];
    for (top, images) in [(0, depth), (IMAGE_HEIGHT + GAP, reconstruction)] {
        for (place, row) in images.chunks_exact(IMAGE_WIDTH).enumerate() {
            let (image, down) = (place / IMAGE_HEIGHT, place % IMAGE_HEIGHT);
            let start = (top + down) * width + image * (IMAGE_WIDTH + GAP);
            pixels[start..start + IMAGE_WIDTH].copy_from_slice(row);
        }
    }
    let mut png = Vec::new();
    let mut encoder = png::Encoder::new(&mut png, width as u32, height as u32);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(png::BitDepth::Eight);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(&pixels)?;
    writer.finish()?;
    Ok(Picture { size, png })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_image_is_above_its_reconstruction() {
        let images = |shades: [u8; 2]| shades.map(|shade| [shade; IMAGE_PIXELS]).concat();
        let picture = above_each_other(&images([10, 20]), &images([30, 40])).unwrap();
        let mut reader = png::Decoder::new(std::io::Cursor::new(&picture.png))
            .read_info()
            .unwrap();
        let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut pixels).unwrap();
        let [width, height] = picture.size;
        assert_eq!(pixels.len(), width * height);
        let corners = [0, width - 1, (height - 1) * width, height * width - 1];
        assert_eq!(corners.map(|place| pixels[place]), [10, 20, 30, 40]);
        assert_eq!(pixels[IMAGE_WIDTH], u8::MAX, "the gap");
    }
}
