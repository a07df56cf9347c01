//! Programs under test: started, watched, resumed, cleared away.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use rustix::process::Signal;
use skein_chaos::{ListedProcess, processes_of};
use skein_protocol::summary::{RunEnding, RunSummary};
use skein_run::RunDirectory;
use skein_run::fault::FAULTS;
use skein_run::orphans::signal_when_orphaned;

/// Time between two checks of a condition.
pub(crate) const LOOK: Duration = Duration::from_millis(10);

/// Training to run.
#[derive(Debug, Clone)]
pub(crate) struct Recipe {
    pub(crate) config: PathBuf,
    pub(crate) overrides: Vec<String>,
}

/// A run and its programs.
#[derive(Debug)]
pub(crate) struct TestedRun {
    skein: PathBuf,
    folder: PathBuf,
    pub(crate) run: RunDirectory,
    /// Log with standard output and standard error of all programs of the run.
    log: PathBuf,
    faults: Option<PathBuf>,
}

impl TestedRun {
    /// Prepares a run in `folder/name` with the log `folder/name.log`. Fault points are armed in
    /// `faults`.
    ///
    /// # Errors
    /// Returns an error if `skein` does not lie beside this program.
    pub(crate) fn new(folder: &Path, name: &str, faults: Option<PathBuf>) -> Result<Self> {
        let skein = std::env::current_exe()
            .context("cannot find the path of this program")?
            .with_file_name("skein");
        if !skein.is_file() {
            bail!(
                "{} is missing: build it with `cargo build --release --workspace --bins`",
                skein.display()
            );
        }
        Ok(Self {
            skein,
            folder: folder.to_owned(),
            run: RunDirectory::new(folder.join(name)),
            log: folder.join(format!("{name}.log")),
            faults,
        })
    }

    /// Folder of all files about the run.
    pub(crate) fn folder(&self) -> &Path {
        &self.folder
    }

    /// Starts the run.
    ///
    /// # Errors
    /// Returns an error if the program cannot be started.
    pub(crate) fn start(&self, recipe: &Recipe, actors: u32) -> Result<Child> {
        let mut command = self.command("run")?;
        command.arg("--config").arg(&recipe.config);
        command.arg("--run-dir").arg(self.run.root());
        command.args(["--actors", &actors.to_string()]);
        command.args(
            recipe
                .overrides
                .iter()
                .flat_map(|setting| ["--set", setting]),
        );
        self.spawn(command)
    }

    /// Resumes the run after everything was killed.
    ///
    /// # Errors
    /// As [`TestedRun::start`].
    pub(crate) fn resume(&self, actors: u32) -> Result<Child> {
        let mut command = self.command("run")?;
        command.arg("--resume").arg(self.run.root());
        command.args(["--actors", &actors.to_string()]);
        self.spawn(command)
    }

    /// Adds actors to the run.
    ///
    /// # Errors
    /// As [`TestedRun::start`].
    pub(crate) fn attach(&self, count: u32) -> Result<Child> {
        let mut command = self.command("attach")?;
        command.arg("--run").arg(self.run.root());
        command.args(["--count", &count.to_string()]);
        self.spawn(command)
    }

    fn command(&self, what: &str) -> Result<Command> {
        let log =
            || -> io::Result<File> { OpenOptions::new().create(true).append(true).open(&self.log) };
        let context = || format!("cannot write {}", self.log.display());
        let mut command = Command::new(&self.skein);
        command.arg(what).stdin(Stdio::null());
        command.stdout(log().with_context(context)?);
        command.stderr(log().with_context(context)?);
        if let Some(faults) = &self.faults {
            command.env(FAULTS, faults);
        }
        Ok(command)
    }

    /// Starts `command` so that it is interrupted when this program dies. Otherwise a run without
    /// end would remain.
    fn spawn(&self, mut command: Command) -> Result<Child> {
        signal_when_orphaned(&mut command, Signal::INT);
        command
            .spawn()
            .with_context(|| format!("cannot start {}", self.skein.display()))
    }

    /// Returns its processes, oldest first.
    pub(crate) fn processes(&self) -> Vec<ListedProcess> {
        processes_of(&self.run)
    }

    /// Returns the last lines of its log.
    pub(crate) fn last_words(&self) -> String {
        let text = fs::read(&self.log).unwrap_or_default();
        let text = String::from_utf8_lossy(&text);
        let lines: Vec<_> = text.lines().collect();
        lines[lines.len().saturating_sub(12)..].join("\n")
    }

    /// Returns its summary, if it exists.
    pub(crate) fn summary(&self) -> Option<RunSummary> {
        serde_json::from_slice(&fs::read(self.run.summary_json()).ok()?).ok()
    }

    /// Returns `true` if it completed.
    pub(crate) fn is_complete(&self) -> bool {
        self.summary()
            .is_some_and(|summary| summary.ending == RunEnding::Completed)
    }

    /// Kills all its processes, after a failure.
    pub(crate) fn clear(&self) {
        let end = Instant::now() + Duration::from_secs(10);
        loop {
            let left = self.processes();
            left.iter().for_each(|process| process.signal(Signal::KILL));
            if left.is_empty() || Instant::now() > end {
                return;
            }
            sleep(LOOK);
        }
    }
}

/// Waits for the end of `child` until `deadline`.
///
/// # Errors
/// Returns an error if it cannot be waited for.
pub(crate) fn wait(child: &mut Child, deadline: Instant) -> io::Result<Option<ExitStatus>> {
    loop {
        if let Some(status) = child.try_wait()? {
            return Ok(Some(status));
        }
        if Instant::now() > deadline {
            return Ok(None);
        }
        sleep(LOOK);
    }
}

/// Counts the episodes in a growing `episodes.csv`, which may also be truncated.
#[derive(Debug)]
pub(crate) struct EpisodeCount {
    path: PathBuf,
    read_bytes: u64,
    lines: u64,
}

impl EpisodeCount {
    /// Counts the episodes of `run`.
    pub(crate) fn of(run: &RunDirectory) -> Self {
        Self {
            path: run.episodes_csv(),
            read_bytes: 0,
            lines: 0,
        }
    }

    /// Returns the number of episodes learned from; it decreases when a learner resumes from an
    /// earlier state.
    pub(crate) fn now(&mut self) -> u64 {
        // Before the first epoch no file exists, which is not an error.
        let _ = self.read_on();
        self.lines.saturating_sub(1)
    }

    fn read_on(&mut self) -> io::Result<()> {
        let mut file = File::open(&self.path)?;
        if file.metadata()?.len() < self.read_bytes {
            (self.read_bytes, self.lines) = (0, 0);
        }
        file.seek(SeekFrom::Start(self.read_bytes))?;
        let mut more = Vec::new();
        file.read_to_end(&mut more)?;
        self.read_bytes += more.len() as u64;
        self.lines += more.iter().filter(|&&byte| byte == b'\n').count() as u64;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn episodes_are_counted_as_they_come_and_after_truncation() {
        let folder = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(folder.path());
        let mut count = EpisodeCount::of(&run);
        assert_eq!(count.now(), 0);
        fs::write(run.episodes_csv(), "header\n0\n1\n2").unwrap();
        assert_eq!(count.now(), 2, "the third is still being written");
        fs::write(run.episodes_csv(), "header\n0\n1\n2\n3\n").unwrap();
        assert_eq!(count.now(), 4);
        fs::write(run.episodes_csv(), "header\n0\n").unwrap();
        assert_eq!(count.now(), 1);
    }
}
