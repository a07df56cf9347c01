//! `skein experiment`: runs the experiments of `configs/experiments/` and reports their results.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::thread;

use anyhow::{Context, Result, bail, ensure};
use skein_experiments::board::ExperimentDisplay;
use skein_experiments::definition::{Experiment, is_path, names};
use skein_experiments::plan::{ExperimentPlan, RunState, root};
use skein_experiments::report::{Findings, Publication};
use skein_experiments::results;
use skein_experiments::runner::{self, RunnerOptions, SessionOutcome};
use skein_launch::display::bar_on_terminal;
use skein_launch::interrupts::{interrupts, runtime};
use skein_run::failure::{EXIT_INTERRUPTED, with_causes};
use skein_run::tables::fit_markdown;
use skein_run::terminal::{quoted, stdout_columns};
use skein_run::{note, show};

use crate::cli::ExperimentArguments;

/// Carries out the command. The exit status shows whether every run is complete.
pub(crate) fn carry_out(arguments: &ExperimentArguments) -> Result<ExitCode> {
    match &arguments.name {
        Some(name) => arguments.carry_out(name),
        None => list(&arguments.catalogue()).map(|()| ExitCode::SUCCESS),
    }
}

/// Prints the question of each experiment in `folder`.
fn list(folder: &Path) -> Result<()> {
    let names = names(folder)?;
    let width = names
        .iter()
        .map(|name| name.chars().count())
        .max()
        .unwrap_or(0);
    let mut unusable = Vec::new();
    for name in &names {
        match Experiment::load(folder, name, None) {
            Ok(experiment) => {
                let runs = format!("{} × {}", experiment.arms.len(), experiment.seeds);
                show!("{name:width$}  {runs:>7} runs  {}", experiment.question);
            }
            Err(error) => unusable.push(with_causes(&error)),
        }
    }
    ensure!(unusable.is_empty(), "{}", unusable.join("\n"));
    Ok(())
}

impl ExperimentArguments {
    fn catalogue(&self) -> PathBuf {
        self.repository.join("configs/experiments")
    }

    fn carry_out(&self, name: &str) -> Result<ExitCode> {
        let experiment = Experiment::load(&self.catalogue(), name, self.episodes)?;
        let seeds = self.seeds.unwrap_or(experiment.seeds);
        let runs = self.runs.clone();
        let runs = runs.unwrap_or_else(|| self.repository.join("runs/experiments"));
        let root = root(&runs, &experiment, self.episodes);
        // Refuse what would prevent publication before hours of work begin.
        if self.publish && (self.episodes.is_some() || seeds < experiment.seeds) {
            bail!(
                "--publish needs the whole experiment: \
                     remove --publish, or --episodes and any --seeds below {}",
                plural(experiment.seeds as usize, "seed")
            );
        }
        if self.publish && is_path(name) {
            bail!(
                "--publish is for the experiments of configs/experiments, by name: \
                     remove --publish, or put the file there and give its name"
            );
        }
        let publication = self
            .publish
            .then(|| Publication::find(&self.repository, name))
            .transpose()?;

        if self.list_jobs {
            return self.print_jobs(&experiment, &root, seeds);
        }
        let mut status = ExitCode::SUCCESS;
        if !self.report {
            let session = self.run(&experiment, &root, seeds)?;
            if session.interruptions > 0 {
                note!(
                    "skein: to resume this experiment: {}",
                    self.command(&experiment, Options::All)
                );
                return Ok(ExitCode::from(EXIT_INTERRUPTED));
            }
            if !session.failed.is_empty() {
                note!(
                    "skein: {} failed: {}; \
                         the same command tries them again and leaves complete runs alone",
                    plural(session.failed.len(), "run"),
                    session.failed.join(", ")
                );
                status = ExitCode::FAILURE;
            }
        }
        if self.job.is_some() {
            return Ok(status);
        }
        let are_all_read = self.report_results(&experiment, &root, seeds, publication.as_ref())?;
        Ok(match are_all_read {
            true => status,
            false => ExitCode::FAILURE,
        })
    }

    /// Prints a command for each run that is not complete.
    fn print_jobs(&self, experiment: &Experiment, root: &Path, seeds: u64) -> Result<ExitCode> {
        let plan = ExperimentPlan::new(experiment, root, seeds)?;
        let command = self.command(experiment, Options::All);
        for run in plan
            .runs
            .iter()
            .filter(|run| run.state != RunState::Complete)
        {
            show!("{command} --job {}", run.name);
        }
        Ok(ExitCode::SUCCESS)
    }

    fn run(&self, experiment: &Experiment, root: &Path, seeds: u64) -> Result<SessionOutcome> {
        // A job shares the folder with others; the lock of its run keeps it to one process.
        let _claim = match self.job {
            None => Some(ExperimentPlan::claim(root)?),
            Some(_) => None,
        };
        let mut plan = match &self.job {
            None => ExperimentPlan::new(experiment, root, seeds),
            Some(job) => ExperimentPlan::of_one(experiment, root, seeds, job),
        }?;
        plan.check_idle()?;
        for (run, other) in plan.link_trained_runs()? {
            note!(
                "skein: {run} is trained already: linked to {}",
                other.display()
            );
        }
        let jobs = match self.jobs {
            Some(jobs) => jobs.into(),
            None => thread::available_parallelism().map_or(1, Into::into),
        };
        let skein = std::env::current_exe().context("cannot find where this program lies")?;
        announce(experiment, &plan, jobs);
        let mut board = ExperimentDisplay::new(bar_on_terminal());
        let manner = RunnerOptions {
            skein: &skein,
            jobs,
        };
        let session = runtime()
            .context("cannot start the runtime")?
            .block_on(async {
                let mut interrupts = interrupts().context("cannot listen for signals")?;
                anyhow::Ok(
                    runner::run(experiment, &plan, manner, &mut interrupts, &mut board).await,
                )
            });
        board.finish();
        session
    }

    /// Writes and prints the report, and publishes it if requested. Returns `false` if the report
    /// lacks a complete run, whose files cannot be read.
    fn report_results(
        &self,
        experiment: &Experiment,
        root: &Path,
        seeds: u64,
        publication: Option<&Publication>,
    ) -> Result<bool> {
        // Read the runs again: if the experiment's file changed meanwhile, they may belong to two
        // experiments.
        let plan = ExperimentPlan::new(experiment, root, seeds)?;
        let (results, unreadable) = results::read(&plan);
        for error in &unreadable {
            note!(
                "skein: a run is left out of the report: {}",
                with_causes(error)
            );
        }
        let are_all_read = unreadable.is_empty();
        let findings = Findings {
            experiment,
            plan: &plan,
            results: &results,
            command: self.command(experiment, Options::OfTheResult),
        };
        let report = findings.write()?;
        let text = fit_markdown(report.text.trim_end(), stdout_columns());
        show!("{text}");
        note!("skein: report: {}", report.document.display());
        for failure in &report.failures {
            note!("skein: a plot could not be drawn: {}", with_causes(failure));
        }
        let Some(publication) = publication else {
            return Ok(are_all_read);
        };
        if !report.failures.is_empty() {
            bail!("not published: a picture is missing; see above");
        }
        if !findings.is_whole() {
            bail!(
                "not published: only {} of {} runs are complete and can be read",
                findings.results.len(),
                plan.runs.len()
            );
        }
        for file in publication.publish(&findings, &report)? {
            note!("skein: published {}", file.display());
        }
        Ok(are_all_read)
    }

    /// Returns the command that repeats this one.
    fn command(&self, experiment: &Experiment, options: Options) -> String {
        let named = self.name.as_deref().unwrap_or(&experiment.name);
        let mut command = format!("launch/experiment.sh {}", quoted(Path::new(named)));
        let mut option = |name: &str, value: Option<String>| {
            if let Some(value) = value {
                command.push_str(&format!(" {name} {value}"));
            }
        };
        option(
            "--seeds",
            self.seeds
                .filter(|seeds| *seeds != experiment.seeds)
                .map(|seeds| seeds.to_string()),
        );
        option(
            "--episodes",
            self.episodes.map(|episodes| episodes.to_string()),
        );
        if options == Options::All {
            option("--jobs", self.jobs.map(|jobs| jobs.to_string()));
            option("--runs", self.runs.as_deref().map(quoted));
            option("--publish", self.publish.then(String::new));
            option("--job", self.job.clone());
        }
        command.trim_end().to_owned()
    }
}

/// Options shown in a command.
#[derive(Clone, Copy, PartialEq)]
enum Options {
    All,
    /// Options that affect the result.
    OfTheResult,
}

fn announce(experiment: &Experiment, plan: &ExperimentPlan, jobs: usize) {
    note!("skein: {}", experiment.question);
    let there = [
        (RunState::Complete, "complete"),
        (RunState::Trained, "trained"),
        (RunState::Begun, "begun"),
    ]
    .map(|(state, what)| (plan.count(state), what))
    .into_iter()
    .filter(|(count, _)| *count > 0)
    .map(|(count, what)| format!(", {count} {what} already"))
    .collect::<String>();
    note!(
        "skein: {} of {} with {} each{there}; {jobs} at a time, in {}",
        plural(plan.runs.len(), "run"),
        plural(experiment.arms.len(), "arm"),
        plural(plan.seeds as usize, "seed"),
        plan.root.display()
    );
    if let Some(flown) = &experiment.suite {
        note!(
            "skein: the best snapshot of each then flies the suite {}: {}",
            flown.file_name(),
            plural(flown.episodes() as usize, "episode")
        );
    }
    if let Some(shortened) = experiment.shortened() {
        note!("skein: shortened: {shortened}");
    }
}

fn plural(count: usize, what: &str) -> String {
    match count {
        1 => format!("1 {what}"),
        count => format!("{count} {what}s"),
    }
}
