//! Folders for readers that only accept files, in memory where possible: thousands of files per
//! second would burden a disk.

use std::fs;
use std::path::Path;

use tempfile::TempDir;

thread_local! {
    static FOLDER: TempDir = folder();
}

/// Creates an empty folder that is removed with the value. Processes of `tests/fuzz.sh` may end
/// without removing theirs, so the script names a folder of its own and removes that.
pub(crate) fn folder() -> TempDir {
    let memory = Path::new("/dev/shm");
    if std::env::var_os("TMPDIR").is_none() && memory.is_dir() {
        tempfile::tempdir_in(memory).unwrap()
    } else {
        tempfile::tempdir().unwrap()
    }
}

/// Calls `read` with the thread's folder, which contains `files`. Other files of earlier calls may
/// remain under other names.
pub(crate) fn with_files<T>(files: &[(&str, &[u8])], read: impl FnOnce(&Path) -> T) -> T {
    FOLDER.with(|folder| {
        for (name, bytes) in files {
            fs::write(folder.path().join(name), bytes).unwrap();
        }
        let result = read(folder.path());
        for (name, _) in files {
            // A reader may have replaced or removed its input.
            let _ = fs::remove_file(folder.path().join(name));
        }
        result
    })
}
