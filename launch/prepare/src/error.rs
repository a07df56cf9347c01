//! Why a run cannot be started.

use std::io;
use std::path::PathBuf;

use skein_protocol::config::ConfigError;
use skein_run::RunError;
use skein_simulator::course::{CourseError, RangesError};
use skein_simulator::simulator::SimulatorError;

use super::room::{FoldersTooSmall, SharedMemoryTooSmall};

/// Why a run cannot be started.
#[derive(Debug, thiserror::Error)]
pub enum PrepareError {
    /// The configuration cannot be used.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The `[simulator]` section cannot be used.
    #[error("{}: [simulator] {problem}", config.display())]
    Simulator {
        /// The configuration file.
        config: PathBuf,
        /// Which key, and what is wrong with it.
        problem: String,
    },
    /// A course cannot be flown.
    #[error(transparent)]
    Course(#[from] CourseError),
    /// A vehicle or camera setting makes no sense.
    #[error("{}: {source}", config.display())]
    Settings {
        /// The configuration file.
        config: PathBuf,
        /// Why.
        #[source]
        source: SimulatorError,
    },
    /// Courses cannot be generated from the ranges given.
    #[error("{}: [simulator.generator] {source}", config.display())]
    Ranges {
        /// The configuration file.
        config: PathBuf,
        /// Why.
        #[source]
        source: RangesError,
    },
    /// An episode may become longer than an actor can send.
    #[error(
        "[simulator] max_steps = {max_steps} makes episodes of up to {} records, but transport.max_records_per_episode = {records}: set it to {} or more",
        max_steps + 1,
        max_steps + 1
    )]
    EpisodeTooLong {
        /// The simulator's limit.
        max_steps: u32,
        /// The transport's limit.
        records: usize,
    },
    /// Training would start from a level that its course does not have.
    #[error(
        "{}: learning.levels = {levels} is more than the {walls} walls of {}: no episode could start from the last level; set it to {walls} or fewer",
        config.display(),
        course
    )]
    TooManyLevels {
        /// The configuration file.
        config: PathBuf,
        /// Start levels asked for.
        levels: u8,
        /// The course, or the ranges of generated ones.
        course: String,
        /// Its walls.
        walls: u8,
    },
    /// More actors than the transport has room for.
    #[error("{actors} actors are more than transport.max_actors = {max}: start fewer, or raise it")]
    TooManyActors {
        /// Asked for.
        actors: usize,
        /// The limit.
        max: usize,
    },
    /// The shared memory would be used up.
    #[error(transparent)]
    Room(#[from] SharedMemoryTooSmall),
    /// No room for the transport's small files.
    #[error(transparent)]
    Folders(#[from] FoldersTooSmall),
    /// There is something in the run's directory.
    #[error("{folder} is not empty: choose another --run-dir, or, if it holds a run, go on with that: --resume {folder}", folder = .0.display())]
    NotEmpty(PathBuf),
    /// A file or folder of the run cannot be written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The path.
        path: PathBuf,
        /// Why.
        #[source]
        source: io::Error,
    },
    /// The run's directory cannot be set up.
    #[error(transparent)]
    Run(#[from] RunError),
    /// The run could be started, were it not for an override.
    #[error("with --set {text}, {source}")]
    Overridden {
        /// The override as given.
        text: String,
        /// What is wrong now.
        #[source]
        source: Box<PrepareError>,
    },
}
