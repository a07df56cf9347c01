//! A picture in memory, and the common style of all plots.
//!
//! The plotting library leaves the edges of thick lines jagged. A canvas is therefore drawn
//! [`SCALE`] times too large and averaged down when it is saved. Text uses a font compiled into the
//! program, because a fresh machine may have none.

use std::fs::{self, File};
use std::io::{self, BufWriter};
use std::path::{Path, PathBuf};
use std::sync::Once;

use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::register_font;
use skein_protocol::files::destination;

use super::ReportError;

/// Size of a canvas relative to the saved picture, in each direction.
const SCALE: u32 = 2;

/// Colour of text and axes.
pub(super) const INK: RGBColor = RGBColor(0x33, 0x38, 0x40);
/// Colour of grid lines.
pub(super) const GRID: RGBColor = RGBColor(0xe6, 0xe8, 0xec);
/// Colour of the main line.
pub(super) const STRONG: RGBColor = RGBColor(0x1f, 0x5f, 0xa8);
/// Paler shade of [`STRONG`].
pub(super) const FAINT: RGBColor = RGBColor(0xa9, 0xc2, 0xde);
/// Colour of reference levels.
pub(super) const REFERENCE: RGBColor = RGBColor(0xc8, 0x55, 0x1b);

/// Surface on which plots are drawn.
pub(super) type Area<'a> = DrawingArea<BitMapBackend<'a>, Shift>;

/// Returns the drawn pixels for `pixels` of the saved picture.
pub(super) const fn px(pixels: u32) -> u32 {
    pixels * SCALE
}

/// Returns a text style of `pixels` height in the saved picture.
pub(super) fn font(pixels: u32) -> TextStyle<'static> {
    ("sans-serif", px(pixels)).into_font().color(&INK)
}

/// RGB picture, initially white.
#[derive(Clone)]
pub(super) struct Canvas {
    width: u32,
    height: u32,
    pixels: Vec<u8>,
}

impl Canvas {
    /// Creates a canvas that is saved as `width` × `height` pixels.
    pub(super) fn new(width: u32, height: u32) -> Self {
        Self {
            width,
            height,
            pixels: vec![0xff; (px(width) * px(height) * 3) as usize],
        }
    }

    /// Paints with the plotting library, in drawn pixels ([`px`]).
    ///
    /// # Errors
    /// [`ReportError::Draw`] holds the message of the plotting library.
    pub(super) fn draw(
        &mut self,
        draw: impl FnOnce(&Area<'_>) -> Result<(), Box<dyn std::error::Error>>,
    ) -> Result<(), ReportError> {
        register_plot_font();
        let size = (px(self.width), px(self.height));
        let area = BitMapBackend::with_buffer(&mut self.pixels, size).into_drawing_area();
        draw(&area)
            .and_then(|()| Ok(area.present()?))
            .map_err(|error| ReportError::Draw(error.to_string()))
    }

    /// Draws an 8-bit grey image of `image_width` columns with its corner at `corner` (saved
    /// pixels). Each of its pixels becomes `zoom` saved pixels wide.
    ///
    /// # Panics
    /// Panics if the image does not fit into the canvas.
    pub(super) fn put_grey(
        &mut self,
        image: &[u8],
        image_width: usize,
        corner: (u32, u32),
        zoom: u32,
    ) {
        let stride = px(self.width) as usize;
        let (left, top, side) = (
            px(corner.0) as usize,
            px(corner.1) as usize,
            px(zoom) as usize,
        );
        for (row, line) in image.chunks_exact(image_width).enumerate() {
            for y in top + row * side..top + (row + 1) * side {
                for (column, &grey) in line.iter().enumerate() {
                    let start = (y * stride + left + column * side) * 3;
                    self.pixels[start..start + side * 3].fill(grey);
                }
            }
        }
    }

    /// Writes the picture as PNG. An existing picture is replaced atomically; if a link names it,
    /// the link stays.
    ///
    /// # Errors
    /// [`ReportError::Write`] names the file.
    pub(super) fn save(&self, path: &Path) -> Result<(), ReportError> {
        replace_picture(path, |aside| self.write(aside))
    }

    fn write(&self, path: &Path) -> io::Result<()> {
        if let Some(directory) = path.parent() {
            fs::create_dir_all(directory)?;
        }
        let mut encoder =
            png::Encoder::new(BufWriter::new(File::create(path)?), self.width, self.height);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        let mut writer = encoder.write_header()?;
        writer.write_image_data(&self.averaged())?;
        writer.finish()?;
        Ok(())
    }

    /// Returns the colour at a drawn pixel.
    #[cfg(test)]
    pub(super) fn colour_at(&self, (x, y): (i32, i32)) -> RGBColor {
        let start = ((y as u32 * px(self.width) + x as u32) * 3) as usize;
        RGBColor(
            self.pixels[start],
            self.pixels[start + 1],
            self.pixels[start + 2],
        )
    }

    /// Returns the picture at its final size, each pixel the mean of the drawn ones.
    pub(super) fn averaged(&self) -> Vec<u8> {
        let stride = px(self.width) as usize;
        let scale = SCALE as usize;
        let mut small = Vec::with_capacity((self.width * self.height * 3) as usize);
        for y in 0..self.height as usize {
            for x in 0..self.width as usize {
                for channel in 0..3 {
                    let sum: u32 = (0..scale * scale)
                        .map(|i| (y * scale + i / scale) * stride + x * scale + i % scale)
                        .map(|pixel| u32::from(self.pixels[pixel * 3 + channel]))
                        .sum();
                    small.push((sum / (SCALE * SCALE)) as u8);
                }
            }
        }
        small
    }
}

/// Writes the picture `path` with `write`, under another name until it is complete. An existing
/// picture is replaced atomically; if a link names it, the link stays.
///
/// # Errors
/// [`ReportError::Write`] names the file.
pub(super) fn replace_picture(
    path: &Path,
    write: impl FnOnce(&Path) -> io::Result<()>,
) -> Result<(), ReportError> {
    let aside = unfinished_picture(path);
    write(&aside)
        .and_then(|()| fs::rename(&aside, target(path)))
        .map_err(|source| {
            // A partial picture is useless. If there is none, removing it does nothing.
            let _ = fs::remove_file(&aside);
            ReportError::Write {
                path: path.to_owned(),
                source,
            }
        })
}

/// Returns the name under which the picture at `path` is written; links are followed.
pub fn unfinished_picture(path: &Path) -> PathBuf {
    target(path).with_extension(match path.extension() {
        Some(extension) if extension == "gif" => "gif.partial",
        _ => "png.partial",
    })
}

/// Returns where a picture goes: links are followed.
fn target(path: &Path) -> PathBuf {
    destination(path).unwrap_or_else(|| path.to_owned())
}

fn register_plot_font() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let registered = register_font(
            "sans-serif",
            FontStyle::Normal,
            epaint_default_fonts::UBUNTU_LIGHT,
        );
        assert!(
            registered.is_ok(),
            "the font compiled into the program is a valid one"
        );
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_saved_picture_shows_what_was_drawn() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("plots").join("half.png");
        let mut canvas = Canvas::new(10, 6);
        canvas
            .draw(|area| {
                area.draw(&Rectangle::new(
                    [(0, 0), (px(5) as i32, px(6) as i32)],
                    RED.filled(),
                ))?;
                Ok(())
            })
            .unwrap();
        canvas.save(&path).unwrap();

        let mut reader = png::Decoder::new(io::BufReader::new(File::open(&path).unwrap()))
            .read_info()
            .unwrap();
        let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
        let info = reader.next_frame(&mut pixels).unwrap();
        assert_eq!((info.width, info.height), (10, 6));
        assert_eq!(
            &pixels[4 * 3..6 * 3],
            &[255, 0, 0, 255, 255, 255],
            "red up to the middle, white from there"
        );
        assert!(!path.with_extension("png.partial").exists());
    }

    #[test]
    fn a_link_to_a_picture_stays_a_link() {
        let directory = tempfile::tempdir().unwrap();
        let at = |name: &str| directory.path().join(name);
        std::os::unix::fs::symlink("picture.png", at("link.png")).unwrap();
        for _ in ["the picture is new", "and replaced"] {
            Canvas::new(4, 4).save(&at("link.png")).unwrap();
            assert!(at("link.png").is_symlink() && at("picture.png").is_file());
        }
    }

    #[test]
    fn a_picture_that_cannot_be_written_is_named_and_leaves_nothing_behind() {
        let directory = tempfile::tempdir().unwrap();
        let taken = directory.path().join("taken.png");
        fs::create_dir(&taken).unwrap();
        let error = Canvas::new(4, 4).save(&taken).unwrap_err().to_string();
        assert!(error.contains("taken.png"), "{error}");
        assert_eq!(fs::read_dir(directory.path()).unwrap().count(), 1);
    }
}
