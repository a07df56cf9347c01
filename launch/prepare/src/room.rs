//! Checks that the machine has room for a run. If shared memory runs out, a process dies of SIGBUS
//! in the middle of an episode. If the disk is full, the learner waits for room. Both can be
//! foreseen.

use std::path::{Path, PathBuf};

use rustix::fs::statvfs;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use skein_protocol::config::{Config, CriticInput, EncoderTraining};
use skein_protocol::snapshot::SnapshotLayout;
use skein_protocol::{IMAGE_PIXELS, critic_state};
use skein_run::allocation::{MemoryLimit, memory_limit};
use skein_transport::shared_memory_needed;

/// Folder of iceoryx2's segments.
const SHARED_MEMORY: &str = "/dev/shm";
/// Parent of the folder of a run's transport.
const FOLDERS: &str = "/tmp";
/// Room for the small files of the transport, in bytes. A hundred actors need less: a dozen files
/// each, of one block each.
const TRANSPORT_FILES: u64 = 8 << 20;
const MIB: u64 = 1 << 20;
/// Open files of a learner, with room for those of a checkpoint.
const FILES: u64 = 96;
/// Open files of a learner for each actor.
const FILES_PER_ACTOR: u64 = 10;
/// Size of a checkpoint's parameters (all networks, target networks and optimiser moments) in
/// snapshots of the same configuration. Measured: 23, as `tensors.safetensors` of a checkpoint of
/// `tests/small.toml` has 73.1 MB, `latest.safetensors` 3.2 MB.
const CHECKPOINT_SNAPSHOTS: u64 = 24;

/// Address space of a learner without what it learns with, in bytes: libraries, stacks, and what
/// the allocator reserves. Measured with `configs/smoke.toml` and two threads, where the sum is 915
/// MiB: the transport of a learner with 781 MiB fails, one with 830 MiB begins, one without a limit
/// reaches 1120 MiB in the end.
const ADDRESS_SPACE: u64 = 600 << 20;
/// Address space of each of its threads for tensors, in bytes: a stack and the allocator's reserve.
const ADDRESS_SPACE_PER_THREAD: u64 = 72 << 20;

/// Shared memory has less free space than a run needs.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
     "{} has {} MiB free, but {actors} actors need {} MiB: start fewer with --actors, \
      remove what other programs left there, \
      or make it larger: sudo mount -o remount,size={}M {}, \
      in a container docker run --shm-size={}m",
    path.display(),
    free / MIB,
    needed.div_ceil(MIB),
    enough.div_ceil(MIB),
    path.display(),
    enough.div_ceil(MIB)
)]
pub struct SharedMemoryTooSmall {
    path: PathBuf,
    actors: usize,
    /// Bytes.
    needed: u64,
    /// Bytes.
    free: u64,
    /// Required total size, in bytes.
    enough: u64,
}

/// Checks that there is shared memory for a learner and `actors` actors with `config`. Passes if
/// the free space is unknown.
///
/// # Errors
/// [`SharedMemoryTooSmall`] names the required and the free space, and the remedy.
pub fn check_shared_memory(config: &Config, actors: usize) -> Result<(), SharedMemoryTooSmall> {
    check_memory_in(
        Path::new(SHARED_MEMORY),
        actors,
        shared_memory_needed(config, actors),
    )
}

/// Checks that there is shared memory for `actors` more actors of a run with `config` that is under
/// way.
///
/// # Errors
/// [`SharedMemoryTooSmall`] names the required and the free space, and the remedy.
pub fn check_shared_memory_for_more(
    config: &Config,
    actors: usize,
) -> Result<(), SharedMemoryTooSmall> {
    let needed = shared_memory_needed(config, actors) - shared_memory_needed(config, 0);
    check_memory_in(Path::new(SHARED_MEMORY), actors, needed)
}

fn check_memory_in(path: &Path, actors: usize, needed: u64) -> Result<(), SharedMemoryTooSmall> {
    let Some(Space { free, total }) = space(path) else {
        return Ok(());
    };
    if free >= needed {
        return Ok(());
    }
    Err(SharedMemoryTooSmall {
        path: path.to_owned(),
        actors,
        needed,
        free,
        enough: total - free + needed,
    })
}

/// The disk has no room for the transport's locks and sockets.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "{FOLDERS} has {} KiB free, but a run's processes need {} KiB there for the files \
     by which they find each other: free some space",
    free >> 10,
    TRANSPORT_FILES >> 10
)]
pub struct FoldersTooSmall {
    /// Bytes.
    free: u64,
}

/// Checks that there is room for the folder of a run's transport.
///
/// # Errors
/// [`FoldersTooSmall`] names the required and the free space.
pub fn check_folders() -> Result<(), FoldersTooSmall> {
    match space(Path::new(FOLDERS)) {
        Some(Space { free, .. }) if free < TRANSPORT_FILES => Err(FoldersTooSmall { free }),
        _ => Ok(()),
    }
}

/// The limit on open files is too low for a run.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "a process may have {limit} open files, but the learner of a run with {actors} actors needs \
     {needed}: raise the limit with ulimit -n {needed}, or start fewer with --actors"
)]
pub struct TooFewFiles {
    actors: usize,
    needed: u64,
    limit: u64,
}

/// Raises this process's limit on open files, which its children inherit, as far as a run with
/// `actors` actors needs it.
///
/// # Errors
/// [`TooFewFiles`] if the system does not allow as many.
pub fn raise_file_limit(actors: usize) -> Result<(), TooFewFiles> {
    // Measured: a learner has 57 open and 9 for each actor, an actor 47.
    let needed = FILES + FILES_PER_ACTOR * actors as u64;
    let limit = getrlimit(Resource::Nofile);
    // `None` is no limit.
    if limit.current.is_none_or(|current| current >= needed) {
        return Ok(());
    }
    let raised = Rlimit {
        current: Some(limit.maximum.map_or(needed, |maximum| maximum.min(needed))),
        ..limit
    };
    let reached = match setrlimit(Resource::Nofile, raised) {
        Ok(()) => raised.current,
        Err(_) => limit.current,
    };
    match reached {
        Some(limit) if limit < needed => Err(TooFewFiles {
            actors,
            needed,
            limit,
        }),
        _ => Ok(()),
    }
}

/// The limit on the size of a file is too low for a run.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "a file may have {} KiB, but the files of this run may grow to {} KiB (checkpoints, shared \
     memory): raise the limit with ulimit -f {}",
    limit >> 10,
    needed.div_ceil(1 << 10),
    needed.div_ceil(1 << 10)
)]
pub struct FilesTooSmall {
    /// Bytes.
    needed: u64,
    /// Bytes.
    limit: u64,
}

/// Checks that this process, and so its children, may write the largest file of a run with `config`
/// and `actors` actors.
///
/// # Errors
/// [`FilesTooSmall`] names the required and the allowed size, and the remedy.
pub fn check_file_size(config: &Config, actors: usize) -> Result<(), FilesTooSmall> {
    check_size_within(config, actors, getrlimit(Resource::Fsize).current)
}

/// `limit`: bytes; `None` is no limit.
fn check_size_within(
    config: &Config,
    actors: usize,
    limit: Option<u64>,
) -> Result<(), FilesTooSmall> {
    let needed = checkpoint_bytes(config).max(shared_memory_needed(config, actors));
    match limit {
        Some(limit) if limit < needed => Err(FilesTooSmall { needed, limit }),
        _ => Ok(()),
    }
}

/// The limit on the address space of a process is too low for one with libtorch.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "{who} needs {} MiB of address space, but {} {}",
    needed.div_ceil(MIB),
    MemoryLimit(*limit),
    needed.div_ceil(1 << 10)
)]
pub struct TooLittleMemory {
    /// The process, for readers.
    who: &'static str,
    /// Bytes.
    needed: u64,
    /// Bytes.
    limit: u64,
}

/// Checks that the learner of a run with `config` and `actors` actors, a child of this process, may
/// have as much address space as it needs at least.
///
/// # Errors
/// [`TooLittleMemory`] names the required and the allowed size, and the remedy.
pub fn check_address_space(config: &Config, actors: usize) -> Result<(), TooLittleMemory> {
    check_address_space_within(config, actors, memory_limit())
}

/// `limit`: bytes; `None` is no limit.
fn check_address_space_within(
    config: &Config,
    actors: usize,
    limit: Option<u64>,
) -> Result<(), TooLittleMemory> {
    let threads = config.run.learner_threads as u64 * ADDRESS_SPACE_PER_THREAD;
    let needed =
        ADDRESS_SPACE + threads + shared_memory_needed(config, actors) + checkpoint_bytes(config);
    match limit {
        Some(limit) if limit < needed => Err(TooLittleMemory {
            who: "the learner",
            needed,
            limit,
        }),
        _ => Ok(()),
    }
}

/// Checks that a program with libtorch, a child of this process, can load its libraries: without
/// room for them it dies before it can say why.
///
/// # Errors
/// [`TooLittleMemory`] names the required and the allowed size, and the remedy.
pub fn check_library_space() -> Result<(), TooLittleMemory> {
    match memory_limit() {
        Some(limit) if limit < ADDRESS_SPACE => Err(TooLittleMemory {
            who: "a program with libtorch",
            needed: ADDRESS_SPACE,
            limit,
        }),
        _ => Ok(()),
    }
}

/// Returns the free bytes of shared memory; `None` if unknown.
pub fn free_shared_memory() -> Option<u64> {
    space(Path::new(SHARED_MEMORY)).map(|space| space.free)
}

/// Returns a warning if the disk of `directory` has no room for the checkpoints of a run with
/// `config`.
pub fn scarce_disk(config: &Config, directory: &Path) -> Option<String> {
    let free = space(directory)?.free;
    // A new checkpoint is written before the oldest is removed.
    let needed = checkpoint_bytes(config) * (config.checkpoints.keep as u64 + 1);
    (free < needed).then(|| {
        format!(
            "the disk of {} has {} MiB free, and {} checkpoints may need {} MiB: \
                if it fills up, the learner waits until there is room",
            directory.display(),
            free / MIB,
            config.checkpoints.keep + 1,
            needed.div_ceil(MIB)
        )
    })
}

/// Returns the bytes of a checkpoint whose replay buffer is full, with its depth images.
fn checkpoint_bytes(config: &Config) -> u64 {
    let learning = &config.learning;
    let records =
        (config.transport.max_records_per_episode * learning.copies_per_transition()) as u64;
    let rows = (config.replay.capacity as u64).min(config.run.episodes.saturating_mul(records));
    let action = config.action_space();
    let message = match learning.critic_input {
        CriticInput::Observation => 0,
        CriticInput::GroundTruth => critic_state(action),
    };
    let actions = action.numbers() * (1 + usize::from(config.teacher.is_configured()));
    let step = config.observation_layout().len() + message;
    let row = 4 * (2 * step + actions + 2) as u64;
    let steps = match learning.encoder {
        EncoderTraining::Vae => config.vae.train_steps * learning.copies_per_transition(),
        EncoderTraining::EndToEnd => config.replay.capacity,
    };
    let images = 2 * steps as u64 + learning.episodes_per_epoch * records;
    let images = match config.vae.start_from {
        Some(_) => 0,
        None => images.min(config.run.episodes.saturating_mul(records)),
    };
    let snapshot = 4 * SnapshotLayout::of(config).values() as u64;
    rows * row + images * IMAGE_PIXELS as u64 + CHECKPOINT_SNAPSHOTS * snapshot
}

/// Free and total bytes of a file system.
struct Space {
    free: u64,
    total: u64,
}

fn space(path: &Path) -> Option<Space> {
    let stat = statvfs(path).ok()?;
    Some(Space {
        free: stat.f_bavail * stat.f_frsize,
        total: stat.f_blocks * stat.f_frsize,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn too_little_memory_is_refused_with_figures_and_remedies() {
        let directory = tempfile::tempdir().unwrap();
        assert_eq!(check_memory_in(directory.path(), 1, 0), Ok(()));
        let too_small = check_memory_in(directory.path(), 64, u64::MAX / 2).unwrap_err();
        let message = too_small.to_string();
        for part in [
            "64 actors",
            "--actors",
            "remount,size=",
            "--shm-size=",
            &format!("{} MiB free", too_small.free / MIB),
        ] {
            assert!(message.contains(part), "`{part}` is missing in {message}");
        }
        assert!(too_small.enough >= too_small.needed);
    }

    #[test]
    fn too_few_open_files_are_refused_with_figures_and_remedies() {
        let allowed = getrlimit(Resource::Nofile).maximum;
        raise_file_limit(1).unwrap();
        let Some(allowed) = allowed else { return };
        let error = raise_file_limit(allowed as usize).unwrap_err();
        assert!(
            error.limit <= allowed && error.needed > allowed,
            "{error:?}"
        );
        for part in ["ulimit -n", "--actors", "open files"] {
            assert!(error.to_string().contains(part), "{error}");
        }
    }

    #[test]
    fn a_file_size_that_a_run_outgrows_is_refused_with_figures_and_remedy() {
        let config = Config::default();
        let checked = |limit| check_size_within(&config, 2, limit);
        assert_eq!(checked(None), Ok(()));
        let error = checked(Some(100 << 10)).unwrap_err();
        assert_eq!(checked(Some(error.needed)), Ok(()));
        assert!(checked(Some(error.needed - 1)).is_err());
        for part in ["100 KiB", "ulimit -f", "shared memory"] {
            assert!(error.to_string().contains(part), "{error}");
        }
    }

    #[test]
    fn an_address_space_too_small_for_a_learner_is_refused_with_figures_and_remedy() {
        let config = Config::default();
        let checked = |limit| check_address_space_within(&config, 2, limit);
        assert_eq!(checked(None), Ok(()));
        let error = checked(Some(500 << 20)).unwrap_err();
        assert_eq!(checked(Some(error.needed)), Ok(()));
        assert!(checked(Some(error.needed - 1)).is_err());
        let needed = format!("{} MiB", error.needed.div_ceil(MIB));
        for part in ["500 MiB", "ulimit -v", &needed] {
            assert!(error.to_string().contains(part), "{error}");
        }
        let mut larger = config.clone();
        larger.run.learner_threads += 4;
        assert!(check_address_space_within(&larger, 2, Some(error.needed)).is_err());
    }

    #[test]
    fn unknown_free_space_passes() {
        let folder = tempfile::tempdir().unwrap();
        let missing = folder.path().join("missing");
        assert_eq!(check_memory_in(&missing, 1, u64::MAX), Ok(()));
        assert_eq!(scarce_disk(&Config::default(), &missing), None);
    }

    #[test]
    fn a_disk_too_small_for_the_checkpoints_causes_a_warning() {
        let mut config = Config::default();
        let directory = tempfile::tempdir().unwrap();
        assert_eq!(scarce_disk(&config, directory.path()), None);
        config.checkpoints.keep = 1 << 40;
        let message = scarce_disk(&config, directory.path()).unwrap();
        assert!(message.contains("checkpoints may need"), "{message}");
    }
}
