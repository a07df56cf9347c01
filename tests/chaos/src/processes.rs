//! Processes of a run, as listed by the kernel.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use rustix::process::{Pid, Signal, kill_process};
use skein_run::RunDirectory;

/// Process that was alive when it was found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ListedProcess {
    /// Process id.
    pub pid: Pid,
    /// Program and arguments.
    pub command: Vec<String>,
    /// Start time in clock ticks since boot. Distinguishes it from a later process with the same
    /// id.
    started_ticks: u64,
}

/// Role of a process in its run.
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
    /// Any other process that was given the directory.
    Other,
}

impl Role {
    /// Returns its name in reports.
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

/// Machine resources used by a process.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Usage {
    /// Resident memory, including shared memory.
    pub resident_bytes: u64,
    /// Peak of the resident memory.
    pub most_resident_bytes: u64,
    /// Resident memory that is neither file nor shared memory.
    pub anonymous_bytes: u64,
    /// Open file descriptors.
    pub descriptors: u64,
    /// Threads.
    pub threads: u64,
}

impl ListedProcess {
    /// Returns `true` if it runs the program `name`.
    pub fn runs(&self, name: &str) -> bool {
        self.command
            .first()
            .is_some_and(|program| Path::new(program).ends_with(name))
    }

    /// Returns its role in the run.
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

    /// Returns the actor's id, if it is an actor.
    pub fn actor(&self) -> Option<u32> {
        let flag = self
            .command
            .iter()
            .position(|argument| argument == "--id")?;
        self.command.get(flag + 1)?.parse().ok()
    }

    /// Sends `signal`, unless it has ended.
    pub fn signal(&self, signal: Signal) {
        if self.is_alive() {
            // It may end between the two lines; the kernel does not reuse its id that soon.
            let _ = kill_process(self.pid, signal);
        }
    }

    /// Returns its process id.
    pub fn pid(&self) -> u32 {
        self.pid.as_raw_nonzero().get().cast_unsigned()
    }

    /// Returns `true` while it runs. A zombie counts as ended.
    pub fn is_alive(&self) -> bool {
        self.stat().is_some_and(|stat| stat.state != 'Z')
    }

    /// Returns `true` if a signal has stopped it.
    pub fn is_frozen(&self) -> bool {
        self.stat().is_some_and(|stat| stat.state == 'T')
    }

    /// Returns the id of its current parent, unless it has ended.
    pub fn parent(&self) -> Option<u32> {
        Some(self.stat()?.parent)
    }

    fn stat(&self) -> Option<Stat> {
        stat(&proc_folder(self.pid)).filter(|stat| stat.started_ticks == self.started_ticks)
    }

    /// Returns the machine resources it uses.
    ///
    /// # Errors
    /// Returns an error if it has ended or belongs to another user.
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

/// Fields of `/proc/PID/stat`.
struct Stat {
    state: char,
    parent: u32,
    started_ticks: u64,
}

/// Returns the fields for the process of `folder` in /proc; `None` if it does not exist.
fn stat(folder: &Path) -> Option<Stat> {
    let stat = fs::read_to_string(folder.join("stat")).ok()?;
    // The program's name, in brackets, may contain anything, even brackets and blanks. Field 3,
    // the state, follows it: proc_pid_stat(5).
    let fields: Vec<_> = stat[stat.rfind(')')? + 1..].split_whitespace().collect();
    let field = |number: usize| fields.get(number - 3);
    Some(Stat {
        state: field(3)?.chars().next()?,
        parent: field(4)?.parse().ok()?,
        started_ticks: field(22)?.parse().ok()?,
    })
}

/// Returns the live processes that have the run's directory as an argument, which all processes of
/// a run have, in order of their start.
pub fn processes_of(run: &RunDirectory) -> Vec<ListedProcess> {
    let directory = run.root().to_string_lossy();
    let process = |entry: fs::DirEntry| {
        let pid = Pid::from_raw(entry.file_name().to_str()?.parse().ok()?)?;
        // A process that has just ended cannot be read; a zombie reads as empty.
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
            .then_some(ListedProcess {
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

    /// A process that has the argument `run` and ends with the test.
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
        // Between fork and exec it still has this test's arguments.
        until(|| !processes_of(&run).is_empty());
        let found = processes_of(&run);
        assert_eq!(found.len(), 1);
        let process = &found[0];
        assert!(process.runs("sh") && process.role() == Role::Other && process.is_alive());
        assert_eq!(process.parent(), Some(std::process::id()));
        // Just after exec it has hardly any pages.
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
        // A zombie, and dead all the same.
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
