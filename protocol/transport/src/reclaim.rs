//! Reclaims the resources of dead processes.
//!
//! iceoryx2 does this for nodes whose process has ended. But where a file is half created or half
//! removed, it stops: a port's slot, of which there are few, is lost, or files stay behind, for
//! each actor that is killed while it joins or leaves. So half-created files are removed before
//! iceoryx2 cleans up, and files that still name a dead process are removed afterwards.

use std::collections::BTreeSet;
use std::fs::{self, DirEntry};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use iceoryx2::node::{DeadNodeView, Node, NodeState, NodeView};
use iceoryx2::prelude::*;
use iceoryx2_bb_posix::unique_system_id::UniqueSystemId;

use super::{Ipc, ServiceError, failed};
use skein_run::{LearnerIncarnation, RunIdentity};

/// Longest time from the first file of a process's node to the lock that shows it is alive. A
/// process that was stopped in between finds its files gone, fails to join, and tries again.
const MAX_JOIN_TIME: Duration = Duration::from_secs(10);

/// Reclaims the resources of dead processes in the transport of an incarnation.
#[derive(Debug)]
pub(super) struct Reclaimer {
    identity: RunIdentity,
    incarnation: LearnerIncarnation,
}

impl Reclaimer {
    pub(super) fn new(identity: &RunIdentity, incarnation: LearnerIncarnation) -> Self {
        Self {
            identity: identity.clone(),
            incarnation,
        }
    }

    /// Reclaims the resources of dead nodes beside `node`. What fails now is tried again at the
    /// next call.
    ///
    /// # Errors
    /// [`ServiceError`] if the nodes cannot be listed.
    pub(super) fn reclaim(&self, node: &Node<Ipc>) -> Result<(), ServiceError> {
        let mut living = BTreeSet::from([process_of(node.id().value())]);
        Node::<Ipc>::list(node.config(), |state| {
            if let NodeState::Dead(dead) = state {
                self.reclaim_node(dead);
            } else {
                living.insert(process_of(state.node_id().value()));
            }
            CallbackProgression::Continue
        })
        .map_err(failed("all", "listing the nodes"))?;
        for path in self.files().into_iter().chain(self.shared_memory()) {
            if processes_in(&path).any(|process| !living.contains(&process)) && is_old(&path) {
                remove(&path);
            }
        }
        Ok(())
    }

    fn reclaim_node(&self, dead: DeadNodeView<Ipc>) {
        let process = process_of(dead.id().value());
        // Nothing depends on half-created files: a tag is finished before its service or port is
        // registered, a segment before anybody maps it.
        let tags = entries(self.nodes().join(dead.id().value().to_string()));
        let half_made_tags = tags.filter(|tag| mode(tag) & 0o200 != 0);
        let segments = self
            .shared_memory()
            .filter(|path| processes_in(path).any(|of| of == process));
        let half_made_segments = segments.filter(|segment| mode(segment) & 0o400 == 0);
        half_made_tags
            .chain(half_made_segments)
            .for_each(|path| remove(&path));
        let _ = dead.try_remove_stale_resources();
    }

    fn nodes(&self) -> PathBuf {
        self.identity
            .incarnation_folder(self.incarnation)
            .join("nodes")
    }

    /// Returns listeners' sockets, nodes' locks, and nodes' folders.
    fn files(&self) -> Vec<PathBuf> {
        let sockets = entries(self.identity.incarnation_folder(self.incarnation));
        sockets.chain(entries(self.nodes())).collect()
    }

    fn shared_memory(&self) -> impl Iterator<Item = PathBuf> {
        self.identity.shared_memory(self.incarnation)
    }
}

/// Returns the process that made `id`, of a node or a port.
fn process_of(id: u128) -> u32 {
    UniqueSystemId::from(id).pid().value().cast_unsigned()
}

/// Returns the processes that made the nodes and ports in the name of `path`: two for a connection,
/// none for a shared file.
fn processes_in(path: &Path) -> impl Iterator<Item = u32> {
    /// Length of ids. Other numbers in names, such as the incarnation and hexadecimal digests, are
    /// shorter or not decimal.
    const DIGITS: std::ops::RangeInclusive<usize> = 20..=39;
    let name = path
        .file_name()
        .and_then(std::ffi::OsStr::to_str)
        .unwrap_or_default();
    let ids = name
        .split(['_', '.'])
        .filter(|word| DIGITS.contains(&word.len()));
    ids.filter_map(|word| word.parse().ok()).map(process_of)
}

fn mode(path: &PathBuf) -> u32 {
    // A missing file counts as complete.
    fs::symlink_metadata(path).map_or(0o600, |about| about.mode())
}

fn is_old(path: &Path) -> bool {
    let changed = fs::symlink_metadata(path).and_then(|about| about.modified());
    // After the clock was set back, the file counts as new for that much longer.
    changed.is_ok_and(|at| at.elapsed().is_ok_and(|age| age > MAX_JOIN_TIME))
}

fn remove(path: &Path) {
    let _ = match path.is_dir() {
        true => fs::remove_dir_all(path),
        false => fs::remove_file(path),
    };
}

/// Returns the entries of `folder`; none if it does not exist.
fn entries(folder: PathBuf) -> impl Iterator<Item = PathBuf> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    entries.map(|entry: DirEntry| entry.path())
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;
    use std::process::Command;

    use super::super::LearnerPorts;
    use super::super::node;
    use super::super::tests::Run;
    use super::*;

    fn age(path: &Path) {
        let touched = Command::new("touch")
            .args(["-h", "-d", "1 minute ago"])
            .arg(path)
            .status();
        assert!(touched.unwrap().success());
    }

    #[test]
    fn old_files_of_dead_processes_are_removed_and_nothing_else_is() {
        let run = Run::with(|_| {});
        let learner =
            LearnerPorts::open(&run.identity, run.lock.incarnation(), &run.config).unwrap();
        let _living = node(&run.identity, run.lock.incarnation(), "living").unwrap();
        learner.maintain().unwrap();
        let incarnation = run.identity.incarnation_folder(run.lock.incarnation());
        let prefix = run.identity.incarnation_prefix(run.lock.incarnation());
        let listed = || -> BTreeSet<PathBuf> {
            let files = entries(incarnation.clone()).chain(entries(incarnation.join("nodes")));
            files
                .chain(run.identity.shared_memory(run.lock.incarnation()))
                .collect()
        };
        let before = listed();
        before.iter().for_each(|path| age(path));

        // The id of a process that has ended, within the id of a node or port as iceoryx2 builds
        // it.
        let mut gone = Command::new("true").spawn().unwrap();
        gone.wait().unwrap();
        let made_by = |process: u32| (7_u128 << 96) | (u128::from(process) << 64) | 1;
        let (id, living) = (made_by(gone.id()), made_by(std::process::id()));
        assert_eq!(process_of(id), gone.id());
        let left = [
            incarnation.join("nodes").join(id.to_string()),
            incarnation
                .join("nodes")
                .join(format!("{prefix}{id}.node_monitor_context")),
            incarnation.join(format!("{prefix}{id}.event")),
            format!("/dev/shm/{prefix}{}_{id}.data", "a".repeat(40)).into(),
            format!(
                "/dev/shm/{prefix}{}_{living}_{id}.connection",
                "a".repeat(40)
            )
            .into(),
        ];
        fs::create_dir(&left[0]).unwrap();
        fs::write(left[0].join(format!("{prefix}node.details")), "").unwrap();
        for path in &left[1..] {
            fs::write(path, "").unwrap();
            fs::set_permissions(path, fs::Permissions::from_mode(0o200)).unwrap();
        }
        let with_left = listed();
        assert_eq!(with_left.len(), before.len() + left.len());
        learner.maintain().unwrap();
        assert_eq!(listed(), with_left, "their process may still be joining");
        left.iter().for_each(|path| age(path));
        learner.maintain().unwrap();
        assert_eq!(listed(), before);
    }
}
