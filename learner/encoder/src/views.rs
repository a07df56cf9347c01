//! Views: depth images from random poses in random courses, and the openings in sight.

use std::sync::Arc;

use anyhow::{Context, Result};
use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use skein_protocol::IMAGE_PIXELS;
use skein_protocol::config::Config;
use skein_protocol::seeds::{Purpose, derive};
use skein_simulator::course::Course;
use skein_simulator::simulator::{OpeningAhead, SimulatorSettings};
use skein_simulator::viewpoints::{OpeningsInSight, Viewpoints};

/// Views of one course; the next ones are of another.
const VIEWS_PER_COURSE: usize = 4;

/// Numbers of an opening: logarithm of its distance, direction left and up, logarithm of its
/// clearance. An error of direction is the same distance in the image wherever the opening is.
pub const OPENING: usize = 4;
/// Numbers known of a view: those of two openings.
pub const KNOWN: usize = 2 * OPENING;

/// Zero and unit of these numbers: about their means and standard deviations.
const SCALES: [(f32, f32); OPENING] = [(1.4, 0.7), (0.0, 0.3), (0.0, 0.2), (-0.1, 0.15)];

/// Depth images and what is known of them.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Views {
    /// Depth images as the camera shows them, `[n, 72, 128]`.
    pub images: Vec<u8>,
    /// The same without the camera's errors.
    pub clean: Vec<u8>,
    /// Openings in sight, scaled to about one, `[n, KNOWN]`; NaN for one that is not in sight.
    pub known: Vec<f32>,
    /// Openings in sight, `[n]`.
    pub openings: Vec<OpeningsInSight>,
}

/// Returns the simulator's settings, which views are drawn with.
///
/// # Errors
/// Names the key at fault.
pub fn simulator_settings(config: &Config) -> Result<SimulatorSettings> {
    let settings: SimulatorSettings = config.simulator.clone().try_into().context("[simulator]")?;
    // Finds what no course can be drawn from, and what no camera can be built of.
    let course = Course::generate(0, &settings.generator).context("[simulator.generator]")?;
    Viewpoints::new(Arc::new(course), &settings).context("[simulator]")?;
    Ok(settings)
}

impl Views {
    /// Draws `count` views. They depend on `seed`, `purpose` and `index` alone.
    ///
    /// # Errors
    /// If no course can be drawn.
    pub fn draw(
        settings: &SimulatorSettings,
        (seed, purpose, index): (u64, Purpose, u64),
        count: usize,
    ) -> Result<Self> {
        let mut views = Self::default();
        let courses = count.div_ceil(VIEWS_PER_COURSE) as u64;
        for number in 0..courses {
            let seed = derive(seed, purpose, index * courses + number);
            let course = Course::generate(seed, &settings.generator)?;
            let mut points = Viewpoints::new(Arc::new(course), settings)?;
            let mut rng = Pcg64Mcg::seed_from_u64(seed);
            let (mut image, mut clean) = ([0; IMAGE_PIXELS], [0; IMAGE_PIXELS]);
            for _ in 0..VIEWS_PER_COURSE.min(count - views.openings.len()) {
                let openings = points.draw(&mut rng, &mut image, &mut clean);
                views.images.extend_from_slice(&image);
                views.clean.extend_from_slice(&clean);
                views.known.extend(openings.into_iter().flat_map(scaled));
                views.openings.push(openings);
            }
        }
        Ok(views)
    }
}

/// An opening as found from a code.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FoundOpening {
    /// Distance forward to the wall, metres.
    pub distance_m: f32,
    /// Offset left and up per metre of distance.
    pub direction: [f32; 2],
    /// Radius of the free space, metres.
    pub clearance_m: f32,
}

impl FoundOpening {
    /// Reads an opening from scaled numbers, as many as [`OPENING`].
    pub fn of(scaled: &[f32]) -> Self {
        let number = |place: usize| {
            let (zero, unit) = SCALES[place];
            zero + unit * scaled[place]
        };
        Self {
            distance_m: number(0).exp(),
            direction: [number(1), number(2)],
            clearance_m: number(3).exp(),
        }
    }
}

fn scaled(opening: Option<OpeningAhead>) -> [f32; OPENING] {
    let Some(opening) = opening else {
        return [f32::NAN; OPENING];
    };
    let [left, up] = opening
        .offset_m
        .map(|offset_m| offset_m / opening.distance_m);
    let numbers = [opening.distance_m.ln(), left, up, opening.clearance_m.ln()];
    std::array::from_fn(|place| {
        let (zero, unit) = SCALES[place];
        (numbers[place] - zero) / unit
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn views_depend_on_seed_purpose_and_index_alone() {
        let settings = SimulatorSettings::default();
        let draw = |which| Views::draw(&settings, which, 6).unwrap();
        let views = draw((1, Purpose::EncoderViews, 3));
        assert_eq!(views.images, draw((1, Purpose::EncoderViews, 3)).images);
        for other in [
            (2, Purpose::EncoderViews, 3),
            (1, Purpose::MeasuredViews, 3),
            (1, Purpose::EncoderViews, 4),
        ] {
            assert_ne!(views.images, draw(other).images, "{other:?}");
        }
        assert_eq!(views.images.len(), 6 * IMAGE_PIXELS);
        assert_eq!(views.known.len(), 6 * KNOWN);
    }

    #[test]
    fn known_numbers_are_those_of_the_openings_in_sight() {
        let settings = SimulatorSettings::default();
        let views = Views::draw(&settings, (1, Purpose::EncoderViews, 0), 100).unwrap();
        let mut in_sight = 0;
        for (openings, known) in views.openings.iter().zip(views.known.chunks(KNOWN)) {
            for (opening, known) in openings.iter().zip(known.chunks(OPENING)) {
                let Some(opening) = opening else {
                    assert!(known.iter().all(|number| number.is_nan()));
                    continue;
                };
                in_sight += 1;
                let found = FoundOpening::of(known);
                assert!((found.distance_m - opening.distance_m).abs() < 1e-4);
                assert!((found.clearance_m - opening.clearance_m).abs() < 1e-4);
                for (direction, offset_m) in found.direction.iter().zip(opening.offset_m) {
                    assert!((direction * opening.distance_m - offset_m).abs() < 1e-4);
                }
            }
        }
        assert!(in_sight > 60, "{in_sight} of 200");
    }
}
