//! What a run's processes hold of the machine, and may leave behind: other processes, shared
//! memory, the transport's folder.

use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use skein_protocol::ids::RunId;
use skein_run::RunDirectory;

use super::processes::processes_of;

/// What a run has outside its directory.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Footprint {
    /// Segments in shared memory.
    pub segments: u64,
    /// Memory that they take, which is less than their length where nothing was written.
    pub segment_bytes: u64,
    /// Files, folders and sockets in the transport's folder, itself included.
    pub transport_entries: u64,
}

/// What the run `id` has outside its directory.
pub fn footprint(id: RunId) -> Footprint {
    let segments = segments(id);
    Footprint {
        segments: segments.len() as u64,
        // A block is 512 bytes whatever the file system's are: stat(2).
        segment_bytes: segments
            .iter()
            .filter_map(|path| fs::metadata(path).ok())
            .map(|data| data.blocks() * 512)
            .sum(),
        transport_entries: entries(&transport(id)),
    }
}

/// Everything that is there and should not be once the run is over.
pub fn leftovers(run: &RunDirectory) -> Vec<String> {
    let mut found: Vec<_> = processes_of(run)
        .iter()
        .map(|process| {
            format!(
                "process {} {:?}",
                process.pid.as_raw_nonzero(),
                process.command
            )
        })
        .collect();
    // Without an identity, nothing was started that could have left anything else.
    if let Ok((identity, _)) = run.open() {
        let shared = segments(identity.run);
        found.extend(shared.iter().map(|path| path.display().to_string()));
        let transport = transport(identity.run);
        if fs::symlink_metadata(&transport).is_ok() {
            found.push(transport.display().to_string());
        }
    }
    found
}

fn transport(id: RunId) -> PathBuf {
    PathBuf::from(format!("/tmp/skein-{:016x}", id.0))
}

fn segments(id: RunId) -> Vec<PathBuf> {
    let prefix = format!("skein_{:016x}", id.0);
    fs::read_dir("/dev/shm")
        .into_iter()
        .flatten()
        .flatten()
        .filter(|entry| entry.file_name().to_string_lossy().starts_with(&prefix))
        .map(|entry| entry.path())
        .collect()
}

fn entries(path: &Path) -> u64 {
    let Ok(data) = fs::symlink_metadata(path) else {
        return 0;
    };
    let within: u64 = match fs::read_dir(path) {
        Ok(folder) if data.is_dir() => folder.flatten().map(|entry| entries(&entry.path())).sum(),
        _ => 0,
    };
    1 + within
}
