//! Durable files: after any interruption, a power cut included, they hold either the old content or
//! all of the new.

use std::fs::{self, DirBuilder, File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

/// Replaces the content of `path` by `bytes` atomically: they are written beside it, synced to
/// disk, and renamed. Only the user can read the file.
///
/// # Errors
/// Errors of the file system; then `path` still has its old content.
pub fn replace(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let temporary_path = temporary_path(path);
    let written = create_private(&temporary_path)
        .and_then(|mut file| {
            file.write_all(bytes)?;
            file.sync_all()
        })
        .and_then(|()| fs::rename(&temporary_path, path));
    if let Err(error) = written {
        // A half-written file takes space, which may be just what is missing. If it cannot be
        // removed, the first error matters more.
        let _ = fs::remove_file(&temporary_path);
        return Err(error);
    }
    sync(path.parent().unwrap_or(Path::new(".")))
}

/// Returns the name under which the file at `path` is written.
fn temporary_path(path: &Path) -> PathBuf {
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(".tmp");
    path.with_file_name(name)
}

/// Creates the file at `path`, or empties an existing one, readable for the user only.
///
/// # Errors
/// Errors of the file system.
pub fn create_private(path: &Path) -> io::Result<File> {
    OpenOptions::new()
        .write(true)
        .create(true)
        .truncate(true)
        .mode(0o600)
        .open(path)
}

/// Creates the directory at `path` if it is missing, accessible for the user only.
///
/// # Errors
/// Errors of the file system, such as a missing parent.
pub fn create_private_directory(path: &Path) -> io::Result<()> {
    match DirBuilder::new().mode(0o700).create(path) {
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists && path.is_dir() => Ok(()),
        created => created,
    }
}

/// Syncs a file, or the names in a directory, to disk.
///
/// # Errors
/// Errors of the file system.
pub fn sync(path: &Path) -> io::Result<()> {
    // The parent of a bare file name is the empty path.
    let path = if path.as_os_str().is_empty() {
        Path::new(".")
    } else {
        path
    };
    File::open(path)?.sync_all()
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    #[test]
    fn a_replaced_file_is_whole_private_and_alone() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("summary.json");
        for content in ["long before", "after"] {
            replace(&path, content.as_bytes()).unwrap();
            assert_eq!(fs::read_to_string(&path).unwrap(), content);
        }
        assert_eq!(
            fs::metadata(&path).unwrap().permissions().mode() & 0o777,
            0o600
        );
        assert_eq!(fs::read_dir(directory.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_failed_replacement_keeps_the_old_content_and_leaves_no_file() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("folder");
        fs::create_dir(&path).unwrap();
        fs::write(path.join("content"), "kept").unwrap();
        replace(&path, b"new").unwrap_err();
        assert_eq!(fs::read_to_string(path.join("content")).unwrap(), "kept");
        assert_eq!(fs::read_dir(directory.path()).unwrap().count(), 1);
    }
}
