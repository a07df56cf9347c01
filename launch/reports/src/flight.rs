//! Moving picture of an episode: the drone in its corridor from above and from the side, what its
//! camera sees, and what the policy sees instead: the latent code, or the image that the decoder
//! makes of it.

use std::path::Path;
use std::{fs, io};

use gif::{DisposalMethod, Encoder, Frame, Repeat};
use plotters::prelude::*;
use skein_protocol::{IMAGE_HEIGHT, IMAGE_WIDTH};
use skein_simulator::course::{Course, DRONE_WIDTH_M, Wall};

use super::ReportError;
use super::canvas::{Area, Canvas, INK, REFERENCE, STRONG, font, px, replace_picture};
use super::obstacles::draw_obstacles;
use super::trajectories::{CORRIDOR, WALL, open_in_cut_m};

const WIDTH: u32 = 640;
const LEFT: u32 = 14;
const TITLE: u32 = 34;
const LABEL: u32 = 20;
/// Highest view of the corridor.
const HIGHEST: f32 = 120.0;
const ZOOM: u32 = 2;
const IMAGE: (u32, u32) = (IMAGE_WIDTH as u32 * ZOOM, IMAGE_HEIGHT as u32 * ZOOM);
/// Left edge of the latent code.
const CODE: u32 = LEFT + IMAGE.0 + 30;
/// Standard deviations of the code that a bar of full length shows.
const LONGEST_BAR: f32 = 3.0;
/// Time of a picture, hundredths of a second: five times as fast as flown, at the usual period.
const DELAY: u16 = 10;
/// Most bytes of a film.
const MOST_BYTES: usize = 3_000_000;
/// Time of the last picture.
const LAST_DELAY: u16 = 150;
/// Height of the drone's body, metres. Source: as for [`DRONE_WIDTH_M`].
const DRONE_HEIGHT_M: f32 = 0.29;

/// A latent code, to be shown.
#[derive(Debug, Clone, Copy)]
pub enum CodeView<'a> {
    /// Its numbers, drawn as bars.
    Numbers(&'a [f32]),
    /// The depth image that the decoder makes of it.
    Image(&'a [u8]),
}

impl CodeView<'_> {
    fn label(self) -> &'static str {
        match self {
            Self::Numbers(_) => "what the policy sees of it: the latent code",
            Self::Image(_) => "what the latent code keeps of it",
        }
    }
}

/// An observation of an episode.
#[derive(Debug, Clone, Copy)]
pub struct FlightStep<'a> {
    /// Position of the vehicle's centre, world frame, metres.
    pub position_m: [f32; 3],
    /// Depth image.
    pub depth: &'a [u8],
    /// The latent code, which the policy sees instead.
    pub code: CodeView<'a>,
    /// Walls passed so far.
    pub walls_passed: u8,
}

/// Draws an episode through `course` to `path`, as a GIF that repeats. `title` names it, `ending`
/// says how it ended. A film of more than 3 MB would be too much for a web page: a long one has
/// fewer pictures.
///
/// # Errors
/// Returns [`ReportError`] if it cannot be drawn or written.
pub fn draw_flight(
    course: &Course,
    steps: &[FlightStep<'_>],
    title: &str,
    ending: &str,
    path: &Path,
) -> Result<(), ReportError> {
    let stage = Stage::of(course);
    let Some(first) = steps.first() else {
        return Ok(());
    };
    let empty = stage.empty(first.code)?;
    let last = steps.len() - 1;
    let film = |stride: usize| {
        let mut film = Film::new(WIDTH, stage.height, stride);
        let ended = format!("{title}, {ending}");
        for number in (0..last).step_by(stride).chain([last]) {
            let mut canvas = empty.clone();
            let title = if number == last { &ended } else { title };
            stage.draw(&mut canvas, &steps[..=number], title)?;
            film.add(&canvas.averaged());
        }
        film.encode()
            .map_err(|error| ReportError::Draw(error.to_string()))
    };
    let mut stride = 1;
    let mut bytes = film(stride)?;
    // Fewer pictures, each shown longer.
    while bytes.len() > MOST_BYTES && stride < steps.len() {
        stride += 1;
        bytes = film(stride)?;
    }
    replace_picture(path, |aside| fs::write(aside, &bytes))
}

/// Places of all that is drawn. Saved pixels.
struct Stage<'a> {
    course: &'a Course,
    /// Per metre.
    scale: f32,
    above: u32,
    side: u32,
    image: u32,
    height: u32,
}

impl<'a> Stage<'a> {
    fn of(course: &'a Course) -> Self {
        let corridor = course.corridor();
        let along = (WIDTH - 2 * LEFT) as f32 / corridor.length_m;
        let scale = along.min(HIGHEST / corridor.width_m.max(corridor.height_m));
        let above = TITLE + LABEL;
        let side = above + (corridor.width_m * scale) as u32 + LABEL + 6;
        let image = side + (corridor.height_m * scale) as u32 + LABEL + 8;
        Self {
            course,
            scale,
            above,
            side,
            image,
            height: image + IMAGE.1 + 12,
        }
    }

    /// Returns the place of a point in the view from above (y up) or from the side (z up).
    fn at(&self, axis: usize, [x_m, y_m, z_m]: [f32; 3]) -> (i32, i32) {
        let corridor = self.course.corridor();
        let (top, down_m) = match axis {
            0 => (self.above, corridor.width_m / 2.0 - y_m),
            _ => (self.side, corridor.height_m - z_m),
        };
        let place = |from: u32, metres: f32| {
            ((from as f32 + metres * self.scale) * px(1) as f32).round() as i32
        };
        (place(LEFT, x_m), place(top, down_m))
    }

    /// Returns the corners of a rectangle between two points along and across.
    fn rectangle(&self, axis: usize, x_m: [f32; 2], across_m: [f32; 2]) -> [(i32, i32); 2] {
        let point = |x_m, across_m| match axis {
            0 => [x_m, across_m, 0.0],
            _ => [x_m, 0.0, across_m],
        };
        let [from_m, to_m] = across_m;
        [
            self.at(axis, point(x_m[0], to_m)),
            self.at(axis, point(x_m[1], from_m)),
        ]
    }

    fn range_m(&self, axis: usize) -> [f32; 2] {
        let corridor = self.course.corridor();
        match axis {
            0 => [-corridor.width_m / 2.0, corridor.width_m / 2.0],
            _ => [0.0, corridor.height_m],
        }
    }

    /// Returns the picture without a drone.
    fn empty(&self, code: CodeView<'_>) -> Result<Canvas, ReportError> {
        let mut canvas = Canvas::new(WIDTH, self.height);
        canvas.draw(|area| {
            let labels = [
                ("from above", LEFT, self.above),
                ("from the side", LEFT, self.side),
                (
                    "what the camera sees: brighter is farther",
                    LEFT,
                    self.image,
                ),
                (code.label(), CODE, self.image),
            ];
            for (label, x, y) in labels {
                area.draw_text(label, &font(13), drawn(x, y - LABEL + 2))?;
            }
            for axis in [0, 1] {
                self.draw_corridor(area, axis)?;
            }
            Ok(())
        })?;
        Ok(canvas)
    }

    fn draw_corridor(
        &self,
        area: &Area<'_>,
        axis: usize,
    ) -> Result<(), Box<dyn std::error::Error>> {
        let length_m = [0.0, self.course.corridor().length_m];
        let range_m = self.range_m(axis);
        let frame = self.rectangle(axis, length_m, range_m);
        area.draw(&Rectangle::new(frame, CORRIDOR.filled()))?;
        draw_obstacles(area, self.course, axis, |point| self.at(axis, point))?;
        for wall in self.course.walls() {
            self.draw_wall(area, axis, wall)?;
        }
        area.draw(&Rectangle::new(frame, WALL.stroke_width(px(1))))?;
        Ok(())
    }

    /// Draws a wall in a cut through the middle of its opening.
    fn draw_wall(
        &self,
        area: &Area<'_>,
        axis: usize,
        wall: &Wall,
    ) -> Result<(), Box<dyn std::error::Error>> {
        let x_m = [wall.x_m(), wall.x_m() + self.course.wall_thickness_m()];
        let [mut closed_from_m, end_m] = self.range_m(axis);
        let open = open_in_cut_m(wall, axis, wall.safe_point()[1 - axis]);
        for (from_m, to_m) in open.into_iter().chain([(end_m, end_m)]) {
            let part = self.rectangle(axis, x_m, [closed_from_m, from_m]);
            area.draw(&Rectangle::new(part, WALL.filled()))?;
            closed_from_m = to_m;
        }
        Ok(())
    }

    /// Draws the last of `steps`, with the way of the others.
    fn draw(
        &self,
        canvas: &mut Canvas,
        steps: &[FlightStep<'_>],
        title: &str,
    ) -> Result<(), ReportError> {
        let Some(now) = steps.last() else {
            return Ok(());
        };
        canvas.draw(|area| {
            let (passed, all) = (now.walls_passed, self.course.levels());
            let what = match self.course.is_world() {
                true => "stages",
                false => "walls",
            };
            let title = format!("{title}: {passed} of {all} {what} passed");
            area.draw_text(&title, &font(17), drawn(LEFT, 8))?;
            for axis in [0, 1] {
                let way = steps.iter().map(|step| self.at(axis, step.position_m));
                let way = way.collect::<Vec<_>>();
                area.draw(&PathElement::new(way, STRONG.stroke_width(px(1))))?;
                self.draw_drone(area, axis, now.position_m)?;
            }
            match now.code {
                CodeView::Numbers(latent) => self.draw_code(area, latent),
                CodeView::Image(_) => Ok(()),
            }
        })?;
        canvas.put_grey(now.depth, IMAGE_WIDTH, (LEFT, self.image), ZOOM);
        if let CodeView::Image(image) = now.code {
            canvas.put_grey(image, IMAGE_WIDTH, (CODE, self.image), ZOOM);
        }
        Ok(())
    }

    fn draw_drone(
        &self,
        area: &Area<'_>,
        axis: usize,
        [x_m, y_m, z_m]: [f32; 3],
    ) -> Result<(), Box<dyn std::error::Error>> {
        let half_m = DRONE_WIDTH_M / 2.0;
        let (across_m, half_across_m) = match axis {
            0 => (y_m, half_m),
            _ => (z_m, DRONE_HEIGHT_M / 2.0),
        };
        let body = self.rectangle(
            axis,
            [x_m - half_m, x_m + half_m],
            [across_m - half_across_m, across_m + half_across_m],
        );
        area.draw(&Rectangle::new(body, REFERENCE.filled()))?;
        Ok(())
    }

    /// Draws a bar for each number of the code, up or down from the middle.
    fn draw_code(&self, area: &Area<'_>, latent: &[f32]) -> Result<(), Box<dyn std::error::Error>> {
        let room = px(WIDTH - LEFT - CODE) as f32;
        let step = room / latent.len().max(1) as f32;
        let half = px(IMAGE.1) as f32 / 2.0;
        let (left, middle) = (px(CODE) as f32, px(self.image) as f32 + half);
        for (number, value) in latent.iter().enumerate() {
            let x = left + number as f32 * step;
            let length = (value / LONGEST_BAR).clamp(-1.0, 1.0) * half;
            let ends = [
                (x.round() as i32, middle.round() as i32),
                (
                    (x + step * 0.7).round() as i32,
                    (middle - length).round() as i32,
                ),
            ];
            area.draw(&Rectangle::new(ends, STRONG.filled()))?;
        }
        let ends = [
            (left as i32, middle as i32),
            ((left + room) as i32, middle as i32),
        ];
        area.draw(&PathElement::new(ends, INK.stroke_width(px(1))))?;
        Ok(())
    }
}

fn drawn(x: u32, y: u32) -> (i32, i32) {
    (px(x) as i32, px(y) as i32)
}

/// Pictures with the colours of one table. Each holds only what differs from the one before.
struct Film {
    width: u32,
    height: u32,
    /// Steps from one picture to the next.
    stride: usize,
    /// Colour numbers of the last picture.
    last: Vec<u8>,
    frames: Vec<Frame<'static>>,
}

/// Greys of the table, from black to white; the colours of a cube follow.
const GREYS: usize = 100;
/// Levels of red, green and blue in the cube.
const LEVELS: usize = 5;
/// Number of the colour that leaves a pixel as it is.
const SAME: u8 = 255;

impl Film {
    fn new(width: u32, height: u32, stride: usize) -> Self {
        Self {
            width,
            height,
            stride,
            last: Vec::new(),
            frames: Vec::new(),
        }
    }

    /// Adds a picture, `rgb` row by row.
    fn add(&mut self, rgb: &[u8]) {
        let now: Vec<u8> = rgb.as_chunks::<3>().0.iter().map(number_of).collect();
        let width = self.width as usize;
        let differs = |place: &usize| self.last.get(*place) != Some(&now[*place]);
        let places = || (0..now.len()).filter(differs);
        let columns = || places().map(|place| place % width);
        let (left, right) = (columns().min().unwrap_or(0), columns().max().unwrap_or(0));
        let top = places().next().unwrap_or(0) / width;
        let bottom = places().next_back().unwrap_or(0) / width;
        let rows = (top..=bottom).flat_map(|row| (left..=right).map(move |at| row * width + at));
        let number = |place: usize| match differs(&place) {
            true => now[place],
            false => SAME,
        };
        self.frames.push(Frame {
            delay: DELAY.saturating_mul(self.stride as u16),
            dispose: DisposalMethod::Keep,
            transparent: Some(SAME),
            left: left as u16,
            top: top as u16,
            width: (right - left + 1) as u16,
            height: (bottom - top + 1) as u16,
            buffer: rows.map(number).collect::<Vec<_>>().into(),
            ..Frame::default()
        });
        self.last = now;
    }

    /// Returns the film as the bytes of a file.
    fn encode(mut self) -> io::Result<Vec<u8>> {
        if let Some(last) = self.frames.last_mut() {
            last.delay = LAST_DELAY;
        }
        let mut bytes = Vec::new();
        let (width, height) = (self.width as u16, self.height as u16);
        let mut encoder =
            Encoder::new(&mut bytes, width, height, &colours()).map_err(io::Error::other)?;
        encoder
            .set_repeat(Repeat::Infinite)
            .map_err(io::Error::other)?;
        for frame in &self.frames {
            encoder.write_frame(frame).map_err(io::Error::other)?;
        }
        drop(encoder);
        Ok(bytes)
    }
}

/// Returns the number of the nearest colour of the table: a grey for what has hardly a colour.
fn number_of(&[red, green, blue]: &[u8; 3]) -> u8 {
    let channels = [red, green, blue].map(usize::from);
    let (least, most) = (red.min(green).min(blue), red.max(green).max(blue));
    if most - least <= 16 {
        let sum: usize = channels.iter().sum();
        return ((sum * (GREYS - 1) + 382) / 765) as u8;
    }
    let level = |channel: usize| (channel * (LEVELS - 1) + 127) / 255;
    let [red, green, blue] = channels.map(level);
    (GREYS + (red * LEVELS + green) * LEVELS + blue) as u8
}

/// Returns the table, three bytes a colour.
fn colours() -> Vec<u8> {
    let greys = (0..GREYS).flat_map(|number| [(number * 255 / (GREYS - 1)) as u8; 3]);
    let level = |level: usize| (level * 255 / (LEVELS - 1)) as u8;
    let cube = (0..LEVELS.pow(3)).flat_map(|number| {
        let [red, green, blue] = [number / (LEVELS * LEVELS), number / LEVELS, number];
        [red, green, blue].map(|digit| level(digit % LEVELS))
    });
    let mut table: Vec<u8> = greys.chain(cube).collect();
    table.resize(256 * 3, 0);
    table
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::failures::tests::course;

    #[test]
    fn a_film_has_a_picture_a_step_and_shows_the_drone_move() {
        let (first, second) = (vec![10; IMAGE_WIDTH * IMAGE_HEIGHT], vec![200; 9216]);
        let step = |x_m: f32, depth| FlightStep {
            position_m: [x_m, 0.0, 3.5],
            depth,
            code: CodeView::Numbers(&[1.0, -2.0, 0.5]),
            walls_passed: 0,
        };
        let steps = [step(2.0, &first), step(6.0, &second)];
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("flight.gif");
        draw_flight(&course(), &steps, "two walls", "hits a wall", &path).unwrap();

        let mut options = gif::DecodeOptions::new();
        options.set_color_output(gif::ColorOutput::Indexed);
        let mut film = options.read_info(fs::File::open(&path).unwrap()).unwrap();
        assert_eq!(film.width(), WIDTH as u16);
        let whole = film.read_next_frame().unwrap().unwrap().clone();
        assert_eq!((whole.left, whole.width), (0, WIDTH as u16));
        let grey = number_of(&[10; 3]);
        assert!(
            whole
                .buffer
                .iter()
                .filter(|&&number| number == grey)
                .count()
                > 30_000
        );
        let change = film.read_next_frame().unwrap().unwrap().clone();
        let grey = number_of(&[200; 3]);
        assert!(
            change
                .buffer
                .iter()
                .filter(|&&number| number == grey)
                .count()
                > 30_000
        );
        assert!(change.buffer.contains(&SAME), "most of it stays");
        assert!(film.read_next_frame().unwrap().is_none());
    }

    #[test]
    fn a_long_film_has_fewer_pictures_and_stays_small() {
        // Noise, which no picture shares with the next.
        let image = |step: u32| -> Vec<u8> {
            let noise = |pixel: u32| (pixel * 7919 + step * 104_729).wrapping_mul(2_654_435_761);
            (0..9216).map(|pixel| (noise(pixel) >> 24) as u8).collect()
        };
        let images: Vec<_> = (0..220).map(image).collect();
        let steps: Vec<_> = images
            .iter()
            .map(|image| FlightStep {
                position_m: [2.0, 0.0, 3.5],
                depth: image,
                code: CodeView::Image(image),
                walls_passed: 0,
            })
            .collect();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("flight.gif");
        draw_flight(&course(), &steps, "noise", "times out", &path).unwrap();
        assert!(fs::metadata(&path).unwrap().len() <= MOST_BYTES as u64);
        let options = gif::DecodeOptions::new();
        let mut film = options.read_info(fs::File::open(&path).unwrap()).unwrap();
        let pictures = std::iter::from_fn(|| film.read_next_frame().unwrap().map(drop)).count();
        assert!(pictures < steps.len() / 2 + 2, "{pictures}");
    }

    #[test]
    fn the_table_has_every_colour_within_a_step_of_the_cube() {
        let table = colours();
        for colour in [
            [0, 0, 0],
            [255, 255, 255],
            [0x1f, 0x5f, 0xa8],
            [0xc8, 0x55, 0x1b],
        ] {
            let place = usize::from(number_of(&colour)) * 3;
            for (channel, &value) in colour.iter().enumerate() {
                let found = table[place + channel];
                assert!(found.abs_diff(value) <= 32, "{colour:?}: {found}");
            }
        }
    }
}
