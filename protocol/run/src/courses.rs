//! Checksums of the copied course files: a run flies exactly the courses it was started with.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::Path;

use xxhash_rust::xxh3::xxh3_64;

use super::RunError;
use skein_protocol::config::Config;
use skein_protocol::files::{self, SETTINGS_BYTES};

/// Returns the checksum of each file in `folder` by its name; none if the folder does not exist.
pub(super) fn checksums(folder: &Path) -> io::Result<BTreeMap<String, String>> {
    let entries = match fs::read_dir(folder) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(BTreeMap::new()),
        entries => entries?,
    };
    let mut checksums = BTreeMap::new();
    for entry in entries {
        let entry = entry?;
        // The configuration holds only UTF-8 names, so this is not a course of the run.
        if let Ok(name) = entry.file_name().into_string() {
            checksums.insert(name, checksum(&entry.path())?);
        }
    }
    Ok(checksums)
}

/// Checks that the files in `folder` match `checksums`, and that the run uses no others.
pub(super) fn verify(
    folder: &Path,
    checksums: &BTreeMap<String, String>,
    config: &Config,
) -> Result<(), RunError> {
    for path in config.courses.paths() {
        let name = path.file_name().and_then(|name| name.to_str());
        let is_known =
            path.parent() == Some(folder) && name.is_some_and(|name| checksums.contains_key(name));
        // A run created without copies has no checksums.
        if !checksums.is_empty() && !is_known {
            return Err(RunError::CourseChanged {
                path: path.clone(),
                problem: format!(
                    "is not one of the courses in {} that the run was started with",
                    folder.display()
                ),
            });
        }
    }
    for (name, expected) in checksums {
        let path = folder.join(name);
        let problem = if Path::new(name).file_name() != Some(name.as_ref()) {
            Some("is not a file name".to_owned())
        } else {
            match checksum(&path) {
                Ok(found) => (found != *expected).then(|| {
                    format!(
                        "has changed since the run was started: its checksum is {found}, not \
                        {expected}"
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

/// Returns the xxh3 in hexadecimal, because JSON numbers do not hold 64 bits everywhere.
fn checksum(path: &Path) -> io::Result<String> {
    let content = files::read(path, SETTINGS_BYTES)?;
    Ok(format!("{:016x}", xxh3_64(&content)))
}
