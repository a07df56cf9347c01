//! Runs of an experiment, and what exists of them already.

use std::fs::{self, File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};

use skein_protocol::config::Config;
use skein_protocol::files::{self, TENSOR_BYTES};
use skein_protocol::summary::RunEnding;
use skein_run::RunDirectory;
use skein_run::failure::with_causes;
use skein_run::terminal::quoted;

use super::definition::Experiment;

/// Number of actors per run. Runs share the machine instead, and the number of actors does not
/// change what is learned.
pub const ACTORS: usize = 1;
/// Name of the report's folder, beside the folders of the arms.
pub const REPORT: &str = "report";

/// Runs of an experiment, in starting order. First seeds come first, so that early results cover
/// all arms.
#[derive(Debug, Clone, PartialEq)]
pub struct ExperimentPlan {
    /// Directory of the experiment.
    pub root: PathBuf,
    /// Number of runs per arm.
    pub seeds: u64,
    /// All runs, or the one of a job.
    pub runs: Vec<PlannedRun>,
}

/// One run of an experiment.
#[derive(Debug, Clone, PartialEq)]
pub struct PlannedRun {
    /// Index of its arm in [`Experiment::arms`].
    pub arm: usize,
    /// Its seed.
    pub seed: u64,
    /// `ARM/seed-N`.
    pub name: String,
    /// Its directory, which may not exist yet.
    pub directory: RunDirectory,
    /// Settings beyond the base configuration.
    pub overrides: Vec<String>,
    /// Its configuration according to the present experiment file.
    pub config: Config,
    /// Path of its suite result, if the experiment has a suite; the file may not exist yet.
    pub suite_json: Option<PathBuf>,
    /// RunState of its files.
    pub state: RunState,
}

/// RunState of a run's files.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RunState {
    /// The run does not exist.
    New,
    /// It was started but is incomplete.
    Begun,
    /// Another process runs it.
    UnderWay,
    /// It is trained, but has no suite result.
    Trained,
    /// It is complete.
    Complete,
}

/// Reason why an experiment cannot start or resume.
#[derive(Debug, thiserror::Error)]
pub enum PlanError {
    /// A folder cannot be created or read.
    #[error("{}: {source}", path.display())]
    Io {
        /// The folder.
        path: PathBuf,
        /// The operating system's error.
        #[source]
        source: io::Error,
    },
    /// No run has this name.
    #[error("no run of the experiment is called {name}: {first} is one; --list-jobs prints all")]
    NoSuchRun {
        /// The name.
        name: String,
        /// Name of the first run.
        first: String,
    },
    /// Another process runs the experiment.
    #[error("{} is under way already: wait for it, or stop it first", .0.display())]
    UnderWay(PathBuf),
    /// Some existing runs do not belong to the experiment.
    #[error(
        "{} cannot be resumed or reported as it is:\n{}",
        root.display(),
        problems.join("\n")
    )]
    Runs {
        /// Directory of the experiment.
        root: PathBuf,
        /// Each such run, with its problem and the remedy.
        problems: Vec<String>,
    },
}

/// ExperimentClaim on the experiment's directory, held while its runs are active.
#[derive(Debug)]
pub struct ExperimentClaim {
    _directory: File,
}

/// Returns the directory of the experiment below `runs`. An experiment shortened on the command
/// line has a directory of its own, so that a trial never interferes with the full experiment.
pub fn root(runs: &Path, experiment: &Experiment, episodes: Option<u64>) -> PathBuf {
    runs.join(match episodes {
        Some(episodes) => format!("{}_{episodes}_episodes", experiment.name),
        None => experiment.name.clone(),
    })
}

impl ExperimentPlan {
    /// Plans `seeds` runs for each arm of `experiment` in `root`, and determines their states.
    ///
    /// # Errors
    /// [`PlanError::Runs`] if an existing run has another configuration or cannot be read. Nothing
    /// is ever removed or overwritten.
    pub fn new(experiment: &Experiment, root: &Path, seeds: u64) -> Result<Self, PlanError> {
        let root = std::path::absolute(root).map_err(io_at(root))?;
        Self::of(every_run(experiment, &root, seeds), root, seeds)
    }

    /// The same for the run called `name`, `ARM/seed-N`, alone. It looks at no other run, because
    /// other processes may be creating them.
    ///
    /// # Errors
    /// As [`new`](Self::new), and [`PlanError::NoSuchRun`], which names one that there is.
    pub fn of_one(
        experiment: &Experiment,
        root: &Path,
        seeds: u64,
        name: &str,
    ) -> Result<Self, PlanError> {
        let root = std::path::absolute(root).map_err(io_at(root))?;
        let mut runs = every_run(experiment, &root, seeds);
        let first = runs.first().map(|run| run.name.clone());
        runs.retain(|run| run.name == name);
        match runs.is_empty() {
            true => Err(PlanError::NoSuchRun {
                name: name.to_owned(),
                first: first.unwrap_or_default(),
            }),
            false => Self::of(runs, root, seeds),
        }
    }

    fn of(mut runs: Vec<PlannedRun>, root: PathBuf, seeds: u64) -> Result<Self, PlanError> {
        let mut problems = Vec::new();
        for run in &mut runs {
            match run.look() {
                Ok(state) => run.state = state,
                Err(problem) => problems.push(problem),
            }
        }
        match problems.is_empty() {
            true => Ok(Self { root, seeds, runs }),
            false => Err(PlanError::Runs { root, problems }),
        }
    }

    /// Refuses to continue while another process works on one of the runs.
    ///
    /// # Errors
    /// [`PlanError::UnderWay`] names the first such run.
    pub fn check_idle(&self) -> Result<(), PlanError> {
        match self.runs.iter().find(|run| run.state == RunState::UnderWay) {
            None => Ok(()),
            Some(run) => Err(PlanError::UnderWay(run.directory.root().to_owned())),
        }
    }

    /// Returns the number of runs in this state.
    pub fn count(&self, state: RunState) -> usize {
        self.runs.iter().filter(|run| run.state == state).count()
    }

    /// Creates the experiment's directory and claims it for this process.
    ///
    /// # Errors
    /// [`PlanError::UnderWay`] if another process has claimed it.
    pub fn claim(root: &Path) -> Result<ExperimentClaim, PlanError> {
        fs::create_dir_all(root).map_err(io_at(root))?;
        let directory = File::open(root).map_err(io_at(root))?;
        match directory.try_lock() {
            Ok(()) => Ok(ExperimentClaim {
                _directory: directory,
            }),
            Err(TryLockError::WouldBlock) => Err(PlanError::UnderWay(root.to_owned())),
            Err(TryLockError::Error(error)) => Err(io_at(root)(error)),
        }
    }
}

/// Every run of the experiment, seed by seed, not looked at yet.
fn every_run(experiment: &Experiment, root: &Path, seeds: u64) -> Vec<PlannedRun> {
    let arms = 0..experiment.arms.len();
    (1..=seeds)
        .flat_map(|seed| arms.clone().map(move |arm| (arm, seed)))
        .map(|(arm, seed)| planned(experiment, root, arm, seed))
        .collect()
}

fn planned(experiment: &Experiment, root: &Path, number: usize, seed: u64) -> PlannedRun {
    let arm = &experiment.arms[number];
    let name = format!("{}/seed-{seed}", arm.name);
    let mut config = arm.config.clone();
    config.run.seed = seed;
    let directory = RunDirectory::new(root.join(&name));
    let suite = experiment.suite.as_ref();
    PlannedRun {
        arm: number,
        seed,
        suite_json: suite.map(|suite| directory.suite_json(&suite.result_name)),
        directory,
        name,
        overrides: [&arm.overrides[..], &[format!("run.seed={seed}")]].concat(),
        config,
        state: RunState::New,
    }
}

impl PlannedRun {
    /// Log of the run's programs, with their standard output and standard error. It lies beside the
    /// run's directory, which must be empty at the start.
    pub fn log(&self) -> PathBuf {
        self.directory.root().with_extension("log")
    }

    /// Returns the present state of the run's files.
    ///
    /// # Errors
    /// Returns the reason why the run cannot belong to the experiment, with the remedy.
    pub fn look(&self) -> Result<RunState, String> {
        let root = self.directory.root().display();
        let quoted = quoted(self.directory.root());
        if !self.directory.identity().is_file() {
            if self.directory.root().is_symlink() {
                return Err(format!(
                    "  {root} is a link to a run that no longer exists: \
                          restore that run, or remove the link: rm {quoted}"
                ));
            }
            let is_empty = fs::read_dir(self.directory.root())
                .map_or(true, |mut entries| entries.next().is_none());
            return match is_empty {
                true => Ok(RunState::New),
                false => Err(format!(
                    "  {root} is not empty and is not a run directory: move it away"
                )),
            };
        }
        let aside = format!("to train it again, move it away: mv {quoted} {quoted}.old");
        let differences = differences(&self.directory, &self.config)
            .map_err(|problem| format!("  {root}: {problem}; {aside}"))?;
        if !differences.is_empty() {
            return Err(format!(
                "  {root} was started with another configuration (\"there\": the run, \"here\": \
                 the experiment): {}. Restore the experiment's file, or, {aside}",
                differences.join(", ")
            ));
        }
        match self.directory.summary() {
            Some(summary) if summary.ending == RunEnding::Completed => {
                let is_flown = self
                    .suite_json
                    .as_ref()
                    .is_none_or(|result| result.is_file());
                return Ok(if is_flown {
                    RunState::Complete
                } else {
                    RunState::Trained
                });
            }
            None if self.directory.summary_json().exists() => {
                return Err(format!(
                    "  {} is damaged: restore it, or, {aside}",
                    self.directory.summary_json().display()
                ));
            }
            _ => {}
        }
        match self.directory.is_running() {
            Ok(false) => Ok(RunState::Begun),
            Ok(true) => Ok(RunState::UnderWay),
            Err(error) => Err(format!("  {root}: {}", with_causes(&error))),
        }
    }
}

/// Returns the differences between the configuration of `run`, including the files it names, and
/// `expected`. A key that did not exist when the run was made has its default value.
fn differences(run: &RunDirectory, expected: &Config) -> Result<Vec<String>, String> {
    let mut stored =
        skein_prepare::resolve(&run.config(), &[], ACTORS).map_err(|error| with_causes(&error))?;
    let mut expected = expected.clone();
    let mut changed = Vec::new();
    for (here, there) in expected.files_mut().zip(stored.files_mut()) {
        // The copy may have another name, because two course files had the same name.
        let content = |path: &Path| files::read(path, TENSOR_BYTES).ok();
        match content(here) == content(there) {
            true => here.clone_from(there),
            false => changed.push(format!("{} has changed since", here.display())),
        }
    }
    let keys = expected.differences(&stored.portable());
    Ok([keys.map_err(|error| error.to_string())?, changed].concat())
}

pub(super) fn io_at(path: &Path) -> impl FnOnce(io::Error) -> PlanError {
    let path = path.to_owned();
    move |source| PlanError::Io { path, source }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;
    use skein_prepare::prepare;

    fn experiment(folder: &Path, share: &str) -> Experiment {
        experiment_with(folder, share, "tables = []")
    }

    fn experiment_with(folder: &Path, share: &str, keys: &str) -> Experiment {
        let base: PathBuf = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/smoke.toml");
        let text = format!(
            "question = \"?\"\nbase = {base:?}\nseeds = 2\n{keys}\ncurves = []\n[[arm]]\nname = \
             \"a\"\nlabel = \"A\"\nsettings.replay.success_share = {share}\n[[arm]]\nname = \
             \"b\"\nlabel = \"B\"\n"
        );
        fs::write(folder.join("test.toml"), text).unwrap();
        Experiment::load(folder, "test", None).unwrap()
    }

    const SUMMARY: &str = r#"{"skein_version":"0","run":7,"seed":2,"ending":"ENDING",
        "policy_sha256":"",
        "final_version":8,"best_version":7,
        "best_confirmed_walls_passed":4.9,"episodes":8,"steps":4,"updates":2,
        "vae_updates":4,"evaluation_episodes":4,
        "tickets_reissued":0,"records_refused":0,"wall_secs":3.3}"#;

    fn begin(run: &PlannedRun, experiment: &Experiment) {
        prepare(
            &experiment.base,
            &run.overrides,
            run.directory.root(),
            ACTORS,
        )
        .unwrap();
    }

    #[test]
    fn first_seeds_of_all_arms_come_first() {
        let folder = tempfile::tempdir().unwrap();
        let plan = ExperimentPlan::new(
            &experiment(folder.path(), "0.25"),
            &folder.path().join("runs"),
            2,
        )
        .unwrap();
        let names: Vec<_> = plan.runs.iter().map(|run| run.name.as_str()).collect();
        assert_eq!(names, ["a/seed-1", "b/seed-1", "a/seed-2", "b/seed-2"]);
        assert_eq!(plan.count(RunState::New), 4);
        assert_eq!(plan.runs[2].config.run.seed, 2);
        assert_eq!(plan.runs[2].overrides.last().unwrap(), "run.seed=2");
    }

    #[test]
    fn begun_runs_are_resumed_and_complete_runs_are_left_alone() {
        let folder = tempfile::tempdir().unwrap();
        let (experiment, root) = (
            experiment(folder.path(), "0.25"),
            folder.path().join("runs"),
        );
        let plan = ExperimentPlan::new(&experiment, &root, 2).unwrap();
        begin(&plan.runs[0], &experiment);
        begin(&plan.runs[3], &experiment);
        let states = |ending| {
            fs::write(
                plan.runs[3].directory.summary_json(),
                SUMMARY.replace("ENDING", ending),
            )
            .unwrap();
            let plan = ExperimentPlan::new(&experiment, &root, 2).unwrap();
            plan.runs.iter().map(|run| run.state).collect::<Vec<_>>()
        };
        assert_eq!(
            states("interrupted"),
            [
                RunState::Begun,
                RunState::New,
                RunState::New,
                RunState::Begun
            ]
        );
        assert_eq!(
            states("completed"),
            [
                RunState::Begun,
                RunState::New,
                RunState::New,
                RunState::Complete
            ]
        );
        // Its result is lost and so are its checkpoints, so it cannot be resumed.
        let summary = plan.runs[3].directory.summary_json();
        fs::write(&summary, "{").unwrap();
        let error = ExperimentPlan::new(&experiment, &root, 2)
            .unwrap_err()
            .to_string();
        for part in ["summary.json is damaged", "mv "] {
            assert!(error.contains(part), "{error}");
        }
        // A job minds its own run alone, whatever others are about to create.
        let job = |name: &str| ExperimentPlan::of_one(&experiment, &root, 2, name);
        assert_eq!(job(&plan.runs[0].name).unwrap().runs.len(), 1);
        assert!(job(&plan.runs[3].name).is_err());
        let unknown = job("no-such").unwrap_err().to_string();
        assert!(unknown.contains(&plan.runs[0].name), "{unknown}");
    }

    #[test]
    fn a_run_is_complete_only_with_the_result_of_its_own_suite() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("runs");
        let suite = |episodes: u64| {
            let course =
                Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/courses/training.toml");
            let text = format!(
                "name = \"few\"\nepisodes = {episodes}\n[[entry]]\nname = \"12345\"\ncourse = \
                 {course:?}\n"
            );
            fs::write(folder.path().join("few.toml"), text).unwrap();
            let experiment = experiment_with(
                folder.path(),
                "0.25",
                "tables = [\"suite\"]\nsuite = \"few.toml\"",
            );
            (
                ExperimentPlan::new(&experiment, &root, 1).unwrap(),
                experiment,
            )
        };
        let (plan, experiment) = suite(5);
        let run = &plan.runs[0];
        begin(run, &experiment);
        assert_eq!(suite(5).0.runs[0].state, RunState::Begun);
        fs::write(
            run.directory.summary_json(),
            SUMMARY.replace("ENDING", "completed"),
        )
        .unwrap();
        assert_eq!(suite(5).0.runs[0].state, RunState::Trained);
        let result = run.suite_json.as_ref().unwrap();
        fs::create_dir(result.parent().unwrap()).unwrap();
        fs::write(result, "").unwrap();
        assert_eq!(suite(5).0.runs[0].state, RunState::Complete);
        assert_eq!(suite(6).0.runs[0].state, RunState::Trained);
    }

    #[test]
    fn a_run_with_another_configuration_or_course_is_refused_with_the_differences() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("runs");
        let before = experiment(folder.path(), "0.25");
        begin(
            &ExperimentPlan::new(&before, &root, 1).unwrap().runs[0],
            &before,
        );
        let refusal = |share| {
            ExperimentPlan::new(&experiment(folder.path(), share), &root, 1)
                .unwrap_err()
                .to_string()
        };
        for part in [
            "a/seed-1",
            "replay.success_share = 0.25 there, 0.5 here",
            "mv ",
        ] {
            assert!(refusal("0.5").contains(part), "{}", refusal("0.5"));
        }
        // A course with the same name but different contents is another course.
        let copy = root.join("a/seed-1/courses/training.toml");
        let course = fs::read_to_string(&copy).unwrap();
        fs::write(&copy, format!("# changed\n{course}")).unwrap();
        assert!(
            refusal("0.25").contains("training.toml has changed since"),
            "{}",
            refusal("0.25")
        );
    }

    #[test]
    fn a_folder_without_a_run_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let stray = folder.path().join("runs/b/seed-1/mine.txt");
        fs::create_dir_all(stray.parent().unwrap()).unwrap();
        fs::write(&stray, "").unwrap();
        let error = ExperimentPlan::new(
            &experiment(folder.path(), "0.25"),
            &folder.path().join("runs"),
            1,
        )
        .unwrap_err();
        assert!(
            error
                .to_string()
                .contains("is not a run directory: move it away"),
            "{error}"
        );
    }

    #[test]
    fn an_experiment_is_run_by_one_process_at_a_time() {
        let folder = tempfile::tempdir().unwrap();
        let claim = ExperimentPlan::claim(folder.path()).unwrap();
        assert!(matches!(
            ExperimentPlan::claim(folder.path()),
            Err(PlanError::UnderWay(_))
        ));
        drop(claim);
        ExperimentPlan::claim(folder.path()).unwrap();
    }
}
