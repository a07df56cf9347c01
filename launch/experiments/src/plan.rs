//! Which runs an experiment consists of, and what of them is there already.

use std::fs::{self, File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};

use skein_protocol::config::Config;
use skein_protocol::summary::RunEnding;
use skein_run::RunDirectory;
use skein_run::failure::with_causes;

use super::definition::Experiment;

/// Actors of each run: runs are side by side instead, and how many fly changes nothing that is
/// learned.
pub const ACTORS: usize = 1;
/// The folder of the report, beside those of the arms.
pub const REPORT: &str = "report";

/// The runs of an experiment, in the order in which they are started: first seeds come first, so
/// that early results cover all arms.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// Where all of it lies.
    pub root: PathBuf,
    /// Runs of each arm.
    pub seeds: u64,
    /// Every run.
    pub runs: Vec<PlannedRun>,
}

/// One run of an experiment.
#[derive(Debug, Clone, PartialEq)]
pub struct PlannedRun {
    /// Its arm's place in [`Experiment::arms`].
    pub arm: usize,
    /// Its seed.
    pub seed: u64,
    /// `ARM/seed-N`.
    pub name: String,
    /// Its directory, which may not be there.
    pub directory: RunDirectory,
    /// What is set beside the base configuration.
    pub overrides: Vec<String>,
    /// Its configuration as the experiment has it now.
    pub config: Config,
    /// The result of the experiment's suite, if it has one; the file may not be there.
    pub suite_json: Option<PathBuf>,
    /// What is there of it.
    pub state: State,
}

/// What is there of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum State {
    /// Nothing.
    New,
    /// It was begun.
    Begun,
    /// Somebody is at it.
    UnderWay,
    /// All of its training, and no result of the suite.
    Trained,
    /// All of it.
    Complete,
}

/// Why an experiment cannot be begun, or gone on with.
#[derive(Debug, thiserror::Error)]
pub enum PlanError {
    /// A folder cannot be made or looked at.
    #[error("{}: {source}", path.display())]
    Io {
        /// The folder.
        path: PathBuf,
        /// Why.
        #[source]
        source: io::Error,
    },
    /// Somebody is at it.
    #[error("{} is under way already: wait for it, or stop it first", .0.display())]
    UnderWay(PathBuf),
    /// There are runs that cannot be part of it.
    #[error("{} cannot be gone on with or reported as it is\n{}", root.display(), problems.join("\n"))]
    Runs {
        /// Where the experiment lies.
        root: PathBuf,
        /// Each run, with what is wrong with it and the remedy.
        problems: Vec<String>,
    },
}

/// The experiment's directory, claimed. To be held while its runs are under way.
#[derive(Debug)]
pub struct Claim {
    _directory: File,
}

/// Where in `runs` the experiment lies. One that is shortened by an option of the command has a
/// place of its own, so that trying it out is never in its way.
pub fn root(runs: &Path, experiment: &Experiment, episodes: Option<u64>) -> PathBuf {
    runs.join(match episodes {
        Some(episodes) => format!("{}_{episodes}_episodes", experiment.name),
        None => experiment.name.clone(),
    })
}

impl Plan {
    /// `seeds` runs of each arm of `experiment` in `root`, and what is there of them.
    ///
    /// # Errors
    /// [`PlanError::Runs`] when a run is there that was started with another configuration, or
    /// cannot be looked at: nothing is ever removed or overwritten.
    pub fn new(experiment: &Experiment, root: &Path, seeds: u64) -> Result<Self, PlanError> {
        let root = std::path::absolute(root).map_err(io_at(root))?;
        let mut plan = Self {
            runs: Vec::new(),
            root,
            seeds,
        };
        let mut problems = Vec::new();
        for seed in 1..=seeds {
            for arm in 0..experiment.arms.len() {
                let mut run = planned(experiment, &plan.root, arm, seed);
                match run.look() {
                    Ok(state) => run.state = state,
                    Err(problem) => problems.push(problem),
                }
                plan.runs.push(run);
            }
        }
        match problems.is_empty() {
            true => Ok(plan),
            false => Err(PlanError::Runs {
                root: plan.root,
                problems,
            }),
        }
    }

    /// Refuses to go on while somebody else is at one of the runs.
    ///
    /// # Errors
    /// [`PlanError::UnderWay`] names the first.
    pub fn check_idle(&self) -> Result<(), PlanError> {
        match self.runs.iter().find(|run| run.state == State::UnderWay) {
            None => Ok(()),
            Some(run) => Err(PlanError::UnderWay(run.directory.root().to_owned())),
        }
    }

    /// Runs in this state.
    pub fn count(&self, state: State) -> usize {
        self.runs.iter().filter(|run| run.state == state).count()
    }

    /// Makes the experiment's directory, and claims it for this process.
    ///
    /// # Errors
    /// [`PlanError::UnderWay`] when another process has it.
    pub fn claim(root: &Path) -> Result<Claim, PlanError> {
        fs::create_dir_all(root).map_err(io_at(root))?;
        let directory = File::open(root).map_err(io_at(root))?;
        match directory.try_lock() {
            Ok(()) => Ok(Claim {
                _directory: directory,
            }),
            Err(TryLockError::WouldBlock) => Err(PlanError::UnderWay(root.to_owned())),
            Err(TryLockError::Error(error)) => Err(io_at(root)(error)),
        }
    }
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
        state: State::New,
    }
}

impl PlannedRun {
    /// What the run's programs say, on standard output and standard error; beside its directory,
    /// which must be empty when it is begun.
    pub fn said(&self) -> PathBuf {
        self.directory.root().with_extension("log")
    }

    /// What is there of it now.
    ///
    /// # Errors
    /// Why it can be no part of the experiment, with the remedy.
    pub fn look(&self) -> Result<State, String> {
        let root = self.directory.root().display();
        if !self.directory.identity().is_file() {
            if self.directory.root().is_symlink() {
                return Err(format!(
                    "  {root} is a link to a run that is gone: bring that back, or remove the link: rm {root}"
                ));
            }
            let is_empty = fs::read_dir(self.directory.root())
                .map_or(true, |mut entries| entries.next().is_none());
            return match is_empty {
                true => Ok(State::New),
                false => Err(format!(
                    "  {root} is not empty and not the directory of a run: move it away"
                )),
            };
        }
        let aside = format!("to begin it anew, move it away: mv {root} {root}.old");
        let differences = differences(&self.directory, &self.config)
            .map_err(|problem| format!("  {root}: {problem}; {aside}"))?;
        if !differences.is_empty() {
            return Err(format!(
                "  {root} was started with another configuration (\"there\" is the run's, \"here\" the experiment's as it is now): {}; put the experiment's file back, or, {aside}",
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
                    State::Complete
                } else {
                    State::Trained
                });
            }
            None if self.directory.summary_json().exists() => {
                return Err(format!(
                    "  {} is damaged: bring it back, or, {aside}",
                    self.directory.summary_json().display()
                ));
            }
            _ => {}
        }
        match self.directory.is_running() {
            Ok(false) => Ok(State::Begun),
            Ok(true) => Ok(State::UnderWay),
            Err(error) => Err(format!("  {root}: {}", with_causes(&error))),
        }
    }
}

/// In what the configuration of `run`, its courses included, differs from `expected`. Of a key that
/// is younger than the run, the run has the default.
fn differences(run: &RunDirectory, expected: &Config) -> Result<Vec<String>, String> {
    let mut stored =
        skein_prepare::resolve(&run.config(), &[], ACTORS).map_err(|error| with_causes(&error))?;
    let mut expected = expected.clone();
    let mut courses = Vec::new();
    for (here, there) in expected.courses.paths_mut().zip(stored.courses.paths_mut()) {
        // The copy of a course whose file has the name of another has a name of its own.
        match fs::read(&here).ok() == fs::read(&there).ok() {
            true => here.clone_from(there),
            false => courses.push(format!("the course {} is another there", here.display())),
        }
    }
    let keys = expected.differences(&stored.portable());
    Ok([keys.map_err(|error| error.to_string())?, courses].concat())
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
            "question = \"?\"\nbase = {base:?}\nseeds = 2\n{keys}\ncurves = []\n[[arm]]\nname = \"a\"\nlabel = \"A\"\nsettings.replay.success_share = {share}\n[[arm]]\nname = \"b\"\nlabel = \"B\"\n"
        );
        fs::write(folder.join("test.toml"), text).unwrap();
        Experiment::load(folder, "test", None).unwrap()
    }

    const SUMMARY: &str = r#"{"skein_version":"0","run":7,"seed":2,"ending":"ENDING","policy_sha256":"","final_version":8,"best_version":7,
        "best_confirmed_walls_passed":4.9,"episodes":8,"steps":4,"updates":2,"vae_updates":4,"evaluation_episodes":4,
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
        let plan = Plan::new(
            &experiment(folder.path(), "0.25"),
            &folder.path().join("runs"),
            2,
        )
        .unwrap();
        let names: Vec<_> = plan.runs.iter().map(|run| run.name.as_str()).collect();
        assert_eq!(names, ["a/seed-1", "b/seed-1", "a/seed-2", "b/seed-2"]);
        assert_eq!(plan.count(State::New), 4);
        assert_eq!(plan.runs[2].config.run.seed, 2);
        assert_eq!(plan.runs[2].overrides.last().unwrap(), "run.seed=2");
    }

    #[test]
    fn what_was_begun_is_gone_on_with_and_what_is_complete_is_left_alone() {
        let folder = tempfile::tempdir().unwrap();
        let (experiment, root) = (
            experiment(folder.path(), "0.25"),
            folder.path().join("runs"),
        );
        let plan = Plan::new(&experiment, &root, 2).unwrap();
        begin(&plan.runs[0], &experiment);
        begin(&plan.runs[3], &experiment);
        let states = |ending| {
            fs::write(
                plan.runs[3].directory.summary_json(),
                SUMMARY.replace("ENDING", ending),
            )
            .unwrap();
            let plan = Plan::new(&experiment, &root, 2).unwrap();
            plan.runs.iter().map(|run| run.state).collect::<Vec<_>>()
        };
        assert_eq!(
            states("interrupted"),
            [State::Begun, State::New, State::New, State::Begun]
        );
        assert_eq!(
            states("completed"),
            [State::Begun, State::New, State::New, State::Complete]
        );
        // What it came to cannot be told, and its checkpoints are gone: it is no run to go on with.
        let summary = plan.runs[3].directory.summary_json();
        fs::write(&summary, "{").unwrap();
        let error = Plan::new(&experiment, &root, 2).unwrap_err().to_string();
        for part in ["summary.json is damaged", "mv "] {
            assert!(error.contains(part), "{error}");
        }
    }

    #[test]
    fn a_run_is_complete_when_its_suite_was_flown_and_not_another() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("runs");
        let suite = |episodes: u64| {
            let course =
                Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/courses/training.toml");
            let text = format!(
                "name = \"few\"\nepisodes = {episodes}\n[[entry]]\nname = \"12345\"\ncourse = {course:?}\n"
            );
            fs::write(folder.path().join("few.toml"), text).unwrap();
            let experiment = experiment_with(
                folder.path(),
                "0.25",
                "tables = [\"suite\"]\nsuite = \"few.toml\"",
            );
            (Plan::new(&experiment, &root, 1).unwrap(), experiment)
        };
        let (plan, experiment) = suite(5);
        let run = &plan.runs[0];
        begin(run, &experiment);
        assert_eq!(suite(5).0.runs[0].state, State::Begun);
        fs::write(
            run.directory.summary_json(),
            SUMMARY.replace("ENDING", "completed"),
        )
        .unwrap();
        assert_eq!(suite(5).0.runs[0].state, State::Trained);
        let result = run.suite_json.as_ref().unwrap();
        fs::create_dir(result.parent().unwrap()).unwrap();
        fs::write(result, "").unwrap();
        assert_eq!(suite(5).0.runs[0].state, State::Complete);
        assert_eq!(suite(6).0.runs[0].state, State::Trained);
    }

    #[test]
    fn a_run_of_another_configuration_or_course_is_refused_with_what_differs() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("runs");
        let before = experiment(folder.path(), "0.25");
        begin(&Plan::new(&before, &root, 1).unwrap().runs[0], &before);
        let refusal = |share| {
            Plan::new(&experiment(folder.path(), share), &root, 1)
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
        // A course of the same name is another one all the same.
        let copy = root.join("a/seed-1/courses/training.toml");
        let course = fs::read_to_string(&copy).unwrap();
        fs::write(&copy, format!("# changed\n{course}")).unwrap();
        assert!(
            refusal("0.25").contains("training.toml is another there"),
            "{}",
            refusal("0.25")
        );
    }

    #[test]
    fn a_folder_that_is_no_run_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let stray = folder.path().join("runs/b/seed-1/mine.txt");
        fs::create_dir_all(stray.parent().unwrap()).unwrap();
        fs::write(&stray, "").unwrap();
        let error = Plan::new(
            &experiment(folder.path(), "0.25"),
            &folder.path().join("runs"),
            1,
        )
        .unwrap_err();
        assert!(
            error
                .to_string()
                .contains("not the directory of a run: move it away"),
            "{error}"
        );
    }

    #[test]
    fn an_experiment_is_run_by_one_process_at_a_time() {
        let folder = tempfile::tempdir().unwrap();
        let claim = Plan::claim(folder.path()).unwrap();
        assert!(matches!(
            Plan::claim(folder.path()),
            Err(PlanError::UnderWay(_))
        ));
        drop(claim);
        Plan::claim(folder.path()).unwrap();
    }
}
