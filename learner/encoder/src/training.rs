//! The training loop: draw views, make a step, and now and then save all that a step changes.

use std::fs;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context, Result, ensure};
use skein_learner::noise::Noise;
use skein_learner::state::Stateful;
use skein_learner::vae::{NativeVae, Targets};
use skein_protocol::IMAGE_PIXELS;
use skein_protocol::config::{Config, Engine};
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
    /// Starts a training, or resumes it from its checkpoint.
    ///
    /// # Errors
    /// Names the key or file at fault, and the remedy.
    pub fn begin(
        config: &'a Config,
        settings: &'a SimulatorSettings,
        files: EncoderFiles,
    ) -> Result<Self> {
        ensure!(
            config.vae.engine(&config.run) == Engine::Native,
            "an encoder is trained with the native engine alone: leave run.engine, run.device and \
             vae.decoder out"
        );
        ensure!(
            !files.encoder.exists(),
            "{} is there already: remove it, or give another --output",
            files.encoder.display()
        );
        let mut training = Self {
            vae: new_vae(config),
            config,
            settings,
            files,
            curve: Vec::new(),
        };
        if let Some(saved) = Checkpoint::load(&training.files.checkpoint, config)? {
            training.vae.load_named(&saved.tensors)?;
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
        let targets = Targets {
            clean: Some(&views.clean[..reproduced(config) * IMAGE_PIXELS]),
            geometry: &views.known,
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

    /// Writes the encoder and what shows how it was trained; removes the checkpoint. Returns the
    /// encoder and its file. Tables and pictures that cannot be written are named and left out.
    ///
    /// # Errors
    /// Names the encoder's file if it cannot be written, or the checkpoint.
    pub fn finish(mut self) -> Result<(TrainedEncoder, PathBuf)> {
        let mut values = vec![0.0; self.vae.published_len()];
        self.vae.publish(&mut values);
        let encoder = TrainedEncoder {
            values,
            latent: self.config.vae.latent,
        };
        let path = self.files.encoder.clone();
        durable::replace(&path, &encoder.to_file(self.config, self.vae.updates()))
            .with_context(|| path.display().to_string())?;
        if let Err(error) = self.describe() {
            note!(
                "skein encoder: the encoder is written; left out: {}",
                with_causes(error.as_ref())
            );
        }
        if self.files.checkpoint.exists() {
            fs::remove_file(&self.files.checkpoint)
                .with_context(|| self.files.checkpoint.display().to_string())?;
        }
        Ok((encoder, path))
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

fn new_vae(config: &Config) -> NativeVae {
    let (run, weight) = (&config.run, config.encoder.geometry_weight);
    let head = (KNOWN, weight);
    NativeVae::supervised(&config.vae, run.seed, run.learner_threads, head)
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
            overrides: Vec::new(),
        };
        arguments.files().unwrap()
    }

    #[test]
    fn a_training_that_was_stopped_or_killed_ends_with_the_same_bits() {
        let (config, settings) = (config(), SimulatorSettings::default());
        let folder = tempfile::tempdir().unwrap();
        let begin = || Training::begin(&config, &settings, files(folder.path())).unwrap();
        let go = AtomicBool::new(false);
        let mut undisturbed = begin();
        assert_eq!(undisturbed.train(&go).unwrap(), Ending::Completed);
        let (expected, file) = undisturbed.finish().unwrap();
        assert_eq!(TrainedEncoder::load(&file).unwrap(), expected);
        let curve = fs::read(files(folder.path()).curve).unwrap();
        fs::remove_file(&file).unwrap();

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
        assert_eq!(resumed.finish().unwrap().0, expected);
        assert_eq!(fs::read(files(folder.path()).curve).unwrap(), curve);
        let mut left: Vec<_> = fs::read_dir(folder.path())
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        left.sort();
        let expected = [
            "mine.safetensors",
            "mine_loss.csv",
            "mine_loss.png",
            "mine_reconstructions.png",
        ];
        assert_eq!(left, expected, "and no checkpoint");
        let again = Training::begin(&config, &settings, files(folder.path()));
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
        let mut training = Training::begin(&config, &settings, files.clone()).unwrap();
        assert!(files.checkpoint.exists(), "before the first step");
        training.train(&AtomicBool::new(false)).unwrap();
        let (encoder, file) = training.finish().unwrap();
        assert_eq!(TrainedEncoder::load(&file).unwrap(), encoder);
        assert!(files.curve.exists() && !files.checkpoint.exists());
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
