//! An encoder on disk: trained ahead of any run, or taken from a snapshot.
//!
//! The file is safetensors, as a snapshot is, with the encoder's tensors alone.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use safetensors::Dtype;
use sha2::{Digest, Sha256};

use crate::config::Config;
use crate::files::{self, TENSOR_BYTES};
use crate::snapshot::{
    CHECKSUM_KEY, CONFIG_KEY, FORMAT_KEY, ParameterFile, Snapshot, SnapshotError, SnapshotLayout,
    checksum, write_tensors,
};

pub(crate) const FORMAT: &str = "encoder-1";
/// Metadata key of the number of VAE steps that trained the encoder.
const STEPS_KEY: &str = "skein.steps";
/// Metadata key of the version of the program that trained it.
const VERSION_KEY: &str = "skein.version";

/// The parameters of an encoder, frozen.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainedEncoder {
    /// Convolutions and mean head, in the order of [`SnapshotLayout::encoder`].
    pub values: Vec<f32>,
    /// Length of its latent code.
    pub latent: usize,
}

/// Reason why a run cannot start from an encoder.
#[derive(Debug, thiserror::Error)]
pub enum EncoderError {
    /// The file cannot be read, or holds no encoder.
    #[error(
        "vae.start_from: {source}; name a file that launch/encoder.sh wrote, or a snapshot of this \
        version"
    )]
    File {
        /// Path and problem.
        #[source]
        source: SnapshotError,
    },
    /// The encoder's code has another length.
    #[error(
        "vae.start_from: {} holds an encoder for codes of {found} numbers, but vae.latent = \
        {expected}: set vae.latent to {found}, or name another file", path.display()
    )]
    Latent {
        /// The file.
        path: PathBuf,
        /// Length of the encoder's code.
        found: usize,
        /// Configured length.
        expected: usize,
    },
}

impl TrainedEncoder {
    /// Reads the encoder that `config` starts from; `None` if it names none.
    ///
    /// # Errors
    /// [`EncoderError`] names file, key and remedy.
    pub fn of(config: &Config) -> Result<Option<Self>, EncoderError> {
        let Some(path) = &config.vae.start_from else {
            return Ok(None);
        };
        let encoder = Self::load(path).map_err(|source| EncoderError::File { source })?;
        if encoder.latent != config.vae.latent {
            return Err(EncoderError::Latent {
                path: path.clone(),
                found: encoder.latent,
                expected: config.vae.latent,
            });
        }
        Ok(Some(encoder))
    }

    /// Reads an encoder's file, or the encoder of a snapshot's file.
    ///
    /// # Errors
    /// [`SnapshotError`] names the file and the problem.
    pub fn load(path: &Path) -> Result<Self, SnapshotError> {
        let bytes = files::read(path, TENSOR_BYTES).map_err(|source| SnapshotError::Io {
            path: path.to_owned(),
            source,
        })?;
        Self::parse(&bytes, path)
    }

    /// Reads an encoder from the `bytes` of a file. `path` only appears in errors.
    ///
    /// # Errors
    /// The same as [`TrainedEncoder::load`].
    pub fn parse(bytes: &[u8], path: &Path) -> Result<Self, SnapshotError> {
        let format = |problem| SnapshotError::Format {
            path: path.to_owned(),
            problem,
        };
        let file = ParameterFile::parse(bytes).map_err(format)?;
        if file.text(FORMAT_KEY).map_err(format)? == FORMAT {
            return Self::parse_file(&file).map_err(format);
        }
        let (snapshot, config) = Snapshot::parse(bytes, path)?;
        Ok(Self::of_snapshot(&snapshot, &config))
    }

    /// Returns the encoder of a snapshot with `config`.
    ///
    /// # Panics
    /// If the snapshot has fewer values than `config` says.
    pub fn of_snapshot(snapshot: &Snapshot, config: &Config) -> Self {
        let encoder = SnapshotLayout::of(config).encoder();
        Self {
            values: snapshot.values[encoder].to_vec(),
            latent: config.vae.latent,
        }
    }

    fn parse_file(file: &ParameterFile<'_>) -> Result<Self, String> {
        let config = file.config()?;
        let layout = SnapshotLayout::of(&config);
        let values = file.values(layout.encoder_tensors(), Dtype::F32)?;
        let texts = [STEPS_KEY, VERSION_KEY, CONFIG_KEY].map(|key| file.text(key));
        let [steps, version, config_text] = texts;
        file.check(&[steps?, version?, config_text?], &values)?;
        Ok(Self {
            values,
            latent: config.vae.latent,
        })
    }

    /// Returns the encoder as a safetensors file. `config`: the configuration that it was trained
    /// with, `steps`: its VAE steps.
    ///
    /// # Panics
    /// If the number of values does not match `config`.
    pub fn to_file(&self, config: &Config, steps: u64) -> Vec<u8> {
        let (steps, config_text) = (steps.to_string(), config.portable());
        let version = env!("CARGO_PKG_VERSION");
        let digest = checksum(&[&steps, version, &config_text], &self.values);
        let metadata = HashMap::from([
            (FORMAT_KEY.to_owned(), FORMAT.to_owned()),
            (CHECKSUM_KEY.to_owned(), digest),
            (STEPS_KEY.to_owned(), steps),
            (VERSION_KEY.to_owned(), version.to_owned()),
            (CONFIG_KEY.to_owned(), config_text),
        ]);
        let layout = SnapshotLayout::of(config);
        write_tensors(layout.encoder_tensors(), &self.values, Dtype::F32, metadata)
    }

    /// Returns the SHA-256 of the parameters' bytes in hexadecimal.
    pub fn sha256(&self) -> String {
        let digest = Sha256::digest(bytemuck::cast_slice::<f32, u8>(&self.values));
        digest.iter().map(|byte| format!("{byte:02x}")).collect()
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::ids::PolicyVersion;

    fn config() -> Config {
        let mut config = Config::default();
        config.vae.latent = 8;
        config.sac.hidden_width = 8;
        config
    }

    fn encoder(config: &Config) -> TrainedEncoder {
        let len = SnapshotLayout::of(config).encoder().len();
        TrainedEncoder {
            values: (0..len).map(|index| (index as f32).sin()).collect(),
            latent: config.vae.latent,
        }
    }

    #[test]
    fn an_encoder_is_read_from_its_own_file_and_from_any_snapshot() {
        let (config, path) = (config(), Path::new("e.safetensors"));
        let written = encoder(&config);
        let file = written.to_file(&config, 7);
        assert_eq!(TrainedEncoder::parse(&file, path).unwrap(), written);

        let layout = SnapshotLayout::of(&config);
        let mut values = written.values.clone();
        values.resize(layout.values(), 0.5);
        let version = PolicyVersion(3);
        let snapshot = Snapshot { version, values }.to_file(&layout, &config);
        assert_eq!(TrainedEncoder::parse(&snapshot, path).unwrap(), written);
    }

    #[test]
    fn a_damaged_or_foreign_file_is_refused_by_name() {
        let (config, path) = (config(), Path::new("e.safetensors"));
        let sound = encoder(&config).to_file(&config, 7);
        let header = 8 + u64::from_le_bytes(*sound.first_chunk().unwrap()) as usize;
        let parameters = (header..sound.len()).step_by((sound.len() - header) / 1000);
        for index in (0..header).chain(parameters) {
            let mut damaged = sound.clone();
            damaged[index] ^= 1 << (index % 8);
            let refused = TrainedEncoder::parse(&damaged, path);
            assert!(refused.is_err(), "byte {index} of {}", sound.len());
        }
        let mut poisoned = encoder(&config);
        poisoned.values[5] = f32::NAN;
        let error = TrainedEncoder::parse(&poisoned.to_file(&config, 7), path).unwrap_err();
        for part in ["e.safetensors", "encoder.conv1.weight"] {
            assert!(error.to_string().contains(part), "{error}");
        }
    }

    #[test]
    fn an_encoder_that_does_not_fit_is_refused_by_file_key_and_remedy() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("e.safetensors");
        let mut config = config();
        assert_eq!(TrainedEncoder::of(&config).unwrap(), None);
        (config.vae.train_steps, config.vae.start_from) = (0, Some(path.clone()));
        let refused = |config: &Config, parts: [&str; 3]| {
            let error = TrainedEncoder::of(config).unwrap_err().to_string();
            for part in parts.into_iter().chain([path.to_str().unwrap()]) {
                assert!(error.contains(part), "`{part}` is missing in `{error}`");
            }
        };
        refused(
            &config,
            ["vae.start_from", "No such file", "launch/encoder.sh"],
        );
        fs::write(&path, "no tensors").unwrap();
        refused(
            &config,
            ["vae.start_from", "not a snapshot", "launch/encoder.sh"],
        );
        fs::write(&path, encoder(&config).to_file(&config, 7)).unwrap();
        assert!(TrainedEncoder::of(&config).unwrap().is_some());
        config.vae.latent = 16;
        refused(
            &config,
            ["vae.start_from", "codes of 8", "set vae.latent to 8"],
        );
    }
}
