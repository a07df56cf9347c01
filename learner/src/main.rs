//! `skein-learner --run DIR`: trains the run prepared in a directory.

use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context, Result};
use clap::Parser;
use skein_learner::training::{self, TrainingError};
use skein_run::allocation::{EndWithoutMemory, keep_freed_memory};
use skein_run::failure::{EXIT_OUT_OF_MEMORY, EXIT_RESTART, with_causes};
use skein_run::logging::{LogFormat, log_to_file};
use skein_run::note;
use skein_run::signals::{is_ignored, survive_file_size_limit};
use skein_run::{LearnerLock, RunDirectory};
use tokio::signal::unix::{Signal, SignalKind, signal};

/// The learner of a run: hands out tickets, trains on the episodes that come back, publishes
/// snapshots. Started by run_local.sh.
///
/// Resumes from the newest undamaged checkpoint in the directory, if there is one. Prints progress
/// to standard output, one JSON object per line. SIGTERM or SIGINT stops the training in order:
/// what was learned is saved.
#[derive(Parser)]
#[command(version)]
struct Arguments {
    /// Directory of the run.
    #[arg(long)]
    run: PathBuf,
}

#[global_allocator]
static ALLOCATOR: EndWithoutMemory = EndWithoutMemory {
    program: "skein-learner",
    status: EXIT_OUT_OF_MEMORY,
};

fn main() -> ExitCode {
    survive_file_size_limit();
    keep_freed_memory();
    match run(&Arguments::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            let status = status_of(&error);
            let error = with_causes(error.as_ref());
            tracing::error!(error, "learner failed");
            note!("skein-learner: {error}");
            status
        }
    }
}

/// Exit status after `error`: says whether starting again may help.
fn status_of(error: &anyhow::Error) -> ExitCode {
    match error.downcast_ref::<TrainingError>() {
        Some(error) if error.is_transport_failure() => ExitCode::from(EXIT_RESTART),
        _ => ExitCode::FAILURE,
    }
}

fn run(arguments: &Arguments) -> Result<()> {
    let directory = RunDirectory::new(&arguments.run);
    let (identity, config) = directory.open()?;
    // Taken before any file of the run is touched, the log included: another learner may be
    // running.
    let lock = LearnerLock::take(&directory, &identity)?;
    let log = directory.learner_log();
    log_to_file(&log, LogFormat::from_environment())
        .with_context(|| format!("cannot write {}", log.display()))?;
    tracing::info!(
        run = %identity.run,
        incarnation = %lock.incarnation(),
        seed = config.run.seed,
        device = %config.run.device,
        "learner starts"
    );
    let stop = stop_on_signals().context("cannot listen to signals")?;
    // An unreadable summary counts as missing: it is written again, from the last checkpoint.
    if directory
        .summary()
        .is_some_and(|summary| summary.is_of_whole(&config))
    {
        let root = directory.root().display();
        tracing::info!("the run is complete: nothing left to do");
        note!("skein-learner: the run in {root} is complete: nothing left to do");
        return Ok(());
    }
    let summary = training::run(&directory, &identity, lock.incarnation(), &config, &stop)?;
    tracing::info!(ending = ?summary.ending, policy_sha256 = summary.policy_sha256, "learner ends");
    Ok(())
}

/// Returns a flag that SIGTERM and SIGINT set, unless they were ignored when this process started.
fn stop_on_signals() -> std::io::Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    let flag = stop.clone();
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_io()
        .build()?;
    let (mut terminate, mut interrupt) = {
        let _entered = runtime.enter();
        (
            listen(SignalKind::terminate())?,
            listen(SignalKind::interrupt())?,
        )
    };
    std::thread::Builder::new()
        .name("signals".to_owned())
        .spawn(move || {
            runtime.block_on(async {
                tokio::select! {
                    () = arrival(&mut terminate) => {}
                    () = arrival(&mut interrupt) => {}
                }
            });
            tracing::info!("stop requested");
            flag.store(true, Ordering::Relaxed);
        })?;
    Ok(stop)
}

/// Listens for a signal; `None` if it was ignored when this process started, and so stays ignored.
fn listen(kind: SignalKind) -> std::io::Result<Option<Signal>> {
    (!is_ignored(kind.as_raw_value()))
        .then(|| signal(kind))
        .transpose()
}

/// Waits for a signal, forever if it is ignored.
async fn arrival(signal: &mut Option<Signal>) {
    match signal {
        Some(signal) => {
            signal.recv().await;
        }
        None => std::future::pending().await,
    }
}
