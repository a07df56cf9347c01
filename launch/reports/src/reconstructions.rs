//! Depth images beside their reconstructions by the VAE.

use std::path::Path;

use safetensors::{Dtype, SafeTensors};
use skein_protocol::files::{self, TENSOR_BYTES};
use skein_protocol::{IMAGE_HEIGHT, IMAGE_PIXELS, IMAGE_WIDTH};

use super::ReportError;
use super::canvas::{Canvas, font, px};

/// Pairs per row of the picture.
const COLUMNS: usize = 4;
/// Largest number of pairs in the picture; nobody would look at more.
const MAX_PAIRS: usize = 12;
/// Saved pixels per image pixel.
const ZOOM: u32 = 2;
const GAP: u32 = 16;
const CAPTION: u32 = 28;
const TITLE: u32 = 48;

/// Depth images and their reconstructions, `[n, 72, 128]` bytes each; brighter is farther.
#[derive(Debug)]
pub(super) struct Pairs {
    depth: Vec<u8>,
    reconstruction: Vec<u8>,
}

impl Pairs {
    /// Reads the tensors `depth` and `reconstruction`, u8 `[n, 72, 128]`, from a safetensors file.
    ///
    /// # Errors
    /// [`ReportError`] names the file and its problem.
    pub(super) fn read(path: &Path) -> Result<Self, ReportError> {
        let bytes = files::read(path, TENSOR_BYTES).map_err(|source| ReportError::Read {
            path: path.to_owned(),
            source,
        })?;
        let malformed = |problem: String| ReportError::Malformed {
            path: path.to_owned(),
            problem,
        };
        let tensors =
            SafeTensors::deserialize(&bytes).map_err(|error| malformed(error.to_string()))?;
        let images = |name: &str| {
            let tensor = tensors
                .tensor(name)
                .map_err(|error| malformed(error.to_string()))?;
            match (tensor.dtype(), tensor.shape()) {
                (Dtype::U8, [_, IMAGE_HEIGHT, IMAGE_WIDTH]) => Ok(tensor.data().to_vec()),
                (dtype, shape) => Err(malformed(format!(
                    "tensor `{name}` is {dtype:?} {shape:?}, not U8 [n, {IMAGE_HEIGHT}, \
                     {IMAGE_WIDTH}]"
                ))),
            }
        };
        Self::of(images("depth")?, images("reconstruction")?).map_err(malformed)
    }

    /// Pairs whole images with their reconstructions.
    ///
    /// # Errors
    /// If their numbers differ or are zero.
    pub(super) fn of(depth: Vec<u8>, reconstruction: Vec<u8>) -> Result<Self, String> {
        if depth.is_empty() || depth.len() != reconstruction.len() {
            return Err("the numbers of images and reconstructions differ or are zero".to_owned());
        }
        Ok(Self {
            depth,
            reconstruction,
        })
    }

    fn iter(&self) -> impl Iterator<Item = (&[u8], &[u8])> {
        self.depth
            .chunks_exact(IMAGE_PIXELS)
            .zip(self.reconstruction.chunks_exact(IMAGE_PIXELS))
    }
}

/// Draws each depth image above its reconstruction.
///
/// # Errors
/// Returns [`ReportError`] if the picture cannot be drawn or written.
pub(super) fn draw(pairs: &Pairs, path: &Path) -> Result<(), ReportError> {
    let shown = pairs.iter().count().min(MAX_PAIRS);
    let (width, height) = (IMAGE_WIDTH as u32 * ZOOM, IMAGE_HEIGHT as u32 * ZOOM);
    let (step_x, step_y) = (width + GAP, 2 * height + 4 + CAPTION + GAP);
    let rows = shown.div_ceil(COLUMNS) as u32;
    let mut canvas = Canvas::new(GAP + COLUMNS as u32 * step_x, TITLE + rows * step_y);
    let corner = |i: usize| {
        (
            GAP + (i % COLUMNS) as u32 * step_x,
            TITLE + (i / COLUMNS) as u32 * step_y,
        )
    };

    canvas.draw(|area| {
        let title = "Depth image (above) and its reconstruction from the latent code (below); \
                     brighter is farther";
        area.draw_text(title, &font(19), (px(GAP) as i32, px(14) as i32))?;
        for (i, (depth, reconstruction)) in pairs.iter().take(shown).enumerate() {
            let (x, y) = corner(i);
            let error = format!("mean error {:.1} of 255", mean_error(depth, reconstruction));
            area.draw_text(
                &error,
                &font(15),
                (px(x) as i32, px(y + 2 * height + 11) as i32),
            )?;
        }
        Ok(())
    })?;
    for (i, (depth, reconstruction)) in pairs.iter().take(shown).enumerate() {
        let (x, y) = corner(i);
        canvas.put_grey(depth, IMAGE_WIDTH, (x, y), ZOOM);
        canvas.put_grey(reconstruction, IMAGE_WIDTH, (x, y + height + 4), ZOOM);
    }
    canvas.save(path)
}

/// Returns the mean absolute difference in grey levels.
fn mean_error(depth: &[u8], reconstruction: &[u8]) -> f64 {
    let sum: u64 = depth
        .iter()
        .zip(reconstruction)
        .map(|(&a, &b)| u64::from(a.abs_diff(b)))
        .sum();
    sum as f64 / depth.len() as f64
}

#[cfg(test)]
mod tests {
    use std::fs;

    use std::collections::HashMap;

    use safetensors::tensor::TensorView;

    use super::*;

    fn write(path: &Path, shape: [usize; 3], reconstructions: usize) {
        let depth = vec![10; shape.iter().product()];
        let reconstruction = vec![13; reconstructions * shape[1] * shape[2]];
        let view = |n, data| TensorView::new(Dtype::U8, vec![n, shape[1], shape[2]], data).unwrap();
        let tensors = HashMap::from([
            ("depth", view(shape[0], &depth)),
            ("reconstruction", view(reconstructions, &reconstruction)),
        ]);
        fs::write(path, safetensors::serialize(tensors, None).unwrap()).unwrap();
    }

    #[test]
    fn pairs_are_read_in_order_and_compared() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("reconstructions.safetensors");
        write(&path, [3, IMAGE_HEIGHT, IMAGE_WIDTH], 3);
        let pairs = Pairs::read(&path).unwrap();
        assert_eq!(pairs.iter().count(), 3);
        assert!(
            pairs
                .iter()
                .all(|(depth, reconstruction)| mean_error(depth, reconstruction) == 3.0)
        );
    }

    #[test]
    fn images_of_another_shape_or_number_are_refused() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("reconstructions.safetensors");
        for (shape, reconstructions, expected) in [
            ([2, 64, 64], 2, "[2, 64, 64]"),
            ([2, IMAGE_HEIGHT, IMAGE_WIDTH], 1, "differ"),
            ([0, IMAGE_HEIGHT, IMAGE_WIDTH], 0, "zero"),
        ] {
            write(&path, shape, reconstructions);
            let error = Pairs::read(&path).map(|_| ()).unwrap_err().to_string();
            assert!(
                error.contains(expected) && error.contains("reconstructions.safetensors"),
                "{error}"
            );
        }
    }
}
