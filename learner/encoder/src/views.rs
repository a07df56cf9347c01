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

/// Numbers of an opening: distance, offset left and up, clearance.
pub const OPENING: usize = 4;
/// Numbers known of a view: those of two openings.
pub const KNOWN: usize = 2 * OPENING;

/// Zero and unit of the numbers of an opening, metres: about their means and standard deviations.
const SCALES_M: [(f32, f32); OPENING] = [(5.0, 3.0), (0.0, 1.0), (0.0, 1.0), (0.9, 0.15)];

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

/// Returns the numbers of an opening, metres.
pub fn numbers_m(opening: &OpeningAhead) -> [f32; OPENING] {
    let [left, up] = opening.offset_m;
    [opening.distance_m, left, up, opening.clearance_m]
}

/// Converts a scaled number of an opening back to metres.
pub fn in_metres(place: usize, scaled: f32) -> f32 {
    let (zero, unit) = SCALES_M[place];
    zero + unit * scaled
}

fn scaled(opening: Option<OpeningAhead>) -> [f32; OPENING] {
    let numbers = opening.map(|opening| numbers_m(&opening));
    std::array::from_fn(|place| {
        let (zero, unit) = SCALES_M[place];
        numbers.map_or(f32::NAN, |numbers| (numbers[place] - zero) / unit)
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
                for (place, number) in numbers_m(opening).into_iter().enumerate() {
                    assert!((in_metres(place, known[place]) - number).abs() < 1e-5);
                }
            }
        }
        assert!(in_sight > 60, "{in_sight} of 200");
    }
}
