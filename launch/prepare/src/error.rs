//! Reasons why a run cannot start.

use std::io;
use std::path::PathBuf;

use skein_protocol::config::ConfigError;
use skein_protocol::encoder_file::EncoderError;
use skein_protocol::policy_file::PolicyError;
use skein_protocol::snapshot::SnapshotError;
use skein_run::RunError;
use skein_run::terminal::quoted;
use skein_simulator::course::{CourseError, RangesError};
use skein_simulator::simulator::{OutOfReach, SimulatorError};

use super::room::{FilesTooSmall, FoldersTooSmall, SharedMemoryTooSmall, TooLittleMemory};

/// Reason why a run cannot start.
#[derive(Debug, thiserror::Error)]
pub enum PrepareError {
    /// The configuration is invalid.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The `[simulator]` section is invalid.
    #[error("{}: [simulator] {problem}", config.display())]
    Simulator {
        /// The configuration file.
        config: PathBuf,
        /// Key and problem.
        problem: String,
    },
    /// A course cannot be flown.
    #[error(transparent)]
    Course(#[from] CourseError),
    /// The decoder beside an encoder cannot be read.
    #[error("{source}; remove it: it only shows what latent codes hold")]
    Decoder {
        /// Path and problem.
        source: SnapshotError,
    },
    /// A mesh file that a run cannot keep a copy of under its name.
    #[error(
        "{}: file = {file:?}: a run keeps copies of all mesh files in one folder: put the file \
         beside the course, under a name that no other course of the run uses for another mesh",
        course.display()
    )]
    MeshFile {
        /// The course file.
        course: PathBuf,
        /// The mesh file, as the course names it.
        file: PathBuf,
    },
    /// A vehicle or camera setting is invalid.
    #[error("{}: {source}", config.display())]
    Settings {
        /// The configuration file.
        config: PathBuf,
        /// Problem of the setting.
        #[source]
        source: SimulatorError,
    },
    /// The encoder to start from cannot be used.
    #[error("{}: {source}", config.display())]
    Encoder {
        /// The configuration file.
        config: PathBuf,
        /// Problem of the encoder's file.
        #[source]
        source: EncoderError,
    },
    /// The policy to start from, or the teacher's, cannot be used.
    #[error("{}: {source}", config.display())]
    Policy {
        /// The configuration file.
        config: PathBuf,
        /// Problem of the policy's file.
        #[source]
        source: PolicyError,
    },
    /// The given ranges do not allow courses to be generated.
    #[error("{}: [simulator.generator] {source}", config.display())]
    Ranges {
        /// The configuration file.
        config: PathBuf,
        /// Problem of the ranges.
        #[source]
        source: RangesError,
    },
    /// A shape of generated courses is listed twice.
    #[error(
        "{}: [simulator.generator] shapes lists {shape:?} twice: name each shape once",
        config.display()
    )]
    RepeatedShape {
        /// The configuration file.
        config: PathBuf,
        /// Name of the shape.
        shape: &'static str,
    },
    /// No episode can finish a course.
    #[error("{}: {course}: {source}", config.display())]
    OutOfReach {
        /// The configuration file.
        config: PathBuf,
        /// Name of the course, or of the ranges of generated courses.
        course: String,
        /// Distances, their keys and the remedy.
        #[source]
        source: OutOfReach,
    },
    /// The run would end within its warm-up.
    #[error(
        "{}: run.episodes = {episodes} of at most [simulator] max_steps = {max_steps} are \
         {most_steps} steps, which learning.warmup_steps = {warmup_steps} takes up, so nothing \
         would be learned; raise run.episodes, lower learning.warmup_steps, or set \
         learning.updates_per_step to 0 if nothing is to be learned",
        config.display()
    )]
    OnlyWarmup {
        /// The configuration file.
        config: PathBuf,
        /// Training episodes.
        episodes: u64,
        /// Largest number of steps of an episode.
        max_steps: u32,
        /// Largest number of steps of the run.
        most_steps: u64,
        /// Steps without updates.
        warmup_steps: usize,
    },
    /// An episode may become longer than an actor can send.
    #[error(
         "[simulator] max_steps = {max_steps} makes episodes of up to {} records, \
          but transport.max_records_per_episode = {records}: set it to at least {}",
        max_steps + 1,
        max_steps + 1
    )]
    EpisodeTooLong {
        /// Largest number of steps in the simulator.
        max_steps: u32,
        /// Largest number of records in the transport.
        records: usize,
    },
    /// Training would start from a level that its course does not have.
    #[error(
         "{}: learning.levels = {levels} exceeds the {walls} walls of {}, \
          so no episode could start from the last level; set it to {walls} or fewer",
        config.display(),
        course
    )]
    TooManyLevels {
        /// The configuration file.
        config: PathBuf,
        /// Requested start levels.
        levels: u8,
        /// Name of the course, or of the ranges of generated courses.
        course: String,
        /// Number of its walls, or the most that the ranges allow.
        walls: usize,
    },
    /// The transport allows fewer actors.
    #[error("{actors} actors are more than transport.max_actors = {max}: start fewer, or raise it")]
    TooManyActors {
        /// Requested actors.
        actors: usize,
        /// Largest number allowed.
        max: usize,
    },
    /// Shared memory is too small.
    #[error(transparent)]
    Room(#[from] SharedMemoryTooSmall),
    /// The disk has no room for the transport's small files.
    #[error(transparent)]
    Folders(#[from] FoldersTooSmall),
    /// The limit on the size of a file is too low.
    #[error(transparent)]
    FileSize(#[from] FilesTooSmall),
    /// The limit on the address space of a process is too low.
    #[error(transparent)]
    Memory(#[from] TooLittleMemory),
    /// The run's directory is not empty.
    #[error(
        "{} is not empty: choose another --run-dir, \
         or resume the run in it with --resume {}",
        .0.display(),
        quoted(.0)
    )]
    NotEmpty(PathBuf),
    /// The run's directory cannot be created or used, for example because it is a file.
    #[error("{}: {source}: name a new or empty directory with --run-dir", path.display())]
    RunDirectory {
        /// The directory.
        path: PathBuf,
        /// The operating system's error.
        #[source]
        source: io::Error,
    },
    /// A file or folder of the run cannot be written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The path.
        path: PathBuf,
        /// The operating system's error.
        #[source]
        source: io::Error,
    },
    /// The run's directory cannot be set up.
    #[error(transparent)]
    Run(#[from] RunError),
    /// An override makes the run impossible.
    #[error("with --set {text}, {source}")]
    Overridden {
        /// The override, as given.
        text: String,
        /// Problem caused by the override.
        #[source]
        source: Box<PrepareError>,
    },
}
