//! The manifest: lists a checkpoint's files, with sizes and checksums that reveal damage.

use std::io::{self, BufReader};
use std::path::Path;

use serde::{Deserialize, Serialize};
use skein_protocol::files::REPORT_BYTES;
use xxhash_rust::xxh3::{Xxh3Default, xxh3_64};

use super::{CheckpointError, Storage};

/// Name of the manifest in the checkpoint's directory.
pub(super) const NAME: &str = "manifest.json";

/// Version of the checkpoint format; changes whenever older checkpoints become unreadable.
pub(super) const FORMAT: u32 = 8;

/// Bytes of a file that are read at once for its checksum.
const PIECE: usize = 1 << 20;

/// Text before the manifest's own checksum. The checksum is the last field in every format, so that
/// damage can be distinguished from another format.
const OWN_CHECKSUM: &str = ",\n  \"xxh3\": \"";
/// Text after the checksum.
const END: &str = "\"\n}\n";

/// Format, configuration, and the files with their checksums.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Manifest {
    format: u32,
    /// `Config::digest`, hexadecimal: JSON's numbers do not hold 64 bits.
    config_digest: String,
    episodes: u64,
    files: Vec<ManifestEntry>,
}

/// Name, size and checksum of one file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ManifestEntry {
    name: String,
    bytes: u64,
    /// Checksum, hexadecimal.
    xxh3: String,
}

impl Manifest {
    /// Describes the files `names` in `directory`, as they are now.
    pub(super) fn of(
        storage: &impl Storage,
        directory: &Path,
        names: &[&str],
        episodes: u64,
        config_digest: u64,
    ) -> Result<Self, CheckpointError> {
        let files = names
            .iter()
            .map(|name| ManifestEntry::of(storage, directory, name))
            .collect::<Result<_, _>>()?;
        Ok(Self {
            format: FORMAT,
            config_digest: hex(config_digest),
            episodes,
            files,
        })
    }

    /// Returns the text: JSON, with a checksum of everything before it as the last field.
    pub(super) fn to_text(&self) -> String {
        let json = serde_json::to_string_pretty(self).expect("a manifest is plain data");
        let body = json
            .strip_suffix("\n}")
            .expect("an object of several fields ends so");
        format!("{body}{OWN_CHECKSUM}{}{END}", hex(xxh3_64(body.as_bytes())))
    }

    /// Reads the manifest of the checkpoint in `directory`; checks that it is undamaged and has
    /// this format.
    pub(super) fn read(storage: &impl Storage, directory: &Path) -> Result<Self, CheckpointError> {
        let path = directory.join(NAME);
        let read = storage.read(&path, REPORT_BYTES);
        let bytes = read.map_err(CheckpointError::io("read", &path))?;
        Self::parse(&bytes, &path)
    }

    /// Parses the manifest from the `bytes` of its file at `path`.
    fn parse(bytes: &[u8], path: &Path) -> Result<Self, CheckpointError> {
        let damaged = |problem: String| CheckpointError::Manifest {
            path: path.to_owned(),
            problem,
        };
        let text = str::from_utf8(bytes).map_err(|error| damaged(error.to_string()))?;
        let body = text
            .strip_suffix(END)
            .and_then(|text| text.rsplit_once(OWN_CHECKSUM))
            .and_then(|(body, checksum)| {
                (hex(xxh3_64(body.as_bytes())) == checksum).then_some(body)
            })
            .ok_or_else(|| damaged("its checksum is not that of its content".to_owned()))?;
        let json = format!("{body}\n}}");
        // The format is read first: another one may have other fields.
        #[derive(Deserialize)]
        struct Format {
            format: u32,
        }
        let Format { format: found } =
            serde_json::from_str(&json).map_err(|error| damaged(error.to_string()))?;
        if found != FORMAT {
            return Err(CheckpointError::Format {
                path: path.to_owned(),
                found,
                expected: FORMAT,
            });
        }
        serde_json::from_str(&json).map_err(|error| damaged(error.to_string()))
    }

    /// Checks that every file in `directory` is as it was written.
    pub(super) fn verify(
        &self,
        storage: &impl Storage,
        directory: &Path,
    ) -> Result<(), CheckpointError> {
        for entry in &self.files {
            let path = directory.join(&entry.name);
            let found = ManifestEntry::of(storage, directory, &entry.name)?;
            entry.check(&path, found.bytes, &found.xxh3)?;
        }
        Ok(())
    }

    /// `true` if the checkpoint was written under the configuration with this digest.
    pub(super) fn is_of(&self, config_digest: u64) -> bool {
        self.config_digest == hex(config_digest)
    }

    /// Number of episodes committed, according to the manifest.
    pub(super) fn episodes(&self) -> u64 {
        self.episodes
    }

    /// Reads the file `name` in `directory`, and checks that it is as it was written.
    pub(super) fn read_file(
        &self,
        storage: &impl Storage,
        directory: &Path,
        name: &str,
    ) -> Result<Vec<u8>, CheckpointError> {
        let entry = self
            .files
            .iter()
            .find(|entry| entry.name == name)
            .ok_or_else(|| CheckpointError::Manifest {
                path: directory.join(NAME),
                problem: format!("it does not list {name}"),
            })?;
        let path = directory.join(name);
        let read = storage.read(&path, u64::MAX);
        let content = read.map_err(CheckpointError::io("read", &path))?;
        entry.check(&path, content.len() as u64, &hex(xxh3_64(&content)))?;
        Ok(content)
    }
}

impl ManifestEntry {
    /// Describes the file `name` in `directory`, as it is now.
    fn of(storage: &impl Storage, directory: &Path, name: &str) -> Result<Self, CheckpointError> {
        let path = directory.join(name);
        // In pieces: depth images can be too large to hold twice in memory.
        let mut hasher = Xxh3Default::new();
        let bytes = storage
            .open(&path, u64::MAX)
            .and_then(|file| io::copy(&mut BufReader::with_capacity(PIECE, file), &mut hasher))
            .map_err(CheckpointError::io("read", &path))?;
        Ok(Self {
            name: name.to_owned(),
            bytes,
            xxh3: hex(hasher.digest()),
        })
    }

    /// Compares the file at `path` with its entry.
    fn check(&self, path: &Path, bytes: u64, xxh3: &str) -> Result<(), CheckpointError> {
        let damaged = |what, found, expected| CheckpointError::Damaged {
            path: path.to_owned(),
            what,
            found,
            expected,
        };
        if bytes != self.bytes {
            return Err(damaged(
                "size",
                format!("{bytes} bytes"),
                format!("{} bytes", self.bytes),
            ));
        }
        if xxh3 != self.xxh3 {
            return Err(damaged("checksum", xxh3.to_owned(), self.xxh3.clone()));
        }
        Ok(())
    }
}

fn hex(value: u64) -> String {
    format!("{value:016x}")
}
