//! `skein`: runs a training, adds actors to one, draws what one left.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::thread;
use std::time::Duration;

use anyhow::{Context, bail};
use clap::error::ErrorKind;
use clap::{Args, CommandFactory, Parser, Subcommand};
use rustix::fs::Mode;
use rustix::process::umask;
use skein_launch::conclusion::conclusion;
use skein_launch::display::Display;
use skein_launch::interrupts::{INTERRUPTED, interrupts, runtime};
use skein_launch::prepare::room::{check_shared_memory_for_more, scarce_disk};
use skein_launch::prepare::{Prepared, ideal_walls_passed, load_courses, prepare};
use skein_launch::reports;
use skein_launch::resume::resume;
use skein_launch::supervisor::{self, Deadlines, Ended, Plan, Programs, SupervisorError};
use skein_protocol::summary::Ending;
use skein_run::ActorClaim;
use skein_run::failure::with_causes;
use skein_run::{RunDirectory, RunError, SupervisorLock, sweep_leftovers};

/// What the system may refuse.
const RUNTIME: &str = "cannot start the runtime";
const SIGNALS: &str = "cannot listen for signals";
/// How long a learner that nobody supervises may still be ending, before its run is resumed.
const PATIENCE: Duration = Duration::from_secs(10);

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
    #[arg(
        long,
        value_name = "FILE",
        overrides_with = "config",
        required_unless_present = "resume"
    )]
    config: Option<PathBuf>,
    /// Where everything goes; must be new or empty.
    #[arg(
        long,
        value_name = "DIR",
        overrides_with = "run_dir",
        required_unless_present = "resume"
    )]
    run_dir: Option<PathBuf>,
    /// Go on with the run in this directory, with the configuration it was started with.
    #[arg(long, value_name = "DIR")]
    resume: Option<PathBuf>,
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

/// A run that failed, and what is left of it.
#[derive(Debug, thiserror::Error)]
#[error("{source}")]
struct Unfinished {
    run: RunDirectory,
    #[source]
    source: SupervisorError,
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
            // What keeps a learner from starting would keep it from going on, too.
            if let Some(Unfinished { run, source }) = error.downcast_ref()
                && !source.tells_all()
            {
                tell_how_to_go_on(run);
            }
            ExitCode::FAILURE
        }
    }
}

fn run(arguments: &RunArguments) -> anyhow::Result<Ended> {
    // Whatever the processes of a run write is their user's alone.
    umask(Mode::RWXG | Mode::RWXO);
    let programs = Programs::beside_this()?;
    let actors = match arguments.actors {
        Some(actors) => actors as usize,
        None => thread::available_parallelism().map_or(1, Into::into),
    };
    sweep();
    let (prepared, lock) = match arguments.task() {
        Task::New { config, run_dir } => {
            let prepared = prepare(config, &arguments.overrides, run_dir, actors)?;
            let lock = SupervisorLock::take(&prepared.run, &prepared.identity)?;
            (prepared, lock)
        }
        Task::Resume(directory) => resume(directory, actors, PATIENCE)?,
    };
    announce(&prepared, actors, arguments);
    let Prepared {
        run,
        config,
        courses,
        new,
        ..
    } = &prepared;
    if let Some(warning) = scarce_disk(config, run.root()) {
        eprintln!("skein: {warning}");
    }

    let claims = claim_actors(run, actors)?;
    let plan = Plan {
        run: run.clone(),
        programs,
        actors: claims.iter().map(ActorClaim::id).collect(),
        learner_threads: config.run.learner_threads,
        deadlines: Deadlines::of(config),
    };
    let mut display = Display::new();
    let outcome = runtime().context(RUNTIME)?.block_on(async {
        let mut interrupts = interrupts().context(SIGNALS)?;
        anyhow::Ok(supervisor::run(&plan, &mut interrupts, &mut display).await)
    });
    display.finish();
    drop(lock);
    sweep();

    let outcome = outcome?;
    if let (Some(new), Err(error)) = (new, &outcome)
        && error.tells_all()
        && run.newest_checkpoint().is_none()
    {
        // The run never began; its directory would only be in the way of the next attempt.
        if let Err(error) = new.take_back() {
            eprintln!("skein: {} remains: {error}", run.root().display());
        }
        return Ok(outcome?);
    }

    // Plots are a service: a run that failed may have left something worth looking at, and one that
    // succeeded has, plots or not.
    let window = config.evaluation.window_episodes as usize;
    if let Err(error) = reports::draw_all(run, courses, window, ideal_walls_passed(config)?) {
        eprintln!("skein: not all plots could be drawn: {error}");
    }
    let ended = outcome.map_err(|source| Unfinished {
        run: run.clone(),
        source,
    })?;
    print!("{}", conclusion(run));
    // Whoever told the learner alone to stop has interrupted the run as well, and a run may be
    // complete before it heeds an interruption.
    let ended = match run.summary().map(|summary| summary.ending) {
        Some(Ending::Completed) => Ended::Finished,
        Some(Ending::Interrupted) => Ended::Interrupted,
        None => ended,
    };
    if ended == Ended::Interrupted {
        if run.summary().is_none() {
            let newest = run.newest_checkpoint();
            let kept = newest.map_or("there is no checkpoint yet".to_owned(), |episodes| {
                format!("the newest checkpoint is of episode {episodes}")
            });
            eprintln!("skein: stopped at once: {kept}");
        }
        tell_how_to_go_on(run);
    }
    Ok(ended)
}

/// What `skein run` is to do.
enum Task<'a> {
    New { config: &'a Path, run_dir: &'a Path },
    Resume(&'a Path),
}

impl RunArguments {
    /// Ends the process with the reason if the arguments contradict each other.
    fn task(&self) -> Task<'_> {
        match (&self.resume, &self.config, &self.run_dir) {
            (None, Some(config), Some(run_dir)) => Task::New { config, run_dir },
            (Some(directory), None, None) if self.overrides.is_empty() => Task::Resume(directory),
            _ => Cli::command()
                .error(
                    ErrorKind::ArgumentConflict,
                    "a run is resumed in its own directory, with the configuration it was started with: --config, --run-dir and --set cannot be given with --resume",
                )
                .exit(),
        }
    }
}

/// Tells what is about to be done.
fn announce(prepared: &Prepared, actors: usize, arguments: &RunArguments) {
    let config = &prepared.config;
    eprintln!(
        "skein: {actors} {}, {} training episodes, seed {}",
        if actors == 1 { "actor" } else { "actors" },
        config.run.episodes,
        config.run.seed
    );
    let root = prepared.run.root().display();
    if arguments.resume.is_some() {
        eprintln!("skein: going on with the run in {root}");
        return;
    }
    eprintln!("skein: everything goes to {root}");
    if !config.courses.evaluation.contains(&config.courses.training) {
        eprintln!(
            "skein: note: the training course is not among courses.evaluation; the best snapshot is chosen on {}",
            prepared
                .courses
                .first()
                .map_or("none", |course| &course.name)
        );
    }
}

/// The last line about a run that is not complete.
fn tell_how_to_go_on(run: &RunDirectory) {
    let root = run.root().display().to_string();
    let is_plain = |character: char| character.is_alphanumeric() || "/._-+=:,@".contains(character);
    let root = match root.chars().all(is_plain) {
        true => root,
        false => format!("'{}'", root.replace('\'', r"'\''")),
    };
    eprintln!("skein: to go on with it: launch/run_local.sh --resume {root}");
}

fn attach(arguments: &AttachArguments) -> anyhow::Result<Ended> {
    let programs = Programs::beside_this()?;
    let run = open(&arguments.run)?;
    let (_, config) = run.open()?;
    // Between two incarnations of its learner, a run is under way as long as somebody sees to it
    // that there will be another.
    if !run.is_under_way()? {
        let root = run.root().display();
        bail!(
            "the run in {root} is not under way on this machine; one that is not complete is gone on with by launch/run_local.sh --resume {root}"
        );
    }
    umask(Mode::RWXG | Mode::RWXO);
    check_shared_memory_for_more(&config, arguments.count as usize)?;
    let claims = claim_actors(&run, arguments.count as usize)?;
    let actors: Vec<_> = claims.iter().map(ActorClaim::id).collect();
    let most = config.transport.max_actors;
    // The lowest free numbers were claimed: with those from the limit on, there would be too many.
    let too_many = actors.iter().filter(|id| id.0 as usize >= most).count();
    if too_many > 0 {
        bail!(
            "that is {too_many} more than transport.max_actors = {most} of this run allows: attach fewer"
        );
    }
    let names: Vec<_> = actors.iter().map(ToString::to_string).collect();
    eprintln!(
        "skein: adding actor {} to {}; Ctrl-C takes them away again",
        names.join(", "),
        run.root().display()
    );
    let plan = Plan {
        run: run.clone(),
        programs,
        actors,
        learner_threads: config.run.learner_threads,
        deadlines: Deadlines::of(&config),
    };
    let mut display = Display::new();
    runtime().context(RUNTIME)?.block_on(async {
        let mut interrupts = interrupts().context(SIGNALS)?;
        let is_under_way = || run.is_under_way().unwrap_or(false);
        Ok(supervisor::attach(&plan, is_under_way, &mut interrupts, &mut display).await?)
    })
}

fn report(arguments: &ReportArguments) -> anyhow::Result<Ended> {
    let run = open(&arguments.run)?;
    let (_, config) = run.open()?;
    let courses = load_courses(&config)?;
    let window = config.evaluation.window_episodes as usize;
    for picture in reports::draw_all(&run, &courses, window, ideal_walls_passed(&config)?)? {
        println!("{}", picture.display());
    }
    Ok(Ended::Finished)
}

/// Removes what runs of this user left whose processes were all killed.
fn sweep() {
    for failure in sweep_leftovers().failures {
        eprintln!("skein: not removed: {failure}");
    }
}

/// The run in `directory`, by its absolute path: processes of a run compare paths.
fn open(directory: &Path) -> anyhow::Result<RunDirectory> {
    let root = directory
        .canonicalize()
        .with_context(|| format!("{} is no directory of a run", directory.display()))?;
    Ok(RunDirectory::new(root))
}

fn claim_actors(run: &RunDirectory, count: usize) -> Result<Vec<ActorClaim>, RunError> {
    (0..count).map(|_| run.claim_actor()).collect()
}
