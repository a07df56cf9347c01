//! Memory limits of this process's control groups, of both versions.

use std::fs;
use std::path::{Path, PathBuf};

/// Mount point of the control groups.
const MOUNT: &str = "/sys/fs/cgroup";
/// A limit from this number of bytes on is no limit: version 1 writes a huge number for none.
const NO_LIMIT: u64 = 1 << 60;

/// A control group that limits the memory of this process. Its files may be missing.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MemoryGroup {
    limit: PathBuf,
    used: PathBuf,
    statistics: PathBuf,
    /// Name of the line in `statistics` with the bytes that the kernel can take back at once.
    reclaimable: &'static str,
    /// File with the line `oom_kill`: how many processes were killed for want of memory.
    pub kills: PathBuf,
}

/// Returns the control groups that limit this process's memory, its own first.
pub fn memory_groups() -> Vec<MemoryGroup> {
    let groups = fs::read_to_string("/proc/self/cgroup").unwrap_or_default();
    groups_below(Path::new(MOUNT), &groups)
}

impl MemoryGroup {
    fn of(folder: &Path, version: Version) -> Self {
        let [limit, used, kills, reclaimable] = match version {
            Version::One => [
                "memory.limit_in_bytes",
                "memory.usage_in_bytes",
                "memory.oom_control",
                "total_inactive_file",
            ],
            Version::Two => [
                "memory.max",
                "memory.current",
                "memory.events",
                "inactive_file",
            ],
        };
        Self {
            limit: folder.join(limit),
            used: folder.join(used),
            statistics: folder.join("memory.stat"),
            reclaimable,
            kills: folder.join(kills),
        }
    }

    /// Returns the group's limit in bytes; `None` if it has none.
    pub fn limit(&self) -> Option<u64> {
        number_in(&self.limit).filter(|&limit| limit < NO_LIMIT)
    }

    /// Returns the bytes that the group may still take, cached files that nothing uses included;
    /// `None` if it has no limit.
    pub fn free(&self) -> Option<u64> {
        let used = number_in(&self.used).unwrap_or(0);
        let reclaimable = counter_in(&self.statistics, self.reclaimable).unwrap_or(0);
        Some(
            self.limit()?
                .saturating_sub(used.saturating_sub(reclaimable)),
        )
    }
}

#[derive(Clone, Copy)]
enum Version {
    One,
    Two,
}

/// Returns the number in the line `name` of a file with one counter a line.
pub fn counter_in(file: &Path, name: &str) -> Option<u64> {
    let text = fs::read_to_string(file).ok()?;
    text.lines()
        .find_map(|line| line.strip_prefix(name)?.strip_prefix(' '))?
        .trim()
        .parse()
        .ok()
}

fn number_in(file: &Path) -> Option<u64> {
    fs::read_to_string(file).ok()?.trim().parse().ok()
}

/// Returns the control groups listed in `groups`, a process's file `cgroup`, below `mount`. Within
/// a container, the group's path may be one of the host; then the group is the mount itself.
pub fn groups_below(mount: &Path, groups: &str) -> Vec<MemoryGroup> {
    let mut found = Vec::new();
    for line in groups.lines() {
        let mut parts = line.splitn(3, ':');
        let (Some(_), Some(controllers), Some(path)) = (parts.next(), parts.next(), parts.next())
        else {
            continue;
        };
        let (folder, version) = match controllers {
            "" => (mount.to_owned(), Version::Two),
            _ if controllers.split(',').any(|name| name == "memory") => {
                (mount.join("memory"), Version::One)
            }
            _ => continue,
        };
        let own = folder.join(path.trim_start_matches('/'));
        // A group is limited by all groups above it too.
        found.extend(
            own.ancestors()
                .take_while(|group| group.starts_with(&folder))
                .map(|group| MemoryGroup::of(group, version)),
        );
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn control_groups_of_both_versions_are_found() {
        let files = |groups: &str| -> Vec<_> {
            let groups = groups_below(Path::new("/m"), groups).into_iter();
            groups.map(|group| (group.limit, group.kills)).collect()
        };
        let paths = |paths: [(&str, &str); 2]| {
            paths.map(|(limit, kills)| (PathBuf::from(limit), PathBuf::from(kills)))
        };
        assert_eq!(
            files("0::/run\n"),
            paths([
                ("/m/run/memory.max", "/m/run/memory.events"),
                ("/m/memory.max", "/m/memory.events"),
            ])
        );
        assert_eq!(
            files("5:cpu,memory:/job\n4:cpuset:/other\nnonsense\n"),
            paths([
                (
                    "/m/memory/job/memory.limit_in_bytes",
                    "/m/memory/job/memory.oom_control"
                ),
                (
                    "/m/memory/memory.limit_in_bytes",
                    "/m/memory/memory.oom_control"
                ),
            ])
        );
    }

    /// In version 1, the outer group is the tighter one. The inner group of version 2 has no limit.
    #[test]
    fn the_free_memory_of_every_group_is_read() {
        let mount = tempfile::tempdir().unwrap();
        let write = |folder: &str, files: &[(&str, &str)]| {
            let folder = mount.path().join(folder);
            fs::create_dir_all(&folder).unwrap();
            for (file, text) in files {
                fs::write(folder.join(file), text).unwrap();
            }
        };
        let free = |groups: &str| -> Vec<_> {
            let groups = groups_below(mount.path(), groups);
            groups.iter().map(MemoryGroup::free).collect()
        };
        write(
            "memory/job",
            &[
                ("memory.limit_in_bytes", "9223372036854771712\n"),
                ("memory.usage_in_bytes", "300\n"),
            ],
        );
        write(
            "memory",
            &[
                ("memory.limit_in_bytes", "1000\n"),
                ("memory.usage_in_bytes", "900\n"),
                ("memory.stat", "inactive_file 7\ntotal_inactive_file 50\n"),
            ],
        );
        assert_eq!(free("5:memory:/job\n"), [None, Some(150)]);
        write(
            "user",
            &[("memory.max", "2000\n"), ("memory.current", "1999\n")],
        );
        write("user/run", &[("memory.max", "max\n")]);
        assert_eq!(free("0::/user/run\n"), [None, Some(1), None]);
    }
}
