//! Folders and locks of ours in places that belong to everybody.

use std::ffi::OsStr;
use std::fs::{self, File, TryLockError};
use std::io;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::{DirBuilderExt, FileExt, MetadataExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::thread::sleep;
use std::time::{Duration, Instant};

use rustix::fs::{Mode, OFlags};
use rustix::process::geteuid;

/// How long a lock is tried that others may hold for the moment it takes them to look.
const LOCK_PATIENCE: Duration = Duration::from_secs(1);
/// Time between two tries.
const LOCK_INTERVAL: Duration = Duration::from_millis(5);

/// Why a place cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum PlaceError {
    /// It cannot be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The path.
        path: PathBuf,
        /// Why.
        #[source]
        source: io::Error,
    },
    /// It is somebody else's.
    #[error("{} belongs to user {owner}, this process to user {user}: a run is its owner's alone", path.display())]
    OtherUser {
        /// The path.
        path: PathBuf,
        /// Its owner.
        owner: u32,
        /// This process's user.
        user: u32,
    },
    /// Somebody holds it and does not let go.
    #[error("{} is being removed and does not vanish", path.display())]
    Busy {
        /// The path.
        path: PathBuf,
    },
}

impl PlaceError {
    /// A failure at `path`.
    pub(super) fn at(path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io { path, source }
    }
}

/// The user this process acts for.
pub(super) fn user() -> u32 {
    geteuid().as_raw()
}

/// Makes a folder for this user alone. One that is there is all right too.
pub(super) fn make_folder(path: &Path) -> io::Result<()> {
    match fs::DirBuilder::new().mode(0o700).create(path) {
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => Ok(()),
        made => made,
    }
}

/// A folder of this user, opened; `None` when it is not there. A link to one is none.
pub(super) fn open_folder(path: &Path) -> Result<Option<File>, PlaceError> {
    let flags = OFlags::DIRECTORY | OFlags::NOFOLLOW | OFlags::CLOEXEC;
    let folder = match rustix::fs::open(path, flags, Mode::empty()) {
        Ok(folder) => File::from(folder),
        Err(rustix::io::Errno::NOENT) => return Ok(None),
        // Whose it is says more than that it is closed.
        Err(error) => {
            let owner = fs::symlink_metadata(path).map(|about| about.uid()).ok();
            return Err(match owner.filter(|owner| *owner != user()) {
                Some(owner) => other_user(path, owner),
                None => PlaceError::at(path)(error.into()),
            });
        }
    };
    let about = folder.metadata().map_err(PlaceError::at(path))?;
    if about.uid() != user() {
        return Err(other_user(path, about.uid()));
    }
    if about.mode() & 0o077 != 0 {
        folder
            .set_permissions(fs::Permissions::from_mode(0o700))
            .map_err(PlaceError::at(path))?;
    }
    Ok(Some(folder))
}

fn other_user(path: &Path, owner: u32) -> PlaceError {
    PlaceError::OtherUser {
        path: path.to_owned(),
        owner,
        user: user(),
    }
}

/// Whether `file` is still what is found at `path`: somebody may have removed it before it was
/// locked.
pub(super) fn is_still_at(file: &File, path: &Path) -> io::Result<bool> {
    let held = file.metadata()?;
    match fs::symlink_metadata(path) {
        // Its number cannot have been given to another while it is open.
        Ok(found) => Ok((held.dev(), held.ino()) == (found.dev(), found.ino())),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
        Err(error) => Err(error),
    }
}

/// A lock that one process holds while it lives: the kernel frees it with the process, however that
/// ends. Its file keeps a few words.
#[derive(Debug)]
pub(super) struct HeldLock {
    file: File,
    path: PathBuf,
}

impl HeldLock {
    /// What the file says.
    pub(super) fn words(&self) -> Result<String, PlaceError> {
        read_words(&self.file).map_err(PlaceError::at(&self.path))
    }

    /// Writes `words` in the place of others, at once: there is no moment at which none are there.
    pub(super) fn write(&self, words: &str) -> Result<(), PlaceError> {
        self.file
            .write_all_at(format!("{words:<WORDS$}").as_bytes(), 0)
            .map_err(PlaceError::at(&self.path))
    }
}

/// Characters of the words in a lock's file.
const WORDS: usize = 40;

fn read_words(file: &File) -> io::Result<String> {
    let mut words = [0; WORDS];
    let length = file.read_at(&mut words, 0)?;
    Ok(String::from_utf8_lossy(&words[..length]).trim().to_owned())
}

/// What a [`HeldLock`] was tried for.
#[derive(Debug)]
pub(super) enum Locked {
    /// This process holds it.
    Mine(HeldLock),
    /// Another holds it, and wrote this.
    Taken { words: String },
}

/// A file for this user alone, made if need be. A link to one is none.
pub(super) fn open_private(path: &Path) -> io::Result<File> {
    fs::OpenOptions::new()
        .read(true)
        .write(true)
        .create(true)
        .truncate(false)
        .mode(0o600)
        .custom_flags(OFlags::NOFOLLOW.bits().cast_signed())
        .open(path)
}

/// Takes the lock of the file at `path`, which is made if need be.
pub(super) fn lock(path: &Path) -> Result<Locked, PlaceError> {
    let file = open_private(path).map_err(PlaceError::at(path))?;
    if lock_within(LOCK_PATIENCE, || file.try_lock()).map_err(PlaceError::at(path))? {
        let path = path.to_owned();
        return Ok(Locked::Mine(HeldLock { file, path }));
    }
    Ok(Locked::Taken {
        words: read_words(&file).map_err(PlaceError::at(path))?,
    })
}

/// Tries a lock until it is had or `patience` is over; whether it is had.
pub(super) fn lock_within(
    patience: Duration,
    mut try_lock: impl FnMut() -> Result<(), TryLockError>,
) -> io::Result<bool> {
    let deadline = Instant::now() + patience;
    loop {
        match try_lock() {
            Ok(()) => return Ok(true),
            Err(TryLockError::Error(error)) => return Err(error),
            Err(TryLockError::WouldBlock) if Instant::now() >= deadline => return Ok(false),
            Err(TryLockError::WouldBlock) => sleep(LOCK_INTERVAL),
        }
    }
}

/// Whether a process holds the lock of the file at `path`.
pub(super) fn is_locked(path: &Path) -> Result<bool, PlaceError> {
    let file = match File::open(path) {
        Ok(file) => file,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(false),
        Err(error) => {
            let folder = path.parent().unwrap_or(path);
            let owner = fs::symlink_metadata(folder).map(|about| about.uid()).ok();
            return Err(match owner.filter(|owner| *owner != user()) {
                Some(owner) => other_user(folder, owner),
                None => PlaceError::at(path)(error),
            });
        }
    };
    match file.try_lock_shared() {
        Ok(()) => Ok(false),
        Err(TryLockError::WouldBlock) => Ok(true),
        Err(TryLockError::Error(error)) => Err(PlaceError::at(path)(error)),
    }
}

/// `name` as the number of a run behind `prefix`, which sixteen hexadecimal digits follow.
pub(super) fn run_of(name: &OsStr, prefix: &str) -> Option<(u64, usize)> {
    let bytes = name.as_bytes();
    let digits = bytes.strip_prefix(prefix.as_bytes())?.get(..16)?;
    let digits = std::str::from_utf8(digits).ok()?;
    let run = u64::from_str_radix(digits, 16).ok()?;
    (format!("{run:016x}") == digits).then_some((run, prefix.len() + 16))
}
