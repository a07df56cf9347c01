//! Measures what an encoder's code says about the openings in sight, without training a policy.
//!
//! A small network, a *probe*, is trained to find the openings from the codes of some views. Its
//! errors on views of other courses are the measurement. What it cannot find, a policy can hardly
//! fly by.

use std::fmt;

use anyhow::Result;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use skein_inference::Encoder;
use skein_kernels::{Isa, Team};
use skein_learner::networks::native::{Dense, Learned, output, output_mut};
use skein_learner::networks::{Layout, LinearLayer};
use skein_protocol::IMAGE_PIXELS;
use skein_protocol::config::Config;
use skein_protocol::encoder_file::TrainedEncoder;
use skein_protocol::ids::PolicyVersion;
use skein_protocol::seeds::{Purpose, derive};
use skein_protocol::snapshot::{Snapshot, SnapshotLayout};
use skein_simulator::course::GeneratedShape;
use skein_simulator::simulator::{OpeningAhead, SimulatorSettings};

use crate::views::{FoundOpening, KNOWN, OPENING, Views};

/// Views that the probe is trained on, and views of each row of the table.
const TRAINING_VIEWS: usize = 16_000;
const VIEWS: usize = 4_000;
/// The probe's hidden layers, and its training.
const WIDTH: i64 = 128;
const STEPS: u64 = 5_000;
const BATCH: usize = 256;
const LEARNING_RATE: f64 = 1e-3;
/// Share of the range of `simulator.generator.clearance_m` that the row of narrow openings has.
const NARROWEST: f32 = 0.1;
/// Distances to the next wall, metres; a drone steers by the nearer ones.
const BANDS_M: [[f32; 2]; 4] = [[0.6, 2.0], [2.0, 4.0], [4.0, 8.0], [8.0, 16.0]];

/// Errors of a probe, by kind of view.
#[derive(Debug)]
pub struct Measurement {
    rows: Vec<(&'static str, RowErrors)>,
}

/// Root mean square errors of one kind of view, metres.
#[derive(Debug)]
struct RowErrors {
    /// Offset of the next opening at its true distance, per axis, by distance.
    offset_m: [f64; 4],
    /// Distance of the next wall, within the farthest band.
    distance_m: f64,
    /// Clearance of the next opening, likewise.
    clearance_m: f64,
    /// Offset of the opening behind the next one, per axis.
    after_offset_m: f64,
}

impl Measurement {
    /// Measures `encoder` on courses like those of `settings`.
    ///
    /// # Errors
    /// If no course can be drawn.
    pub fn of(
        encoder: &TrainedEncoder,
        config: &Config,
        settings: &SimulatorSettings,
    ) -> Result<Self> {
        let mut config = config.clone();
        config.vae.latent = encoder.latent;
        let snapshot = Snapshot {
            version: PolicyVersion(0),
            values: encoder.values.clone(),
        };
        let network = skein_inference::encoder(&snapshot, &SnapshotLayout::of(&config));
        let mut team = Team::new(config.run.learner_threads);
        let seed = config.run.seed;
        let views = |settings: &SimulatorSettings, index, count| {
            Views::draw(settings, (seed, Purpose::MeasuredViews, index), count)
        };
        let training = views(settings, 0, TRAINING_VIEWS)?;
        let codes = codes(&network, encoder.latent, &mut team, &training.images);
        let mut probe = Probe::train(team, encoder.latent, seed, &codes, &training.known);
        let mut rows = Vec::new();
        for (name, settings) in kinds(settings) {
            // Other courses than the probe's.
            let views = views(&settings, 1 + TRAINING_VIEWS as u64, VIEWS)?;
            let codes = self::codes(&network, encoder.latent, &mut probe.team, &views.images);
            rows.push((name, probe.errors(&codes, &views)));
        }
        Ok(Self { rows })
    }
}

/// Returns the kinds of views in the table.
fn kinds(settings: &SimulatorSettings) -> [(&'static str, SimulatorSettings); 4] {
    let of = |change: &dyn Fn(&mut SimulatorSettings)| {
        let mut settings = settings.clone();
        settings.disturbances.share = 0.0;
        change(&mut settings);
        settings
    };
    let [least, most] = settings.generator.clearance_m;
    [
        ("as trained, calm", of(&|_| {})),
        (
            "narrowest openings",
            of(&|settings| {
                settings.generator.clearance_m[1] = least + NARROWEST * (most - least);
            }),
        ),
        (
            "shapes held out",
            of(&|settings| {
                settings.generator.shapes =
                    [&GeneratedShape::HELD_OUT[..], &GeneratedShape::UNTRIED].concat();
            }),
        ),
        (
            "disturbed",
            of(&|settings| settings.disturbances.share = 1.0),
        ),
    ]
}

/// Returns the code of each image, `[n, latent]`.
fn codes(encoder: &Encoder, latent: usize, team: &mut Team, images: &[u8]) -> Vec<f32> {
    const CHUNK: usize = 64 * IMAGE_PIXELS;
    let chunks = images.chunks(CHUNK);
    let codes = chunks.flat_map(|chunk| encoder.encode_all(team, chunk));
    codes.flat_map(|code| code[..latent].to_vec()).collect()
}

/// Differences between an opening found and the true one, metres.
type Differences = fn(&FoundOpening, &OpeningAhead) -> [f32; 2];

/// A network from code to [`Views::known`].
struct Probe {
    team: Team,
    dense: Dense,
    learned: Learned,
    latent: usize,
}

impl Probe {
    /// Trains a probe on codes, `[n, latent]`, and what is known of their views, `[n, KNOWN]`.
    fn train(team: Team, latent: usize, seed: u64, codes: &[f32], known: &[f32]) -> Self {
        let isa = Isa::best();
        let mut layout = Layout::default();
        let sizes = [
            (latent as i64, WIDTH),
            (WIDTH, WIDTH),
            (WIDTH, KNOWN as i64),
        ];
        for (layer, (inputs, outputs)) in sizes.into_iter().enumerate() {
            let _ = LinearLayer::describe(&mut layout, &format!("layer{layer}"), inputs, outputs);
        }
        let seed = derive(seed, Purpose::MeasuredViews, 0);
        let mut probe = Self {
            team,
            dense: Dense::new(isa, layout.tensors()),
            learned: Learned::new(layout.initial_values(seed), LEARNING_RATE),
            latent,
        };
        let rows = known.len() / KNOWN;
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let [mut activations, mut grad] = [0; 2].map(|_| probe.dense.allocate(BATCH));
        let (mut input, mut wanted) = (Vec::new(), Vec::new());
        for step in 0..STEPS {
            input.clear();
            wanted.clear();
            for _ in 0..BATCH {
                let row = rng.random_range(0..rows);
                input.extend_from_slice(&codes[row * latent..][..latent]);
                wanted.extend_from_slice(&known[row * KNOWN..][..KNOWN]);
            }
            let Self {
                team,
                dense,
                learned,
                ..
            } = &mut probe;
            dense.forward(team, &learned.values, &input, &mut activations);
            let pairs = output(&activations).iter().zip(&wanted);
            for (grad, (found, wanted)) in output_mut(&mut grad).iter_mut().zip(pairs) {
                let error = if wanted.is_nan() { 0.0 } else { found - wanted };
                *grad = error / BATCH as f32;
            }
            dense.backward(team, &learned.values, &activations, &mut grad);
            dense.gradient(team, &input, &activations, &grad, &mut learned.gradient);
            learned.set_learning_rate(LEARNING_RATE * (1.0 - step as f64 / STEPS as f64));
            learned.step(team, isa);
        }
        probe
    }

    fn errors(&mut self, codes: &[f32], views: &Views) -> RowErrors {
        let mut found = vec![0.0; codes.len() / self.latent * KNOWN];
        let values = &self.learned.values;
        self.dense
            .forward_through(&mut self.team, values, codes, &mut found);
        // Root mean square of some differences between the openings found and true.
        let error = |which: usize, [least_m, most_m]: [f32; 2], differences: Differences| {
            let mut squares = Vec::new();
            for (openings, found) in views.openings.iter().zip(found.chunks(KNOWN)) {
                let is_in_band =
                    |opening: &&OpeningAhead| (least_m..most_m).contains(&opening.distance_m);
                if let Some(opening) = openings[which].as_ref().filter(is_in_band) {
                    let found = FoundOpening::of(&found[which * OPENING..]);
                    let differences = differences(&found, opening);
                    squares.extend(differences.map(|error| f64::from(error).powi(2)));
                }
            }
            (squares.iter().sum::<f64>() / squares.len() as f64).sqrt()
        };
        let offset: Differences = |found, opening| {
            [0, 1].map(|axis| found.direction[axis] * opening.distance_m - opening.offset_m[axis])
        };
        let distance: Differences = |found, opening| [found.distance_m - opening.distance_m; 2];
        let clearance: Differences = |found, opening| [found.clearance_m - opening.clearance_m; 2];
        let all = [BANDS_M[0][0], BANDS_M[2][1]];
        RowErrors {
            offset_m: BANDS_M.map(|band| error(0, band, offset)),
            distance_m: error(0, all, distance),
            clearance_m: error(0, all, clearance),
            after_offset_m: error(1, [0.0, f32::INFINITY], offset),
        }
    }
}

impl fmt::Display for Measurement {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "Root mean square errors of openings found from the code, m:\n{:20} {:>34} {:>8} {:>9} \
             {:>14}",
            "", "offset at 0.6–2, 2–4, 4–8, 8–16 m", "distance", "clearance", "offset of next"
        )?;
        let rows = self.rows.iter().map(|(name, errors)| {
            let offsets = errors.offset_m.map(|error| format!("{error:7.3}"));
            format!(
                "{name:20} {:>34} {:8.3} {:9.3} {:14.3}",
                offsets.join(" "),
                errors.distance_m,
                errors.clearance_m,
                errors.after_offset_m
            )
        });
        f.write_str(&rows.collect::<Vec<_>>().join("\n"))
    }
}
