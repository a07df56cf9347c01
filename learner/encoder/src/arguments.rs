//! The command line, and the files that it names.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use clap::Parser;

/// Trains an encoder on depth images from random poses in generated courses, before any run.
///
/// A run flies with it from its first episode on: --set vae.start_from=FILE --set
/// vae.train_steps=0. The result depends on configuration and seed alone. The same command resumes
/// a training that was stopped or killed.
#[derive(Debug, Parser)]
#[command(name = "skein encoder", bin_name = "skein encoder", version, after_help = NOTES)]
pub struct Arguments {
    /// Configuration: [encoder], [vae], [simulator] and run.seed count. launch/encoder.sh sets
    /// configs/encoder.toml by default.
    #[arg(long, value_name = "FILE", overrides_with = "config")]
    pub config: PathBuf,
    /// Where the encoder goes. Its loss, reconstructions and checkpoint go beside it.
    #[arg(long, value_name = "FILE", required_unless_present = "measure")]
    pub output: Option<PathBuf>,
    /// Train nothing: measure the encoder in this file, or that of a snapshot.
    #[arg(long, value_name = "FILE", conflicts_with = "output")]
    pub measure: Option<PathBuf>,
    /// Change one setting of the config, for example --set encoder.steps=2000; may be repeated.
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
    /// State from which the training resumes; removed at its end.
    pub checkpoint: PathBuf,
    /// Loss and its parts over the steps.
    pub curve: PathBuf,
    /// The same as a picture.
    pub curve_picture: PathBuf,
    /// Depth images beside their reconstructions.
    pub reconstructions: PathBuf,
}

impl Arguments {
    /// Returns the files of the training.
    ///
    /// # Errors
    /// If the output has no name, or lies in a folder that does not exist.
    pub fn files(&self) -> Result<EncoderFiles> {
        let output = self.output.as_deref().unwrap_or(Path::new(""));
        let stem = output.file_stem().and_then(|stem| stem.to_str());
        let stem = stem.context("--output names no file, or one that is not UTF-8")?;
        let folder = output.parent().filter(|folder| *folder != Path::new(""));
        anyhow::ensure!(
            folder.is_none_or(Path::is_dir),
            "--output {}: its folder does not exist: create it",
            output.display()
        );
        let beside = |end: &str| output.with_file_name(format!("{stem}{end}"));
        Ok(EncoderFiles {
            encoder: output.to_owned(),
            checkpoint: beside(".checkpoint"),
            curve: beside("_loss.csv"),
            curve_picture: beside("_loss.png"),
            reconstructions: beside("_reconstructions.png"),
        })
    }
}
