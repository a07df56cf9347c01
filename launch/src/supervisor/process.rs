//! One child process: how it is started, told to end, and reaped.

use std::ffi::OsString;
use std::fmt;
use std::fs::OpenOptions;
use std::io;
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{ExitStatus, Stdio};

use rustix::process::{Pid, Signal, kill_process};
use skein_run::failure::{EXIT_LEARNER_GONE, EXIT_RESTART};
use tokio::process::{Child, Command};
use tokio::sync::watch;

use skein_run::orphans::signal_when_orphaned;

/// Status of a Rust program that panicked.
const PANICKED: i32 = 101;

/// What a process is told.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Order {
    /// Go on.
    Run,
    /// SIGTERM: end in order.
    Terminate,
    /// SIGKILL.
    Kill,
}

/// How a process ended. Shown as what is said of it: "exited with status 1".
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Exit {
    /// By itself, with this status.
    Status(i32),
    /// By this signal.
    Signal(i32),
    /// It could not be started again, or not be waited for.
    Unknown(String),
}

impl Exit {
    /// The status of success.
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

    /// Whether it ended because it found no learner.
    pub(super) fn is_for_want_of_a_learner(&self) -> bool {
        *self == Self::Status(EXIT_LEARNER_GONE.into())
    }

    /// Whether somebody ended it by a signal for that purpose. Whether that was the supervisor
    /// itself does not show here.
    pub(super) fn is_a_kill(&self) -> bool {
        [Signal::KILL, Signal::TERM]
            .iter()
            .any(|signal| *self == Self::Signal(signal.as_raw()))
    }

    /// Whether the same program may do better when it is started again: it was killed, it panicked,
    /// or its transport failed. An error that it told itself would come again.
    pub(super) fn may_pass(&self) -> bool {
        match *self {
            Self::Status(status) => status == PANICKED || status == i32::from(EXIT_RESTART),
            Self::Signal(_) | Self::Unknown(_) => true,
        }
    }
}

impl fmt::Display for Exit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Status(PANICKED) => f.write_str("panicked"),
            Self::Status(status) => write!(f, "exited with status {status}"),
            Self::Signal(signal) => write!(f, "was killed by signal {signal}"),
            Self::Unknown(how) => f.write_str(how),
        }
    }
}

/// Where a process writes its standard output.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Output {
    /// To the supervisor.
    Piped,
    /// Into its log file, as its standard error always does.
    Logged,
}

/// A program to start: which, with what arguments, and where its output goes.
#[derive(Debug)]
pub(super) struct Launch<'a> {
    pub(super) program: &'a Path,
    pub(super) arguments: Vec<OsString>,
    /// Threads its tensor libraries may use; more than its share would slow everybody down.
    pub(super) threads: usize,
    pub(super) log: PathBuf,
    pub(super) output: Output,
}

impl Launch<'_> {
    /// Starts the program.
    ///
    /// It leads a process group of its own, so that Ctrl-C in the terminal reaches only the
    /// supervisor, which knows the order of things. The kernel kills it when the *thread* that
    /// started it ends, however that comes about: to be called on the main thread.
    ///
    /// # Errors
    /// When its log cannot be opened or the program cannot be started.
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
            // A waiting thread gives its core to an actor instead of spinning on it.
            .env("OMP_WAIT_POLICY", "passive")
            .env("GOMP_SPINCOUNT", "0")
            .stdin(Stdio::null())
            .stdout(output)
            .stderr(log)
            .process_group(0)
            .kill_on_drop(true);
        signal_when_orphaned(command.as_std_mut(), Signal::KILL);
        command.spawn()
    }
}

/// Waits for `child`, passing on what `orders` say. Returns only when it is reaped: nothing is left
/// of it then.
pub(super) async fn reap(mut child: Child, mut orders: watch::Receiver<Order>) -> Exit {
    let mut listening = true;
    loop {
        tokio::select! {
            status = child.wait() => return Exit::of(status),
            changed = orders.changed(), if listening => {
                listening = changed.is_ok();
                // Whoever gave the orders is gone without an order: nobody wants the process any
                // more.
                let order = if listening { *orders.borrow_and_update() } else { Order::Kill };
                obey(&child, order);
            }
        }
    }
}

fn obey(child: &Child, order: Order) {
    let signal = match order {
        Order::Run => return,
        Order::Terminate => Signal::TERM,
        Order::Kill => Signal::KILL,
    };
    // A child that is not reaped keeps its number, so the signal cannot reach a stranger; and that
    // it has just ended is no error.
    if let Some(pid) = child.id().and_then(|id| Pid::from_raw(id.cast_signed())) {
        let _ = kill_process(pid, signal);
    }
}
