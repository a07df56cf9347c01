//! Directory of a new run: created, filled with copies, and removed if the run never starts.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs::{self, DirBuilder, Permissions};
use std::io;
use std::os::unix::fs::{DirBuilderExt, PermissionsExt};
use std::path::{Path, PathBuf};

use skein_protocol::config::ParameterKey;
use skein_protocol::config::{Config, CoursesSection};
use skein_protocol::decoder_file::{DECODER_FILE, TrainedDecoder};
use skein_protocol::encoder_file::TrainedEncoder;
use skein_run::RunDirectory;
use skein_simulator::course::Course;

use super::PrepareError;

/// A run's directory is accessible to its owner only.
const OWNER_ONLY: u32 = 0o700;

/// Directory of a new run, created or found empty.
#[derive(Debug)]
pub struct NewDirectory {
    root: PathBuf,
    origin: Origin,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Origin {
    Made,
    Found,
}

impl NewDirectory {
    /// Creates `directory` unless it exists and is empty. Only its owner can access it afterwards.
    ///
    /// # Errors
    /// Returns [`PrepareError::NotEmpty`], or [`PrepareError::RunDirectory`] with the path.
    pub(super) fn make(directory: &Path) -> Result<Self, PrepareError> {
        let io = |source| PrepareError::RunDirectory {
            path: directory.to_owned(),
            source,
        };
        if let Some(parent) = directory.parent() {
            fs::create_dir_all(parent).map_err(io)?;
        }
        let origin = match DirBuilder::new().mode(OWNER_ONLY).create(directory) {
            Ok(()) => Origin::Made,
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => Origin::Found,
            Err(error) => return Err(io(error)),
        };
        if fs::read_dir(directory).map_err(io)?.next().is_some() {
            return Err(PrepareError::NotEmpty(directory.to_owned()));
        }
        // Of two starts that found it empty, one makes this folder.
        match fs::create_dir(RunDirectory::new(directory).courses()) {
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {
                return Err(PrepareError::NotEmpty(directory.to_owned()));
            }
            made => made.map_err(io)?,
        }
        fs::set_permissions(directory, Permissions::from_mode(OWNER_ONLY)).map_err(io)?;
        let root = directory.canonicalize().map_err(io)?;
        Ok(Self { root, origin })
    }

    /// Returns its absolute path.
    pub(super) fn root(&self) -> &Path {
        &self.root
    }

    /// Restores the previous state: nothing in the directory is worth keeping.
    ///
    /// # Errors
    /// Returns an error if something cannot be removed.
    pub fn take_back(&self) -> io::Result<()> {
        if self.origin == Origin::Made {
            return fs::remove_dir_all(&self.root);
        }
        for entry in fs::read_dir(&self.root)? {
            let entry = entry?;
            if entry.file_type()?.is_dir() {
                fs::remove_dir_all(entry.path())?;
            } else {
                fs::remove_file(entry.path())?;
            }
        }
        Ok(())
    }
}

/// Copies the files of courses and parameters into the run's directory and makes the configuration
/// refer to the copies, so that the run stays reproducible when the originals change.
pub(super) fn copy_inputs(root: &Path, config: &mut Config) -> Result<(), PrepareError> {
    let run = RunDirectory::new(root);
    for (key, path) in config.parameter_files_mut() {
        copy(path, run.parameters(key))?;
        if key == ParameterKey::Encoder {
            copy_decoder(path, run.decoder())?;
        }
        *path = key.copy().into();
    }
    let folder = run.courses();
    let mut copies: BTreeMap<OsString, PathBuf> = BTreeMap::new();
    for path in config.courses.paths_mut() {
        let stem = CoursesSection::stem_of(path);
        let mut name = OsString::from(format!("{stem}.toml"));
        for number in 2.. {
            if copies.get(&name).is_none_or(|original| original == path) {
                break;
            }
            name = format!("{stem}_{number}.toml").into();
        }
        copy(path, folder.join(&name))?;
        copy_meshes(path, &folder)?;
        let relative = Path::new("courses").join(&name);
        copies.insert(name, std::mem::replace(path, relative));
    }
    Ok(())
}

/// Copies the decoder that lies beside the file of an encoder, if it belongs to that.
fn copy_decoder(encoder: &Path, to: PathBuf) -> Result<(), PrepareError> {
    let decoder = encoder.with_file_name(DECODER_FILE);
    let belongs = || {
        let encoder = TrainedEncoder::load(encoder)?;
        TrainedDecoder::of(&encoder.sha256(), &decoder)
    };
    match belongs().map_err(|source| PrepareError::Decoder { source })? {
        Some(_) => copy(&decoder, to),
        None => Ok(()),
    }
}

/// Copies the mesh files that the course file `path` names.
fn copy_meshes(path: &Path, folder: &Path) -> Result<(), PrepareError> {
    for file in Course::mesh_files(path)? {
        let from = path.parent().unwrap_or(Path::new("")).join(&file);
        let to = folder.join(&file);
        let is_name = file.file_name() == Some(file.as_os_str());
        let is_new = || !to.exists() || same_bytes(&from, &to);
        if !is_name || !is_new() {
            return Err(PrepareError::MeshFile {
                course: path.to_owned(),
                file,
            });
        }
        copy(&from, to)?;
    }
    Ok(())
}

fn same_bytes(one: &Path, other: &Path) -> bool {
    matches!((fs::read(one), fs::read(other)), (Ok(one), Ok(other)) if one == other)
}

/// Copies a file, for the user only.
fn copy(from: &Path, to: PathBuf) -> Result<(), PrepareError> {
    // A copy has the original's mode, whatever the umask.
    fs::copy(from, &to)
        .and_then(|_| fs::set_permissions(&to, Permissions::from_mode(0o600)))
        .map_err(|source| PrepareError::Io { path: to, source })
}
