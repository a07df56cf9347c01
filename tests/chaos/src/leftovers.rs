//! Machine resources of a run that may outlive it: processes, shared memory, the transport's
//! folder.

use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use skein_protocol::ids::RunId;
use skein_run::RunDirectory;

use super::processes::processes_of;

/// Resources of a run outside its directory.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Footprint {
    /// Segments in shared memory.
    pub segments: u64,
    /// Memory that they occupy, in bytes. Pages that were never written do not count.
    pub segment_bytes: u64,
    /// Files, folders and sockets in the transport's folder, including the folder itself.
    pub transport_entries: u64,
}

/// Returns the resources of the run `id` outside its directory.
pub fn footprint(id: RunId) -> Footprint {
    let segments = segments(id);
    Footprint {
        segments: segments.len() as u64,
        // stat(2) counts blocks of 512 bytes, whatever the file system's block size.
        segment_bytes: segments
            .iter()
            .filter_map(|path| fs::metadata(path).ok())
            .map(|data| data.blocks() * 512)
            .sum(),
        transport_entries: entries(&transport(id)),
    }
}

/// Returns everything that exists but should not exist once the run is over.
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
    // A run without an identity started no process, so nothing else can be left.
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
