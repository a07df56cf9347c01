//! A run of the real programs: started, watched, ended, and cleared away.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::thread::sleep;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use serde::de::DeserializeOwned;
use skein_chaos::{ListedProcess, Role, compare, leftovers, processes_of};
use skein_protocol::evaluation::EvaluationReport;
use skein_protocol::summary::RunSummary;
use skein_run::signals::heed;
use skein_run::{RunDirectory, sweep_leftovers};
use tempfile::TempDir;

use crate::episodes::{LearnedResults, RecordedEpisode, episodes};
use crate::programs::{ProgramOutput, program, repository};

/// Time limit of a run. On an idle machine, none takes a fifth of it.
const LIMIT: Duration = Duration::from_secs(180);
/// Time between two checks of a condition.
const POLL_INTERVAL: Duration = Duration::from_millis(20);

/// Lock for one run at a time per test process, because each takes all cores.
static TURN: Mutex<()> = Mutex::new(());

/// Description of a run to start.
#[derive(Debug, Clone)]
pub struct RunRecipe {
    config: PathBuf,
    overrides: Vec<String>,
    environment: Vec<(String, String)>,
    actors: u32,
    within: Option<PathBuf>,
}

impl RunRecipe {
    /// Returns the shipped `configs/smoke.toml` with two actors.
    pub fn smoke() -> Self {
        Self::of(repository().join("configs/smoke.toml"))
    }

    /// Returns `tests/small.toml` with two actors, which takes a few seconds.
    pub fn small() -> Self {
        Self::of(repository().join("tests/small.toml"))
    }

    /// Returns the configuration file `config` with two actors.
    pub fn of(config: PathBuf) -> Self {
        Self {
            config,
            overrides: Vec::new(),
            environment: Vec::new(),
            actors: 2,
            within: None,
        }
    }

    /// Puts the run's directory into this folder.
    pub fn within(mut self, folder: &Path) -> Self {
        self.within = Some(folder.to_owned());
        self
    }

    /// Sets the number of actors.
    pub fn actors(mut self, actors: u32) -> Self {
        self.actors = actors;
        self
    }

    /// Adds `--set section.key=value`.
    pub fn set(mut self, setting: &str) -> Self {
        self.overrides.push(setting.to_owned());
        self
    }

    /// Sets an environment variable.
    pub fn environment(mut self, name: &str, value: &str) -> Self {
        self.environment.push((name.to_owned(), value.to_owned()));
        self
    }

    /// Starts the run, after all other runs of this test process have ended.
    ///
    /// # Panics
    /// Panics if it cannot be started.
    pub fn start(self) -> RunningRun {
        let turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
        self.start_in_turn(Some(turn))
    }

    /// Starts the run while `_other` is under way.
    ///
    /// # Panics
    /// Panics if it cannot be started.
    pub fn start_beside(self, _other: &RunningRun) -> RunningRun {
        self.start_in_turn(None)
    }

    fn start_in_turn(self, turn: Option<MutexGuard<'static, ()>>) -> RunningRun {
        let folder = tempfile::tempdir().unwrap();
        let within = self.within.as_deref().unwrap_or(folder.path());
        let root = within.canonicalize().unwrap().join("run");
        let mut command = skein_run(folder.path(), self.actors);
        command
            .arg("--config")
            .arg(&self.config)
            .arg("--run-dir")
            .arg(&root)
            .args(self.overrides.iter().flat_map(|setting| ["--set", setting]))
            .envs(self.environment);
        RunningRun {
            supervisor: command.spawn().unwrap(),
            attached: Vec::new(),
            directory: RunDirectory::new(root),
            folder: Some(folder),
            deadline: Instant::now() + LIMIT,
            _turn: turn,
        }
    }

    /// Runs it to its end and asserts success.
    ///
    /// # Panics
    /// Panics if it fails.
    pub fn finish(self) -> EndedRun {
        self.start().finish()
    }
}

/// Returns `skein run` with `actors` actors and its output in files in `folder`.
fn skein_run(folder: &Path, actors: u32) -> Command {
    let mut command = Command::new(program("skein"));
    command
        .args(["run", "--actors", &actors.to_string()])
        .env_remove("RUST_LOG")
        .env_remove("SKEIN_LOG_FORMAT")
        .stdin(Stdio::null())
        .stdout(File::create(folder.join("stdout")).unwrap())
        .stderr(File::create(folder.join("stderr")).unwrap());
    // Tests interrupt it, and may themselves run in the background of a script, which ignores this.
    heed(&mut command, Signal::INT);
    command
}

/// A run under way. Its processes and remains are cleared away when it goes out of scope.
#[derive(Debug)]
pub struct RunningRun {
    supervisor: Child,
    attached: Vec<Child>,
    directory: RunDirectory,
    folder: Option<TempDir>,
    deadline: Instant,
    _turn: Option<MutexGuard<'static, ()>>,
}

impl RunningRun {
    /// Returns its directory.
    pub fn directory(&self) -> &RunDirectory {
        &self.directory
    }

    /// Returns the supervisor's standard error so far.
    pub fn stderr(&self) -> String {
        let folder = self
            .folder
            .as_ref()
            .expect("the folder is taken only at the end");
        fs::read_to_string(folder.path().join("stderr")).unwrap()
    }

    /// Waits until `condition` returns a value.
    ///
    /// # Panics
    /// Panics if the run ends before, or the time is up; `what` describes the condition.
    pub fn until<T>(&mut self, what: &str, mut condition: impl FnMut(&Self) -> Option<T>) -> T {
        loop {
            if let Some(found) = condition(self) {
                return found;
            }
            let ended = self.supervisor.try_wait().unwrap();
            assert!(
                ended.is_none(),
                "the run ended before {what}:\n{}",
                self.stderr()
            );
            assert!(
                Instant::now() < self.deadline,
                "never {what}:\n{}",
                self.stderr()
            );
            sleep(POLL_INTERVAL);
        }
    }

    /// Waits until the supervisor has ended, by itself or on request.
    ///
    /// # Panics
    /// Panics if the time is up.
    pub fn until_ended(&mut self) {
        while self.supervisor.try_wait().unwrap().is_none() {
            assert!(
                Instant::now() < self.deadline,
                "the run does not end:\n{}",
                self.stderr()
            );
            sleep(POLL_INTERVAL);
        }
    }

    /// Waits until `count` training episodes are learned from.
    ///
    /// # Panics
    /// As [`RunningRun::until`].
    pub fn until_episodes(&mut self, count: usize) {
        self.until(&format!("{count} episodes were learned from"), |run| {
            (episodes(&run.directory).len() >= count).then_some(())
        });
    }

    /// Kills the learner once `episodes` episodes were learned from, and waits for the next.
    ///
    /// # Panics
    /// Panics if the run ends before, or no learner follows.
    pub fn kill_learner_after(&mut self, episodes: usize) {
        self.until_episodes(episodes);
        let victim = self.process("skein-learner");
        victim.signal(Signal::KILL);
        self.until("another learner was there", |run| {
            let mut learners = run.processes(Role::Learner).into_iter();
            learners.find(|learner| *learner != victim)
        });
    }

    /// Starts `skein attach` with one actor.
    ///
    /// # Panics
    /// Panics if it cannot be started.
    pub fn attach(&mut self) {
        let attached = Command::new(program("skein"))
            .arg("attach")
            .arg("--run")
            .arg(self.directory.root())
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        self.attached.push(attached);
    }

    /// Sends `signal` to the supervisor only.
    ///
    /// # Panics
    /// Panics if it has been reaped already.
    pub fn signal(&self, signal: Signal) {
        let pid = Pid::from_raw(self.supervisor.id().cast_signed()).unwrap();
        kill_process(pid, signal).unwrap();
    }

    /// Returns the first process of this run that runs `program`.
    ///
    /// # Panics
    /// Panics if there is none.
    pub fn process(&self, program: &str) -> ListedProcess {
        let processes = processes_of(&self.directory);
        let found = processes.into_iter().find(|process| process.runs(program));
        found.unwrap_or_else(|| panic!("no {program} is running:\n{}", self.stderr()))
    }

    /// Returns its processes with this role, oldest first.
    pub fn processes(&self, role: Role) -> Vec<ListedProcess> {
        let mut processes = processes_of(&self.directory);
        processes.retain(|process| process.role() == role);
        processes
    }

    /// Kills the supervisor only.
    ///
    /// # Panics
    /// Panics if it had ended already.
    pub fn kill_supervisor(&mut self) {
        let ended = self.supervisor.try_wait().unwrap();
        assert!(
            ended.is_none(),
            "the run ended too early:\n{}",
            self.stderr()
        );
        self.supervisor.kill().unwrap();
        self.supervisor.wait().unwrap();
    }

    /// Kills all its processes at once, as a power cut does.
    ///
    /// # Panics
    /// Panics if one of them does not end.
    pub fn cut_off(&mut self) {
        processes_of(&self.directory)
            .iter()
            .for_each(|process| process.signal(Signal::KILL));
        self.supervisor.wait().unwrap();
        while !processes_of(&self.directory).is_empty() {
            assert!(
                Instant::now() < self.deadline,
                "{:?}",
                processes_of(&self.directory)
            );
            sleep(POLL_INTERVAL);
        }
    }

    /// Resumes it with `actors` actors after its supervisor has ended.
    ///
    /// # Panics
    /// Panics if it cannot be started.
    pub fn resume(&mut self, actors: u32) {
        self.resume_with(actors, &[]);
    }

    /// As [`RunningRun::resume`], with more arguments.
    ///
    /// # Panics
    /// Panics if it cannot be started.
    pub fn resume_with(&mut self, actors: u32, arguments: &[&str]) {
        self.supervisor.wait().unwrap();
        let folder = self
            .folder
            .as_ref()
            .expect("the folder is taken only at the end");
        let mut command = skein_run(folder.path(), actors);
        command
            .arg("--resume")
            .arg(self.directory.root())
            .args(arguments);
        self.supervisor = command.spawn().unwrap();
        self.deadline = Instant::now() + LIMIT;
    }

    /// Waits for the end of the supervisor and of the `skein attach` processes, which must succeed.
    ///
    /// # Panics
    /// Panics if the time is up, or an attach process failed.
    pub fn wait(mut self) -> EndedRun {
        self.until_ended();
        let status = self.supervisor.wait().unwrap();
        for attached in &mut self.attached {
            // Attach processes end with the run; one that hangs is not waited for here.
            let end = Instant::now() + Duration::from_secs(20);
            while attached.try_wait().unwrap().is_none() && Instant::now() < end {
                sleep(POLL_INTERVAL);
            }
            let status = attached.try_wait().unwrap();
            assert!(
                status.is_some_and(|status| status.success()),
                "skein attach: {status:?}"
            );
        }
        let left = leftovers(&self.directory);
        let folder = self.folder.take().expect("the folder is taken only here");
        let read = |name| fs::read(folder.path().join(name)).unwrap();
        EndedRun {
            output: ProgramOutput::of(status, &read("stdout"), &read("stderr")),
            directory: self.directory.clone(),
            left,
            _folder: folder,
        }
    }

    /// Waits for the end and asserts that the run succeeded and left nothing behind.
    ///
    /// # Panics
    /// Panics if it did not.
    pub fn finish(self) -> EndedRun {
        let ended = self.wait();
        assert_eq!(ended.output.code, Some(0), "{}", ended.output.stderr);
        ended.assert_nothing_is_left();
        ended
    }
}

impl Drop for RunningRun {
    fn drop(&mut self) {
        // Nothing here may panic, because failing tests come through here.
        let _ = self.supervisor.kill();
        let _ = self.supervisor.wait();
        let end = Instant::now() + Duration::from_secs(10);
        loop {
            let left = processes_of(&self.directory);
            left.iter().for_each(|process| process.signal(Signal::KILL));
            if left.is_empty() || Instant::now() > end {
                break;
            }
            sleep(POLL_INTERVAL);
        }
        for attached in &mut self.attached {
            let _ = attached.wait();
        }
        sweep_leftovers();
    }
}

/// A run that has ended. Its directory is removed when it goes out of scope.
#[derive(Debug)]
pub struct EndedRun {
    /// ProgramOutput and exit status of the supervisor.
    pub output: ProgramOutput,
    /// Run directory.
    pub directory: RunDirectory,
    left: Vec<String>,
    _folder: TempDir,
}

impl EndedRun {
    /// Asserts that no process, shared memory or socket was left when the supervisor ended.
    ///
    /// # Panics
    /// Panics if something was left.
    pub fn assert_nothing_is_left(&self) {
        assert!(self.left.is_empty(), "left behind: {:#?}", self.left);
    }

    /// Reads `summary.json`.
    ///
    /// # Panics
    /// Panics if it is missing or malformed.
    pub fn summary(&self) -> RunSummary {
        json(self.directory.summary_json())
    }

    /// Reads `evaluation.json`.
    ///
    /// # Panics
    /// Panics like [`EndedRun::summary`].
    pub fn evaluation(&self) -> EvaluationReport {
        json(self.directory.evaluation_json())
    }

    /// Reads `episodes.csv`.
    ///
    /// # Panics
    /// Panics if it is malformed.
    pub fn episodes(&self) -> Vec<RecordedEpisode> {
        episodes(&self.directory)
    }

    /// Asserts that it has the results of `calm`, in every file and every point of every curve,
    /// except for the actor of each episode.
    ///
    /// # Panics
    /// Panics if it has not; the message names every difference.
    pub fn assert_same_as(&self, calm: &Self) {
        let differences: Vec<_> = compare(&calm.directory, &self.directory)
            .into_iter()
            .filter_map(|check| Some(format!("{}: {}", check.what, check.verdict.err()?)))
            .collect();
        assert!(
            differences.is_empty(),
            "{differences:#?}\n{}",
            self.output.stderr
        );
    }

    /// Returns the results that do not depend on how the run was flown.
    ///
    /// # Panics
    /// Panics like [`EndedRun::summary`].
    pub fn learned(&self) -> LearnedResults {
        LearnedResults::of(&self.directory, &self.summary())
    }
}

fn json<T: DeserializeOwned>(path: PathBuf) -> T {
    let text =
        fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    serde_json::from_str(&text).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}
