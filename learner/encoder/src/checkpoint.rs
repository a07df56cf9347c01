//! State of a training, from which it resumes to the same bits.
//!
//! The file is a checksum of eight bytes and then safetensors: parameters and Adam's moments, the
//! curve so far, and the configuration in the metadata.

use std::collections::HashMap;
use std::io;
use std::path::Path;

use anyhow::{Context, Result, ensure};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use skein_learner::state::{NamedTensor, TensorValues};
use skein_protocol::config::Config;
use skein_protocol::files::{self, TENSOR_BYTES};
use skein_run::durable;
use xxhash_rust::xxh3::xxh3_64;

use crate::curve::{COLUMNS, CurvePoint};

const CONFIG_KEY: &str = "config";
const CURVE: &str = "curve";

/// A restorable state, between two steps.
#[derive(Debug, PartialEq)]
pub(crate) struct Checkpoint {
    /// Networks and optimizer.
    pub(crate) tensors: Vec<NamedTensor>,
    /// Points of the curve so far.
    pub(crate) curve: Vec<CurvePoint>,
}

impl Checkpoint {
    /// Writes the state of a training with `config` to `path`, atomically.
    ///
    /// # Errors
    /// Errors of the file system; `path` keeps its content then.
    pub(crate) fn save(&self, path: &Path, config: &Config) -> Result<()> {
        let file = self.to_file(config);
        durable::replace(path, &file).with_context(|| path.display().to_string())
    }

    /// Reads the state of a training with `config` from `path`; `None` if there is none.
    ///
    /// # Errors
    /// Names the file, the problem and the remedy.
    pub(crate) fn load(path: &Path, config: &Config) -> Result<Option<Self>> {
        let read = match files::read(path, TENSOR_BYTES) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            read => read.map_err(anyhow::Error::from),
        };
        read.and_then(|bytes| Self::parse(&bytes, config))
            .map(Some)
            .with_context(|| {
                format!(
                    "cannot resume from {}: remove it to start over, or give another --output",
                    path.display()
                )
            })
    }

    fn to_file(&self, config: &Config) -> Vec<u8> {
        let points: Vec<f64> = self.curve.iter().copied().flatten().collect();
        let shape = vec![self.curve.len(), COLUMNS];
        let curve = (CURVE, Dtype::F64, shape, bytemuck::cast_slice(&points));
        let networks = self.tensors.iter().map(|tensor| {
            let (dtype, bytes): (_, &[u8]) = match &tensor.values {
                TensorValues::F32(values) => (Dtype::F32, bytemuck::cast_slice(values)),
                TensorValues::F64(values) => (Dtype::F64, bytemuck::cast_slice(values)),
                TensorValues::I64(values) => (Dtype::I64, bytemuck::cast_slice(values)),
            };
            (tensor.name.as_str(), dtype, tensor.shape.clone(), bytes)
        });
        let views = networks.chain([curve]).map(|(name, dtype, shape, bytes)| {
            let view = TensorView::new(dtype, shape, bytes);
            (name, view.expect("a tensor is as long as its shape says"))
        });
        let metadata = HashMap::from([(CONFIG_KEY.to_owned(), config.portable())]);
        let tensors =
            safetensors::serialize(views, Some(metadata)).expect("names and shapes are plain data");
        [&xxh3_64(&tensors).to_le_bytes()[..], &tensors].concat()
    }

    fn parse(bytes: &[u8], config: &Config) -> Result<Self> {
        let (checksum, file) = bytes.split_first_chunk().context("it is cut short")?;
        ensure!(
            u64::from_le_bytes(*checksum) == xxh3_64(file),
            "it is damaged: its checksum does not match"
        );
        let (_, metadata) = SafeTensors::read_metadata(file)?;
        let metadata = metadata.metadata().as_ref();
        let there = metadata.and_then(|metadata| metadata.get(CONFIG_KEY));
        let there = there.context("it names no configuration")?;
        let differences = config.differences(there)?;
        ensure!(
            differences.is_empty(),
            "it belongs to another configuration: {}",
            differences.join(", ")
        );
        let (mut tensors, mut curve) = (Vec::new(), Vec::new());
        for (name, view) in SafeTensors::deserialize(file)?.tensors() {
            let values = match view.dtype() {
                Dtype::F32 => TensorValues::F32(bytemuck::pod_collect_to_vec(view.data())),
                Dtype::F64 => TensorValues::F64(bytemuck::pod_collect_to_vec(view.data())),
                Dtype::I64 => TensorValues::I64(bytemuck::pod_collect_to_vec(view.data())),
                other => anyhow::bail!("{name} is {other:?}"),
            };
            match values {
                TensorValues::F64(points) if name == CURVE => {
                    let (points, rest) = points.as_chunks();
                    ensure!(rest.is_empty(), "its curve is cut short");
                    curve = points.to_vec();
                }
                values => tensors.push(NamedTensor {
                    name,
                    shape: view.shape().to_vec(),
                    values,
                }),
            }
        }
        Ok(Self { tensors, curve })
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn a_checkpoint_is_read_as_written_and_refused_when_damaged_or_foreign() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("mine.checkpoint");
        let config = Config::default();
        assert_eq!(Checkpoint::load(&path, &config).unwrap(), None);
        let tensor = |name: &str, values| NamedTensor {
            name: name.to_owned(),
            shape: vec![2],
            values,
        };
        let checkpoint = Checkpoint {
            tensors: vec![
                tensor("a", TensorValues::F32(vec![1.0, -0.5])),
                tensor("b", TensorValues::I64(vec![3, 4])),
            ],
            curve: vec![[1.0; COLUMNS], [2.5; COLUMNS]],
        };
        checkpoint.save(&path, &config).unwrap();
        let mut read = Checkpoint::load(&path, &config).unwrap().unwrap();
        read.tensors.sort_by(|a, b| a.name.cmp(&b.name));
        assert_eq!(read, checkpoint);

        let refused = |config: &Config, problem: &str| {
            let error = format!("{:#}", Checkpoint::load(&path, config).unwrap_err());
            for part in ["mine.checkpoint", "remove it", problem] {
                assert!(error.contains(part), "{error}");
            }
        };
        let mut other = config.clone();
        other.run.seed = 9;
        refused(&other, "run.seed = 1 there, 9 here");
        let mut damaged = fs::read(&path).unwrap();
        *damaged.last_mut().unwrap() ^= 1;
        fs::write(&path, &damaged).unwrap();
        refused(&config, "damaged");
        fs::write(&path, &damaged[..3]).unwrap();
        refused(&config, "cut short");
    }
}
