//! Configurations of the runs that are stormed.

use std::path::Path;

use skein_learner::checkpoint::CheckpointStore;
use skein_protocol::config::{Config, ConfirmOn};
use skein_protocol::ids::RunId;

use crate::calm::Calm;
use crate::disk::VirtualDisk;

/// The run.
pub(crate) const RUN: RunId = RunId(7);
/// Folder of the run.
pub(crate) const FOLDER: &str = "run";
/// Folder of its checkpoints.
pub(crate) const CHECKPOINTS: &str = "run/checkpoints";
/// Its results: a row for each episode.
pub(crate) const RESULTS: &str = "run/episodes.csv";

/// Number of shapes.
pub(crate) const SHAPES: u64 = 32;

/// A configuration, with the calm run's results.
#[derive(Debug)]
pub(crate) struct Shape {
    pub(crate) config: Config,
    pub(crate) calm: Calm,
    pub(crate) disk: VirtualDisk,
    pub(crate) store: CheckpointStore<VirtualDisk>,
}

impl Shape {
    /// Shape of this number, below [`SHAPES`].
    pub(crate) fn new(number: u64) -> Self {
        let config = config(number);
        let disk = VirtualDisk::default();
        Self {
            calm: Calm::of(&config),
            store: CheckpointStore::on(disk.clone(), Path::new(CHECKPOINTS), &config),
            disk,
            config,
        }
    }
}

/// One shape of four flies in segments, two with policy lag 1.
fn config(number: u64) -> Config {
    let mut config = Config::default();
    config.run.seed = number;
    config.run.episodes = 4 + number % 7;
    config.learning.episodes_per_epoch = 1 + number % 3;
    config.learning.levels = 3;
    config.learning.episodes_per_level = 2;
    match number % 4 {
        0 => {
            config.learning.episodes_per_epoch = 1;
            config.learning.segment_steps = 1 + number % 8 / 4;
        }
        1 | 2 => config.learning.policy_lag = 1,
        _ => {}
    }
    config.courses.generated_share = 0.5;
    config.checkpoints.every_episodes = 1 + number % 3;
    config.checkpoints.keep = 1 + number as usize % 2;
    config.evaluation.confirm_episodes = 2;
    config.evaluation.confirm_on = match number % 2 {
        0 => ConfirmOn::Generated,
        _ => ConfirmOn::FirstCourse,
    };
    config.transport.tickets_per_actor = 1 + number as usize / 4 % 3;
    config.transport.max_actors = 4;
    config.transport.actor_silence_secs = 2.0;
    config.transport.episode_deadline_secs = 10.0;
    config.transport.learner_silence_secs = 8.0;
    config
}
