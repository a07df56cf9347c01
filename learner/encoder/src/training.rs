//! The training loop: draw views, make a step, and now and then save all that a step changes.

use std::fs;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context, Result, ensure};
use skein_learner::noise::Noise;
use skein_learner::state::Stateful;
use skein_learner::vae::{NativeVae, Targets};
use skein_protocol::IMAGE_PIXELS;
use skein_protocol::config::{Config, Engine};
use skein_protocol::decoder_file::TrainedDecoder;
use skein_protocol::encoder_file::TrainedEncoder;
use skein_protocol::seeds::{Purpose, derive};
use skein_run::failure::with_causes;
use skein_run::{durable, note};
use skein_simulator::simulator::SimulatorSettings;

use crate::arguments::EncoderFiles;
use crate::checkpoint::Checkpoint;
use crate::curve::{self, COLUMNS, CurvePoint, STEPS_PER_POINT};
use crate::progress::Progress;
use crate::views::{KNOWN, Views};

/// Points of the curve between two checkpoints: half a minute.
const POINTS_PER_CHECKPOINT: usize = 10;
/// Views drawn beside their reconstructions.
const PICTURES: usize = 12;

/// A training under way.
pub struct Training<'a> {
    config: &'a Config,
    settings: &'a SimulatorSettings,
    files: EncoderFiles,
    vae: NativeVae,
    /// The encoder that is there already: only its decoder is trained.
    frozen: Option<TrainedEncoder>,
    curve: Vec<CurvePoint>,
}

/// End of a training's loop.
#[derive(Debug, PartialEq, Eq)]
pub enum Ending {
    /// All steps are done.
    Completed,
    /// Stopped after so many steps, all saved.
    Interrupted(u64),
}

impl<'a> Training<'a> {
    /// Starts a training, or resumes it from its checkpoint. With a `frozen` encoder, only its
    /// decoder is trained.
    ///
    /// # Errors
    /// Names the key or file at fault, and the remedy.
    pub fn begin(
        config: &'a Config,
        settings: &'a SimulatorSettings,
        files: EncoderFiles,
        frozen: Option<TrainedEncoder>,
    ) -> Result<Self> {
        ensure!(
            config.vae.engine(&config.run) == Engine::Native,
            "an encoder is trained with the native engine alone: leave run.engine, run.device and \
             vae.decoder out"
        );
        for file in [&files.encoder, &files.decoder] {
            let is_given = frozen.is_some() && file == &files.encoder;
            ensure!(
                is_given || !file.exists(),
                "{} is there already: remove it, or give another --output",
                file.display()
            );
        }
        let mut training = Self {
            vae: new_vae(config, frozen.as_ref())?,
            frozen,
            config,
            settings,
            files,
            curve: Vec::new(),
        };
        if let Some(saved) = Checkpoint::load(&training.files.checkpoint, config)? {
            training.vae.load_named(&saved.tensors)?;
            if let Some(encoder) = &training.frozen {
                ensure!(
                    training.encoder() == *encoder,
                    "{} belongs to another encoder: remove it",
                    training.files.checkpoint.display()
                );
            }
            training.curve = saved.curve;
            note!(
                "skein encoder: resuming after step {}",
                training.vae.updates()
            );
        } else {
            // Shows before the first step whether its folder can be written.
            training.save()?;
        }
        Ok(training)
    }

    /// Makes all steps that are left, or stops once `stop` is set.
    ///
    /// # Errors
    /// If a number is no longer finite, or a file cannot be written.
    pub fn train(&mut self, stop: &AtomicBool) -> Result<Ending> {
        let steps = self.config.encoder.steps;
        let mut progress = Progress::start(self.vae.updates(), steps);
        while self.vae.updates() < steps {
            let point = self.next_point(stop)?;
            progress.show(&point);
            self.curve.push(point);
            if stop.load(Ordering::Relaxed) {
                progress.finish();
                self.save()?;
                return Ok(Ending::Interrupted(self.vae.updates()));
            }
            if self.curve.len().is_multiple_of(POINTS_PER_CHECKPOINT)
                && let Err(error) = self.save()
            {
                note!(
                    "skein encoder: not saved, goes on: {}",
                    with_causes(error.as_ref())
                );
            }
        }
        progress.finish();
        Ok(Ending::Completed)
    }

    /// Makes the steps of a point of the curve, also those that are left once `stop` is set.
    fn next_point(&mut self, stop: &AtomicBool) -> Result<CurvePoint> {
        let mut announced = false;
        let first = self.vae.updates();
        let end = self.config.encoder.steps.min(first + STEPS_PER_POINT);
        let mut sums = [0.0; COLUMNS];
        for step in first..end {
            let parts = self.step(step)?;
            sums.iter_mut()
                .zip(parts)
                .for_each(|(sum, part)| *sum += part);
            if stop.load(Ordering::Relaxed) && !announced {
                note!("skein encoder: stops after step {end} and saves; again to stop at once");
                announced = true;
            }
        }
        let mut point = sums.map(|sum| sum / (end - first) as f64);
        point[0] = end as f64;
        Ok(point)
    }

    /// Makes the step after `step` steps. Returns a point of the curve.
    fn step(&mut self, step: u64) -> Result<CurvePoint> {
        let (config, seed) = (self.config, self.config.run.seed);
        let which = (seed, Purpose::EncoderViews, step);
        let views = Views::draw(self.settings, which, config.vae.batch_size)?;
        let mut noise = Noise::new(derive(seed, Purpose::EncoderNoise, step));
        self.vae.set_learning_rate(learning_rate(config, step));
        let targets = match self.frozen {
            None => Targets {
                clean: Some(&views.clean[..reproduced(config) * IMAGE_PIXELS]),
                geometry: &views.known,
            },
            Some(_) => Targets {
                clean: Some(&views.clean),
                geometry: &[],
            },
        };
        let updated = self
            .vae
            .update_supervised(&views.images, targets, &mut noise);
        let (metrics, geometry) = updated?;
        let parts = [
            0.0,
            metrics.loss,
            metrics.pixel_error * IMAGE_PIXELS as f32,
            metrics.divergence,
            geometry,
        ];
        Ok(parts.map(f64::from))
    }

    fn save(&mut self) -> Result<()> {
        let checkpoint = Checkpoint {
            tensors: self.vae.named_tensors(),
            curve: self.curve.clone(),
        };
        checkpoint.save(&self.files.checkpoint, self.config)
    }

    /// Returns the encoder as it is now.
    fn encoder(&self) -> TrainedEncoder {
        let mut values = vec![0.0; self.vae.published_len()];
        self.vae.publish(&mut values);
        TrainedEncoder {
            values,
            latent: self.config.vae.latent,
        }
    }

    /// Writes what was trained, encoder and decoder, and what shows how; removes the checkpoint.
    /// Returns the encoder. Tables and pictures that cannot be written are named and left out.
    ///
    /// # Errors
    /// Names the file that cannot be written, or the checkpoint.
    pub fn finish(mut self) -> Result<TrainedEncoder> {
        let encoder = self.encoder();
        let decoder = TrainedDecoder {
            values: self.vae.decoder_values(),
            latent: encoder.latent,
            encoder_sha256: encoder.sha256(),
        };
        let write = |path: &Path, bytes: &[u8]| {
            durable::replace(path, bytes).with_context(|| path.display().to_string())
        };
        write(&self.files.decoder, &decoder.to_file())?;
        if self.frozen.is_none() {
            let file = encoder.to_file(self.config, self.vae.updates());
            write(&self.files.encoder, &file)?;
        }
        if let Err(error) = self.describe() {
            note!(
                "skein encoder: the networks are written; left out: {}",
                with_causes(error.as_ref())
            );
        }
        if self.files.checkpoint.exists() {
            fs::remove_file(&self.files.checkpoint)
                .with_context(|| self.files.checkpoint.display().to_string())?;
        }
        Ok(encoder)
    }

    /// Writes the curve as a table and a picture, and draws reconstructions.
    fn describe(&mut self) -> Result<()> {
        curve::write(&self.curve, &self.files.curve)?;
        curve::draw(&self.curve, &self.files.curve_picture)?;
        let which = (self.config.run.seed, Purpose::MeasuredViews, 0);
        let views = Views::draw(self.settings, which, PICTURES)?;
        let seen = self.vae.reconstruct(&views.images);
        let seen: Vec<u8> = seen
            .into_iter()
            .map(|depth| (depth * 255.0).round_ties_even() as u8)
            .collect();
        skein_reports::draw_reconstructions(&views.images, &seen, &self.files.reconstructions)?;
        Ok(())
    }
}

fn new_vae(config: &Config, frozen: Option<&TrainedEncoder>) -> Result<NativeVae> {
    let (run, weight) = (&config.run, config.encoder.geometry_weight);
    let Some(encoder) = frozen else {
        let head = (KNOWN, weight);
        let vae = NativeVae::supervised(&config.vae, run.seed, run.learner_threads, head);
        return Ok(vae);
    };
    ensure!(
        encoder.latent == config.vae.latent,
        "the encoder's codes have {0} numbers: --set vae.latent={0}",
        encoder.latent
    );
    let mut vae = NativeVae::new(&config.vae, run.seed, run.learner_threads);
    vae.freeze_encoder(&encoder.values);
    Ok(vae)
}

/// Returns the number of images of a minibatch that the decoder reproduces, at least one.
fn reproduced(config: &Config) -> usize {
    let images = config.vae.batch_size as f64 * config.encoder.reproduced_share;
    (images.ceil() as usize).max(1)
}

/// Returns Adam's step size of the step after `step` steps: constant, and then falling linearly.
fn learning_rate(config: &Config, step: u64) -> f64 {
    let section = &config.encoder;
    let left = (section.steps - step) as f64 / section.steps as f64;
    config.vae.learning_rate * (left / section.decay_share).min(1.0)
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;

    fn config() -> Config {
        let mut config = Config::default();
        (config.vae.latent, config.vae.batch_size) = (8, 2);
        config.run.learner_threads = 1;
        config.encoder.steps = 2 * STEPS_PER_POINT + 3;
        config
    }

    fn files(folder: &std::path::Path) -> EncoderFiles {
        let arguments = crate::arguments::Arguments {
            config: PathBuf::new(),
            output: Some(folder.join("mine.safetensors")),
            measure: None,
            decoder_of: None,
            overrides: Vec::new(),
        };
        arguments.files().unwrap()
    }

    #[test]
    fn a_training_that_was_stopped_or_killed_ends_with_the_same_bits() {
        let (config, settings) = (config(), SimulatorSettings::default());
        let folder = tempfile::tempdir().unwrap();
        let begin = || Training::begin(&config, &settings, files(folder.path()), None).unwrap();
        let go = AtomicBool::new(false);
        let mut undisturbed = begin();
        assert_eq!(undisturbed.train(&go).unwrap(), Ending::Completed);
        let expected = undisturbed.finish().unwrap();
        let file = files(folder.path()).encoder;
        assert_eq!(TrainedEncoder::load(&file).unwrap(), expected);
        let curve = fs::read(files(folder.path()).curve).unwrap();
        let decoder = TrainedDecoder::of(&expected.sha256(), &files(folder.path()).decoder);
        assert!(decoder.unwrap().is_some());
        fs::remove_file(&file).unwrap();
        fs::remove_file(files(folder.path()).decoder).unwrap();

        let mut stopped = begin();
        let ending = stopped.train(&AtomicBool::new(true)).unwrap();
        assert_eq!(ending, Ending::Interrupted(STEPS_PER_POINT));
        // Killed: nothing of these steps is saved.
        let mut killed = begin();
        killed.next_point(&go).unwrap();
        drop(killed);
        let mut resumed = begin();
        assert_eq!(resumed.vae.updates(), STEPS_PER_POINT);
        resumed.train(&go).unwrap();
        assert_eq!(resumed.finish().unwrap(), expected);
        assert_eq!(fs::read(files(folder.path()).curve).unwrap(), curve);
        let mut left: Vec<_> = fs::read_dir(folder.path())
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        left.sort();
        let expected = [
            "decoder.safetensors",
            "mine.safetensors",
            "mine_loss.csv",
            "mine_loss.png",
            "mine_reconstructions.png",
        ];
        assert_eq!(left, expected, "and no checkpoint");
        let again = Training::begin(&config, &settings, files(folder.path()), None);
        let error = again.err().unwrap().to_string();
        assert!(
            error.contains("mine.safetensors") && error.contains("--output"),
            "{error}"
        );
    }

    #[test]
    fn a_picture_that_cannot_be_drawn_costs_no_encoder() {
        let (mut config, settings) = (config(), SimulatorSettings::default());
        config.encoder.steps = 1;
        let folder = tempfile::tempdir().unwrap();
        let files = files(folder.path());
        fs::create_dir(&files.reconstructions).unwrap();
        let mut training = Training::begin(&config, &settings, files.clone(), None).unwrap();
        assert!(files.checkpoint.exists(), "before the first step");
        training.train(&AtomicBool::new(false)).unwrap();
        let encoder = training.finish().unwrap();
        assert_eq!(TrainedEncoder::load(&files.encoder).unwrap(), encoder);
        assert!(files.curve.exists() && !files.checkpoint.exists());
    }

    #[test]
    fn a_decoder_is_trained_for_an_encoder_that_stays_as_it_is() {
        let (mut config, settings) = (config(), SimulatorSettings::default());
        config.encoder.steps = STEPS_PER_POINT;
        let folder = tempfile::tempdir().unwrap();
        let given = new_vae(&config, None).unwrap();
        let mut values = vec![0.0; given.published_len()];
        given.publish(&mut values);
        let encoder = TrainedEncoder { values, latent: 8 };
        let files = EncoderFiles::beside(&folder.path().join("given.safetensors"), "decoder");
        fs::write(&files.encoder, "as it is").unwrap();
        let begin = |encoder: &TrainedEncoder| {
            Training::begin(&config, &settings, files.clone(), Some(encoder.clone()))
        };
        let mut training = begin(&encoder).unwrap();
        training.train(&AtomicBool::new(false)).unwrap();
        training.save().unwrap();
        let mut other = encoder.clone();
        other.values[0] += 1.0;
        let refused = begin(&other).err().unwrap().to_string();
        assert!(refused.contains("another encoder"), "{refused}");

        let (first, last) = (
            training.curve[0][2],
            new_error(&config, &settings, &encoder),
        );
        assert!(first < last, "the decoder has learned: {first} {last}");
        assert_eq!(training.finish().unwrap(), encoder);
        assert_eq!(fs::read(&files.encoder).unwrap(), b"as it is");
        let decoder = TrainedDecoder::of(&encoder.sha256(), &files.decoder);
        assert!(decoder.unwrap().is_some());
        assert!(!files.checkpoint.exists());

        config.vae.latent = 16;
        let refused = new_vae(&config, Some(&encoder)).err().unwrap().to_string();
        assert!(refused.contains("--set vae.latent=8"), "{refused}");
    }

    /// Returns the squared error of an untrained decoder's first step.
    fn new_error(config: &Config, settings: &SimulatorSettings, encoder: &TrainedEncoder) -> f64 {
        let folder = tempfile::tempdir().unwrap();
        let files = EncoderFiles::beside(&folder.path().join("e"), "decoder");
        let training = Training::begin(config, settings, files, Some(encoder.clone()));
        training.unwrap().step(0).unwrap()[2]
    }

    #[test]
    fn the_learning_rate_falls_to_zero_in_the_last_steps_only() {
        let mut config = config();
        (config.encoder.steps, config.encoder.decay_share) = (100, 0.5);
        let rates = [0, 50, 75, 99].map(|step| learning_rate(&config, step));
        let rate = config.vae.learning_rate;
        assert_eq!(rates, [rate, rate, rate * 0.5, rate * 0.02]);
    }
}
