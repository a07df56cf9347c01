//! The policy snapshot: the encoder and policy parameters that an actor flies with, as one range of
//! bytes.
//!
//! The parameters lie back to back, f32 little-endian, in the order of [`SnapshotLayout`]. In
//! shared memory a [`SnapshotHeader`] precedes them. On disk they are safetensors with the run's
//! configuration in the metadata, so that the file alone can be flown.

use std::collections::HashMap;
use std::io;
use std::ops::Range;
use std::path::{Path, PathBuf};

use bytemuck::{Pod, Zeroable};
use half::f16;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use sha2::{Digest, Sha256};
use xxhash_rust::xxh3::{Xxh3, xxh3_64};

use crate::ActionSpace;
use crate::config::{AlgorithmName, Config, ObservationLayout};
use crate::encoder_file;
use crate::files::{self, TENSOR_BYTES};
use crate::ids::{PolicyVersion, RunId};

/// Channels of the encoder's four 4×4 convolutions of stride 2; the first entry is the image's
/// (paper, section 3.3; widths as in arXiv:1803.10122).
pub const ENCODER_CHANNELS: [usize; 5] = [1, 32, 64, 128, 256];
/// Width and height of the encoder's kernels.
pub const ENCODER_KERNEL: usize = 4;
/// Length of the last convolution's output: 256 channels of 2×6.
pub const ENCODER_FEATURES: usize = 3072;
/// Fully connected layers of the policy (paper, section 3.4).
pub const POLICY_LAYERS: usize = 4;

/// One parameter tensor within a snapshot.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TensorSpec {
    /// `part.layer.kind`, e.g. `encoder.conv1.weight`.
    pub name: String,
    /// Shape in PyTorch's convention: `[out, in, height, width]`, `[out, in]` or `[out]`.
    pub shape: Vec<usize>,
    /// Position of its f32 values, counted in values.
    pub range: Range<usize>,
}

/// Meaning of a policy's outputs, and so how actions are drawn.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum PolicyHead {
    /// Mean and log standard deviation of a Gaussian squashed by tanh, one each for every number
    /// of the action.
    SquashedGaussian,
    /// The action before tanh. Exploration adds noise of this standard deviation after tanh
    /// and clamps the sum to [-1, 1].
    Noisy(f32),
}

impl PolicyHead {
    /// Returns the number of outputs of a policy with these actions.
    pub fn outputs(self, action: ActionSpace) -> usize {
        match self {
            Self::SquashedGaussian => 2 * action.numbers(),
            Self::Noisy(_) => action.numbers(),
        }
    }
}

/// Names, shapes and positions of the tensors in a snapshot.
#[derive(Debug, Clone, PartialEq)]
pub struct SnapshotLayout {
    tensors: Vec<TensorSpec>,
    encoder_values: usize,
    head: PolicyHead,
}

impl SnapshotLayout {
    /// Returns the layout for policies with this observation, hidden layers of `hidden_width` and a
    /// squashed Gaussian.
    pub fn new(view: &ObservationLayout, hidden_width: usize) -> Self {
        Self::with_head(view, hidden_width, PolicyHead::SquashedGaussian)
    }

    /// Returns the layout for policies with this observation, hidden layers of `hidden_width` and
    /// this head.
    pub fn with_head(view: &ObservationLayout, hidden_width: usize, head: PolicyHead) -> Self {
        let mut layout = Self {
            tensors: Vec::new(),
            encoder_values: 0,
            head,
        };
        for (index, pair) in ENCODER_CHANNELS.windows(2).enumerate() {
            let shape = [pair[1], pair[0], ENCODER_KERNEL, ENCODER_KERNEL];
            layout.push_layer(&format!("encoder.conv{}", index + 1), &shape);
        }
        layout.push_layer("encoder.mean", &[view.latent, ENCODER_FEATURES]);
        layout.encoder_values = layout.values();
        let widths = [
            view.len(),
            hidden_width,
            hidden_width,
            hidden_width,
            head.outputs(view.action),
        ];
        for (index, pair) in widths.windows(2).enumerate() {
            layout.push_layer(&format!("policy.layer{}", index + 1), &[pair[1], pair[0]]);
        }
        layout
    }

    /// Returns the layout for a configuration.
    pub fn of(config: &Config) -> Self {
        let (hidden_width, head) = match config.learning.algorithm {
            AlgorithmName::Sac => (config.sac.hidden_width, PolicyHead::SquashedGaussian),
            AlgorithmName::Distill => (config.distill.hidden_width, PolicyHead::SquashedGaussian),
            AlgorithmName::Td3 => (
                config.td3.hidden_width,
                PolicyHead::Noisy(config.td3.exploration_noise as f32),
            ),
        };
        Self::with_head(&config.observation_layout(), hidden_width, head)
    }

    /// Returns the policy's head.
    pub fn head(&self) -> PolicyHead {
        self.head
    }

    fn push_layer(&mut self, name: &str, weight: &[usize]) {
        self.push(format!("{name}.weight"), weight);
        self.push(format!("{name}.bias"), &weight[..1]);
    }

    fn push(&mut self, name: String, shape: &[usize]) {
        let start = self.values();
        self.tensors.push(TensorSpec {
            name,
            shape: shape.to_vec(),
            range: start..start + shape.iter().product::<usize>(),
        });
    }

    /// Returns the tensors in order.
    pub fn tensors(&self) -> &[TensorSpec] {
        &self.tensors
    }

    /// Returns the tensor of this name.
    pub fn tensor(&self, name: &str) -> Option<&TensorSpec> {
        self.tensors.iter().find(|tensor| tensor.name == name)
    }

    /// Returns the number of values in a snapshot.
    pub fn values(&self) -> usize {
        self.tensors.last().map_or(0, |tensor| tensor.range.end)
    }

    /// Returns the range of the encoder's values, which precede the policy's.
    pub fn encoder(&self) -> Range<usize> {
        0..self.encoder_values
    }

    /// Returns the encoder's tensors, which precede the policy's.
    pub fn encoder_tensors(&self) -> &[TensorSpec] {
        let is_encoders = |tensor: &TensorSpec| tensor.range.end <= self.encoder_values;
        &self.tensors[..self.tensors.partition_point(is_encoders)]
    }

    /// Returns the range of the policy's values.
    pub fn policy(&self) -> Range<usize> {
        self.encoder_values..self.values()
    }

    /// Returns a fingerprint of names and shapes, compared by both ends of the weights service.
    pub fn digest(&self) -> u64 {
        let text: Vec<String> = self
            .tensors
            .iter()
            .map(|t| format!("{}{:?}", t.name, t.shape))
            .collect();
        xxh3_64(text.join(";").as_bytes())
    }
}

/// Header of a snapshot in shared memory.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Pod, Zeroable)]
#[repr(C)]
pub struct SnapshotHeader {
    /// The run.
    pub run: u64,
    /// The policy version.
    pub policy_version: u64,
    /// [`SnapshotLayout::digest`].
    pub layout: u64,
    /// xxh3 of the values' bytes.
    pub checksum: u64,
}

// Four 8-byte fields: no padding.
const _: () = assert!(size_of::<SnapshotHeader>() == 4 * 8);

/// A frozen policy: the parameters of encoder and policy.
#[derive(Debug, Clone, PartialEq)]
pub struct Snapshot {
    /// Policy version.
    pub version: PolicyVersion,
    /// The parameters in the order of the layout.
    pub values: Vec<f32>,
}

/// Reason why a snapshot is refused.
#[derive(Debug, thiserror::Error)]
pub enum SnapshotError {
    /// The snapshot belongs to another run.
    #[error("the snapshot belongs to run {found:016x}, not to {expected:016x}")]
    OtherRun {
        /// The snapshot's run.
        found: u64,
        /// This run.
        expected: u64,
    },
    /// The snapshot has other tensors.
    #[error(
        "the snapshot has another layout: learning.algorithm, its hidden_width, \
        learning.observation, learning.history_steps, vae.latent or simulator.vehicle.action differ"
    )]
    OtherLayout,
    /// The length does not match the layout.
    #[error("the snapshot has {found} bytes, its layout {expected}")]
    Length {
        /// The snapshot's length in bytes.
        found: usize,
        /// The layout's length in bytes.
        expected: usize,
    },
    /// The bytes are damaged.
    #[error("the snapshot's checksum does not match its bytes")]
    Damaged,
    /// A parameter is not finite.
    #[error("the snapshot's tensor {tensor} holds a value that is not finite")]
    NotFinite {
        /// The tensor.
        tensor: String,
    },
    /// The file cannot be read.
    #[error(
        "cannot read the snapshot {}: {source}{}",
        path.display(),
        remedy(source)
    )]
    Read {
        /// The file.
        path: PathBuf,
        /// Cause.
        #[source]
        source: io::Error,
    },
    /// The file cannot be written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// Cause.
        #[source]
        source: io::Error,
    },
    /// The file is not a snapshot of this version.
    #[error("{} is not a snapshot of this version: {problem}", path.display())]
    Format {
        /// The file.
        path: PathBuf,
        /// The problem.
        problem: String,
    },
}

impl Snapshot {
    /// Returns the header that precedes the values.
    pub fn header(&self, run: RunId, layout: &SnapshotLayout) -> SnapshotHeader {
        SnapshotHeader {
            run: run.0,
            policy_version: self.version.0,
            layout: layout.digest(),
            checksum: xxh3_64(bytemuck::cast_slice(&self.values)),
        }
    }

    /// Reads a snapshot from shared memory.
    ///
    /// # Errors
    /// [`SnapshotError`] if it is of another run or layout, or damaged.
    pub fn receive(
        header: &SnapshotHeader,
        bytes: &[u8],
        run: RunId,
        layout: &SnapshotLayout,
    ) -> Result<Self, SnapshotError> {
        if header.run != run.0 {
            return Err(SnapshotError::OtherRun {
                found: header.run,
                expected: run.0,
            });
        }
        if header.layout != layout.digest() {
            return Err(SnapshotError::OtherLayout);
        }
        let expected = layout.values() * size_of::<f32>();
        if bytes.len() != expected {
            return Err(SnapshotError::Length {
                found: bytes.len(),
                expected,
            });
        }
        if xxh3_64(bytes) != header.checksum {
            return Err(SnapshotError::Damaged);
        }
        let snapshot = Self {
            version: PolicyVersion(header.policy_version),
            values: values_of(bytes),
        };
        check_finite(layout.tensors(), &snapshot.values)?;
        Ok(snapshot)
    }

    /// Returns the SHA-256 of the parameters' bytes in hexadecimal: equal exactly if two policies
    /// are bit-equal.
    pub fn sha256(&self) -> String {
        let digest = Sha256::digest(bytemuck::cast_slice::<f32, u8>(&self.values));
        digest.iter().map(|byte| format!("{byte:02x}")).collect()
    }

    /// Returns the snapshot as a safetensors file, with the [portable](Config::portable) `config`
    /// in its metadata.
    ///
    /// # Panics
    /// If the number of values does not match `layout`.
    pub fn to_file(&self, layout: &SnapshotLayout, config: &Config) -> Vec<u8> {
        let (version, config) = (self.version.to_string(), config.portable());
        let digest = checksum(&[&version, &config], &self.values);
        let metadata = HashMap::from([
            (FORMAT_KEY.to_owned(), FORMAT.to_owned()),
            (CHECKSUM_KEY.to_owned(), digest),
            (VERSION_KEY.to_owned(), version),
            (CONFIG_KEY.to_owned(), config),
        ]);
        write_tensors(layout.tensors(), &self.values, Dtype::F32, metadata)
    }

    /// Reads a snapshot file and the configuration it was trained with. That configuration holds
    /// the names of course files, not their folders.
    ///
    /// # Errors
    /// [`SnapshotError`] names the file and the problem.
    pub fn load(path: &Path) -> Result<(Self, Config), SnapshotError> {
        let bytes = files::read(path, TENSOR_BYTES).map_err(|source| SnapshotError::Read {
            path: path.to_owned(),
            source,
        })?;
        Self::parse(&bytes, path)
    }

    /// Reads a snapshot from the `bytes` of a snapshot file. `path` only appears in errors.
    ///
    /// # Errors
    /// The same as [`Snapshot::load`].
    pub fn parse(bytes: &[u8], path: &Path) -> Result<(Self, Config), SnapshotError> {
        parse_file(bytes).map_err(|problem| SnapshotError::Format {
            path: path.to_owned(),
            problem,
        })
    }
}

/// Returns the remedy, if there is one.
fn remedy(error: &io::Error) -> &'static str {
    match error.kind() {
        io::ErrorKind::NotFound => {
            "; name a file such as DIR/snapshots/best.safetensors of a run's directory DIR"
        }
        _ => "",
    }
}

pub(crate) const FORMAT_KEY: &str = "skein.format";
const FORMAT: &str = "policy-snapshot-2";
/// Metadata key of the [`checksum`].
pub(crate) const CHECKSUM_KEY: &str = "skein.checksum";
const VERSION_KEY: &str = "skein.policy_version";
pub(crate) const CONFIG_KEY: &str = "skein.config";

/// Returns the xxh3 of a parameter file's content in hexadecimal. Nothing else detects a flipped
/// bit that leaves finite numbers.
pub(crate) fn checksum(texts: &[&str], values: &[f32]) -> String {
    let mut hasher = Xxh3::new();
    for text in texts {
        hasher.update(&(text.len() as u64).to_le_bytes());
        hasher.update(text.as_bytes());
    }
    hasher.update(bytemuck::cast_slice(values));
    format!("{:016x}", hasher.digest())
}

/// Returns a safetensors file with `tensors` and this metadata.
///
/// # Panics
/// If there are fewer `values` than the tensors hold.
pub(crate) fn write_tensors<T: Pod>(
    tensors: &[TensorSpec],
    values: &[T],
    dtype: Dtype,
    metadata: HashMap<String, String>,
) -> Vec<u8> {
    let views = tensors.iter().map(|tensor| {
        let bytes = bytemuck::cast_slice(&values[tensor.range.clone()]);
        let view = TensorView::new(dtype, tensor.shape.clone(), bytes)
            .expect("a tensor's range is as long as its shape says");
        (tensor.name.clone(), view)
    });
    safetensors::serialize(views, Some(metadata)).expect("names and shapes are plain data")
}

/// A file of named tensors, with a configuration and a checksum in its metadata.
pub(crate) struct ParameterFile<'a> {
    metadata: HashMap<String, String>,
    tensors: SafeTensors<'a>,
}

impl<'a> ParameterFile<'a> {
    /// Reads the names; errors of all methods are the problem alone.
    pub(crate) fn parse(bytes: &'a [u8]) -> Result<Self, String> {
        let (_, metadata) = SafeTensors::read_metadata(bytes).map_err(|error| error.to_string())?;
        let metadata = metadata.metadata().clone().ok_or("it has no metadata")?;
        let tensors = SafeTensors::deserialize(bytes).map_err(|error| error.to_string())?;
        Ok(Self { metadata, tensors })
    }

    /// Returns the text of this metadata key.
    pub(crate) fn text(&self, key: &str) -> Result<&str, String> {
        let text = self.metadata.get(key);
        let text = text.ok_or_else(|| format!("its metadata has no {key}"))?;
        Ok(text)
    }

    /// Returns the valid configuration in the metadata.
    pub(crate) fn config(&self) -> Result<Config, String> {
        let config: Config = toml::from_str(self.text(CONFIG_KEY)?)
            .map_err(|error| format!("its configuration: {error}"))?;
        let valid = config.validate();
        valid.map_err(|error| format!("its configuration: {error}"))?;
        Ok(config)
    }

    /// Returns the finite values of `tensors`, back to back, which the file holds as `dtype`.
    pub(crate) fn values(&self, tensors: &[TensorSpec], dtype: Dtype) -> Result<Vec<f32>, String> {
        let mut values = Vec::new();
        for tensor in tensors {
            let view = self.tensors.tensor(&tensor.name);
            let view = view.map_err(|error| error.to_string())?;
            if view.dtype() != dtype || view.shape() != tensor.shape {
                return Err(format!(
                    "{} is {:?} {:?}, not {dtype:?} {:?}",
                    tensor.name,
                    view.dtype(),
                    view.shape(),
                    tensor.shape
                ));
            }
            match dtype {
                Dtype::F16 => values.extend(halves_of(view.data())),
                _ => values.extend(values_of(view.data())),
            }
        }
        check_finite(tensors, &values).map_err(|error| error.to_string())?;
        Ok(values)
    }

    /// Compares the file's checksum with that of these metadata texts and values.
    pub(crate) fn check(&self, texts: &[&str], values: &[f32]) -> Result<(), String> {
        let (found, expected) = (checksum(texts, values), self.text(CHECKSUM_KEY)?);
        if found == expected {
            return Ok(());
        }
        Err(format!(
            "it is damaged: the checksum of its content is {found}, expected {expected}"
        ))
    }
}

fn parse_file(bytes: &[u8]) -> Result<(Snapshot, Config), String> {
    let file = ParameterFile::parse(bytes)?;
    let format = file.text(FORMAT_KEY)?;
    if format == encoder_file::FORMAT {
        return Err("it holds an encoder alone, for vae.start_from".to_owned());
    }
    if format != FORMAT {
        return Err(format!("its format is {format}, not {FORMAT}"));
    }
    let version = file.text(VERSION_KEY)?;
    let number = version.parse();
    let number = number.map_err(|_| format!("its {VERSION_KEY} is not a number"))?;
    let config = file.config()?;
    let values = file.values(SnapshotLayout::of(&config).tensors(), Dtype::F32)?;
    file.check(&[version, file.text(CONFIG_KEY)?], &values)?;
    let version = PolicyVersion(number);
    Ok((Snapshot { version, values }, config))
}

fn check_finite(tensors: &[TensorSpec], values: &[f32]) -> Result<(), SnapshotError> {
    let broken = |tensor: &&TensorSpec| {
        let values = &values[tensor.range.clone()];
        values.iter().any(|value| !value.is_finite())
    };
    match tensors.iter().find(broken) {
        Some(tensor) => Err(SnapshotError::NotFinite {
            tensor: tensor.name.clone(),
        }),
        None => Ok(()),
    }
}

/// Reads f32 values from bytes that need not be aligned.
fn values_of(bytes: &[u8]) -> Vec<f32> {
    bytes
        .chunks_exact(4)
        .map(|chunk| f32::from_le_bytes([chunk[0], chunk[1], chunk[2], chunk[3]]))
        .collect()
}

/// Reads values of half precision from bytes that need not be aligned.
fn halves_of(bytes: &[u8]) -> impl Iterator<Item = f32> {
    let (halves, _) = bytes.as_chunks();
    halves.iter().map(|half| f16::from_le_bytes(*half).to_f32())
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::config::Observation;

    fn view() -> ObservationLayout {
        ObservationLayout::present(Observation::LatentVelocity, 32)
    }

    fn snapshot(layout: &SnapshotLayout) -> Snapshot {
        let values = (0..layout.values())
            .map(|index| (index as f32).sin())
            .collect();
        Snapshot {
            version: PolicyVersion(12),
            values,
        }
    }

    #[test]
    fn tensors_lie_back_to_back_and_encoder_before_policy() {
        let layout = SnapshotLayout::new(&view(), 256);
        let mut end = 0;
        for tensor in layout.tensors() {
            assert_eq!(tensor.range.start, end);
            end = tensor.range.end;
        }
        assert_eq!(layout.encoder(), 0..787_456);
        assert_eq!(
            layout.policy().len(),
            34 * 256 + 256 + 2 * (256 * 256 + 256) + 256 * 4 + 4
        );
    }

    #[test]
    fn a_received_snapshot_is_the_one_sent() {
        let layout = SnapshotLayout::new(&view(), 64);
        let sent = snapshot(&layout);
        let header = sent.header(RunId(1), &layout);
        let bytes = bytemuck::cast_slice(&sent.values);
        assert_eq!(
            Snapshot::receive(&header, bytes, RunId(1), &layout).unwrap(),
            sent
        );
    }

    #[test]
    fn a_foreign_damaged_or_poisoned_snapshot_is_refused() {
        let layout = SnapshotLayout::new(&view(), 64);
        let mut sent = snapshot(&layout);
        let header = sent.header(RunId(1), &layout);
        let mut bytes = bytemuck::cast_slice(&sent.values).to_vec();
        let receive = |bytes: &[u8], run, layout: &SnapshotLayout| {
            Snapshot::receive(&header, bytes, run, layout)
        };
        assert!(matches!(
            receive(&bytes, RunId(2), &layout),
            Err(SnapshotError::OtherRun { .. })
        ));
        // A shorter observation, and a longer code with the same observation length.
        for (per_step, latent) in [(Observation::Latent, 32), (Observation::Latent, 34)] {
            let other = SnapshotLayout::new(&ObservationLayout::present(per_step, latent), 64);
            assert!(matches!(
                receive(&bytes, RunId(1), &other),
                Err(SnapshotError::OtherLayout)
            ));
        }
        assert!(matches!(
            receive(&bytes[4..], RunId(1), &layout),
            Err(SnapshotError::Length { .. })
        ));
        bytes[1000] ^= 1;
        assert!(matches!(
            receive(&bytes, RunId(1), &layout),
            Err(SnapshotError::Damaged)
        ));
        sent.values[5] = f32::NAN;
        let header = sent.header(RunId(1), &layout);
        let poisoned = Snapshot::receive(
            &header,
            bytemuck::cast_slice(&sent.values),
            RunId(1),
            &layout,
        );
        assert!(
            poisoned
                .unwrap_err()
                .to_string()
                .contains("encoder.conv1.weight")
        );
    }

    #[test]
    fn a_file_holds_the_snapshot_and_its_configuration() {
        let mut config = Config::default();
        config.sac.hidden_width = 64;
        let layout = SnapshotLayout::of(&config);
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("best.safetensors");
        let saved = snapshot(&layout);
        fs::write(&path, saved.to_file(&layout, &config)).unwrap();
        let (loaded, loaded_config) = Snapshot::load(&path).unwrap();
        assert_eq!(loaded, saved);
        assert_eq!(loaded.sha256(), saved.sha256());
        assert_eq!(loaded_config.portable(), config.portable());
        assert_eq!(
            loaded_config.courses.training.as_os_str(),
            "training.toml",
            "the file names no folder"
        );
        let sound = fs::read(&path).unwrap();
        // The whole header, where a bit may change a name or a position, and a thousand positions
        // among the parameters.
        let header = 8 + u64::from_le_bytes(*sound.first_chunk().unwrap()) as usize;
        let parameters = (header..sound.len()).step_by((sound.len() - header) / 1000);
        for index in (0..header).chain(parameters) {
            let mut damaged = sound.clone();
            damaged[index] ^= 1 << (index % 8);
            let refused = Snapshot::parse(&damaged, &path);
            assert!(refused.is_err(), "byte {index} of {}", sound.len());
        }
        let mut bytes = sound;
        bytes.truncate(bytes.len() - 1);
        fs::write(&path, bytes).unwrap();
        assert!(
            Snapshot::load(&path)
                .unwrap_err()
                .to_string()
                .contains("best.safetensors")
        );
    }
}
