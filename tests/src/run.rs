//! A run of the real programs: started, watched, ended, and cleared away.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::thread::sleep;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use serde::de::DeserializeOwned;
use skein_chaos::{Process, Role, compare, leftovers, processes_of};
use skein_protocol::evaluation::EvaluationReport;
use skein_protocol::summary::Summary;
use skein_run::{RunDirectory, sweep_leftovers};
use tempfile::TempDir;

use crate::episodes::{Episode, Learned, episodes};
use crate::programs::{Output, program, repository};

/// No run here takes a fifth of it on an idle machine.
const LIMIT: Duration = Duration::from_secs(180);
/// Between two looks at what is waited for.
const LOOK: Duration = Duration::from_millis(20);

/// One run at a time in a test process: each takes all cores.
static TURN: Mutex<()> = Mutex::new(());

/// A run to be started.
#[derive(Debug, Clone)]
pub struct Recipe {
    config: PathBuf,
    overrides: Vec<String>,
    environment: Vec<(String, String)>,
    actors: u32,
    within: Option<PathBuf>,
}

impl Recipe {
    /// The shipped `configs/smoke.toml`, two actors.
    pub fn smoke() -> Self {
        Self::of(repository().join("configs/smoke.toml"))
    }

    /// `tests/small.toml`, two actors: a few seconds.
    pub fn small() -> Self {
        Self::of(repository().join("tests/small.toml"))
    }

    /// The configuration file `config`, two actors.
    pub fn of(config: PathBuf) -> Self {
        Self {
            config,
            overrides: Vec::new(),
            environment: Vec::new(),
            actors: 2,
            within: None,
        }
    }

    /// With its directory in this folder.
    pub fn within(mut self, folder: &Path) -> Self {
        self.within = Some(folder.to_owned());
        self
    }

    /// With so many actors.
    pub fn actors(mut self, actors: u32) -> Self {
        self.actors = actors;
        self
    }

    /// With `--set section.key=value`.
    pub fn set(mut self, setting: &str) -> Self {
        self.overrides.push(setting.to_owned());
        self
    }

    /// With this environment variable.
    pub fn environment(mut self, name: &str, value: &str) -> Self {
        self.environment.push((name.to_owned(), value.to_owned()));
        self
    }

    /// Starts it; waits until no other run of this test process is under way.
    ///
    /// # Panics
    /// When it cannot be started.
    pub fn start(self) -> Running {
        let turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
        self.start_in_turn(Some(turn))
    }

    /// Starts it while `_other` is under way.
    ///
    /// # Panics
    /// When it cannot be started.
    pub fn start_beside(self, _other: &Running) -> Running {
        self.start_in_turn(None)
    }

    fn start_in_turn(self, turn: Option<MutexGuard<'static, ()>>) -> Running {
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
        Running {
            supervisor: command.spawn().unwrap(),
            attached: Vec::new(),
            directory: RunDirectory::new(root),
            folder: Some(folder),
            deadline: Instant::now() + LIMIT,
            _turn: turn,
        }
    }

    /// Runs it to its end and requires that it succeeds.
    ///
    /// # Panics
    /// When it does not.
    pub fn finish(self) -> Ended {
        self.start().finish()
    }
}

/// `skein run` with so many actors, saying what it says to files in `folder`.
fn skein_run(folder: &Path, actors: u32) -> Command {
    let mut command = Command::new(program("skein"));
    command
        .args(["run", "--actors", &actors.to_string()])
        .env_remove("RUST_LOG")
        .env_remove("SKEIN_LOG_FORMAT")
        .stdin(Stdio::null())
        .stdout(File::create(folder.join("stdout")).unwrap())
        .stderr(File::create(folder.join("stderr")).unwrap());
    command
}

/// A run under way. Its processes and all they left are cleared away when it goes out of scope.
#[derive(Debug)]
pub struct Running {
    supervisor: Child,
    attached: Vec<Child>,
    directory: RunDirectory,
    folder: Option<TempDir>,
    deadline: Instant,
    _turn: Option<MutexGuard<'static, ()>>,
}

impl Running {
    /// Its directory.
    pub fn directory(&self) -> &RunDirectory {
        &self.directory
    }

    /// What the supervisor has said on standard error so far.
    pub fn stderr(&self) -> String {
        let folder = self.folder.as_ref().expect("it is taken only at the end");
        fs::read_to_string(folder.path().join("stderr")).unwrap()
    }

    /// Waits until `condition` gives something.
    ///
    /// # Panics
    /// When the run ends before, or the time is up; `what` says what was waited for.
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
            sleep(LOOK);
        }
    }

    /// Waits until the supervisor has ended, of itself or because it was told to.
    ///
    /// # Panics
    /// When the time is up.
    pub fn until_ended(&mut self) {
        while self.supervisor.try_wait().unwrap().is_none() {
            assert!(
                Instant::now() < self.deadline,
                "it does not end:\n{}",
                self.stderr()
            );
            sleep(LOOK);
        }
    }

    /// Waits until so many training episodes are learned from.
    ///
    /// # Panics
    /// As [`Running::until`].
    pub fn until_episodes(&mut self, count: usize) {
        self.until(&format!("{count} episodes were learned from"), |run| {
            (episodes(&run.directory).len() >= count).then_some(())
        });
    }

    /// Kills the learner once so many episodes were learned from, and waits until another is there.
    ///
    /// # Panics
    /// When the run ends before, or none comes.
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
    /// When it cannot be started.
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

    /// Sends `signal` to the supervisor alone.
    ///
    /// # Panics
    /// When it has been reaped already.
    pub fn signal(&self, signal: Signal) {
        let pid = Pid::from_raw(self.supervisor.id().cast_signed()).unwrap();
        kill_process(pid, signal).unwrap();
    }

    /// The process of this run that runs `program`, the first of several.
    ///
    /// # Panics
    /// When there is none.
    pub fn process(&self, program: &str) -> Process {
        let processes = processes_of(&self.directory);
        let found = processes.into_iter().find(|process| process.runs(program));
        found.unwrap_or_else(|| panic!("no {program} is there:\n{}", self.stderr()))
    }

    /// Its processes of this role, oldest first.
    pub fn processes(&self, role: Role) -> Vec<Process> {
        let mut processes = processes_of(&self.directory);
        processes.retain(|process| process.role() == role);
        processes
    }

    /// Kills the supervisor alone.
    ///
    /// # Panics
    /// When it had ended already.
    pub fn kill_supervisor(&mut self) {
        let ended = self.supervisor.try_wait().unwrap();
        assert!(
            ended.is_none(),
            "the run ended too soon:\n{}",
            self.stderr()
        );
        self.supervisor.kill().unwrap();
        self.supervisor.wait().unwrap();
    }

    /// Kills all its processes at once, as a power cut does.
    ///
    /// # Panics
    /// When one of them does not end.
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
            sleep(LOOK);
        }
    }

    /// Goes on with it, with so many actors, once its supervisor has ended, however it did.
    ///
    /// # Panics
    /// When it cannot be started.
    pub fn resume(&mut self, actors: u32) {
        self.supervisor.wait().unwrap();
        let folder = self.folder.as_ref().expect("it is taken only at the end");
        let mut command = skein_run(folder.path(), actors);
        command.arg("--resume").arg(self.directory.root());
        self.supervisor = command.spawn().unwrap();
        self.deadline = Instant::now() + LIMIT;
    }

    /// Waits for the end of the supervisor and of those attached, which must succeed.
    ///
    /// # Panics
    /// When the time is up, or one attached failed.
    pub fn wait(mut self) -> Ended {
        self.until_ended();
        let status = self.supervisor.wait().unwrap();
        for attached in &mut self.attached {
            // It ends with the run, unless it hangs: then its end is not waited for here.
            let end = Instant::now() + Duration::from_secs(20);
            while attached.try_wait().unwrap().is_none() && Instant::now() < end {
                sleep(LOOK);
            }
            let status = attached.try_wait().unwrap();
            assert!(
                status.is_some_and(|status| status.success()),
                "skein attach: {status:?}"
            );
        }
        let left = leftovers(&self.directory);
        let folder = self.folder.take().expect("it is taken only here");
        let read = |name| fs::read(folder.path().join(name)).unwrap();
        Ended {
            output: Output::of(status, &read("stdout"), &read("stderr")),
            directory: self.directory.clone(),
            left,
            _folder: folder,
        }
    }

    /// Waits for the end and requires that the run succeeded and left nothing behind.
    ///
    /// # Panics
    /// When it did not.
    pub fn finish(self) -> Ended {
        let ended = self.wait();
        assert_eq!(ended.output.code, Some(0), "{}", ended.output.stderr);
        ended.assert_nothing_is_left();
        ended
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        // Nothing here may panic: a test that failed comes through here.
        let _ = self.supervisor.kill();
        let _ = self.supervisor.wait();
        let end = Instant::now() + Duration::from_secs(10);
        loop {
            let left = processes_of(&self.directory);
            left.iter().for_each(|process| process.signal(Signal::KILL));
            if left.is_empty() || Instant::now() > end {
                break;
            }
            sleep(LOOK);
        }
        for attached in &mut self.attached {
            let _ = attached.wait();
        }
        sweep_leftovers();
    }
}

/// A run that has ended. Its directory is removed when it goes out of scope.
#[derive(Debug)]
pub struct Ended {
    /// How the supervisor ended.
    pub output: Output,
    /// The run's directory.
    pub directory: RunDirectory,
    left: Vec<String>,
    _folder: TempDir,
}

impl Ended {
    /// Requires that no process, shared memory or socket was left the moment the supervisor had
    /// ended.
    ///
    /// # Panics
    /// When something was.
    pub fn assert_nothing_is_left(&self) {
        assert!(self.left.is_empty(), "left behind: {:#?}", self.left);
    }

    /// `summary.json`.
    ///
    /// # Panics
    /// When it is not there or malformed.
    pub fn summary(&self) -> Summary {
        json(self.directory.summary_json())
    }

    /// `evaluation.json`.
    ///
    /// # Panics
    /// As [`Ended::summary`].
    pub fn evaluation(&self) -> EvaluationReport {
        json(self.directory.evaluation_json())
    }

    /// `episodes.csv`.
    ///
    /// # Panics
    /// When it is malformed.
    pub fn episodes(&self) -> Vec<Episode> {
        episodes(&self.directory)
    }

    /// Requires that it came to the same as `calm`, in every file and every point of every curve,
    /// who flew what apart.
    ///
    /// # Panics
    /// When it did not; the message names every difference.
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

    /// What must be the same however the run was flown.
    ///
    /// # Panics
    /// As [`Ended::summary`].
    pub fn learned(&self) -> Learned {
        Learned::of(&self.directory, &self.summary())
    }
}

fn json<T: DeserializeOwned>(path: PathBuf) -> T {
    let text =
        fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    serde_json::from_str(&text).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}
