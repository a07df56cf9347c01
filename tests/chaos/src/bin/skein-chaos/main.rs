//! `skein-chaos`: trains once undisturbed and once with disturbances, and compares the results.

mod cost;
mod plan;
mod planned;
mod points;
mod recorder;
mod report;
mod soak;
mod stage;
mod statistics;
mod storm;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use clap::Parser;
use skein_chaos::{compare, leftovers};
use skein_protocol::config::Config;
use skein_protocol::summary::RunSummary;
use skein_run::RunDirectory;
use skein_run::failure::with_causes;
use skein_run::note;
use skein_run::signals::survive_file_size_limit;

use cost::CheckpointCost;
use plan::{DisturbanceCounts, Subject};
use planned::PlannedScript;
use points::Points;
use recorder::Recorder;
use soak::Soak;
use stage::{Recipe, TestedRun};
use storm::{Calm, Spared, Storm};

/// Kills, freezes, attaches and detaches the processes of a training at random, and compares its
/// results with an undisturbed training.
///
/// Trains the configuration undisturbed, then again with disturbances, and compares bit for bit:
/// policy, episodes, best snapshot, evaluation, curves. Then it looks for leftovers of the run on
/// the machine. DIR/disturbances.jsonl lists all disturbances; a seed always gives the same ones.
/// --points, --soak and --cost run other tests instead.
#[derive(Debug, Parser)]
#[command(version, after_long_help = EXIT_STATUS)]
struct Arguments {
    /// Configuration of the training; tests/chaos.sh sets configs/smoke.toml by default.
    #[arg(
        long,
        value_name = "FILE",
        required_unless_present = "calm",
        overrides_with = "config"
    )]
    config: Option<PathBuf>,
    /// Change one setting of the configuration, for example --set run.seed=7; may be repeated.
    #[arg(long = "set", value_name = "SECTION.KEY=VALUE")]
    overrides: Vec<String>,
    /// Compare with this finished run, and use its configuration, instead of training undisturbed
    /// first.
    #[arg(long, value_name = "DIR", conflicts_with_all = ["config", "overrides"])]
    calm: Option<PathBuf>,
    /// Folder of all results; must be new or empty. tests/chaos.sh sets
    /// runs/chaos_<date>_<time>_<process> by default.
    #[arg(long, value_name = "DIR", overrides_with = "run_dir")]
    run_dir: PathBuf,
    /// Seed of the disturbances and their times.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Number of actors.
    #[arg(
        long,
        value_name = "N",
        default_value_t = 4,
        value_parser = clap::value_parser!(u32).range(1..)
    )]
    actors: u32,
    /// Number of actors to kill.
    #[arg(long, value_name = "N", default_value_t = 50)]
    actor_kills: u32,
    /// Number of learners to kill.
    #[arg(long, value_name = "N", default_value_t = 5)]
    learner_kills: u32,
    /// Number of supervisors to kill, every other one together with all other processes. The run is
    /// resumed each time.
    #[arg(long, value_name = "N", default_value_t = 2)]
    supervisor_kills: u32,
    /// Number of processes to stop with SIGSTOP and continue later, half of them after their
    /// deadline.
    #[arg(long, value_name = "N", default_value_t = 6)]
    freezes: u32,
    /// Number of times to attach one or two actors and remove them again.
    #[arg(long, value_name = "N", default_value_t = 3)]
    attachments: u32,
    /// Soak test instead: train for this long while actors come and go, sample the resources of
    /// every process (DIR/soak.csv), and look for anything that grows.
    #[arg(long, value_name = "MINUTES", conflicts_with_all = ["calm", "points"])]
    soak: Option<f64>,
    /// Cost test instead: train this many times with and without checkpoints, alternately, and
    /// print the cost of checkpoints and of assembling episodes. Needs an otherwise idle machine.
    #[arg(
        long,
        value_name = "TIMES",
        conflicts_with_all = ["calm", "points", "soak"],
        value_parser = clap::value_parser!(u32).range(1..)
    )]
    cost: Option<u32>,
    /// Fault-point test instead: let a process die at each fault point named in fault.rs.
    #[arg(long)]
    points: bool,
}

const EXIT_STATUS: &str = "\
Exit status: 0 all disturbances happened, and nothing differs, grew, is left or costs 3 % or more; \
1 otherwise, 2 wrong arguments.";

/// Settings of a soak test, unless overridden: a run that outlasts it, and a replay buffer whose
/// two parts fill during the warm-up.
const SOAK_SETTINGS: [&str; 2] = ["run.episodes=100000000", "replay.capacity=8192"];

/// Settings of a fault-point test, unless overridden: a checkpoint after each epoch, so that its
/// fault points are reached soon after each death.
const POINTS_SETTINGS: [&str; 1] = ["checkpoints.every_episodes=1"];

/// Outcome of a test.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum TestOutcome {
    /// All requested disturbances happened, and no difference was found.
    Passed,
    /// A difference or leftover was found, or a disturbance did not happen.
    Failed,
}

impl TestOutcome {
    #[allow(clippy::fn_params_excessive_bools)] // the condition is the point
    fn of(all_is_well: bool) -> Self {
        if all_is_well {
            Self::Passed
        } else {
            Self::Failed
        }
    }
}

impl Arguments {
    /// Returns the training to run, with `settings` unless overridden.
    fn recipe(&self, settings: &[&str]) -> Result<Recipe> {
        let mut overrides: Vec<_> = settings.iter().map(ToString::to_string).collect();
        overrides.extend_from_slice(&self.overrides);
        Ok(Recipe {
            config: self.config.clone().context("--config is missing")?,
            overrides,
        })
    }
}

fn main() -> ExitCode {
    survive_file_size_limit();
    match run(&Arguments::parse()) {
        Ok(TestOutcome::Passed) => ExitCode::SUCCESS,
        Ok(TestOutcome::Failed) => ExitCode::FAILURE,
        Err(error) => {
            note!("skein-chaos: {}", with_causes(error.as_ref()));
            ExitCode::FAILURE
        }
    }
}

fn run(arguments: &Arguments) -> Result<TestOutcome> {
    let folder = new_folder(&arguments.run_dir)?;
    match (arguments.soak, arguments.cost) {
        (Some(minutes), _) => soak(arguments, &folder, Duration::from_secs_f64(minutes * 60.0)),
        (None, Some(times)) => cost(arguments, &folder, times),
        (None, None) => disturb(arguments, &folder),
    }
}

/// Runs the cost test.
fn cost(arguments: &Arguments, folder: &Path, times: u32) -> Result<TestOutcome> {
    let recipe = arguments.recipe(&[])?;
    let cost = CheckpointCost::measure(&recipe, times, |name, recipe| {
        summary(&train_undisturbed(folder, name, recipe, arguments.actors)?)
    })?;
    Ok(TestOutcome::of(cost.print()))
}

/// Trains undisturbed and disturbed, and compares the results.
fn disturb(arguments: &Arguments, folder: &Path) -> Result<TestOutcome> {
    let (calm, recipe) = calm_run(arguments, folder)?;
    let (identity, config) = calm.open()?;
    let summary = summary(&calm)?;

    let faults = arguments.points.then(|| folder.join("faults"));
    let stage = TestedRun::new(folder, "disturbed", faults.clone())?;
    note!(
        "skein-chaos: training with disturbances, in {}",
        stage.run.root().display()
    );
    let started = Instant::now();
    let mut storm = start(&stage, &recipe, arguments.actors, Spared::Nobody)?;
    let all_done = match faults {
        Some(faults) => {
            let mut points = Points::new(faults, config.run.episodes)?;
            storm.run(&mut points)?;
            report::points(&points)
        }
        None => {
            let mut planning = planning(arguments, &config, &summary);
            storm.run(&mut planning)?;
            report::disturbances(&storm, &planning)
        }
    };
    report::durations(started.elapsed().as_secs_f64(), summary.wall_secs);

    if stage.run.open()?.0.config_digest != identity.config_digest {
        bail!(
            "{} was trained with another configuration",
            calm.root().display()
        );
    }
    let same = report::comparison(&compare(&calm, &stage.run));
    let clean = report::leftovers(&leftovers(&stage.run));
    Ok(TestOutcome::of(all_done && same && clean))
}

/// Runs the soak test for `length`.
fn soak(arguments: &Arguments, folder: &Path, length: Duration) -> Result<TestOutcome> {
    let stage = TestedRun::new(folder, "soaked", None)?;
    let recipe = arguments.recipe(&SOAK_SETTINGS)?;
    note!(
        "skein-chaos: training for {:.0} minutes, in {}",
        length.as_secs_f64() / 60.0,
        stage.run.root().display()
    );
    let mut soak = Soak::new(&stage.run, length, arguments.seed, &folder.join("soak.csv"))?;
    let mut storm = start(&stage, &recipe, arguments.actors, Spared::ElderActor)?;
    storm.run(&mut soak)?;
    report::tally(&storm);
    let flat = report::findings(&soak.findings());
    let clean = report::leftovers(&leftovers(&stage.run));
    Ok(TestOutcome::of(flat && clean))
}

fn start<'a>(
    stage: &'a TestedRun,
    recipe: &Recipe,
    actors: u32,
    spared: Spared,
) -> Result<Storm<'a>> {
    let recorder = Recorder::create(&stage.folder().join("disturbances.jsonl"))
        .context("cannot write the recording")?;
    Ok(Storm::new(
        stage,
        stage.start(recipe, actors)?,
        recorder,
        spared,
    ))
}

/// Returns the undisturbed run, and the training that repeats it.
fn calm_run(arguments: &Arguments, folder: &Path) -> Result<(RunDirectory, Recipe)> {
    let Some(calm) = &arguments.calm else {
        let recipe = arguments.recipe(if arguments.points {
            &POINTS_SETTINGS
        } else {
            &[]
        })?;
        return Ok((
            train_undisturbed(folder, "calm", &recipe, arguments.actors)?,
            recipe,
        ));
    };
    let calm = calm
        .canonicalize()
        .with_context(|| format!("{} is not a run directory", calm.display()))?;
    let calm = RunDirectory::new(calm);
    let recipe = Recipe {
        config: calm.config(),
        overrides: Vec::new(),
    };
    Ok((calm, recipe))
}

/// Creates the folder and returns its absolute path, because processes of a run compare paths.
fn new_folder(path: &Path) -> Result<PathBuf> {
    let context = || format!("cannot create {}", path.display());
    fs::create_dir_all(path).with_context(context)?;
    if fs::read_dir(path).with_context(context)?.next().is_some() {
        bail!("{} is not empty: name a new directory", path.display());
    }
    path.canonicalize().with_context(context)
}

fn train_undisturbed(
    folder: &Path,
    name: &str,
    recipe: &Recipe,
    actors: u32,
) -> Result<RunDirectory> {
    let stage = TestedRun::new(folder, name, None)?;
    note!(
        "skein-chaos: training undisturbed, in {}",
        stage.run.root().display()
    );
    let supervisor = stage.start(recipe, actors)?;
    Storm::new(&stage, supervisor, Recorder::silent(), Spared::Nobody)
        .run(&mut Calm)
        .context("the undisturbed run failed")?;
    let left = leftovers(&stage.run);
    if !left.is_empty() {
        bail!("the undisturbed run left behind {left:?}");
    }
    Ok(stage.run)
}

fn summary(run: &RunDirectory) -> Result<RunSummary> {
    let path = run.summary_json();
    let context = || format!("cannot read {}: the run may be incomplete", path.display());
    serde_json::from_slice(&fs::read(&path).with_context(context)?).with_context(context)
}

fn planning(arguments: &Arguments, config: &Config, calm: &RunSummary) -> PlannedScript {
    let subject = Subject {
        episodes: config.run.episodes,
        episodes_per_epoch: config.learning.episodes_per_epoch,
        actors: arguments.actors,
        actor_silence_secs: config.transport.actor_silence_secs,
        learner_silence_secs: config.transport.learner_silence_secs,
    };
    let wanted = DisturbanceCounts {
        actor_kills: arguments.actor_kills,
        learner_kills: arguments.learner_kills,
        supervisor_kills: arguments.supervisor_kills,
        freezes: arguments.freezes,
        attachments: arguments.attachments,
    };
    let epochs = config.run.episodes as f64 / config.learning.episodes_per_epoch as f64;
    let epoch = Duration::from_secs_f64(calm.wall_secs / epochs.max(1.0));
    PlannedScript::new(
        wanted.plan(&subject, arguments.seed),
        subject.episodes_per_epoch,
        epoch,
    )
}
