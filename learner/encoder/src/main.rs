//! `skein-encoder`: trains an encoder before any run, or measures one.

use std::process::ExitCode;
use std::sync::atomic::Ordering;

use anyhow::{Context, Result};
use clap::Parser;
use skein_encoder::arguments::Arguments;
use skein_encoder::measurement::Measurement;
use skein_encoder::training::{Ending, Training};
use skein_encoder::views::simulator_settings;
use skein_protocol::config::Config;
use skein_protocol::encoder_file::TrainedEncoder;
use skein_run::allocation::{EndWithoutMemory, keep_freed_memory};
use skein_run::failure::{EXIT_INTERRUPTED, with_causes};
use skein_run::signals::{end_on_signal, survive_file_size_limit};
use skein_run::{note, show};

#[global_allocator]
static ALLOCATOR: EndWithoutMemory = EndWithoutMemory {
    program: "skein encoder",
    status: 1,
};

fn main() -> ExitCode {
    survive_file_size_limit();
    keep_freed_memory();
    match run(&Arguments::parse()) {
        Ok(status) => status,
        Err(error) => {
            note!("skein encoder: {}", with_causes(error.as_ref()));
            ExitCode::FAILURE
        }
    }
}

fn run(arguments: &Arguments) -> Result<ExitCode> {
    let config = Config::load(&arguments.config, &arguments.overrides)?;
    arguments.check_overrides()?;
    let settings =
        simulator_settings(&config).with_context(|| arguments.config.display().to_string())?;
    if let Some(file) = &arguments.measure {
        let encoder = TrainedEncoder::load(file)?;
        show!("{}", Measurement::of(&encoder, &config, &settings)?);
        return Ok(ExitCode::SUCCESS);
    }
    let stop = end_on_signal().context("cannot listen to signals")?;
    // Signals end the process at once while the flag is set: then there is nothing to save.
    stop.store(true, Ordering::Relaxed);
    let frozen = arguments.decoder_of.as_deref().map(TrainedEncoder::load);
    let (frozen, files) = (frozen.transpose()?, arguments.files()?);
    let mut training = Training::begin(&config, &settings, files.clone(), frozen)?;
    stop.store(false, Ordering::Relaxed);
    let ending = training.train(&stop)?;
    stop.store(true, Ordering::Relaxed);
    match ending {
        Ending::Completed => {
            let encoder = training.finish()?;
            if arguments.decoder_of.is_none() {
                show!("{}", Measurement::of(&encoder, &config, &settings)?);
                let file = files.encoder.display();
                show!("{file}: SHA-256 {}", encoder.sha256());
            }
            Ok(ExitCode::SUCCESS)
        }
        Ending::Interrupted(steps) => {
            note!("skein encoder: stopped after step {steps}; the same command resumes");
            Ok(ExitCode::from(EXIT_INTERRUPTED))
        }
    }
}
