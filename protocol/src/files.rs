//! Reading files that a user names, or may have changed.
//!
//! A pipe might never end and a device might never stop: only regular files of a limited size are
//! read.

use std::fs::{self, File};
use std::io::{self, Read, Take};
use std::path::{Path, PathBuf};

/// Most bytes of a configuration, a suite, a course or an experiment: many times what one with
/// every key and a comment on each needs.
pub const SETTINGS_BYTES: u64 = 1 << 20;
/// Most bytes of a report as JSON, or of a document.
pub const REPORT_BYTES: u64 = 64 << 20;
/// Most bytes of a snapshot or another file of tensors.
pub const TENSOR_BYTES: u64 = 1 << 30;
/// Most bytes of a table, such as `episodes.csv` of some ten million episodes.
pub const TABLE_BYTES: u64 = 4 << 30;

/// Most links that the kernel follows on the way to one file.
const MOST_LINKS: usize = 40;

/// Opens the regular file at `path`, of at most `most` bytes. No more of it can be read, even if it
/// grows.
///
/// # Errors
/// The system's error, or what is wrong with the file and the remedy. Callers name the file.
pub fn open(path: &Path, most: u64) -> io::Result<Take<File>> {
    // Opening a pipe would wait for its writer.
    let about = fs::metadata(path).map_err(|error| behind_link(path, error))?;
    if about.is_dir() {
        return Err(io::Error::other("it is a folder: name a file"));
    }
    if !about.is_file() {
        return Err(io::Error::other(
            "it is not a regular file: name one, or move this aside",
        ));
    }
    if about.len() > most {
        return Err(io::Error::other(format!(
            "it has {} bytes, more than the {most} that such a file may have: name another",
            about.len()
        )));
    }
    Ok(File::open(path)?.take(most))
}

/// Returns `error`, with where `path` leads if it is a link to nothing.
fn behind_link(path: &Path, error: io::Error) -> io::Error {
    match fs::read_link(path) {
        Ok(target) if error.kind() == io::ErrorKind::NotFound => io::Error::new(
            error.kind(),
            format!("it is a link to {}, which does not exist", target.display()),
        ),
        _ => error,
    }
}

/// Reads the regular file at `path`, of at most `most` bytes.
///
/// # Errors
/// Like [`open`].
pub fn read(path: &Path, most: u64) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    open(path, most)?.read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// Reads the regular text file at `path`, of at most `most` bytes.
///
/// # Errors
/// Like [`open`]; `InvalidData` if it is not UTF-8.
pub fn read_text(path: &Path, most: u64) -> io::Result<String> {
    let mut text = String::new();
    open(path, most)?.read_to_string(&mut text)?;
    Ok(text)
}

/// Returns the path of the file that a writer to `path` changes or creates: links are followed,
/// also one to a file that does not exist yet. `None` if its folder does not exist.
pub fn destination(path: &Path) -> Option<PathBuf> {
    let mut path = std::path::absolute(path).ok()?;
    for _ in 0..MOST_LINKS {
        let folder = path.parent()?.canonicalize().ok()?;
        path = folder.join(path.file_name()?);
        match fs::read_link(&path) {
            Ok(target) => path = folder.join(target),
            Err(_) => return Some(path),
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    #[test]
    fn only_a_regular_file_within_the_limit_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("file");
        fs::write(&file, "text").unwrap();
        assert_eq!(read(&file, 4).unwrap(), b"text");
        assert_eq!(read_text(&file, 4).unwrap(), "text");
        let error = read(&file, 3).unwrap_err().to_string();
        assert!(error.contains("4 bytes, more than the 3"), "{error}");
        for (strange, problem) in [
            (Path::new("/dev/zero"), "not a regular file"),
            (folder.path(), "a folder: name a file"),
        ] {
            let error = read_text(strange, SETTINGS_BYTES).unwrap_err().to_string();
            assert!(error.contains(problem), "{error}");
        }
        let link = folder.path().join("link");
        symlink("nowhere", &link).unwrap();
        let dangling = read(&link, 4).unwrap_err();
        assert_eq!(dangling.kind(), io::ErrorKind::NotFound);
        let problem = "a link to nowhere, which does not exist";
        assert!(dangling.to_string().contains(problem), "{dangling}");
        let missing = read(&folder.path().join("missing"), 4).unwrap_err();
        assert_eq!(missing.kind(), io::ErrorKind::NotFound);
    }

    #[test]
    fn a_file_that_grows_is_read_up_to_the_limit() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("file");
        fs::write(&file, "1234").unwrap();
        let mut opened = open(&file, 6).unwrap();
        fs::write(&file, "123456789").unwrap();
        let mut text = String::new();
        opened.read_to_string(&mut text).unwrap();
        assert_eq!(text, "123456");
    }

    #[test]
    fn the_destination_is_behind_all_links_whether_it_exists_or_not() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().canonicalize().unwrap();
        let at = |name: &str| root.join(name);
        fs::create_dir(at("inner")).unwrap();
        symlink("second", at("first")).unwrap();
        symlink("inner/file", at("second")).unwrap();
        symlink("loop", at("loop")).unwrap();
        for _ in ["missing", "there"] {
            for path in ["first", "second", "inner/../inner/file"] {
                assert_eq!(destination(&at(path)), Some(at("inner/file")), "{path}");
            }
            fs::write(at("inner/file"), "").unwrap();
        }
        assert_eq!(destination(&at("loop")), None);
        assert_eq!(destination(&at("nowhere/file")), None);
    }
}
