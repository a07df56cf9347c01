//! Folders and locks in directories that all users share.

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

/// Longest time to try a lock, which other processes may hold briefly while they look.
const LOCK_PATIENCE: Duration = Duration::from_secs(1);
/// Time between two tries of a lock.
const LOCK_INTERVAL: Duration = Duration::from_millis(5);

/// Reason why a file, folder or lock cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum PathError {
    /// The path cannot be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The path.
        path: PathBuf,
        /// Cause.
        #[source]
        source: io::Error,
    },
    /// The path belongs to another user.
    #[error("{} belongs to user {owner}, but this process runs as user {user}: only its owner \
        can use a run", path.display())]
    OtherUser {
        /// The path.
        path: PathBuf,
        /// Owner.
        owner: u32,
        /// User of this process.
        user: u32,
    },
    /// The folder is being removed and does not disappear.
    #[error("{} is being removed but does not disappear", path.display())]
    Busy {
        /// The path.
        path: PathBuf,
    },
}

impl PathError {
    /// Returns the error for a failure at `path`.
    pub(super) fn at(path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io { path, source }
    }
}

/// Returns the user that this process runs as.
pub(super) fn user() -> u32 {
    geteuid().as_raw()
}

/// Creates a folder for this user only. An existing one is accepted.
pub(super) fn make_folder(path: &Path) -> io::Result<()> {
    match fs::DirBuilder::new().mode(0o700).create(path) {
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => Ok(()),
        made => made,
    }
}

/// Opens a folder of this user; returns `None` if it does not exist. A link is not accepted.
pub(super) fn open_folder(path: &Path) -> Result<Option<File>, PathError> {
    let flags = OFlags::DIRECTORY | OFlags::NOFOLLOW | OFlags::CLOEXEC;
    let folder = match rustix::fs::open(path, flags, Mode::empty()) {
        Ok(folder) => File::from(folder),
        Err(rustix::io::Errno::NOENT) => return Ok(None),
        // The owner explains more than the refused access.
        Err(error) => {
            let owner = fs::symlink_metadata(path).map(|about| about.uid()).ok();
            return Err(match owner.filter(|owner| *owner != user()) {
                Some(owner) => other_user(path, owner),
                None => PathError::at(path)(error.into()),
            });
        }
    };
    let about = folder.metadata().map_err(PathError::at(path))?;
    if about.uid() != user() {
        return Err(other_user(path, about.uid()));
    }
    if about.mode() & 0o077 != 0 {
        folder
            .set_permissions(fs::Permissions::from_mode(0o700))
            .map_err(PathError::at(path))?;
    }
    Ok(Some(folder))
}

fn other_user(path: &Path, owner: u32) -> PathError {
    PathError::OtherUser {
        path: path.to_owned(),
        owner,
        user: user(),
    }
}

/// Returns `true` if `file` is still found at `path`: another process may have removed it before it
/// was locked.
pub(super) fn is_still_at(file: &File, path: &Path) -> io::Result<bool> {
    let held = file.metadata()?;
    match fs::symlink_metadata(path) {
        // The inode number is not reused while the file is open.
        Ok(found) => Ok((held.dev(), held.ino()) == (found.dev(), found.ino())),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
        Err(error) => Err(error),
    }
}

/// A lock that one process holds while it is alive: the kernel releases it when the process ends,
/// however that happens. Its file holds a short text.
#[derive(Debug)]
pub(super) struct FileLock {
    file: File,
    path: PathBuf,
}

impl FileLock {
    /// Returns the text in the file.
    pub(super) fn content(&self) -> Result<String, PathError> {
        read_content(&self.file).map_err(PathError::at(&self.path))
    }

    /// Replaces the text by `content` in one write, so the file is never empty.
    pub(super) fn write(&self, content: &str) -> Result<(), PathError> {
        self.file
            .write_all_at(format!("{content:<CONTENT_LEN$}").as_bytes(), 0)
            .map_err(PathError::at(&self.path))
    }
}

/// Length of the text in a lock's file.
const CONTENT_LEN: usize = 40;

fn read_content(file: &File) -> io::Result<String> {
    let mut content = [0; CONTENT_LEN];
    let length = file.read_at(&mut content, 0)?;
    Ok(String::from_utf8_lossy(&content[..length])
        .trim()
        .to_owned())
}

/// Result of trying a [`FileLock`].
#[derive(Debug)]
pub(super) enum LockAttempt {
    /// This process holds the lock.
    Acquired(FileLock),
    /// Another process holds the lock, and wrote `content`.
    HeldByOther { content: String },
}

/// Opens a file for this user only, creating it if needed. A link is not accepted.
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

/// Takes the lock of the file at `path`, which is created if needed.
pub(super) fn lock(path: &Path) -> Result<LockAttempt, PathError> {
    let file = open_private(path).map_err(PathError::at(path))?;
    if lock_within(LOCK_PATIENCE, || file.try_lock()).map_err(PathError::at(path))? {
        let path = path.to_owned();
        return Ok(LockAttempt::Acquired(FileLock { file, path }));
    }
    Ok(LockAttempt::HeldByOther {
        content: read_content(&file).map_err(PathError::at(path))?,
    })
}

/// Tries a lock until it is acquired or `patience` is over; returns `true` if it was acquired.
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

/// Returns `true` if a process holds the lock of the file at `path`.
pub(super) fn is_locked(path: &Path) -> Result<bool, PathError> {
    // A pipe in its place is not waited for.
    let mut options = fs::OpenOptions::new();
    options
        .read(true)
        .custom_flags(OFlags::NONBLOCK.bits().cast_signed());
    let file = match options.open(path) {
        Ok(file) => file,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(false),
        Err(error) => {
            let folder = path.parent().unwrap_or(path);
            let owner = fs::symlink_metadata(folder).map(|about| about.uid()).ok();
            return Err(match owner.filter(|owner| *owner != user()) {
                Some(owner) => other_user(folder, owner),
                None => PathError::at(path)(error),
            });
        }
    };
    match file.try_lock_shared() {
        Ok(()) => Ok(false),
        Err(TryLockError::WouldBlock) => Ok(true),
        Err(TryLockError::Error(error)) => Err(PathError::at(path)(error)),
    }
}

/// Parses `name` as `prefix` and the sixteen hexadecimal digits of a run. Returns the run and the
/// length of both.
pub(super) fn run_of(name: &OsStr, prefix: &str) -> Option<(u64, usize)> {
    let bytes = name.as_bytes();
    let digits = bytes.strip_prefix(prefix.as_bytes())?.get(..16)?;
    let digits = std::str::from_utf8(digits).ok()?;
    let run = u64::from_str_radix(digits, 16).ok()?;
    (format!("{run:016x}") == digits).then_some((run, prefix.len() + 16))
}
