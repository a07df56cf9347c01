//! Folders for readers that take files only, in memory where the machine has it: thousands of files
//! a second are no load for a disk.

use std::fs;
use std::path::Path;

use tempfile::TempDir;

thread_local! {
    static FOLDER: TempDir = folder();
}

/// An empty folder that is removed with the value. `tests/fuzz.sh`, whose processes end without a
/// word, names one of its own to remove.
pub(crate) fn folder() -> TempDir {
    let memory = Path::new("/dev/shm");
    if std::env::var_os("TMPDIR").is_none() && memory.is_dir() {
        tempfile::tempdir_in(memory).unwrap()
    } else {
        tempfile::tempdir().unwrap()
    }
}

/// Calls `read` with the thread's folder, in which `files` lie and nothing else that an earlier
/// call did not put there under another name.
pub(crate) fn with_files<T>(files: &[(&str, &[u8])], read: impl FnOnce(&Path) -> T) -> T {
    FOLDER.with(|folder| {
        for (name, bytes) in files {
            fs::write(folder.path().join(name), bytes).unwrap();
        }
        let result = read(folder.path());
        for (name, _) in files {
            // A reader may have replaced or removed what it was given.
            let _ = fs::remove_file(folder.path().join(name));
        }
        result
    })
}
