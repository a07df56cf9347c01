//! The programs under test: started, watched, resumed, cleared away.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use rustix::process::Signal;
use skein_chaos::{Process, processes_of};
use skein_protocol::summary::{RunEnding, Summary};
use skein_run::RunDirectory;
use skein_run::fault::FAULTS;
use skein_run::orphans::signal_when_orphaned;

/// Between two looks at what is waited for.
pub(crate) const LOOK: Duration = Duration::from_millis(10);

/// What to train.
#[derive(Debug, Clone)]
pub(crate) struct Recipe {
    pub(crate) config: PathBuf,
    pub(crate) overrides: Vec<String>,
}

/// A run and the programs that carry it.
#[derive(Debug)]
pub(crate) struct Stage {
    skein: PathBuf,
    folder: PathBuf,
    pub(crate) run: RunDirectory,
    /// What all programs of the run say on standard output and standard error.
    said: PathBuf,
    faults: Option<PathBuf>,
}

impl Stage {
    /// For a run in `folder/name`; what its programs say goes to `folder/name.log`. `faults` is
    /// where fault points are armed.
    ///
    /// # Errors
    /// When `skein` does not lie beside this program.
    pub(crate) fn new(folder: &Path, name: &str, faults: Option<PathBuf>) -> Result<Self> {
        let skein = std::env::current_exe()
            .context("cannot tell where this program lies")?
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
            said: folder.join(format!("{name}.log")),
            faults,
        })
    }

    /// Where everything about the run goes.
    pub(crate) fn folder(&self) -> &Path {
        &self.folder
    }

    /// Starts the run anew.
    ///
    /// # Errors
    /// When the program cannot be started.
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

    /// Starts it again after everything was killed.
    ///
    /// # Errors
    /// As [`Stage::start`].
    pub(crate) fn resume(&self, actors: u32) -> Result<Child> {
        let mut command = self.command("run")?;
        command.arg("--resume").arg(self.run.root());
        command.args(["--actors", &actors.to_string()]);
        self.spawn(command)
    }

    /// Adds actors to it.
    ///
    /// # Errors
    /// As [`Stage::start`].
    pub(crate) fn attach(&self, count: u32) -> Result<Child> {
        let mut command = self.command("attach")?;
        command.arg("--run").arg(self.run.root());
        command.args(["--count", &count.to_string()]);
        self.spawn(command)
    }

    fn command(&self, what: &str) -> Result<Command> {
        let said = || -> io::Result<File> {
            OpenOptions::new()
                .create(true)
                .append(true)
                .open(&self.said)
        };
        let context = || format!("cannot write {}", self.said.display());
        let mut command = Command::new(&self.skein);
        command.arg(what).stdin(Stdio::null());
        command.stdout(said().with_context(context)?);
        command.stderr(said().with_context(context)?);
        if let Some(faults) = &self.faults {
            command.env(FAULTS, faults);
        }
        Ok(command)
    }

    /// Starts `command` so that it is interrupted when this program dies: nobody would end a run
    /// that is made to last for ever.
    fn spawn(&self, mut command: Command) -> Result<Child> {
        signal_when_orphaned(&mut command, Signal::INT);
        command
            .spawn()
            .with_context(|| format!("cannot start {}", self.skein.display()))
    }

    /// Its processes, oldest first.
    pub(crate) fn processes(&self) -> Vec<Process> {
        processes_of(&self.run)
    }

    /// The last lines that its programs said.
    pub(crate) fn last_words(&self) -> String {
        let text = fs::read(&self.said).unwrap_or_default();
        let text = String::from_utf8_lossy(&text);
        let lines: Vec<_> = text.lines().collect();
        lines[lines.len().saturating_sub(12)..].join("\n")
    }

    /// Its summary, once there is one.
    pub(crate) fn summary(&self) -> Option<Summary> {
        serde_json::from_slice(&fs::read(self.run.summary_json()).ok()?).ok()
    }

    /// Whether it came to its end.
    pub(crate) fn is_complete(&self) -> bool {
        self.summary()
            .is_some_and(|summary| summary.ending == RunEnding::Completed)
    }

    /// Kills whatever is left of it. For the way out of a failure.
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

/// Waits for the end of `child`, but not longer than until `deadline`.
///
/// # Errors
/// When it cannot be waited for.
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

/// Counts the episodes in an `episodes.csv` that grows, and may be cut back.
#[derive(Debug)]
pub(crate) struct EpisodeCount {
    path: PathBuf,
    read_bytes: u64,
    lines: u64,
}

impl EpisodeCount {
    /// Of the run in `run`.
    pub(crate) fn of(run: &RunDirectory) -> Self {
        Self {
            path: run.episodes_csv(),
            read_bytes: 0,
            lines: 0,
        }
    }

    /// Episodes learned from so far; less than before when a learner was resumed from before.
    pub(crate) fn now(&mut self) -> u64 {
        // Before the first epoch there is no file; that is no fault.
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
    fn episodes_are_counted_as_they_come_and_when_they_are_cut_back() {
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
