//! The copies of the course files: a run flies through those it was started with, or not at all.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::Path;

use xxhash_rust::xxh3::xxh3_64;

use super::RunError;
use skein_protocol::config::Config;

/// Checksum of each file in `folder`, by its name; of a folder that does not exist, none.
pub(super) fn checksums(folder: &Path) -> io::Result<BTreeMap<String, String>> {
    let entries = match fs::read_dir(folder) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(BTreeMap::new()),
        entries => entries?,
    };
    let mut checksums = BTreeMap::new();
    for entry in entries {
        let entry = entry?;
        // A name that is not UTF-8 cannot stand in the configuration: no course of the run.
        if let Ok(name) = entry.file_name().into_string() {
            checksums.insert(name, checksum(&entry.path())?);
        }
    }
    Ok(checksums)
}

/// Checks that the files in `folder` are those of `checksums`, and that the run flies through no
/// others.
pub(super) fn verify(
    folder: &Path,
    checksums: &BTreeMap<String, String>,
    config: &Config,
) -> Result<(), RunError> {
    for path in config.courses.paths() {
        let name = path.file_name().and_then(|name| name.to_str());
        let is_known =
            path.parent() == Some(folder) && name.is_some_and(|name| checksums.contains_key(name));
        // A run that was created without copies vouches for none.
        if !checksums.is_empty() && !is_known {
            return Err(RunError::CourseChanged {
                path: path.clone(),
                problem: format!(
                    "is none of the courses in {} that the run was started with",
                    folder.display()
                ),
            });
        }
    }
    for (name, expected) in checksums {
        let path = folder.join(name);
        let problem = if Path::new(name).file_name() != Some(name.as_ref()) {
            Some("is no name of a course file".to_owned())
        } else {
            match checksum(&path) {
                Ok(found) => (found != *expected).then(|| {
                    format!(
                        "was changed since the run was started: its checksum is {found} where {expected} is expected"
                    )
                }),
                Err(error) => Some(format!("cannot be read: {error}")),
            }
        };
        if let Some(problem) = problem {
            return Err(RunError::CourseChanged { path, problem });
        }
    }
    Ok(())
}

/// xxh3, hexadecimal: JSON's numbers do not hold 64 bits everywhere.
fn checksum(path: &Path) -> io::Result<String> {
    fs::read(path).map(|content| format!("{:016x}", xxh3_64(&content)))
}
