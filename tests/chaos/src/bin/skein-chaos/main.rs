//! `skein-chaos`: trains a run in peace and once more under fire, and tells whether it made a
//! difference.

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
use skein_protocol::summary::Summary;
use skein_run::RunDirectory;
use skein_run::failure::with_causes;

use cost::Cost;
use plan::{Subject, Wanted};
use planned::Planning;
use points::Points;
use recorder::Recorder;
use soak::Soak;
use stage::{Recipe, Stage};
use storm::{Calm, Spared, Storm};

/// Kills, freezes, attaches and detaches the processes of a training at random, and compares what
/// it learned with an undisturbed one.
///
/// Trains the configuration undisturbed, then once more with the disturbances, and compares bit for
/// bit: policy, episodes, best snapshot, evaluation, curves. Then it looks for what is left of the
/// run on the machine. DIR/disturbances.jsonl lists everything that was done; the same seed does
/// the same. --points, --soak and --cost do something else instead.
#[derive(Debug, Parser)]
#[command(version, after_long_help = EXIT_STATUS)]
struct Arguments {
    /// What to train, and how; tests/chaos.sh sets configs/smoke.toml by default.
    #[arg(
        long,
        value_name = "FILE",
        required_unless_present = "calm",
        overrides_with = "config"
    )]
    config: Option<PathBuf>,
    /// Change one setting of the config, for example --set run.seed=7; may be repeated.
    #[arg(long = "set", value_name = "SECTION.KEY=VALUE")]
    overrides: Vec<String>,
    /// Compare with this finished run and train by its configuration, instead of training in peace
    /// first.
    #[arg(long, value_name = "DIR", conflicts_with_all = ["config", "overrides"])]
    calm: Option<PathBuf>,
    /// Where everything goes; must be new or empty. tests/chaos.sh sets runs/chaos_<date>_<time> by
    /// default.
    #[arg(long, value_name = "DIR", overrides_with = "run_dir")]
    run_dir: PathBuf,
    /// What is done and when follows from it.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Actors to start.
    #[arg(long, value_name = "N", default_value_t = 4, value_parser = clap::value_parser!(u32).range(1..))]
    actors: u32,
    /// Actors to kill.
    #[arg(long, value_name = "N", default_value_t = 50)]
    actor_kills: u32,
    /// Learners to kill.
    #[arg(long, value_name = "N", default_value_t = 5)]
    learner_kills: u32,
    /// Supervisors to kill, every other one together with all other processes; the run is resumed
    /// each time.
    #[arg(long, value_name = "N", default_value_t = 2)]
    supervisor_kills: u32,
    /// Processes to stop with SIGSTOP and to continue later, half of them after their deadline.
    #[arg(long, value_name = "N", default_value_t = 6)]
    freezes: u32,
    /// Times to attach one or two actors, and to take them away.
    #[arg(long, value_name = "N", default_value_t = 3)]
    attachments: u32,
    /// Instead, train for so long with actors coming and going, sample what every process holds
    /// (DIR/soak.csv), and look for anything that grows.
    #[arg(long, value_name = "MINUTES", conflicts_with_all = ["calm", "points"])]
    soak: Option<f64>,
    /// Instead, train so many times with checkpoints and so many times without, in turn, and print
    /// what checkpoints and assembling episodes cost; on a machine that does nothing else.
    #[arg(long, value_name = "TIMES", conflicts_with_all = ["calm", "points", "soak"], value_parser = clap::value_parser!(u32).range(1..))]
    cost: Option<u32>,
    /// Instead, let a process die at each of the points named in the source (fault.rs).
    #[arg(long)]
    points: bool,
}

const EXIT_STATUS: &str = "\
Exit status: 0 everything was done, and nothing differs, grew, is left or costs 3 % or more; 1 \
otherwise; 2 wrong arguments.";

/// What a soak sets, unless it is set otherwise: a run that outlasts it, and a replay buffer that
/// is full, both parts of it, while it is still warming up.
const SOAK_SETTINGS: [&str; 2] = ["run.episodes=100000000", "replay.capacity=8192"];

/// What a death at each point sets, unless it is set otherwise: a checkpoint after each epoch, so
/// that the points of writing one are passed soon after each death.
const POINTS_SETTINGS: [&str; 1] = ["checkpoints.every_episodes=1"];

/// How it went.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Verdict {
    /// Everything asked for was done, and it made no difference.
    Passed,
    /// Something differs, is left behind, or was not done.
    Failed,
}

impl Verdict {
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
    /// What to train, with `settings` unless they are set otherwise.
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
    match run(&Arguments::parse()) {
        Ok(Verdict::Passed) => ExitCode::SUCCESS,
        Ok(Verdict::Failed) => ExitCode::FAILURE,
        Err(error) => {
            eprintln!("skein-chaos: {}", with_causes(error.as_ref()));
            ExitCode::FAILURE
        }
    }
}

fn run(arguments: &Arguments) -> Result<Verdict> {
    let folder = new_folder(&arguments.run_dir)?;
    match (arguments.soak, arguments.cost) {
        (Some(minutes), _) => soak(arguments, &folder, Duration::from_secs_f64(minutes * 60.0)),
        (None, Some(times)) => cost(arguments, &folder, times),
        (None, None) => disturb(arguments, &folder),
    }
}

/// Trains with checkpoints and without, and tells what they cost.
fn cost(arguments: &Arguments, folder: &Path, times: u32) -> Result<Verdict> {
    let recipe = arguments.recipe(&[])?;
    let cost = Cost::measure(&recipe, times, |name, recipe| {
        summary(&train_in_peace(folder, name, recipe, arguments.actors)?)
    })?;
    Ok(Verdict::of(cost.tell()))
}

/// Trains in peace, then under fire, and compares.
fn disturb(arguments: &Arguments, folder: &Path) -> Result<Verdict> {
    let (calm, recipe) = calm_run(arguments, folder)?;
    let (identity, config) = calm.open()?;
    let summary = summary(&calm)?;

    let faults = arguments.points.then(|| folder.join("faults"));
    let stage = Stage::new(folder, "disturbed", faults.clone())?;
    eprintln!(
        "skein-chaos: the same under fire, in {}",
        stage.run.root().display()
    );
    let started = Instant::now();
    let mut storm = start(&stage, &recipe, arguments.actors, Spared::Nobody)?;
    let all_done = match faults {
        Some(faults) => {
            let mut points = Points::new(faults, config.run.episodes)?;
            storm.rage(&mut points)?;
            report::points(&points)
        }
        None => {
            let mut planning = planning(arguments, &config, &summary);
            storm.rage(&mut planning)?;
            report::disturbances(&storm, &planning)
        }
    };
    report::durations(started.elapsed().as_secs_f64(), summary.wall_secs);

    if stage.run.open()?.0.config_digest != identity.config_digest {
        bail!(
            "{} was trained by another configuration",
            calm.root().display()
        );
    }
    let same = report::comparison(&compare(&calm, &stage.run));
    let clean = report::leftovers(&leftovers(&stage.run));
    Ok(Verdict::of(all_done && same && clean))
}

/// Trains for `length` with actors coming and going, and looks for anything that grows.
fn soak(arguments: &Arguments, folder: &Path, length: Duration) -> Result<Verdict> {
    let stage = Stage::new(folder, "soaked", None)?;
    let recipe = arguments.recipe(&SOAK_SETTINGS)?;
    eprintln!(
        "skein-chaos: trains for {:.0} minutes in {}",
        length.as_secs_f64() / 60.0,
        stage.run.root().display()
    );
    let mut soak = Soak::new(&stage.run, length, arguments.seed, &folder.join("soak.csv"))?;
    let mut storm = start(&stage, &recipe, arguments.actors, Spared::ElderActor)?;
    storm.rage(&mut soak)?;
    report::tally(&storm);
    let flat = report::findings(&soak.findings());
    let clean = report::leftovers(&leftovers(&stage.run));
    Ok(Verdict::of(flat && clean))
}

fn start<'a>(stage: &'a Stage, recipe: &Recipe, actors: u32, spared: Spared) -> Result<Storm<'a>> {
    let recorder = Recorder::create(&stage.folder().join("disturbances.jsonl"))
        .context("cannot write the recording")?;
    Ok(Storm::new(
        stage,
        stage.start(recipe, actors)?,
        recorder,
        spared,
    ))
}

/// The undisturbed run, and how to train the same.
fn calm_run(arguments: &Arguments, folder: &Path) -> Result<(RunDirectory, Recipe)> {
    let Some(calm) = &arguments.calm else {
        let recipe = arguments.recipe(if arguments.points {
            &POINTS_SETTINGS
        } else {
            &[]
        })?;
        return Ok((
            train_in_peace(folder, "calm", &recipe, arguments.actors)?,
            recipe,
        ));
    };
    let calm = calm
        .canonicalize()
        .with_context(|| format!("{} is no directory of a run", calm.display()))?;
    let calm = RunDirectory::new(calm);
    let recipe = Recipe {
        config: calm.config(),
        overrides: Vec::new(),
    };
    Ok((calm, recipe))
}

/// The folder by its absolute path, created: processes of a run compare paths.
fn new_folder(path: &Path) -> Result<PathBuf> {
    let context = || format!("cannot create {}", path.display());
    fs::create_dir_all(path).with_context(context)?;
    if fs::read_dir(path).with_context(context)?.next().is_some() {
        bail!("{} is not empty: name a new directory", path.display());
    }
    path.canonicalize().with_context(context)
}

fn train_in_peace(folder: &Path, name: &str, recipe: &Recipe, actors: u32) -> Result<RunDirectory> {
    let stage = Stage::new(folder, name, None)?;
    eprintln!(
        "skein-chaos: trains in peace, in {}",
        stage.run.root().display()
    );
    let supervisor = stage.start(recipe, actors)?;
    Storm::new(&stage, supervisor, Recorder::silent(), Spared::Nobody)
        .rage(&mut Calm)
        .context("the undisturbed run failed")?;
    let left = leftovers(&stage.run);
    if !left.is_empty() {
        bail!("the undisturbed run left behind {left:?}");
    }
    Ok(stage.run)
}

fn summary(run: &RunDirectory) -> Result<Summary> {
    let path = run.summary_json();
    let context = || format!("{}: is this a finished run?", path.display());
    serde_json::from_slice(&fs::read(&path).with_context(context)?).with_context(context)
}

fn planning(arguments: &Arguments, config: &Config, calm: &Summary) -> Planning {
    let subject = Subject {
        episodes: config.run.episodes,
        episodes_per_epoch: config.learning.episodes_per_epoch,
        actors: arguments.actors,
        actor_silence_secs: config.transport.actor_silence_secs,
        learner_silence_secs: config.transport.learner_silence_secs,
    };
    let wanted = Wanted {
        actor_kills: arguments.actor_kills,
        learner_kills: arguments.learner_kills,
        supervisor_kills: arguments.supervisor_kills,
        freezes: arguments.freezes,
        attachments: arguments.attachments,
    };
    let epochs = config.run.episodes as f64 / config.learning.episodes_per_epoch as f64;
    let epoch = Duration::from_secs_f64(calm.wall_secs / epochs.max(1.0));
    Planning::new(
        wanted.plan(&subject, arguments.seed),
        subject.episodes_per_epoch,
        epoch,
    )
}
