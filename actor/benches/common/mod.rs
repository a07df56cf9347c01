//! Shared parts of the actor benchmarks: a run of the default configuration whose learner is the
//! benchmark itself.

use std::path::Path;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use skein_protocol::config::{Config, Observation};
use skein_protocol::ids::{Attempt, EpisodeId, PolicyVersion, RunId};
use skein_protocol::snapshot::{Snapshot, SnapshotLayout};
use skein_protocol::ticket::{CourseChoice, Exploration, Ticket};
use skein_run::{LearnerLock, RunDirectory, RunIdentity};
use skein_transport::LearnerPorts;

/// Observation of `one-course.toml`.
pub(crate) const OBSERVATION: Observation = Observation::LatentVelocity;

/// Run whose only learner is this process.
pub(crate) struct Learner {
    pub(crate) identity: RunIdentity,
    pub(crate) config: Config,
    pub(crate) ports: LearnerPorts,
    _lock: LearnerLock,
    #[allow(dead_code, reason = "only the benchmark that starts a process uses it")]
    pub(crate) directory: tempfile::TempDir,
}

impl Learner {
    pub(crate) fn open() -> Self {
        let directory = tempfile::tempdir().expect("a temporary directory can be created");
        let run = RunDirectory::new(directory.path());
        let mut config = Config::default();
        config.learning.observation = OBSERVATION;
        let courses = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/courses");
        config.courses.training = courses.join("training.toml");
        config.courses.evaluation = vec![courses.join("training.toml")];
        run.create(&config).expect("the directory is new");
        let (identity, config) = run.open().expect("the run was just created");
        let lock = LearnerLock::take(&run, &identity).expect("no other process uses the run");
        let ports = LearnerPorts::open(&identity, lock.incarnation(), &config)
            .expect("services can be created");
        Self {
            identity,
            config,
            ports,
            _lock: lock,
            directory,
        }
    }

    /// Returns a snapshot with parameters uniform in about PyTorch's default range, so that all
    /// layers compute with numbers of ordinary size.
    pub(crate) fn snapshot(&self) -> Snapshot {
        let layout = SnapshotLayout::of(&self.config);
        let mut rng = Pcg64Mcg::seed_from_u64(1);
        let mut values = vec![0.0; layout.values()];
        for tensor in layout.tensors() {
            let bound = (tensor.shape[0] as f32 / tensor.range.len() as f32)
                .sqrt()
                .min(0.5);
            values[tensor.range.clone()].fill_with(|| rng.random_range(-bound..bound));
        }
        Snapshot {
            version: PolicyVersion(0),
            values,
        }
    }
}

/// Returns a ticket of a training episode with that snapshot.
pub(crate) fn ticket(run: RunId, episode: u64, level: u8) -> Ticket {
    Ticket {
        run,
        episode: EpisodeId(episode),
        attempt: Attempt(0),
        policy_version: PolicyVersion(0),
        course: CourseChoice::Training,
        start_level: level,
        exploration: Exploration::Sample,
        seed: episode,
        teacher_share: None,
        segment: None,
    }
}
