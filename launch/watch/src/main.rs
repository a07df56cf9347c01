//! `skein-watch`: a page on this machine that shows what the runs of a folder are doing.
//!
//! It reads the files that runs leave, and nothing else: a run cannot tell whether it is watched,
//! and nothing can be changed through the page.

mod activity;
mod catalogue;
mod curves;
mod episodes;
mod evaluation;
mod events;
mod reconstruction;
mod recordings;
mod server;
mod settings;

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Context;
use clap::Parser;
use skein_run::failure::with_causes;
use skein_run::orphans::end_with_parent;
use skein_run::signals::survive_file_size_limit;
use skein_run::{note, show};

use catalogue::Catalogue;

/// Serves a page that shows what the runs of a folder are doing: curves, actors, settings, and
/// where evaluation episodes failed.
///
/// Only this machine can open the page. It reads the runs' files and changes nothing. Ctrl-C ends
/// it; runs go on.
#[derive(Debug, Parser)]
#[command(
    name = "skein-watch",
    version,
    after_help = "Exit status: 0 ended by Ctrl-C, 1 failed, 2 wrong arguments."
)]
struct Arguments {
    /// Folder with the directories of runs, at any depth up to four.
    #[arg(value_name = "DIR", default_value = "runs")]
    folder: PathBuf,
    /// Port to listen on; 0 takes any that is free.
    #[arg(long, value_name = "PORT", default_value_t = 6080)]
    port: u16,
    /// End with the process that started this one.
    #[arg(long)]
    end_with_parent: bool,
}

fn main() -> ExitCode {
    survive_file_size_limit();
    match watch(&Arguments::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            note!("skein-watch: {}", with_causes(error.as_ref()));
            ExitCode::FAILURE
        }
    }
}

fn watch(arguments: &Arguments) -> anyhow::Result<()> {
    if arguments.end_with_parent {
        end_with_parent().context("cannot end with the process that started this one")?;
    }
    let catalogue = Catalogue::open(&arguments.folder)?;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        // Reading of files: a page asks for a few things at a time.
        .max_blocking_threads(4)
        .build()
        .context("cannot start the threads of the server")?;
    runtime.block_on(async {
        let listener = server::listen(arguments.port).await?;
        let address = listener.local_addr().context("the server has no address")?;
        show!(
            "http://{address} shows the runs in {}; Ctrl-C ends it",
            arguments.folder.display()
        );
        server::serve(listener, catalogue).await
    })
}
