//! The manifest: what a checkpoint consists of, and how each part is recognised as undamaged.

use std::fs::{self, File};
use std::io::{self, BufReader};
use std::path::Path;

use serde::{Deserialize, Serialize};
use xxhash_rust::xxh3::{Xxh3Default, xxh3_64};

use super::CheckpointError;

/// Its name in the checkpoint's directory.
pub(super) const NAME: &str = "manifest.json";

/// Changes with everything that makes older checkpoints unreadable.
const FORMAT: u32 = 1;

/// Bytes of a file that are read at once for its checksum.
const PIECE: usize = 1 << 20;

/// Format, configuration, and the files with their checksums.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Manifest {
    format: u32,
    /// `Config::digest`, hexadecimal: JSON's numbers do not hold 64 bits.
    config_digest: String,
    flights: u64,
    files: Vec<Entry>,
}

/// A file of the checkpoint.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    name: String,
    bytes: u64,
    /// Hexadecimal.
    xxh3: String,
}

impl Manifest {
    /// Of the files `names` in `directory`, as they are now.
    pub(super) fn of(
        directory: &Path,
        names: &[&str],
        flights: u64,
        config_digest: u64,
    ) -> Result<Self, CheckpointError> {
        let entry = |name: &&str| {
            let path = directory.join(name);
            // Piece by piece: depth images can be larger than what is wise to hold twice.
            let mut hasher = Xxh3Default::new();
            let bytes = File::open(&path)
                .and_then(|file| io::copy(&mut BufReader::with_capacity(PIECE, file), &mut hasher))
                .map_err(CheckpointError::io("read", &path))?;
            Ok(Entry {
                name: (*name).to_owned(),
                bytes,
                xxh3: hex(hasher.digest()),
            })
        };
        let files = names.iter().map(entry).collect::<Result<_, _>>()?;
        Ok(Self {
            format: FORMAT,
            config_digest: hex(config_digest),
            flights,
            files,
        })
    }

    /// Its text.
    pub(super) fn to_json(&self) -> String {
        serde_json::to_string_pretty(self).expect("a manifest is plain data") + "\n"
    }

    /// Reads the manifest of the checkpoint in `directory` and checks that it is of this format and `config_digest`.
    pub(super) fn read(directory: &Path, config_digest: u64) -> Result<Self, CheckpointError> {
        let path = directory.join(NAME);
        let damaged = |problem: String| CheckpointError::Manifest {
            path: path.clone(),
            problem,
        };
        let text = fs::read_to_string(&path).map_err(CheckpointError::io("read", &path))?;
        // The format is read first: another one may have other fields.
        #[derive(Deserialize)]
        struct Format {
            format: u32,
        }
        let Format { format: found } = serde_json::from_str(&text).map_err(|error| damaged(error.to_string()))?;
        if found != FORMAT {
            return Err(CheckpointError::Format {
                path,
                found,
                expected: FORMAT,
            });
        }
        let manifest: Self = serde_json::from_str(&text).map_err(|error| damaged(error.to_string()))?;
        if manifest.to_json() != text {
            return Err(damaged("it is not laid out as it was written".to_owned()));
        }
        let found =
            parse_hex(&manifest.config_digest).ok_or_else(|| damaged("config_digest is no number".to_owned()))?;
        if found != config_digest {
            return Err(CheckpointError::Configuration {
                path,
                found,
                expected: config_digest,
            });
        }
        Ok(manifest)
    }

    /// Flights committed according to the manifest.
    pub(super) fn flights(&self) -> u64 {
        self.flights
    }

    /// Reads the file `name` in `directory` and checks that it is what was written.
    pub(super) fn read_file(&self, directory: &Path, name: &str) -> Result<Vec<u8>, CheckpointError> {
        let entry = self
            .files
            .iter()
            .find(|entry| entry.name == name)
            .ok_or_else(|| CheckpointError::Manifest {
                path: directory.join(NAME),
                problem: format!("it does not list {name}"),
            })?;
        let path = directory.join(name);
        let content = fs::read(&path).map_err(CheckpointError::io("read", &path))?;
        let damaged = |what, found, expected| CheckpointError::Damaged {
            path: path.clone(),
            what,
            found,
            expected,
        };
        if content.len() as u64 != entry.bytes {
            return Err(damaged(
                "size",
                format!("{} bytes", content.len()),
                format!("{} bytes", entry.bytes),
            ));
        }
        let checksum = hex(xxh3_64(&content));
        if checksum != entry.xxh3 {
            return Err(damaged("checksum", checksum, entry.xxh3.clone()));
        }
        Ok(content)
    }
}

fn hex(value: u64) -> String {
    format!("{value:016x}")
}

fn parse_hex(text: &str) -> Option<u64> {
    u64::from_str_radix(text, 16).ok()
}
