//! Fault points: places in the code at which a process can be made to die, to test that a death
//! changes no result.
//!
//! A point is armed from outside, while the run is in progress. The environment variable [`FAULTS`]
//! names a directory; a process that reaches a point whose file exists there removes the file and
//! kills itself with SIGKILL. So an armed point kills exactly one process, and its successor
//! passes. Without the variable, a point costs one comparison.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use rustix::process::{Signal, getpid, kill_process};

/// Environment variable that names the directory of armed points.
pub const FAULTS: &str = "SKEIN_FAULTS";

macro_rules! points {
    ($($(#[$doc:meta])* $point:ident => $name:literal),* $(,)?) => {
        /// A place in the code at which a process may die.
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        pub enum FaultPoint { $($(#[$doc])* $point),* }

        impl FaultPoint {
            /// All points.
            pub const ALL: &[Self] = &[$(Self::$point),*];

            /// Name of the file that arms the point.
            pub const fn name(self) -> &'static str {
                match self { $(Self::$point => $name),* }
            }
        }
    };
}

points! {
    /// An actor has joined and has not yet reported it.
    ActorJoined => "actor.joined",
    /// An actor has rendered a record and not yet sent it.
    ActorBeforeSend => "actor.before-send",
    /// An actor has sent the third record of an episode.
    ActorMidEpisode => "actor.mid-episode",
    /// An actor has sent the last record of an episode and not yet woken the learner.
    ActorAfterLastRecord => "actor.after-last-record",
    /// The learner has opened its services; no actor could join yet.
    LearnerStarted => "learner.started",
    /// The learner's receiving thread has committed an episode that the training thread has not
    /// seen.
    LearnerEpisodeCommitted => "learner.episode-committed",
    /// All episodes of an epoch are committed; no update has begun.
    LearnerEpochCollected => "learner.epoch-collected",
    /// An update of an epoch is done.
    LearnerMidUpdates => "learner.mid-updates",
    /// All updates of an epoch are done; nothing is published.
    LearnerUpdated => "learner.updated",
    /// A snapshot lies in shared memory and is not sent yet.
    LearnerPublishing => "learner.publishing",
    /// A snapshot is sent.
    LearnerPublished => "learner.published",
    /// The confirmation episodes of a candidate are flown and not yet judged.
    LearnerCandidateFlown => "learner.candidate-flown",
    /// A new best snapshot is on disk; no checkpoint refers to it.
    LearnerBestSaved => "learner.best-saved",
    /// A checkpoint's directory exists and is empty.
    CheckpointCreated => "checkpoint.created",
    /// A checkpoint's tensors are written.
    CheckpointTensors => "checkpoint.tensors",
    /// A checkpoint's replay buffer is written.
    CheckpointReplay => "checkpoint.replay",
    /// A checkpoint's counters are written.
    CheckpointProgress => "checkpoint.progress",
    /// A checkpoint's manifest is written; nothing is synced to disk yet.
    CheckpointManifest => "checkpoint.manifest",
    /// A checkpoint is on disk under its temporary name.
    CheckpointSynced => "checkpoint.synced",
    /// A checkpoint has its final name; superseded ones still exist.
    CheckpointRenamed => "checkpoint.renamed",
    /// A superseded checkpoint has been renamed; its files still exist.
    CheckpointRetired => "checkpoint.retired",
    /// The final evaluation is flown and not yet written.
    LearnerEvaluated => "learner.evaluated",
    /// Everything is written but the summary.
    LearnerBeforeSummary => "learner.before-summary",
}

/// Kills this process if `point` is armed.
pub fn die_if_armed(point: FaultPoint) {
    static DIRECTORY: OnceLock<Option<PathBuf>> = OnceLock::new();
    let directory = DIRECTORY.get_or_init(|| std::env::var_os(FAULTS).map(PathBuf::from));
    if let Some(directory) = directory
        && disarm(directory, point)
    {
        // A process may always kill itself, so there is no error to handle.
        let _ = kill_process(getpid(), Signal::KILL);
    }
}

/// Removes the armed point from `directory`; returns `true` if it existed. Of several processes
/// that reach it at once, one succeeds.
fn disarm(directory: &Path, point: FaultPoint) -> bool {
    fs::remove_file(directory.join(point.name())).is_ok()
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::*;

    #[test]
    fn an_armed_point_fires_once_and_no_other_does() {
        let directory = tempfile::tempdir().unwrap();
        fs::write(directory.path().join("actor.mid-episode"), "").unwrap();
        assert!(!disarm(directory.path(), FaultPoint::LearnerUpdated));
        assert!(disarm(directory.path(), FaultPoint::ActorMidEpisode));
        assert!(!disarm(directory.path(), FaultPoint::ActorMidEpisode));
    }

    #[test]
    fn no_two_points_share_a_name() {
        let names: HashSet<_> = FaultPoint::ALL.iter().map(|point| point.name()).collect();
        assert_eq!(names.len(), FaultPoint::ALL.len());
    }
}
