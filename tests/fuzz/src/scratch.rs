//! A folder for readers that take files only: one a thread, in `TMPDIR`, which `launch/fuzz.sh` puts into memory.

use std::fs;
use std::path::Path;

use tempfile::TempDir;

thread_local! {
    static FOLDER: TempDir = tempfile::tempdir().unwrap();
}

/// Calls `read` with the thread's folder, in which `files` lie and nothing else that an earlier call did not put there under another name.
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
