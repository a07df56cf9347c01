//! Points at which a process can be made to die, to show that it does not matter.
//!
//! A point is armed from outside and while the run is under way: the environment variable
//! [`FAULTS`] names a directory, and whoever passes a point of which there is a file there removes
//! the file and kills itself with SIGKILL. So a point that was armed once kills once, whichever
//! process comes by, and the process that is started in its place gets past. Without the variable,
//! passing a point costs a comparison.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use rustix::process::{Signal, getpid, kill_process};

/// Environment variable that names the directory of armed points.
pub const FAULTS: &str = "SKEIN_FAULTS";

macro_rules! points {
    ($($(#[$doc:meta])* $point:ident => $name:literal),* $(,)?) => {
        /// A moment at which a process may die.
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        pub enum FaultPoint { $($(#[$doc])* $point),* }

        impl FaultPoint {
            /// All of them.
            pub const ALL: &[Self] = &[$(Self::$point),*];

            /// The name of the file that arms it.
            pub const fn name(self) -> &'static str {
                match self { $(Self::$point => $name),* }
            }
        }
    };
}

points! {
    /// An actor has joined and not yet said so.
    ActorJoined => "actor.joined",
    /// An actor has rendered a record and not yet sent it.
    ActorBeforeSend => "actor.before-send",
    /// An actor has sent the third record of an episode.
    ActorMidEpisode => "actor.mid-episode",
    /// An actor has sent the last record of an episode and not yet woken the learner.
    ActorAfterLastRecord => "actor.after-last-record",
    /// The learner has opened its services, and nobody could join yet.
    LearnerStarted => "learner.started",
    /// The learner's receiving thread has committed an episode that the training thread has not
    /// seen.
    LearnerEpisodeCommitted => "learner.episode-committed",
    /// All episodes of an epoch are there, none is learned from.
    LearnerEpochCollected => "learner.epoch-collected",
    /// An update of an epoch is done.
    LearnerMidUpdates => "learner.mid-updates",
    /// All updates of an epoch are done, nothing is published.
    LearnerUpdated => "learner.updated",
    /// A snapshot lies in shared memory and is not yet sent.
    LearnerPublishing => "learner.publishing",
    /// A snapshot is sent.
    LearnerPublished => "learner.published",
    /// A candidate for the best snapshot was evaluated and not yet judged.
    LearnerCandidateFlown => "learner.candidate-flown",
    /// A new best snapshot is on disk, and no checkpoint knows of it.
    LearnerBestSaved => "learner.best-saved",
    /// A checkpoint's directory is there, empty.
    CheckpointCreated => "checkpoint.created",
    /// A checkpoint's tensors are written.
    CheckpointTensors => "checkpoint.tensors",
    /// A checkpoint's replay buffer is written.
    CheckpointReplay => "checkpoint.replay",
    /// A checkpoint's counters are written.
    CheckpointProgress => "checkpoint.progress",
    /// A checkpoint's manifest is written, nothing is brought to disk yet.
    CheckpointManifest => "checkpoint.manifest",
    /// A checkpoint is on disk under the name it is written under.
    CheckpointSynced => "checkpoint.synced",
    /// A checkpoint is in its place, those that it makes superfluous are still there.
    CheckpointRenamed => "checkpoint.renamed",
    /// A superfluous checkpoint has lost its name and not yet its files.
    CheckpointRetired => "checkpoint.retired",
    /// The final evaluation is flown and not yet written.
    LearnerEvaluated => "learner.evaluated",
    /// Everything is written but the summary.
    LearnerBeforeSummary => "learner.before-summary",
}

/// Passes `point`: dies here if it is armed.
pub fn pass(point: FaultPoint) {
    static DIRECTORY: OnceLock<Option<PathBuf>> = OnceLock::new();
    let directory = DIRECTORY.get_or_init(|| std::env::var_os(FAULTS).map(PathBuf::from));
    if let Some(directory) = directory
        && disarm(directory, point)
    {
        // An error is for whoever may not kill itself, which cannot be; going on then is as good as
        // anything.
        let _ = kill_process(getpid(), Signal::KILL);
    }
}

/// Takes the armed point out of `directory`; whether it was there. Of several processes that come
/// by at a time, one gets it.
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
