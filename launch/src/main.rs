//! `skein`: runs a training, adds actors to one, draws what one left.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::thread;

use anyhow::{Context, bail};
use clap::{Args, Parser, Subcommand};
use skein_launch::conclusion::conclusion;
use skein_launch::display::Display;
use skein_launch::prepare::{Prepared, ideal_walls_passed, load_courses, prepare};
use skein_launch::reports;
use skein_launch::supervisor::{self, Ended, Plan, Programs};
use skein_protocol::config::Config;
use skein_protocol::failure::with_causes;
use skein_protocol::ids::ActorId;
use skein_protocol::run::{RunDirectory, RunError};
use skein_protocol::services::is_learner_alive;
use tokio::runtime::Runtime;
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::mpsc;

/// Status of a process that was interrupted, as shells report it: 128 + SIGINT.
const INTERRUPTED: u8 = 130;

/// Trains a drone to avoid obstacles from its depth camera.
#[derive(Parser)]
#[command(version)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Start a learner and its actors, and watch them until the run ends.
    Run(RunArguments),
    /// Add actors to a run that is under way on this machine.
    Attach(AttachArguments),
    /// Draw the plots of a run again.
    Report(ReportArguments),
}

#[derive(Args)]
struct RunArguments {
    /// What to train, and how.
    #[arg(long, value_name = "FILE", overrides_with = "config")]
    config: PathBuf,
    /// Where everything goes; must be new or empty.
    #[arg(long, value_name = "DIR", overrides_with = "run_dir")]
    run_dir: PathBuf,
    /// Actors to start [default: number of cores].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    actors: Option<u32>,
    /// Change one setting of the config; may be repeated.
    #[arg(long = "set", value_name = "SECTION.KEY=VALUE")]
    overrides: Vec<String>,
}

#[derive(Args)]
struct AttachArguments {
    /// The run's directory.
    #[arg(long, value_name = "DIR")]
    run: PathBuf,
    /// Actors to start.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    count: u32,
}

#[derive(Args)]
struct ReportArguments {
    /// The run's directory.
    #[arg(long, value_name = "DIR")]
    run: PathBuf,
}

fn main() -> ExitCode {
    let outcome = match Cli::parse().command {
        Command::Run(arguments) => run(&arguments),
        Command::Attach(arguments) => attach(&arguments),
        Command::Report(arguments) => report(&arguments),
    };
    match outcome {
        Ok(Ended::Finished) => ExitCode::SUCCESS,
        Ok(Ended::Interrupted) => ExitCode::from(INTERRUPTED),
        Err(error) => {
            eprintln!("skein: {}", with_causes(error.as_ref()));
            ExitCode::FAILURE
        }
    }
}

fn run(arguments: &RunArguments) -> anyhow::Result<Ended> {
    let programs = Programs::beside_this()?;
    let actors = match arguments.actors {
        Some(actors) => actors as usize,
        None => thread::available_parallelism().map_or(1, Into::into),
    };
    let prepared = prepare(&arguments.config, &arguments.overrides, &arguments.run_dir, actors)?;
    let Prepared {
        run,
        identity,
        config,
        courses,
    } = &prepared;
    eprintln!(
        "skein: {actors} {}, {} training flights, seed {}",
        if actors == 1 { "actor" } else { "actors" },
        config.run.flights,
        config.run.seed
    );
    eprintln!("skein: everything goes to {}", run.root().display());
    if !config.courses.evaluation.contains(&config.courses.training) {
        eprintln!(
            "skein: note: the training course is not among courses.evaluation; the best snapshot is chosen on {}",
            courses.first().map_or("none", |course| &course.name)
        );
    }

    let plan = Plan {
        run: run.clone(),
        programs,
        actors: claim_actors(run, actors)?,
        learner_threads: config.run.learner_threads,
        learner_grace: supervisor::LEARNER_GRACE,
    };
    let mut display = Display::new();
    let outcome = runtime()?.block_on(async {
        let mut interrupts = interrupts()?;
        anyhow::Ok(supervisor::run(&plan, &mut interrupts, &mut display).await)
    });
    display.finish();
    identity.remove_transport();

    // Plots are a service: a run that failed may have left something worth looking at, and one that succeeded has, plots or not.
    let window = config.evaluation.window_flights as usize;
    if let Err(error) = reports::draw_all(run, courses, window, ideal_walls_passed(config)?) {
        eprintln!("skein: not all plots could be drawn: {error}");
    }
    let ended = outcome??;
    print!("{}", conclusion(run));
    Ok(ended)
}

fn attach(arguments: &AttachArguments) -> anyhow::Result<Ended> {
    let programs = Programs::beside_this()?;
    let run = open(&arguments.run)?;
    let (identity, config) = run.open()?;
    if !is_learner_alive(&identity)? {
        bail!("the run in {} is not under way on this machine", run.root().display());
    }
    let actors = claim_actors(&run, arguments.count as usize)?;
    let names: Vec<_> = actors.iter().map(ToString::to_string).collect();
    eprintln!(
        "skein: adding actor {} to {}; Ctrl-C takes them away again",
        names.join(", "),
        run.root().display()
    );
    let plan = Plan {
        run,
        programs,
        actors,
        learner_threads: config.run.learner_threads,
        learner_grace: supervisor::LEARNER_GRACE,
    };
    let mut display = Display::new();
    runtime()?.block_on(async {
        let mut interrupts = interrupts()?;
        Ok(supervisor::attach(&plan, &mut interrupts, &mut display).await?)
    })
}

fn report(arguments: &ReportArguments) -> anyhow::Result<Ended> {
    let run = open(&arguments.run)?;
    let config = Config::load(&run.config(), &[])?;
    let courses = load_courses(&config)?;
    let window = config.evaluation.window_flights as usize;
    for picture in reports::draw_all(&run, &courses, window, ideal_walls_passed(&config)?)? {
        println!("{}", picture.display());
    }
    Ok(Ended::Finished)
}

/// The run in `directory`, by its absolute path: processes of a run compare paths.
fn open(directory: &Path) -> anyhow::Result<RunDirectory> {
    let root = directory
        .canonicalize()
        .with_context(|| format!("{} is no directory of a run", directory.display()))?;
    Ok(RunDirectory::new(root))
}

fn claim_actors(run: &RunDirectory, count: usize) -> Result<Vec<ActorId>, RunError> {
    (0..count).map(|_| run.claim_actor()).collect()
}

/// All on the main thread: children are bound to the life of the thread that started them.
fn runtime() -> anyhow::Result<Runtime> {
    tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("cannot start the runtime")
}

/// One message for each time the user, or the system, asks this process to end.
fn interrupts() -> anyhow::Result<mpsc::Receiver<()>> {
    let (sender, receiver) = mpsc::channel(4);
    for kind in [SignalKind::interrupt(), SignalKind::terminate(), SignalKind::hangup()] {
        let mut signal = signal(kind).context("cannot listen for signals")?;
        let sender = sender.clone();
        tokio::spawn(async move {
            while signal.recv().await.is_some() {
                // When four are waiting, a fifth says nothing new.
                let _ = sender.try_send(());
            }
        });
    }
    Ok(receiver)
}
