//! The command line of `skein`, and with it every help text of the commands in `launch/`.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use clap::{Args, Parser, Subcommand};
use skein_evaluate::Pictures;
use skein_run::failure::EXIT_WRONG_ARGUMENTS;
use skein_run::terminal::quoted;
use skein_run::{note, notes};

/// Trains a drone to avoid obstacles from its depth camera.
///
/// One learner and several actors, processes on this machine, share a run. The same configuration
/// and seed give the same policy, bit for bit, however many actors fly and whichever of them fail.
#[derive(Parser)]
#[command(name = "skein", version, after_help = SCRIPTS)]
pub(crate) struct Cli {
    #[command(subcommand)]
    pub(crate) command: Command,
}

const SCRIPTS: &str = "\
The scripts in launch/ build what a command needs and hand over to it: run_local.sh (run), \
attach_actor.sh (attach), encoder.sh (encoder), evaluate.sh (evaluate), experiment.sh \
(experiment), export.sh (export), watch.sh (watch).";

/// The commands; the text of each stands at its arguments.
#[derive(Subcommand)]
pub(crate) enum Command {
    #[command(after_long_help = RUN_NOTES)]
    Run(RunArguments),
    #[command(after_long_help = ATTACH_NOTES)]
    Attach(AttachArguments),
    Encoder(EncoderArguments),
    Evaluate(skein_evaluate::Arguments),
    #[command(after_long_help = EXPERIMENT_NOTES)]
    Experiment(ExperimentArguments),
    #[command(after_long_help = EXPORT_NOTES)]
    Export(ExportArguments),
    #[command(after_long_help = REPORT_NOTES)]
    Report(ReportArguments),
    Watch(WatchArguments),
}

/// Trains on this machine: starts a learner and its actors, and watches them until the run ends.
///
/// Progress goes to standard error. At the end, the best snapshot flies the evaluation courses; the
/// table of how it flew and the paths of everything the run left go to standard output.
#[derive(Args)]
pub(crate) struct RunArguments {
    /// Configuration to train; launch/run_local.sh sets configs/local.toml by default.
    #[arg(
        long,
        value_name = "FILE",
        overrides_with = "config",
        required_unless_present = "resume"
    )]
    pub(crate) config: Option<PathBuf>,
    /// Where everything goes; must be new or empty. launch/run_local.sh sets
    /// runs/<date>_<time>_<process> by default.
    #[arg(
        long,
        value_name = "DIR",
        overrides_with = "run_dir",
        required_unless_present = "resume"
    )]
    pub(crate) run_dir: Option<PathBuf>,
    /// Resume the run in this directory from its newest checkpoint.
    ///
    /// The run was stopped, failed or was cut off. It keeps its configuration, may have any number
    /// of actors, and ends with the same result as if it had never stopped.
    #[arg(long, value_name = "DIR")]
    pub(crate) resume: Option<PathBuf>,
    /// With --resume: lengthen the run, complete or not, to N training episodes in all.
    ///
    /// It ends with the same result as if it had been started with N. Its end so far, at which the
    /// last snapshot was judged, is undone: it resumes from the checkpoint before.
    #[arg(
        long,
        value_name = "N",
        value_parser = clap::value_parser!(u64).range(1..)
    )]
    pub(crate) episodes: Option<u64>,
    /// Actors to start [default: number of cores]. With 0, the run waits for actors that join it:
    /// `skein attach`, or an environment of yours in Python.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32))]
    pub(crate) actors: Option<u32>,
    /// Change one setting of the config, for example --set run.seed=7; may be repeated.
    ///
    /// Paths are relative to the working directory; in the config file they are relative to that
    /// file.
    #[arg(long = "set", value_name = "SECTION.KEY=VALUE")]
    pub(crate) overrides: Vec<String>,
}

const RUN_NOTES: &str = "\
Ctrl-C stops in order: episodes under way are abandoned, the updates of the epoch are finished, \
everything learned is saved. A second Ctrl-C stops at once; --resume then continues from the \
newest checkpoint.

Environment:
  RUST_LOG          level of the logs in DIR/logs [default: info], for example debug
  SKEIN_LOG_FORMAT  json writes the logs as one JSON object a line

Exit status: 0 finished, 1 failed, 2 wrong arguments, 130 interrupted.";

/// Adds actors to a run that is under way on this machine.
///
/// They stay until the run ends, and find its learner again if that is restarted. They change how
/// fast the run proceeds, never what it learns.
#[derive(Args)]
pub(crate) struct AttachArguments {
    /// Directory of the run, as `skein run` printed it.
    #[arg(long, value_name = "DIR")]
    pub(crate) run: PathBuf,
    /// Actors to start.
    #[arg(
        long,
        value_name = "N",
        default_value_t = 1,
        value_parser = clap::value_parser!(u32).range(1..)
    )]
    pub(crate) count: u32,
}

const ATTACH_NOTES: &str = "\
Ctrl-C removes these actors again; the run continues without them.

Exit status: 0 the run ended, 1 failed, 2 wrong arguments, 130 interrupted.";

/// Trains an encoder before any run, or measures one.
///
/// The program skein-encoder does it, and has the options: skein encoder --help.
#[derive(Args)]
#[command(disable_help_flag = true)]
pub(crate) struct EncoderArguments {
    /// Options of skein-encoder.
    #[arg(
        value_name = "OPTIONS",
        trailing_var_arg = true,
        allow_hyphen_values = true
    )]
    pub(crate) options: Vec<OsString>,
}

/// Serves a page on this machine that shows what the runs of a folder are doing.
///
/// The program skein-watch does it, and has the options: skein watch --help.
#[derive(Args)]
#[command(disable_help_flag = true)]
pub(crate) struct WatchArguments {
    /// Options of skein-watch.
    #[arg(
        value_name = "OPTIONS",
        trailing_var_arg = true,
        allow_hyphen_values = true
    )]
    pub(crate) options: Vec<OsString>,
}

/// Trains several configurations with several seeds, and reports how they compare.
///
/// An experiment is a file configs/experiments/NAME.toml: a question, and arms, which are settings
/// to compare. Each arm is trained with several seeds, each an ordinary run on one core in
/// runs/experiments/NAME/ARM/seed-N; what it prints goes to ARM/seed-N.log. Where the experiment
/// names an evaluation suite, the best snapshot of each run then flies it. The report, tables and
/// pictures with 95 % intervals over the seeds, is printed and goes to
/// runs/experiments/NAME/report/.
///
/// The same command again continues what was interrupted or failed and leaves alone what is
/// complete. What another experiment has trained with the same configuration and seed is not
/// trained again: a link leads there.
#[derive(Args)]
pub(crate) struct ExperimentArguments {
    /// Name of the experiment, a file configs/experiments/NAME.toml, or the path of a file
    /// elsewhere.
    #[arg(required_unless_present = "list", value_name = "NAME|FILE")]
    pub(crate) name: Option<String>,
    /// Print the experiments, with the number of runs and the question of each.
    #[arg(long, conflicts_with = "name")]
    pub(crate) list: bool,
    /// Runs of each arm, with seeds from 1 to K [default: as the experiment's file says].
    #[arg(long, value_name = "K", value_parser = clap::value_parser!(u64).range(1..=100))]
    pub(crate) seeds: Option<u64>,
    /// Runs at a time [default: number of cores].
    #[arg(long, value_name = "J", value_parser = clap::value_parser!(u16).range(1..))]
    pub(crate) jobs: Option<u16>,
    /// Print a command for each run that is not complete, one a line, and run nothing: for GNU
    /// parallel, xargs, or an array of Slurm jobs.
    ///
    /// Each host needs the repository at the same commit. Give --runs a folder that all share, or
    /// copy what they left into one; --report then gathers it.
    #[arg(long, conflicts_with_all = ["report", "publish", "job", "jobs"])]
    pub(crate) list_jobs: bool,
    /// Run only this one of the runs, as --list-jobs names it, and report nothing.
    #[arg(long, value_name = "ARM/seed-N", conflicts_with_all = ["report", "publish", "jobs"])]
    pub(crate) job: Option<String>,
    /// Shorten every run to N training episodes, in a folder of its own:
    /// runs/experiments/NAME_N_episodes.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub(crate) episodes: Option<u64>,
    /// Folder for the runs of all experiments [default: runs/experiments in the repository].
    #[arg(long, value_name = "DIR")]
    pub(crate) runs: Option<PathBuf>,
    /// Run nothing: report what is there.
    #[arg(long)]
    pub(crate) report: bool,
    /// Publish the report in docs/results/NAME.md, between its lines <!-- report --> and
    /// <!-- end -->.
    ///
    /// The pictures go to docs/results/pictures/, the figures of each run to
    /// docs/results/runs/NAME.csv. What stands around the two lines is kept.
    #[arg(long, hide_short_help = true)]
    pub(crate) publish: bool,
    /// Repository that holds the experiments and the documents; launch/experiment.sh sets it.
    #[arg(long, value_name = "DIR", default_value = ".", hide_short_help = true)]
    pub(crate) repository: PathBuf,
}

const EXPERIMENT_NOTES: &str = "\
Ctrl-C stops in order: every training under way finishes the updates of its epoch and saves; a \
suite under way is flown again the next time. A second Ctrl-C stops at once.

Exit status: 0 every run is complete, 1 a run failed or something was refused, 2 wrong arguments, \
130 interrupted.";

/// Writes a snapshot as an ONNX graph, which programs without Skein run.
///
/// The graph holds encoder, policy and history: depth, velocity, history -> action, next_history.
/// docs/python.md describes it.
#[derive(Args)]
pub(crate) struct ExportArguments {
    /// Snapshot, such as DIR/snapshots/best.safetensors of a run.
    #[arg(long, value_name = "FILE")]
    pub(crate) snapshot: PathBuf,
    /// File to write; it is replaced.
    #[arg(long, value_name = "FILE")]
    pub(crate) onnx: PathBuf,
}

const EXPORT_NOTES: &str = "\
Exit status: 0 written, 1 the snapshot cannot be read or the file not written, 2 wrong arguments.";

const REPORT_NOTES: &str = "\
Exit status: 0 drawn, 1 a plot could not be drawn or the run not be read, 2 wrong arguments.";

/// Draws the plots of a run again, from the files it left, and prints their paths.
///
/// With --failures or --gif, draws these instead: the run's best snapshot flies the final
/// evaluation again, the same episodes, or a suite. `skein evaluate` has more to choose from.
#[derive(Args)]
pub(crate) struct ReportArguments {
    /// Directory of the run.
    #[arg(long, value_name = "DIR")]
    pub(crate) run: PathBuf,
    #[command(flatten)]
    pub(crate) pictures: Pictures,
    /// With --failures or --gif: a suite file to fly instead of the run's evaluation courses.
    /// Example: configs/evaluations/shapes.toml.
    #[arg(long, value_name = "FILE", requires = "Pictures")]
    pub(crate) suite: Option<PathBuf>,
}

/// Task of `skein run`.
pub(crate) enum Task<'a> {
    New {
        config: &'a Path,
        run_dir: &'a Path,
    },
    Resume {
        directory: &'a Path,
        episodes: Option<u64>,
    },
}

impl RunArguments {
    /// Ends the process with the reason if the arguments contradict each other.
    pub(crate) fn task(&self) -> Task<'_> {
        match (&self.resume, &self.config, &self.run_dir) {
            (None, Some(config), Some(run_dir)) if self.episodes.is_none() => {
                Task::New { config, run_dir }
            }
            (Some(directory), None, None) if self.overrides.is_empty() => Task::Resume {
                directory,
                episodes: self.episodes,
            },
            _ => {
                note!("skein: {}", self.conflict());
                notes::settle();
                std::process::exit(EXIT_WRONG_ARGUMENTS.into())
            }
        }
    }

    /// Returns what contradicts --resume, or lacks it, and what to do.
    fn conflict(&self) -> String {
        if let (None, Some(episodes)) = (&self.resume, self.episodes) {
            return format!(
                "--episodes lengthens a run and needs --resume DIR; for a new run, give \
                 --set run.episodes={episodes}"
            );
        }
        let given = [
            (self.config.is_some(), "--config"),
            (self.run_dir.is_some(), "--run-dir"),
            (!self.overrides.is_empty(), "--set"),
        ];
        let given: Vec<_> = given
            .iter()
            .filter(|(is, _)| *is)
            .map(|(_, name)| *name)
            .collect();
        let directory = self.resume.as_deref().unwrap_or(Path::new("DIR"));
        let resume = format!("launch/run_local.sh --resume {}", quoted(directory));
        let lengthen = match self
            .overrides
            .iter()
            .any(|text| text.starts_with("run.episodes"))
        {
            true => format!("; to lengthen it, give {resume} --episodes N"),
            false => String::new(),
        };
        format!(
            "{} cannot be given with --resume: a run is resumed in its own directory, with the \
             configuration it was started with. To resume it, give {resume} alone{lengthen}; \
             to train with other settings, start a new run without --resume",
            given.join(" and ")
        )
    }
}
