//! Checksums of the copied files of courses and parameters: a run flies exactly the courses, with
//! exactly the encoder and the policies, that it was started with.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::Path;

use xxhash_rust::xxh3::xxh3_64;

use super::RunError;
use skein_protocol::config::Config;
use skein_protocol::files::{self, TENSOR_BYTES};

/// Returns the checksum of each file in `folder` by its name; none if the folder does not exist.
pub(super) fn course_checksums(folder: &Path) -> io::Result<BTreeMap<String, String>> {
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
pub(super) fn verify_courses(
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
            change(&path, expected)
        };
        if let Some(problem) = problem {
            return Err(RunError::CourseChanged { path, problem });
        }
    }
    Ok(())
}

/// Returns the checksum of each copy of a file of parameters that `config` names and that is in
/// `root`, by the copy's name.
pub(super) fn parameter_checksums(
    root: &Path,
    config: &Config,
) -> io::Result<BTreeMap<String, String>> {
    let mut checksums = BTreeMap::new();
    for (key, _) in config.parameter_files() {
        match checksum(&root.join(key.copy())) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            found => drop(checksums.insert(key.copy().to_owned(), found?)),
        }
    }
    Ok(checksums)
}

/// Checks that the run uses the copies in `root`, and that they match `checksums`.
pub(super) fn verify_parameters(
    root: &Path,
    checksums: &BTreeMap<String, String>,
    config: &Config,
) -> Result<(), RunError> {
    for (key, used) in config.parameter_files() {
        // A run created without a copy has no checksum.
        let Some(expected) = checksums.get(key.copy()) else {
            continue;
        };
        let path = root.join(key.copy());
        let problem = match *used == path {
            true => change(&path, expected),
            false => Some(format!(
                "is not what {} names, which is {}",
                key.name(),
                used.display()
            )),
        };
        if let Some(problem) = problem {
            return Err(RunError::ParametersChanged { path, problem });
        }
    }
    Ok(())
}

/// Returns the difference between the file at `path` and the one whose checksum is `expected`.
fn change(path: &Path, expected: &str) -> Option<String> {
    match checksum(path) {
        Ok(found) => (found != expected).then(|| {
            format!(
                "has changed since the run was started: its checksum is {found}, not {expected}"
            )
        }),
        Err(error) => Some(format!("cannot be read: {error}")),
    }
}

/// Returns the xxh3 in hexadecimal, because JSON numbers do not hold 64 bits everywhere.
fn checksum(path: &Path) -> io::Result<String> {
    let content = files::read(path, TENSOR_BYTES)?;
    Ok(format!("{:016x}", xxh3_64(&content)))
}
