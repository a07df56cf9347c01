//! The processes of a run, as the kernel lists them.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use rustix::process::{Pid, Signal, kill_process};
use skein_run::RunDirectory;

/// A process that was alive when it was looked for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Process {
    /// Its number.
    pub pid: Pid,
    /// Program and arguments.
    pub command: Vec<String>,
    /// When it was started, in clock ticks since the machine was: tells it from a later process of
    /// the same number.
    started_ticks: u64,
}

/// What a process is to its run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Role {
    /// `skein run`.
    Supervisor,
    /// `skein attach`.
    Crew,
    /// `skein-learner`.
    Learner,
    /// `skein-actor`.
    Actor,
    /// Anything else that was given the directory.
    Other,
}

impl Role {
    /// Its name in reports.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Supervisor => "supervisor",
            Self::Crew => "crew",
            Self::Learner => "learner",
            Self::Actor => "actor",
            Self::Other => "other",
        }
    }
}

/// What a process holds of the machine.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Usage {
    /// Memory that is mapped and present, shared memory included.
    pub resident_bytes: u64,
    /// As many were there at one time.
    pub most_resident_bytes: u64,
    /// The part of it that is its own: neither files nor shared memory.
    pub anonymous_bytes: u64,
    /// Open file descriptors.
    pub descriptors: u64,
    /// Threads.
    pub threads: u64,
}

impl Process {
    /// Whether it runs the program `name`.
    pub fn runs(&self, name: &str) -> bool {
        self.command
            .first()
            .is_some_and(|program| Path::new(program).ends_with(name))
    }

    /// What it is to its run.
    pub fn role(&self) -> Role {
        let asked_to = |what: &str| self.command.get(1).is_some_and(|argument| argument == what);
        if self.runs("skein-learner") {
            Role::Learner
        } else if self.runs("skein-actor") {
            Role::Actor
        } else if self.runs("skein") && asked_to("run") {
            Role::Supervisor
        } else if self.runs("skein") && asked_to("attach") {
            Role::Crew
        } else {
            Role::Other
        }
    }

    /// The actor's number, of an actor.
    pub fn actor(&self) -> Option<u32> {
        let flag = self
            .command
            .iter()
            .position(|argument| argument == "--id")?;
        self.command.get(flag + 1)?.parse().ok()
    }

    /// Sends `signal`, unless it has ended meanwhile.
    pub fn signal(&self, signal: Signal) {
        if self.is_alive() {
            // It may end between the two lines; its number is not given to another that soon.
            let _ = kill_process(self.pid, signal);
        }
    }

    /// Its number.
    pub fn pid(&self) -> u32 {
        self.pid.as_raw_nonzero().get().cast_unsigned()
    }

    /// Whether it has not ended. A process that waits to be reaped has.
    pub fn is_alive(&self) -> bool {
        self.stat().is_some_and(|stat| stat.state != 'Z')
    }

    /// Whether it is stopped by a signal.
    pub fn is_frozen(&self) -> bool {
        self.stat().is_some_and(|stat| stat.state == 'T')
    }

    /// The process that it is a child of now, unless it has ended.
    pub fn parent(&self) -> Option<u32> {
        Some(self.stat()?.parent)
    }

    fn stat(&self) -> Option<Stat> {
        stat(&proc_folder(self.pid)).filter(|stat| stat.started_ticks == self.started_ticks)
    }

    /// What it holds of the machine.
    ///
    /// # Errors
    /// When it has ended, or belongs to another user.
    pub fn usage(&self) -> io::Result<Usage> {
        let folder = proc_folder(self.pid);
        let status = fs::read_to_string(folder.join("status"))?;
        let figure = |key: &str| {
            status
                .lines()
                .find_map(|line| {
                    line.strip_prefix(key)?
                        .split_whitespace()
                        .next()?
                        .parse::<u64>()
                        .ok()
                })
                .ok_or_else(|| {
                    io::Error::new(
                        io::ErrorKind::InvalidData,
                        format!("no {key} in {}", folder.display()),
                    )
                })
        };
        Ok(Usage {
            resident_bytes: figure("VmRSS:")? * 1024,
            most_resident_bytes: figure("VmHWM:")? * 1024,
            anonymous_bytes: figure("RssAnon:")? * 1024,
            descriptors: fs::read_dir(folder.join("fd"))?.count() as u64,
            threads: figure("Threads:")?,
        })
    }
}

fn proc_folder(pid: Pid) -> PathBuf {
    PathBuf::from(format!("/proc/{}", pid.as_raw_nonzero()))
}

/// What the kernel tells of a process in one line.
struct Stat {
    state: char,
    parent: u32,
    started_ticks: u64,
}

/// Of the process that `folder` in /proc is about; `None` when there is none.
fn stat(folder: &Path) -> Option<Stat> {
    let stat = fs::read_to_string(folder.join("stat")).ok()?;
    // The program's name, in brackets, may hold anything, brackets and blanks included. Field 3,
    // the state, follows: proc_pid_stat(5).
    let fields: Vec<_> = stat[stat.rfind(')')? + 1..].split_whitespace().collect();
    let field = |number: usize| fields.get(number - 3);
    Some(Stat {
        state: field(3)?.chars().next()?,
        parent: field(4)?.parse().ok()?,
        started_ticks: field(22)?.parse().ok()?,
    })
}

/// The living processes that were given the run's directory as an argument: all of its own are. In
/// the order in which they were started.
pub fn processes_of(run: &RunDirectory) -> Vec<Process> {
    let directory = run.root().to_string_lossy();
    let process = |entry: fs::DirEntry| {
        let pid = Pid::from_raw(entry.file_name().to_str()?.parse().ok()?)?;
        // A process that has just ended cannot be read, one that waits to be reaped reads as empty.
        let command = fs::read(entry.path().join("cmdline")).ok()?;
        let command: Vec<_> = command
            .strip_suffix(&[0])?
            .split(|&byte| byte == 0)
            .map(|argument| String::from_utf8_lossy(argument).into_owned())
            .collect();
        let started_ticks = stat(&entry.path())?.started_ticks;
        command
            .iter()
            .any(|argument| *argument == directory)
            .then_some(Process {
                pid,
                command,
                started_ticks,
            })
    };
    let mut found: Vec<_> = fs::read_dir("/proc")
        .into_iter()
        .flatten()
        .filter_map(|entry| process(entry.ok()?))
        .collect();
    found.sort_by_key(|process| (process.started_ticks, process.pid.as_raw_nonzero()));
    found
}

#[cfg(test)]
mod tests {
    use std::process::{Child, Command};
    use std::thread::sleep;
    use std::time::{Duration, Instant};

    use super::*;

    /// A process that was given the directory `run`, and is ended with the test.
    struct Sleeper(Child);

    impl Sleeper {
        fn given(run: &str) -> Self {
            Self(
                Command::new("sh")
                    .args(["-c", "read line", run])
                    .stdin(std::process::Stdio::piped())
                    .spawn()
                    .unwrap(),
            )
        }
    }

    impl Drop for Sleeper {
        fn drop(&mut self) {
            let _ = self.0.kill();
            let _ = self.0.wait();
        }
    }

    fn until(mut condition: impl FnMut() -> bool) {
        let end = Instant::now() + Duration::from_secs(10);
        while !condition() {
            assert!(Instant::now() < end);
            sleep(Duration::from_millis(5));
        }
    }

    #[test]
    fn a_process_is_found_frozen_woken_and_gone() {
        let run = RunDirectory::new("/no-run-has-this-name/found");
        let mut sleeper = Sleeper::given("/no-run-has-this-name/found");
        // Between fork and exec it still has the arguments of this process.
        until(|| !processes_of(&run).is_empty());
        let found = processes_of(&run);
        assert_eq!(found.len(), 1);
        let process = &found[0];
        assert!(process.runs("sh") && process.role() == Role::Other && process.is_alive());
        assert_eq!(process.parent(), Some(std::process::id()));
        // Just after exec it has hardly a page yet.
        until(|| {
            let usage = process.usage().unwrap();
            usage.threads == 1
                && usage.descriptors >= 3
                && usage.resident_bytes > usage.anonymous_bytes
        });
        process.signal(Signal::STOP);
        until(|| process.is_frozen());
        process.signal(Signal::CONT);
        until(|| !process.is_frozen());
        process.signal(Signal::KILL);
        // Not reaped yet, and dead all the same.
        until(|| !process.is_alive());
        assert_eq!(processes_of(&run), []);
        sleeper.0.wait().unwrap();
    }

    #[test]
    fn the_processes_of_another_run_are_not_found() {
        let _sleeper = Sleeper::given("/no-run-has-this-name/here");
        assert_eq!(
            processes_of(&RunDirectory::new("/no-run-has-this-name/there")),
            []
        );
    }
}
