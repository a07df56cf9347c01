//! `skein experiment`: runs the experiments of `configs/experiments/`, and reports what they found.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::thread;

use anyhow::{Context, Result, bail, ensure};
use skein_experiments::board::Board;
use skein_experiments::definition::{Experiment, names};
use skein_experiments::plan::{Plan, State, root};
use skein_experiments::report::{Findings, Publication};
use skein_experiments::results;
use skein_experiments::runner::{self, Manner, Session};
use skein_launch::display::bar_on_terminal;
use skein_launch::interrupts::{interrupts, runtime};
use skein_run::failure::{EXIT_INTERRUPTED, with_causes};

use crate::beside_this;
use crate::cli::ExperimentArguments;

/// Does what `arguments` ask for; the status says whether every run is complete.
pub(crate) fn carry_out(arguments: &ExperimentArguments) -> Result<ExitCode> {
    match &arguments.name {
        Some(name) => arguments.carry_out(name),
        None => list(&arguments.catalogue()).map(|()| ExitCode::SUCCESS),
    }
}

/// Prints what each experiment in `folder` is to find out.
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
                println!("{name:width$}  {runs:>7} runs  {}", experiment.question);
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
        // What would keep hours of work from being published is told before they begin.
        if self.publish && (self.episodes.is_some() || seeds < experiment.seeds) {
            bail!(
                "--publish puts the whole experiment into docs/results/{name}.md, and --episodes or fewer than {} would leave a part of it there: leave out the one or the other",
                plural(experiment.seeds as usize, "seed")
            );
        }
        let publication = self
            .publish
            .then(|| Publication::find(&self.repository, name))
            .transpose()?;

        let mut status = ExitCode::SUCCESS;
        if !self.report {
            let session = self.run(&experiment, &root, seeds)?;
            if session.interruptions > 0 {
                eprintln!(
                    "skein: to go on with it: {}",
                    self.command(&experiment, Options::All)
                );
                return Ok(ExitCode::from(EXIT_INTERRUPTED));
            }
            if !session.failed.is_empty() {
                eprintln!(
                    "skein: {} failed: {}; the same command tries them again and leaves alone what is complete",
                    plural(session.failed.len(), "run"),
                    session.failed.join(", ")
                );
                status = ExitCode::FAILURE;
            }
        }
        self.tell(&experiment, &root, seeds, publication.as_ref())?;
        Ok(status)
    }

    fn run(&self, experiment: &Experiment, root: &Path, seeds: u64) -> Result<Session> {
        let _claim = Plan::claim(root)?;
        let mut plan = Plan::new(experiment, root, seeds)?;
        plan.check_idle()?;
        for (run, other) in plan.take_over()? {
            eprintln!(
                "skein: {run} was trained already: it is {}",
                other.display()
            );
        }
        let jobs = match self.jobs {
            Some(jobs) => jobs.into(),
            None => thread::available_parallelism().map_or(1, Into::into),
        };
        let (skein, evaluate) = (beside_this("skein")?, beside_this("skein-evaluate")?);
        announce(experiment, &plan, jobs);
        let mut board = Board::new(bar_on_terminal());
        let manner = Manner {
            skein: &skein,
            evaluate: &evaluate,
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

    /// Reports what there is, and publishes it if that was asked for.
    fn tell(
        &self,
        experiment: &Experiment,
        root: &Path,
        seeds: u64,
        publication: Option<&Publication>,
    ) -> Result<()> {
        // Looked at anew: a file that was changed while runs were under way has made two
        // experiments of one.
        let plan = Plan::new(experiment, root, seeds)?;
        let findings = Findings {
            experiment,
            plan: &plan,
            results: &results::read(&plan)?,
            command: self.command(experiment, Options::OfTheResult),
        };
        let report = findings.write()?;
        println!("{}", report.text.trim_end());
        eprintln!("skein: the report is in {}", report.document.display());
        let Some(publication) = publication else {
            return Ok(());
        };
        if !findings.is_whole() {
            bail!(
                "nothing was published: {} of {} runs are complete",
                findings.results.len(),
                plan.runs.len()
            );
        }
        for file in publication.publish(&findings, &report)? {
            eprintln!("skein: published {}", file.display());
        }
        Ok(())
    }

    /// The command that does what this one does.
    fn command(&self, experiment: &Experiment, options: Options) -> String {
        let mut command = format!("launch/experiment.sh {}", experiment.name);
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
            option(
                "--runs",
                self.runs.as_ref().map(|runs| runs.display().to_string()),
            );
            option("--publish", self.publish.then(String::new));
        }
        command.trim_end().to_owned()
    }
}

/// Which options of a command are told.
#[derive(Clone, Copy, PartialEq)]
enum Options {
    All,
    /// Those that the result depends on.
    OfTheResult,
}

fn announce(experiment: &Experiment, plan: &Plan, jobs: usize) {
    eprintln!("skein: {}", experiment.question);
    let there = [
        (State::Complete, "complete"),
        (State::Trained, "trained"),
        (State::Begun, "begun"),
    ]
    .map(|(state, what)| (plan.count(state), what))
    .into_iter()
    .filter(|(count, _)| *count > 0)
    .map(|(count, what)| format!(", {count} {what} already"))
    .collect::<String>();
    eprintln!(
        "skein: {} of {} with {} each{there}; {jobs} at a time, in {}",
        plural(plan.runs.len(), "run"),
        plural(experiment.arms.len(), "arm"),
        plural(plan.seeds as usize, "seed"),
        plan.root.display()
    );
    if let Some(flown) = &experiment.suite {
        eprintln!(
            "skein: the best snapshot of each then flies the suite {}: {}",
            flown.file_name(),
            plural(flown.episodes() as usize, "episode")
        );
    }
    if let Some(shortened) = experiment.shortened() {
        eprintln!("skein: shortened: {shortened}");
    }
}

fn plural(count: usize, what: &str) -> String {
    match count {
        1 => format!("1 {what}"),
        count => format!("{count} {what}s"),
    }
}
