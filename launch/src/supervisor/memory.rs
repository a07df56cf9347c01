//! Memory that runs out during a run.
//!
//! A process that touches a page of shared memory for which no memory is left dies of SIGBUS. When
//! a control group or the machine runs out of memory, the kernel kills a process with SIGKILL. Only
//! the kernel's counter of such kills distinguishes this from a user's kill. A process that is
//! refused memory says so by its exit status. Under a limit of the shell (`ulimit -v`), libraries
//! that are refused memory may fail in any other way.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use rustix::process::Signal;
use skein_prepare::room::free_shared_memory;
use skein_run::allocation::{MemoryLimit, memory_limit};
use skein_run::control_groups::{MemoryGroup, counter_in, memory_groups};

use super::process::Exit;

/// Shared memory with less free space than this, in bytes, counts as full.
const FULL: u64 = 8 << 20;

/// Lack of memory that ended a process.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum MemoryShortage {
    /// Shared memory was full. Other processes fill and empty it: a later start may find room.
    Shared(String),
    /// The process was killed or ended because memory ran out. A later incarnation needs as much.
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
    /// Control groups of the processes.
    groups: Vec<MemoryGroup>,
    /// Kills that are accounted for: those before this run, then one for each that ended a process.
    explained: Arc<AtomicU64>,
}

impl MemoryWatch {
    /// Watches the memory of this process's control group, to which its children belong.
    pub(super) fn new() -> Self {
        let groups = memory_groups();
        let mut counters: Vec<_> = groups.iter().map(|group| group.kills.clone()).collect();
        // Of the whole machine, where the group's counter cannot be read.
        counters.push(PathBuf::from("/proc/vmstat"));
        Self::on(counters, groups)
    }

    pub(super) fn on(counters: Vec<PathBuf>, groups: Vec<MemoryGroup>) -> Self {
        let watch = Self {
            counters,
            groups,
            explained: Arc::default(),
        };
        watch.explained.store(watch.kills(), Ordering::Relaxed);
        watch
    }

    /// Returns the shortage that ended a process with `exit`; `None` for another reason.
    pub(super) fn shortage(&self, exit: &Exit) -> Option<MemoryShortage> {
        match *exit {
            Exit::Signal(signal) if signal == Signal::KILL.as_raw() => self.kill_by_kernel(),
            _ => shared_shortage(exit, free_shared_memory())
                .or_else(|| refusal(exit, memory_limit())),
        }
    }

    /// Explains a process killed by SIGKILL, if the kernel has killed one more than was explained.
    fn kill_by_kernel(&self) -> Option<MemoryShortage> {
        if self.kills() <= self.explained.load(Ordering::Relaxed) {
            return None;
        }
        self.explained.fetch_add(1, Ordering::Relaxed);
        let limit = self.groups.iter().filter_map(MemoryGroup::limit).min();
        let whose = match limit {
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
        let count = |file: &PathBuf| counter_in(file, "oom_kill");
        self.counters.iter().find_map(count).unwrap_or(0)
    }
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

/// Returns the shortage of a process that ended with `exit` because it was refused memory, or may
/// have failed for that reason where each process is limited to `limit` bytes.
fn refusal(exit: &Exit, limit: Option<u64>) -> Option<MemoryShortage> {
    let text = match limit.map(MemoryLimit) {
        Some(limit) if exit.ran_out_of_memory() => format!(": {limit}"),
        Some(limit) if exit.may_recover() && !exit.was_killed() => {
            format!(", perhaps for want of memory: {limit}")
        }
        None if exit.ran_out_of_memory() => ": end other programs, start fewer actors with \
            --actors, or in a new run lower replay.capacity"
            .to_owned(),
        _ => return None,
    };
    Some(MemoryShortage::Own(text))
}

#[cfg(test)]
mod tests {
    use std::fs;

    use skein_run::control_groups::groups_below;

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
    fn a_refusal_names_the_shells_limit_and_its_remedy() {
        let text = |exit: &Exit, limit| {
            let shortage = refusal(exit, limit)?;
            assert!(matches!(shortage, MemoryShortage::Own(_)));
            Some(format!("{exit}{}", shortage.text()))
        };
        let (refused, panicked) = (Exit::Status(5), Exit::Status(101));
        let limit = Some(488 << 20);
        for (exit, limit, parts) in [
            (&refused, limit, ["out of memory: ", "488 MiB", "ulimit -v"]),
            (
                &refused,
                None,
                ["out of memory: ", "--actors", "replay.capacity"],
            ),
            (&panicked, limit, ["perhaps", "488 MiB", "ulimit -v"]),
            (&Exit::Signal(6), limit, ["perhaps", "488 MiB", "ulimit -v"]),
        ] {
            let text = text(exit, limit).unwrap();
            for part in parts {
                assert!(text.contains(part), "`{part}` is missing in {text}");
            }
        }
        assert_eq!(text(&panicked, None), None);
        // What a user or the program itself did has another reason.
        for exit in [Exit::Signal(15), Exit::Status(1), Exit::Status(3)] {
            assert_eq!(text(&exit, limit), None);
        }
        assert!(refused.may_recover(), "it is started again, with pauses");
    }

    #[test]
    fn a_kill_counts_as_lack_of_memory_only_if_the_kernel_counted_it() {
        let folder = tempfile::tempdir().unwrap();
        let groups = groups_below(folder.path(), "0::/\n");
        let events = groups[0].kills.clone();
        let count = |kills: u32| {
            fs::write(&events, format!("low 0\noom 9\noom_kill {kills}\n")).unwrap();
        };
        count(3);
        fs::write(folder.path().join("memory.max"), "536870912\n").unwrap();
        let absent = folder.path().join("absent");
        let watch = MemoryWatch::on(vec![absent, events.clone()], groups);
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
}
