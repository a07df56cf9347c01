//! Text files from outside.

use std::fs;
use std::io;
use std::path::Path;

/// Bytes of a file: far more than any course or suite takes.
const LONGEST: u64 = 1 << 20;

/// The text of a file.
///
/// # Errors
/// When it cannot be read, is longer than any that makes sense, or is no regular file: of a pipe or
/// a device, the end might never come.
pub(crate) fn read_text(path: &Path) -> io::Result<String> {
    let about = fs::metadata(path)?;
    if !about.is_file() || about.len() > LONGEST {
        return Err(io::Error::other(format!(
            "is no text file of at most {LONGEST} bytes"
        )));
    }
    fs::read_to_string(path)
}
