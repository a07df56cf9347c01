//! `skein-evaluate`: flies a trained snapshot and reports its results.

use std::process::ExitCode;

use clap::Parser;
use skein_evaluate::{Arguments, run};
use skein_run::allocation::EndWithoutMemory;
use skein_run::failure::with_causes;
use skein_run::note;
use skein_run::signals::survive_file_size_limit;

#[global_allocator]
static ALLOCATOR: EndWithoutMemory = EndWithoutMemory {
    program: "skein-evaluate",
    status: 1,
};

fn main() -> ExitCode {
    survive_file_size_limit();
    match run(&Arguments::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            note!("skein-evaluate: {}", with_causes(error.as_ref()));
            ExitCode::FAILURE
        }
    }
}
