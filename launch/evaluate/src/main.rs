//! `skein-evaluate`: flies a trained snapshot and reports its results.

use std::process::ExitCode;

use clap::Parser;
use skein_evaluate::{Arguments, run};
use skein_run::failure::with_causes;
use skein_run::note;

fn main() -> ExitCode {
    match run(&Arguments::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            note!("skein-evaluate: {}", with_causes(error.as_ref()));
            ExitCode::FAILURE
        }
    }
}
