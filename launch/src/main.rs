//! `skein`: the front door. Runs a training, adds actors to one, draws what one left; evaluates and
//! experiments.

mod cli;
mod experiment;

use std::ffi::OsString;
use std::os::unix::process::CommandExt;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::process::{self, ExitCode};
use std::thread;
use std::time::Duration;

use anyhow::{Context, bail};
use clap::Parser;
use rustix::fs::Mode;
use rustix::process::umask;
use skein_launch::conclusion::conclusion;
use skein_launch::display::ProgressDisplay;
use skein_launch::interrupts::{interrupts, runtime};
use skein_launch::resume::resume;
use skein_launch::supervisor::{
    self, Deadlines, Ended, Programs, SupervisionPlan, SupervisorError,
};
use skein_prepare::room::{
    check_library_space, check_shared_memory_for_more, raise_file_limit, scarce_disk,
};
use skein_prepare::{NewDirectory, Prepared, prepare};
use skein_protocol::config::{Config, CoursesSection, EvaluationSection};
use skein_protocol::summary::RunEnding;
use skein_reports::{ideal_walls_passed, load_courses};
use skein_run::ActorClaim;
use skein_run::allocation::EndWithoutMemory;
use skein_run::failure::{EXIT_INTERRUPTED, with_causes};
use skein_run::logging::environment_faults;
use skein_run::signals::survive_file_size_limit;
use skein_run::terminal::{quoted, stdout_columns};
use skein_run::{RunDirectory, RunError, SupervisorLock, sweep_leftovers};
use skein_run::{note, notes, show};

use cli::{
    AttachArguments, Cli, Command, EncoderArguments, ExportArguments, ReportArguments,
    RunArguments, Task,
};

/// Contexts of errors that the operating system may return.
const RUNTIME: &str = "cannot start the runtime";
const SIGNALS: &str = "cannot listen for signals";
/// Time that an unsupervised learner has to end before its run is resumed.
const PATIENCE: Duration = Duration::from_secs(10);

/// A run that failed; the user has read why.
#[derive(Debug, thiserror::Error)]
#[error("the run failed")]
struct Unfinished;

#[global_allocator]
static ALLOCATOR: EndWithoutMemory = EndWithoutMemory {
    program: "skein",
    status: 1,
};

fn main() -> ExitCode {
    survive_file_size_limit();
    notes::never_wait();
    let status = carry_out();
    notes::settle();
    status
}

fn carry_out() -> ExitCode {
    let outcome = match Cli::parse().command {
        Command::Run(arguments) => run(&arguments).map(status),
        Command::Attach(arguments) => attach(&arguments).map(status),
        Command::Encoder(arguments) => encoder(&arguments),
        Command::Evaluate(arguments) => skein_evaluate::run(&arguments).map(|()| ExitCode::SUCCESS),
        Command::Experiment(arguments) => {
            warn_of_environment();
            experiment::carry_out(&arguments)
        }
        Command::Export(ExportArguments { snapshot, onnx }) => {
            skein_export::export(&snapshot, &onnx)
                .map(|()| {
                    show!("{}", onnx.display());
                    ExitCode::SUCCESS
                })
                .map_err(Into::into)
        }
        Command::Report(arguments) => report(&arguments),
        Command::Watch(arguments) => hand_over("skein-watch", "watch.sh", &arguments.options),
    };
    match outcome {
        Ok(status) => status,
        Err(error) => {
            // What failed in a run has been printed already.
            if !error.is::<Unfinished>() {
                note!("skein: {}", with_causes(error.as_ref()));
            }
            ExitCode::FAILURE
        }
    }
}

fn status(ended: Ended) -> ExitCode {
    match ended {
        Ended::Finished => ExitCode::SUCCESS,
        Ended::Interrupted => ExitCode::from(EXIT_INTERRUPTED),
    }
}

fn run(arguments: &RunArguments) -> anyhow::Result<Ended> {
    // All files of a run are readable by its user alone.
    umask(Mode::RWXG | Mode::RWXO);
    let programs = Programs::beside_this()?;
    let actors = match arguments.actors {
        Some(actors) => actors as usize,
        None => thread::available_parallelism().map_or(1, Into::into),
    };
    warn_of_environment();
    raise_file_limit(actors)?;
    sweep();
    let (prepared, lock) = match arguments.task() {
        Task::New { config, run_dir } => {
            let prepared = prepare(config, &arguments.overrides, run_dir, actors)?;
            let lock = SupervisorLock::take(&prepared.run, &prepared.identity)?;
            (prepared, lock)
        }
        Task::Resume {
            directory,
            episodes,
        } => resume(directory, episodes, actors, PATIENCE)?,
    };
    announce(&prepared, actors, arguments);
    let Prepared {
        run, config, new, ..
    } = &prepared;
    if let Some(warning) = scarce_disk(config, run.root()) {
        note!("skein: {warning}");
    }

    let claims = claim_actors(run, actors)?;
    let plan = SupervisionPlan {
        run: run.clone(),
        programs,
        actors: claims.iter().map(ActorClaim::id).collect(),
        learner_threads: config.run.learner_threads,
        deadlines: Deadlines::of(config),
    };
    let mut display = ProgressDisplay::new();
    let outcome = runtime().context(RUNTIME)?.block_on(async {
        let mut interrupts = interrupts().context(SIGNALS)?;
        anyhow::Ok(supervisor::run(&plan, &mut interrupts, &mut display).await)
    });
    display.finish();
    drop(lock);
    sweep();

    let ended = match outcome? {
        Ok(ended) => ended,
        Err(error) => return Err(failed(run, config, new.as_ref(), &error).into()),
    };
    draw_if_possible(run, config);
    show!("{}", conclusion(run, stdout_columns()).trim_end());
    // A user who stopped only the learner has interrupted the run as well. Conversely, a run may
    // complete before it acts on an interruption.
    let ended = match run.summary().map(|summary| summary.ending) {
        Some(RunEnding::Completed) => Ended::Finished,
        Some(RunEnding::Interrupted) => Ended::Interrupted,
        None => ended,
    };
    if ended == Ended::Interrupted {
        if run.summary().is_none() {
            let newest = run.newest_checkpoint();
            let kept = newest.map_or("there is no checkpoint yet".to_owned(), |episodes| {
                format!("the newest checkpoint was written after episode {episodes}")
            });
            note!("skein: stopped immediately: {kept}");
        }
        print_resume_command(run);
    }
    Ok(ended)
}

/// Prints why a run failed and what can be done, before anything else can fail.
fn failed(
    run: &RunDirectory,
    config: &Config,
    new: Option<&NewDirectory>,
    error: &SupervisorError,
) -> Unfinished {
    note!("skein: {}", with_causes(error));
    if let SupervisorError::DirectoryGone(_) = error {
        return Unfinished;
    }
    // A learner that cannot start cannot be resumed either.
    if !error.is_self_explanatory() {
        print_resume_command(run);
    } else if let Some(new) = new
        && run.newest_checkpoint().is_none()
    {
        // The run never began: its directory would only block the next attempt.
        if let Err(error) = new.take_back() {
            note!("skein: {} remains: {error}", run.root().display());
        }
        return Unfinished;
    }
    draw_if_possible(run, config);
    Unfinished
}

/// Draws the plots. They are optional: a run that failed may still have left something to draw, and
/// a run that succeeded is a success without them.
fn draw_if_possible(run: &RunDirectory, config: &Config) {
    // A run that was removed does not come back as a folder of plots.
    if !run.root().exists() {
        return;
    }
    let Ok(plots) = catch_unwind(AssertUnwindSafe(|| draw(run, config))) else {
        note!("skein: some plots could not be drawn: the drawing panicked");
        return;
    };
    report_failures(&plots.failures);
    if !plots.failures.is_empty() {
        let root = quoted(run.root());
        note!(
            "skein: everything else is kept; to draw again: \
             target/release/skein report --run {root}"
        );
    }
}

/// Reports variables of the environment that the processes of a run cannot use: in their logs
/// nobody would look for it.
fn warn_of_environment() {
    for fault in environment_faults() {
        note!("skein: {fault}");
    }
}

/// Prints what is about to start.
fn announce(prepared: &Prepared, actors: usize, arguments: &RunArguments) {
    let config = &prepared.config;
    note!(
        "skein: {actors} {}, {} training episodes, seed {}",
        if actors == 1 { "actor" } else { "actors" },
        config.run.episodes,
        config.run.seed
    );
    let root = prepared.run.root().display();
    if arguments.resume.is_some() {
        note!("skein: resuming the run in {root}");
        return;
    }
    note!("skein: run directory: {root}");
    if !config.courses.evaluation.contains(&config.courses.training) {
        let names = CoursesSection::names(&config.courses.evaluation);
        note!(
            "skein: note: the training course is not in courses.evaluation; \
                 the best snapshot is chosen on {}",
            names.first().map_or("none", String::as_str)
        );
    }
    let confirming = config.evaluation.confirm_episodes;
    if confirming < EvaluationSection::FEW_EPISODES {
        note!(
            "skein: note: evaluation.confirm_episodes = {confirming}: \
                 so few say little about which snapshot is the best; {} or more do",
            EvaluationSection::FEW_EPISODES
        );
    }
}

/// Prints the command that resumes an incomplete run.
fn print_resume_command(run: &RunDirectory) {
    let root = quoted(run.root());
    note!("skein: to resume this run: launch/run_local.sh --resume {root}");
}

fn attach(arguments: &AttachArguments) -> anyhow::Result<Ended> {
    warn_of_environment();
    raise_file_limit(arguments.count as usize)?;
    let programs = Programs::beside_this()?;
    let run = open(&arguments.run)?;
    let (_, config) = run.open()?;
    // While the learner restarts, its supervisor keeps the run under way.
    if !run.is_running()? {
        bail!(
            "the run in {} is not under way on this machine; \
              if it is incomplete, resume it with launch/run_local.sh --resume {}",
            run.root().display(),
            quoted(run.root())
        );
    }
    umask(Mode::RWXG | Mode::RWXO);
    check_shared_memory_for_more(&config, arguments.count as usize)?;
    let claims = claim_actors(&run, arguments.count as usize)?;
    let actors: Vec<_> = claims.iter().map(ActorClaim::id).collect();
    let most = config.transport.max_actors;
    // The lowest free ids were claimed. Ids at or above the limit exceed the allowed number.
    let too_many = actors.iter().filter(|id| id.0 as usize >= most).count();
    if too_many > 0 {
        bail!("this run allows transport.max_actors = {most} actors: attach {too_many} fewer");
    }
    let names: Vec<_> = actors.iter().map(ToString::to_string).collect();
    note!(
        "skein: adding actor {} to {}; Ctrl-C removes them again",
        names.join(", "),
        run.root().display()
    );
    let plan = SupervisionPlan {
        run: run.clone(),
        programs,
        actors,
        learner_threads: config.run.learner_threads,
        deadlines: Deadlines::of(&config),
    };
    let mut display = ProgressDisplay::new();
    runtime().context(RUNTIME)?.block_on(async {
        let mut interrupts = interrupts().context(SIGNALS)?;
        let is_under_way = || run.is_running().unwrap_or(false);
        Ok(supervisor::attach(&plan, is_under_way, &mut interrupts, &mut display).await?)
    })
}

/// Becomes the program that trains encoders: it needs libtorch, which this one does without.
fn encoder(arguments: &EncoderArguments) -> anyhow::Result<ExitCode> {
    check_library_space()?;
    hand_over("skein-encoder", "encoder.sh", &arguments.options)
}

/// Replaces this program by `program`, which lies beside it and is built by `script`.
fn hand_over(program: &str, script: &str, options: &[OsString]) -> anyhow::Result<ExitCode> {
    let program = std::env::current_exe()
        .context("cannot find where this program lies")?
        .with_file_name(program);
    let error = process::Command::new(&program).args(options).exec();
    Err(error).with_context(|| {
        format!(
            "cannot start {}: build it with launch/{script}",
            program.display()
        )
    })
}

fn report(arguments: &ReportArguments) -> anyhow::Result<ExitCode> {
    let pictures = &arguments.pictures;
    if pictures.failures.is_some() || pictures.gif.is_some() {
        skein_evaluate::draw(&arguments.run, arguments.suite.as_deref(), pictures)?;
        return Ok(ExitCode::SUCCESS);
    }
    let run = open(&arguments.run)?;
    let (_, config) = run.open()?;
    let plots = draw(&run, &config);
    for picture in &plots.pictures {
        show!("{}", picture.display());
    }
    report_failures(&plots.failures);
    if !plots.failures.is_empty() {
        return Ok(ExitCode::FAILURE);
    }
    if plots.pictures.is_empty() {
        note!(
            "skein: {} holds nothing to draw yet: no episode has ended",
            run.root().display()
        );
    }
    Ok(ExitCode::SUCCESS)
}

/// Plots of a run, and a message for each that could not be drawn.
struct Plots {
    pictures: Vec<PathBuf>,
    failures: Vec<String>,
}

/// Draws every plot that the run left the files for. A course that cannot be read costs only what
/// needs it.
fn draw(run: &RunDirectory, config: &Config) -> Plots {
    let mut failures = Vec::new();
    let courses = load_courses(config).unwrap_or_else(|error| {
        failures.push(with_causes(&error));
        Vec::new()
    });
    let ideal = ideal_walls_passed(config)
        .map_err(|error| failures.push(with_causes(&error)))
        .ok();
    failures.dedup();
    let window = config.evaluation.window_episodes as usize;
    let drawn = skein_reports::draw_all(run, &courses, window, ideal);
    failures.extend(drawn.failures.iter().map(|error| with_causes(error)));
    for torn in &drawn.torn {
        note!("skein: note: {torn}");
    }
    Plots {
        pictures: drawn.pictures,
        failures,
    }
}

fn report_failures(failures: &[String]) {
    for failure in failures {
        note!("skein: a plot could not be drawn: {failure}");
    }
}

/// Removes the remains of this user's runs whose processes were all killed.
fn sweep() {
    for failure in sweep_leftovers().failures {
        note!("skein: could not remove: {failure}");
    }
}

/// Returns the run in `directory`, by its absolute path, because processes of a run compare paths.
fn open(directory: &Path) -> anyhow::Result<RunDirectory> {
    let root = directory
        .canonicalize()
        .with_context(|| format!("{} is not a run directory", directory.display()))?;
    Ok(RunDirectory::new(root))
}

fn claim_actors(run: &RunDirectory, count: usize) -> Result<Vec<ActorClaim>, RunError> {
    (0..count).map(|_| run.claim_actor()).collect()
}
