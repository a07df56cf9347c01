//! The command line, and the files that it names.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use clap::Parser;
use skein_protocol::decoder_file::DECODER_FILE;

/// Trains an encoder on depth images from random poses in generated courses, before any run.
///
/// A run flies with it from its first episode on: --set vae.start_from=FILE --set
/// vae.train_steps=0. The result depends on configuration and seed alone. The same command resumes
/// a training that was stopped or killed.
#[derive(Debug, Parser)]
#[command(name = "skein encoder", bin_name = "skein encoder", version, after_help = NOTES)]
pub struct Arguments {
    /// Configuration. Of its keys, those that --set takes count. launch/encoder.sh sets
    /// configs/encoder.toml by default.
    #[arg(long, value_name = "FILE", overrides_with = "config")]
    pub config: PathBuf,
    /// Where the encoder goes. Its loss, reconstructions and checkpoint go beside it.
    #[arg(long, value_name = "FILE", required_unless_present_any = ["measure", "decoder_of"])]
    pub output: Option<PathBuf>,
    /// Train the decoder alone, decoder.safetensors beside this FILE, for the codes of the encoder
    /// in it, or of a snapshot's. Recordings, moving pictures and the page show with it what codes
    /// hold. --set encoder.steps=2000 is enough.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["output", "measure"])]
    pub decoder_of: Option<PathBuf>,
    /// Train nothing: measure the encoder in this file, or that of a snapshot.
    #[arg(long, value_name = "FILE", conflicts_with = "output")]
    pub measure: Option<PathBuf>,
    /// Change one setting of the config, for example --set encoder.steps=2000; may be repeated.
    ///
    /// These have an effect: [encoder]; latent, batch_size, learning_rate and kl_weight of [vae];
    /// camera, generator, the vehicle's preset and the disturbances' share and depth of
    /// [simulator]; run.seed and run.learner_threads. With --measure, those of [simulator] and
    /// [run].
    #[arg(long = "set", value_name = "SECTION.KEY=VALUE")]
    pub overrides: Vec<String>,
}

const NOTES: &str = "\
The table at the end says how well a small network finds the openings in sight from the code, on
courses that the training has not seen: root mean square errors in metres.

Exit status: 0 finished, 1 failed, 2 wrong arguments, 130 interrupted.";

/// Files of a training.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EncoderFiles {
    /// The encoder.
    pub encoder: PathBuf,
    /// Its decoder, which shows what latent codes hold.
    pub decoder: PathBuf,
    /// State from which the training resumes; removed at its end.
    pub checkpoint: PathBuf,
    /// Loss and its parts over the steps.
    pub curve: PathBuf,
    /// The same as a picture.
    pub curve_picture: PathBuf,
    /// Depth images beside their reconstructions.
    pub reconstructions: PathBuf,
}

impl EncoderFiles {
    /// Returns the files of a training that belong to the file `encoder`; the names of those that
    /// describe it begin with `stem`.
    pub(crate) fn beside(encoder: &Path, stem: &str) -> Self {
        let beside = |end: &str| encoder.with_file_name(format!("{stem}{end}"));
        Self {
            encoder: encoder.to_owned(),
            decoder: encoder.with_file_name(DECODER_FILE),
            checkpoint: beside(".checkpoint"),
            curve: beside("_loss.csv"),
            curve_picture: beside("_loss.png"),
            reconstructions: beside("_reconstructions.png"),
        }
    }
}

/// Sections and keys that count for a training alone.
const TRAINED_WITH: [&str; 5] = [
    "encoder",
    "vae.latent",
    "vae.batch_size",
    "vae.learning_rate",
    "vae.kl_weight",
];
/// Sections and keys that count for the views, and so for a measurement too.
const SEEN_WITH: [&str; 7] = [
    "simulator.vehicle.preset",
    "simulator.camera",
    "simulator.generator",
    "simulator.disturbances.share",
    "simulator.disturbances.depth",
    "run.seed",
    "run.learner_threads",
];

impl Arguments {
    /// Refuses an override of a key that the training, or the measurement, does not use.
    ///
    /// # Errors
    /// Names the override and the keys that count.
    pub fn check_overrides(&self) -> Result<()> {
        let (what, trained_with) = match self.measure {
            Some(_) => ("a measurement", &[][..]),
            None => ("an encoder's training", &TRAINED_WITH[..]),
        };
        let used = [trained_with, &SEEN_WITH].concat();
        let is_in = |key: &str, section: &str| {
            key.strip_prefix(section)
                .is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
        };
        for text in &self.overrides {
            let key = text.split_once('=').map_or(text.as_str(), |(key, _)| key);
            let key = key.trim();
            anyhow::ensure!(
                used.iter().any(|used| is_in(key, used) || is_in(used, key)),
                "--set {text}: {key} has no effect on {what}; only {} have",
                used.join(", ")
            );
        }
        Ok(())
    }

    /// Returns the files of the training.
    ///
    /// # Errors
    /// If the output has no name, or lies in a folder that does not exist.
    pub fn files(&self) -> Result<EncoderFiles> {
        if let Some(encoder) = &self.decoder_of {
            return Ok(EncoderFiles::beside(encoder, "decoder"));
        }
        let output = self.output.as_deref().unwrap_or(Path::new(""));
        let stem = output.file_stem().and_then(|stem| stem.to_str());
        let stem = stem.context("--output names no file, or one that is not UTF-8")?;
        let folder = output.parent().filter(|folder| *folder != Path::new(""));
        anyhow::ensure!(
            folder.is_none_or(Path::is_dir),
            "--output {}: its folder does not exist: create it",
            output.display()
        );
        let files = EncoderFiles::beside(output, stem);
        anyhow::ensure!(
            output != files.checkpoint,
            "--output {}: the training keeps its state there and removes it: name another file",
            output.display()
        );
        Ok(files)
    }
}

#[cfg(test)]
mod tests {
    use skein_protocol::config::Config;

    use super::*;

    fn checked(command: &[&str], overrides: &[&str]) -> Result<(), String> {
        let mut all = [&["skein encoder", "--config", "encoder.toml"], command].concat();
        overrides
            .iter()
            .for_each(|text| all.extend(["--set", text]));
        let arguments = Arguments::parse_from(all);
        arguments
            .check_overrides()
            .map_err(|error| error.to_string())
    }

    #[test]
    fn an_output_that_the_training_would_remove_is_refused() {
        let files = |output: &str| {
            let command = ["skein encoder", "--config", "e.toml", "--output", output];
            Arguments::parse_from(command).files()
        };
        let error = files("x.checkpoint").unwrap_err().to_string();
        assert!(error.contains("x.checkpoint: the training"), "{error}");
        assert_eq!(files("x").unwrap().checkpoint, Path::new("x.checkpoint"));
    }

    const TRAINING: [&str; 2] = ["--output", "e.safetensors"];
    const MEASUREMENT: [&str; 2] = ["--measure", "e.safetensors"];

    #[test]
    fn settings_without_effect_are_refused_by_name() {
        let sound = "encoder.steps=9";
        for key in [
            "vae.train_steps",
            "vae.start_from",
            "vae.recode_steps",
            "vae.updates_per_step",
            "vae.decoder",
            "run.episodes",
            "run.device",
            "sac.discount",
            "simulator.max_steps",
            "simulator.reward.collision",
            "simulator.disturbances.gust.force_rms_n",
            "simulator.vehicle.forward_speed_mps",
            "encoders.steps",
        ] {
            let text = format!("{key}=1");
            let error = checked(&TRAINING, &[sound, &text]).unwrap_err();
            let expected = format!("--set {text}: {key} has no effect on an encoder's training");
            assert!(error.starts_with(&expected), "{error}");
            assert!(error.contains("vae.latent, vae.batch_size"), "{error}");
        }
        let error = checked(&MEASUREMENT, &["vae.latent=8"]).unwrap_err();
        assert!(error.contains("no effect on a measurement"), "{error}");
    }

    #[test]
    fn every_setting_of_views_networks_and_schedule_is_taken() {
        for key in TRAINED_WITH.into_iter().chain(SEEN_WITH) {
            assert_eq!(checked(&TRAINING, &[&format!("{key}=1")]), Ok(()));
        }
        for text in [
            "simulator.generator.clearance_m=[1,2]",
            "simulator.disturbances={share=0.5}",
        ] {
            assert_eq!(checked(&TRAINING, &[text]), Ok(()));
            assert_eq!(checked(&MEASUREMENT, &[text]), Ok(()));
        }
    }

    /// The vae keys listed here and those refused above are all there are.
    #[test]
    fn every_key_of_the_vae_is_either_used_or_refused() {
        let mut config = Config::default();
        config.vae.start_from = Some(PathBuf::from("e.safetensors"));
        let text = config.portable();
        let (_, vae) = text.split_once("[vae]\n").unwrap();
        let lines = vae.lines().take_while(|line| !line.starts_with('['));
        let keys: Vec<_> = lines.filter_map(|line| line.split_once(" = ")).collect();
        assert!(keys.len() >= 9, "{keys:?}");
        let is_used = |key: &str| checked(&TRAINING, &[&format!("vae.{key}=1")]).is_ok();
        let mut used: Vec<_> = keys.iter().map(|(key, _)| *key).collect();
        used.retain(|key| is_used(key));
        used.sort();
        assert_eq!(used, ["batch_size", "kl_weight", "latent", "learning_rate"]);
    }
}
