//! What a run's processes may leave behind on the machine: other processes, shared memory, the transport's folder.

use std::fs;
use std::path::Path;

use rustix::process::{Pid, Signal, kill_process};
use skein_protocol::run::RunDirectory;

/// A living process.
#[derive(Debug, Clone)]
pub struct Process {
    /// Its number.
    pub pid: Pid,
    /// Program and arguments.
    pub command: Vec<String>,
}

impl Process {
    /// Whether it runs the program `name`.
    pub fn runs(&self, name: &str) -> bool {
        self.command
            .first()
            .is_some_and(|program| Path::new(program).ends_with(name))
    }

    /// Sends `signal`, unless it has ended meanwhile.
    pub fn signal(&self, signal: Signal) {
        let _ = kill_process(self.pid, signal);
    }
}

/// The processes that were given the run's directory as an argument: all of its own are.
pub fn processes_of(run: &RunDirectory) -> Vec<Process> {
    let directory = run.root().to_str().unwrap();
    let process = |entry: fs::DirEntry| {
        let pid = Pid::from_raw(entry.file_name().to_str()?.parse().ok()?)?;
        // A process that has just ended cannot be read, one that waits to be reaped reads as empty.
        let command = fs::read(entry.path().join("cmdline")).ok()?;
        let command: Vec<_> = command
            .split(|&byte| byte == 0)
            .map(|argument| String::from_utf8_lossy(argument).into_owned())
            .collect();
        command
            .iter()
            .any(|argument| argument == directory)
            .then_some(Process { pid, command })
    };
    fs::read_dir("/proc")
        .unwrap()
        .filter_map(|entry| process(entry.ok()?))
        .collect()
}

/// Everything that is there and should not be once the run is over.
pub fn leftovers(run: &RunDirectory) -> Vec<String> {
    let mut found: Vec<_> = processes_of(run)
        .iter()
        .map(|process| format!("process {:?}", process.command))
        .collect();
    // Without an identity, nothing was started that could have left anything else.
    if let Ok((identity, _)) = run.open() {
        let prefix = identity.shared_memory_prefix();
        let shared = fs::read_dir("/dev/shm").unwrap().filter_map(|entry| {
            let name = entry.ok()?.file_name().to_str()?.to_owned();
            name.starts_with(&prefix).then(|| format!("/dev/shm/{name}"))
        });
        found.extend(shared);
        if identity.transport_folder().exists() {
            found.push(identity.transport_folder().display().to_string());
        }
    }
    found
}
