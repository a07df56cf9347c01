//! The file system as checkpoints use it.
//!
//! The store takes any implementation, so that a simulation can cut its power between any two
//! operations, and fill it at any of them.

use std::ffi::OsString;
use std::fs::{self, File};
use std::io::{self, Read, Take, Write};
use std::path::Path;

use safetensors::SafeTensorError;
use safetensors::tensor::View;
use skein_protocol::files;
use skein_run::durable;

/// Operations on files and directories. What is not synced may be lost in a power cut.
///
/// # Errors
/// Every method: errors of the file system.
pub trait Storage: Clone {
    /// An open file.
    type Reader: Read;

    /// Creates the directory at `path` if it is missing, accessible for the user only.
    fn create_directory(&self, path: &Path) -> io::Result<()>;

    /// Writes a file that only the user can read, in place of an existing one.
    fn write(&self, path: &Path, bytes: &[u8]) -> io::Result<()>;

    /// Writes named tensors as such a file.
    ///
    /// # Errors
    /// [`SafeTensorError::IoError`] is the file system's; all others say what cannot be written.
    fn write_tensors<V: View>(
        &self,
        path: &Path,
        tensors: Vec<(String, V)>,
    ) -> Result<(), SafeTensorError>;

    /// Opens the regular file at `path`, of at most `most` bytes.
    fn open(&self, path: &Path, most: u64) -> io::Result<Self::Reader>;

    /// Syncs to disk the content of a file, or the names in a directory.
    fn sync(&self, path: &Path) -> io::Result<()>;

    /// Renames a file or directory.
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()>;

    /// Removes a file, or a directory with its content, if there is one.
    fn remove(&self, path: &Path) -> io::Result<()>;

    /// `true` if there is a file or directory at `path`.
    fn exists(&self, path: &Path) -> bool;

    /// Names of the directories in the directory at `path`.
    fn directories(&self, path: &Path) -> io::Result<Vec<OsString>>;

    /// Reads the regular file at `path`, of at most `most` bytes.
    ///
    /// # Errors
    /// As [`Storage::open`].
    fn read(&self, path: &Path, most: u64) -> io::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        self.open(path, most)?.read_to_end(&mut bytes)?;
        Ok(bytes)
    }
}

/// The system's files.
#[derive(Debug, Clone, Copy, Default)]
pub struct Files;

impl Storage for Files {
    type Reader = Take<File>;

    fn create_directory(&self, path: &Path) -> io::Result<()> {
        durable::create_private_directory(path)
    }

    fn write(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        durable::create_private(path)?.write_all(bytes)
    }

    fn write_tensors<V: View>(
        &self,
        path: &Path,
        tensors: Vec<(String, V)>,
    ) -> Result<(), SafeTensorError> {
        safetensors::serialize_to_file(tensors, None, path)
    }

    fn open(&self, path: &Path, most: u64) -> io::Result<Take<File>> {
        files::open(path, most)
    }

    fn sync(&self, path: &Path) -> io::Result<()> {
        durable::sync(path)
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        fs::rename(from, to)
    }

    fn remove(&self, path: &Path) -> io::Result<()> {
        let removed = match fs::remove_dir_all(path) {
            // A foreign file under one of our names is removed too.
            Err(error) if error.kind() == io::ErrorKind::NotADirectory => fs::remove_file(path),
            removed => removed,
        };
        match removed {
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
            removed => removed,
        }
    }

    fn exists(&self, path: &Path) -> bool {
        path.exists()
    }

    fn directories(&self, path: &Path) -> io::Result<Vec<OsString>> {
        let mut names = Vec::new();
        for entry in fs::read_dir(path)? {
            let entry = entry?;
            if entry.file_type().is_ok_and(|kind| kind.is_dir()) {
                names.push(entry.file_name());
            }
        }
        Ok(names)
    }
}
