//! Memory that runs out during a run.
//!
//! A process that touches a page of shared memory for which no memory is left dies of SIGBUS. When
//! a control group or the machine runs out of memory, the kernel kills a process with SIGKILL. Only
//! the kernel's counter of such kills distinguishes this from a user's kill.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use rustix::process::Signal;
use skein_prepare::room::free_shared_memory;

use super::process::Exit;

/// Shared memory with less free space than this, in bytes, counts as full.
const FULL: u64 = 8 << 20;
/// Mount point of the control groups.
const CONTROL_GROUPS: &str = "/sys/fs/cgroup";
/// A limit from this number of bytes on is no limit: version 1 writes a huge number for none.
const NO_LIMIT: u64 = 1 << 60;

/// Lack of memory that ended a process.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum MemoryShortage {
    /// Shared memory was full. Other processes fill and empty it: a later start may find room.
    Shared(String),
    /// The kernel killed the process because memory ran out. A later incarnation needs as much.
    Own(String),
}

impl MemoryShortage {
    /// Returns the explanation, to be appended to a sentence.
    pub(super) fn text(&self) -> &str {
        match self {
            Self::Shared(text) | Self::Own(text) => text,
        }
    }
}

/// Watches both kinds of memory for the processes of one supervisor.
#[derive(Debug, Clone)]
pub(super) struct MemoryWatch {
    /// Files with a counter `oom_kill`, the most specific first.
    counters: Vec<PathBuf>,
    /// Files with a limit in bytes.
    limits: Vec<PathBuf>,
    /// Kills that are accounted for: those before this run, then one for each that ended a process.
    explained: Arc<AtomicU64>,
}

impl MemoryWatch {
    /// Watches the memory of this process's control group, to which its children belong.
    pub(super) fn new() -> Self {
        let groups = fs::read_to_string("/proc/self/cgroup").unwrap_or_default();
        let (mut counters, limits) = files_of(Path::new(CONTROL_GROUPS), &groups);
        // Of the whole machine, where the group's counter cannot be read.
        counters.push(PathBuf::from("/proc/vmstat"));
        Self::on(counters, limits)
    }

    fn on(counters: Vec<PathBuf>, limits: Vec<PathBuf>) -> Self {
        let watch = Self {
            counters,
            limits,
            explained: Arc::default(),
        };
        watch.explained.store(watch.kills(), Ordering::Relaxed);
        watch
    }

    /// Returns the shortage that ended a process with `exit`; `None` for another reason.
    pub(super) fn shortage(&self, exit: &Exit) -> Option<MemoryShortage> {
        match *exit {
            Exit::Signal(signal) if signal == Signal::KILL.as_raw() => self.kill_by_kernel(),
            _ => shared_shortage(exit, free_shared_memory()),
        }
    }

    /// Explains a process killed by SIGKILL, if the kernel has killed one more than was explained.
    fn kill_by_kernel(&self) -> Option<MemoryShortage> {
        if self.kills() <= self.explained.load(Ordering::Relaxed) {
            return None;
        }
        self.explained.fetch_add(1, Ordering::Relaxed);
        let limit = self.limits.iter().filter_map(|file| number_in(file)).min();
        let whose = match limit.filter(|&limit| limit < NO_LIMIT) {
            Some(limit) => format!("the limit of its control group is {} MiB", limit >> 20),
            None => "by the kernel's count of such kills".to_owned(),
        };
        Some(MemoryShortage::Own(format!(
            ": out of memory ({whose}); raise the limit, start fewer actors with --actors, or in a \
             new run lower replay.capacity"
        )))
    }

    /// Number of processes that the kernel has killed for want of memory.
    fn kills(&self) -> u64 {
        let count = |file: &PathBuf| {
            let text = fs::read_to_string(file).ok()?;
            let lines = text.lines();
            lines
                .filter_map(|line| line.strip_prefix("oom_kill "))
                .next()?
                .trim()
                .parse()
                .ok()
        };
        self.counters.iter().find_map(count).unwrap_or(0)
    }
}

fn number_in(file: &Path) -> Option<u64> {
    fs::read_to_string(file).ok()?.trim().parse().ok()
}

/// Returns the files with the counters and the limits of the control groups listed in `groups`, a
/// process's file `cgroup`, below `mount`. Within a container, the group's path may be one of the
/// host; then the group is the mount itself.
fn files_of(mount: &Path, groups: &str) -> (Vec<PathBuf>, Vec<PathBuf>) {
    let (mut counters, mut limits) = (Vec::new(), Vec::new());
    for line in groups.lines() {
        let mut parts = line.splitn(3, ':');
        let (Some(_), Some(controllers), Some(path)) = (parts.next(), parts.next(), parts.next())
        else {
            continue;
        };
        let (folder, counter, limit) = match controllers {
            "" => (mount.to_owned(), "memory.events", "memory.max"),
            _ if controllers.split(',').any(|name| name == "memory") => (
                mount.join("memory"),
                "memory.oom_control",
                "memory.limit_in_bytes",
            ),
            _ => continue,
        };
        let own = folder.join(path.trim_start_matches('/'));
        // A group is limited by all groups above it too.
        for group in own
            .ancestors()
            .take_while(|group| group.starts_with(&folder))
        {
            counters.push(group.join(counter));
            limits.push(group.join(limit));
        }
    }
    (counters, limits)
}

/// Returns the shortage of a process that ended with `exit` because shared memory, with `free`
/// bytes left, is full.
fn shared_shortage(exit: &Exit, free: Option<u64>) -> Option<MemoryShortage> {
    let free = free.filter(|&free| free < FULL)?;
    (*exit == Exit::Signal(Signal::BUS.as_raw())).then(|| {
        MemoryShortage::Shared(format!(
            ": shared memory (/dev/shm) is full: {} MiB free",
            free >> 20
        ))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_bus_error_while_memory_is_full_counts_as_a_shortage() {
        let shortage = shared_shortage(&Exit::Signal(7), Some(FULL - 1)).unwrap();
        assert_eq!(
            shortage.text(),
            ": shared memory (/dev/shm) is full: 7 MiB free"
        );
        assert_eq!(shared_shortage(&Exit::Signal(7), Some(FULL)), None);
        assert_eq!(shared_shortage(&Exit::Signal(11), Some(0)), None);
        assert_eq!(shared_shortage(&Exit::Signal(7), None), None);
    }

    #[test]
    fn a_kill_counts_as_lack_of_memory_only_if_the_kernel_counted_it() {
        let folder = tempfile::tempdir().unwrap();
        let (events, limit) = (folder.path().join("events"), folder.path().join("max"));
        let count = |kills: u32| {
            fs::write(&events, format!("low 0\noom 9\noom_kill {kills}\n")).unwrap();
        };
        count(3);
        fs::write(&limit, "536870912\n").unwrap();
        let watch = MemoryWatch::on(
            vec![folder.path().join("absent"), events.clone()],
            vec![limit],
        );
        let killed = Exit::Signal(Signal::KILL.as_raw());
        assert_eq!(watch.shortage(&killed), None, "kills before the run");
        count(4);
        assert_eq!(watch.shortage(&Exit::Signal(Signal::TERM.as_raw())), None);
        // The crew and the learner share one count.
        let shortage = watch.clone().shortage(&killed).unwrap();
        assert!(matches!(shortage, MemoryShortage::Own(_)));
        assert!(shortage.text().contains("out of memory"), "{shortage:?}");
        assert!(shortage.text().contains("512 MiB"), "{shortage:?}");
        assert_eq!(
            watch.shortage(&killed),
            None,
            "each kill explains one death"
        );
    }

    #[test]
    fn control_groups_of_both_versions_are_found() {
        let mount = Path::new("/m");
        let paths = |groups: &str| files_of(mount, groups);
        let (counters, limits) = paths("0::/user/run\n");
        assert_eq!(
            counters,
            [
                "/m/user/run/memory.events",
                "/m/user/memory.events",
                "/m/memory.events"
            ]
            .map(PathBuf::from)
        );
        assert_eq!(limits[0], Path::new("/m/user/run/memory.max"));
        let (counters, _) = paths("5:cpu,memory:/job\n4:cpuset:/other\nnonsense\n");
        assert_eq!(
            counters,
            [
                "/m/memory/job/memory.oom_control",
                "/m/memory/memory.oom_control"
            ]
            .map(PathBuf::from)
        );
    }
}
