//! Text files from outside the process.

use std::fs;
use std::io;
use std::path::Path;

/// Most bytes of a file: far more than any course or suite needs.
const MOST_BYTES: u64 = 1 << 20;

/// Reads a text file.
///
/// # Errors
/// If the file cannot be read, exceeds [`MOST_BYTES`], or is not a regular file: reading a pipe or
/// a device might never end.
pub(crate) fn read_text(path: &Path) -> io::Result<String> {
    let about = fs::metadata(path)?;
    if !about.is_file() || about.len() > MOST_BYTES {
        return Err(io::Error::other(format!(
            "not a regular file of at most {MOST_BYTES} bytes"
        )));
    }
    fs::read_to_string(path)
}
