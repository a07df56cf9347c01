//! One child process: how it is started, signalled and reaped.

use std::ffi::OsString;
use std::fmt;
use std::fs::OpenOptions;
use std::io;
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{ExitStatus, Stdio};

use rustix::process::{Pid, Signal, kill_process};
use skein_run::failure::{EXIT_LEARNER_GONE, EXIT_OUT_OF_MEMORY, EXIT_RESTART};
use tokio::process::{Child, Command};
use tokio::sync::watch;

use skein_run::orphans::signal_when_orphaned;
use skein_run::signals::heed;

/// Exit status of a Rust program that panicked.
const PANICKED: i32 = 101;
const OUT_OF_MEMORY: i32 = EXIT_OUT_OF_MEMORY as i32;

/// Instruction to a process.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ProcessOrder {
    /// Keep running.
    Run,
    /// SIGTERM: end in order.
    Terminate,
    /// SIGKILL.
    Kill,
}

/// End of a process. Its text completes a sentence: "exited with status 1".
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Exit {
    /// It ended by itself, with this status.
    Status(i32),
    /// It was killed by this signal.
    Signal(i32),
    /// It could not be restarted, or not be waited for.
    Unknown(String),
}

impl Exit {
    /// Exit status of success.
    pub(super) const SUCCESS: Self = Self::Status(0);

    fn of(status: io::Result<ExitStatus>) -> Self {
        match status {
            Ok(status) => match (status.code(), status.signal()) {
                (Some(code), _) => Self::Status(code),
                (None, Some(signal)) => Self::Signal(signal),
                (None, None) => Self::Unknown(format!("ended with {status}")),
            },
            Err(error) => Self::Unknown(format!("cannot be waited for: {error}")),
        }
    }

    /// Returns `true` if it ended because it found no learner.
    pub(super) fn found_no_learner(&self) -> bool {
        *self == Self::Status(EXIT_LEARNER_GONE.into())
    }

    /// Returns `true` if a signal killed it. The value does not show whether the supervisor sent
    /// that signal.
    pub(super) fn was_killed(&self) -> bool {
        [Signal::KILL, Signal::TERM]
            .iter()
            .any(|signal| *self == Self::Signal(signal.as_raw()))
    }

    /// Returns `true` if it ended because it was refused memory.
    pub(super) fn ran_out_of_memory(&self) -> bool {
        *self == Self::Status(OUT_OF_MEMORY)
    }

    /// Returns `true` if a restart may help: it was killed, it panicked, its transport failed, or
    /// memory ran out. An error that the program reported itself would only repeat.
    pub(super) fn may_recover(&self) -> bool {
        match *self {
            Self::Status(status) => {
                [PANICKED, EXIT_RESTART.into(), OUT_OF_MEMORY].contains(&status)
            }
            Self::Signal(_) | Self::Unknown(_) => true,
        }
    }
}

impl fmt::Display for Exit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Status(PANICKED) => f.write_str("panicked"),
            Self::Status(OUT_OF_MEMORY) => f.write_str("ran out of memory"),
            Self::Status(status) => write!(f, "exited with status {status}"),
            Self::Signal(signal) => write!(f, "was killed by signal {signal}"),
            Self::Unknown(how) => f.write_str(how),
        }
    }
}

/// Destination of a process's standard output.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Output {
    /// A pipe to the supervisor.
    Piped,
    /// Its log file, like its standard error.
    Logged,
}

/// A program to start, with its arguments and the destination of its output.
#[derive(Debug)]
pub(super) struct ProcessLaunch<'a> {
    pub(super) program: &'a Path,
    pub(super) arguments: Vec<OsString>,
    /// Threads for its tensor libraries. More than its share would slow all processes down.
    pub(super) threads: usize,
    pub(super) log: PathBuf,
    pub(super) output: Output,
}

impl ProcessLaunch<'_> {
    /// Starts the program.
    ///
    /// It leads a process group of its own, so that Ctrl-C in the terminal reaches only the
    /// supervisor, which stops processes in the right order. The kernel kills it when the *thread*
    /// that started it ends, for whatever reason: call this on the main thread.
    /// # Errors
    /// Returns an error if its log cannot be opened or the program cannot be started.
    pub(super) fn start(&self) -> io::Result<Child> {
        let log = OpenOptions::new()
            .create(true)
            .append(true)
            .open(&self.log)?;
        let output = match self.output {
            Output::Piped => Stdio::piped(),
            Output::Logged => log.try_clone()?.into(),
        };
        let mut command = Command::new(self.program);
        command
            .args(&self.arguments)
            .env("OMP_NUM_THREADS", self.threads.to_string())
            .env("MKL_NUM_THREADS", self.threads.to_string())
            .env("OMP_DYNAMIC", "false")
            // A waiting thread yields its core to an actor instead of spinning.
            .env("OMP_WAIT_POLICY", "passive")
            .env("GOMP_SPINCOUNT", "0")
            .stdin(Stdio::null())
            .stdout(output)
            .stderr(log)
            .process_group(0)
            .kill_on_drop(true);
        signal_when_orphaned(command.as_std_mut(), Signal::KILL);
        heed(command.as_std_mut(), Signal::TERM);
        command.spawn()
    }
}

/// Waits for `child` and forwards `orders` to it. Returns once it is reaped and nothing is left of
/// it.
pub(super) async fn reap(mut child: Child, mut orders: watch::Receiver<ProcessOrder>) -> Exit {
    let mut listening = true;
    loop {
        tokio::select! {
            status = child.wait() => return Exit::of(status),
            changed = orders.changed(), if listening => {
                listening = changed.is_ok();
                // The sender is gone without a last order: the process is no longer needed.
                let order = match listening {
                    true => *orders.borrow_and_update(),
                    false => ProcessOrder::Kill,
                };
                obey(&child, order);
            }
        }
    }
}

fn obey(child: &Child, order: ProcessOrder) {
    let signal = match order {
        ProcessOrder::Run => return,
        ProcessOrder::Terminate => Signal::TERM,
        ProcessOrder::Kill => Signal::KILL,
    };
    // A child that is not reaped keeps its process id, so the signal cannot reach another process.
    // A child that has just ended is not an error.
    if let Some(pid) = child.id().and_then(|id| Pid::from_raw(id.cast_signed())) {
        let _ = kill_process(pid, signal);
    }
}
