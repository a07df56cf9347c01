//! Conversion of a checkpoint's state to files and back.

use std::borrow::Cow;
use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use safetensors::tensor::{Dtype, SafeTensors, TensorView, View};
use skein_protocol::ids::PolicyVersion;
use skein_protocol::snapshot::Snapshot;
use skein_protocol::{IMAGE_HEIGHT, IMAGE_PIXELS, IMAGE_WIDTH};
use skein_run::fault::{FaultPoint, die_if_armed};

use super::manifest::Manifest;
use super::{CheckpointError, CheckpointState, Storage, TrainingProgress};
use crate::replay::{ReplayState, RingState};
use crate::state::{NamedTensor, TensorValues};

const TENSORS: &str = "tensors.safetensors";
const REPLAY: &str = "replay.safetensors";
const SNAPSHOTS: &str = "snapshots.safetensors";
const PROGRESS: &str = "progress.bin";
/// File of the configuration.
pub(super) const CONFIG: &str = "config.toml";
/// All files except the manifest.
pub(super) const NAMES: [&str; 5] = [TENSORS, REPLAY, SNAPSHOTS, PROGRESS, CONFIG];

/// Bytes that decoding `progress.bin` may allocate: two windows of a million episodes, and the
/// rest. It stops a damaged length.
const PROGRESS_LIMIT: usize = 64 << 20;

// Safetensors are little-endian, and values are written as they lie in memory.
const _: () = assert!(cfg!(target_endian = "little"));

/// Content of `progress.bin`: counters, and the numbers of the replay buffer that are not tensors.
#[derive(serde::Serialize, serde::Deserialize)]
struct ProgressFile {
    progress: TrainingProgress,
    success_inserted: u64,
    regular_inserted: u64,
    /// Number of image blocks in the replay buffer; `None` once the VAE is frozen.
    image_blocks: Option<u64>,
}

/// Writes all files except the manifest into `directory`. `config`: the portable configuration.
pub(super) fn write(
    storage: &impl Storage,
    directory: &Path,
    state: &CheckpointState,
    config: &str,
) -> Result<(), CheckpointError> {
    let tensors = state
        .tensors
        .iter()
        .map(|tensor| (tensor.name.clone(), BorrowedTensor::of(tensor)))
        .collect();
    write_tensors(storage, &directory.join(TENSORS), tensors)?;
    die_if_armed(FaultPoint::CheckpointTensors);
    write_tensors(
        storage,
        &directory.join(REPLAY),
        replay_tensors(&state.replay),
    )?;
    die_if_armed(FaultPoint::CheckpointReplay);
    let snapshots = state
        .snapshots
        .iter()
        .map(|snapshot| {
            (
                snapshot.version.to_string(),
                BorrowedTensor::flat(Dtype::F32, &snapshot.values),
            )
        })
        .collect();
    write_tensors(storage, &directory.join(SNAPSHOTS), snapshots)?;
    let progress = ProgressFile {
        progress: state.progress.clone(),
        success_inserted: state.replay.success.inserted,
        regular_inserted: state.replay.regular.inserted,
        image_blocks: state
            .replay
            .images
            .as_ref()
            .map(|blocks| blocks.len() as u64),
    };
    let bytes = bincode::serde::encode_to_vec(&progress, bincode::config::standard())
        .expect("progress consists of numbers, texts and lists of them");
    write_bytes(storage, &directory.join(PROGRESS), &bytes)?;
    write_bytes(storage, &directory.join(CONFIG), config.as_bytes())?;
    die_if_armed(FaultPoint::CheckpointProgress);
    Ok(())
}

/// Writes a file that only the user can read.
pub(super) fn write_bytes(
    storage: &impl Storage,
    path: &Path,
    bytes: &[u8],
) -> Result<(), CheckpointError> {
    let written = storage.write(path, bytes);
    written.map_err(CheckpointError::io("write", path))
}

/// Reads the files that [`write`] wrote, each checked against `manifest`.
pub(super) fn read(
    storage: &impl Storage,
    directory: &Path,
    manifest: &Manifest,
) -> Result<CheckpointState, CheckpointError> {
    let path = directory.join(PROGRESS);
    let bytes = manifest.read_file(storage, directory, PROGRESS)?;
    let file =
        parse_progress(&bytes).map_err(|problem| CheckpointError::Content { path, problem })?;
    let open = |name| TensorFile::open(storage, directory, name, manifest);
    let replay = read_replay(&open(REPLAY)?, &file)?;
    Ok(CheckpointState {
        progress: file.progress,
        tensors: read_tensors(&open(TENSORS)?)?,
        replay,
        snapshots: read_snapshots(&open(SNAPSHOTS)?)?,
    })
}

fn parse_progress(bytes: &[u8]) -> Result<ProgressFile, String> {
    let limited = bincode::config::standard().with_limit::<PROGRESS_LIMIT>();
    let (file, read) =
        bincode::serde::decode_from_slice(bytes, limited).map_err(|error| error.to_string())?;
    match bytes.len() - read {
        0 => Ok(file),
        more => Err(format!("{more} bytes follow its expected end")),
    }
}

fn read_snapshots(stored: &TensorFile) -> Result<Vec<Snapshot>, CheckpointError> {
    let tensors = stored.tensors()?;
    let mut snapshots = Vec::new();
    for name in tensors.names() {
        let version = name
            .parse()
            .map_err(|_| stored.unusable(format!("{name} is not a snapshot's version")))?;
        let values = stored.tensor(&tensors, name, Dtype::F32)?;
        snapshots.push(Snapshot {
            version: PolicyVersion(version),
            values: bytemuck::allocation::pod_collect_to_vec(values.data()),
        });
    }
    snapshots.sort_by_key(|snapshot| snapshot.version);
    Ok(snapshots)
}

fn replay_tensors(replay: &ReplayState) -> Vec<(String, BorrowedTensor<'_>)> {
    let mut tensors = Vec::new();
    for (part, ring) in [("success", &replay.success), ("regular", &replay.regular)] {
        tensors.push((
            format!("{part}.rows"),
            BorrowedTensor::flat(Dtype::F32, &ring.rows),
        ));
        tensors.push((
            format!("{part}.images"),
            BorrowedTensor::flat(Dtype::U32, &ring.images),
        ));
    }
    for (number, block) in replay.images.iter().flatten().enumerate() {
        let shape = vec![block.len() / IMAGE_PIXELS, IMAGE_HEIGHT, IMAGE_WIDTH];
        tensors.push((
            block_name(number as u64),
            BorrowedTensor {
                dtype: Dtype::U8,
                shape,
                bytes: block,
            },
        ));
    }
    tensors
}

fn read_replay(stored: &TensorFile, file: &ProgressFile) -> Result<ReplayState, CheckpointError> {
    let tensors = stored.tensors()?;
    let ring = |part: &str, inserted| {
        let rows = stored.tensor(&tensors, &format!("{part}.rows"), Dtype::F32)?;
        let images = stored.tensor(&tensors, &format!("{part}.images"), Dtype::U32)?;
        Ok(RingState {
            inserted,
            rows: bytemuck::allocation::pod_collect_to_vec(rows.data()),
            images: bytemuck::allocation::pod_collect_to_vec(images.data()),
        })
    };
    let block = |number| {
        Ok(Arc::new(
            stored
                .tensor(&tensors, &block_name(number), Dtype::U8)?
                .data()
                .to_vec(),
        ))
    };
    Ok(ReplayState {
        success: ring("success", file.success_inserted)?,
        regular: ring("regular", file.regular_inserted)?,
        images: file
            .image_blocks
            .map(|blocks| (0..blocks).map(block).collect::<Result<_, _>>())
            .transpose()?,
    })
}

fn block_name(number: u64) -> String {
    format!("images.{number:06}")
}

fn write_tensors(
    storage: &impl Storage,
    path: &Path,
    tensors: Vec<(String, BorrowedTensor<'_>)>,
) -> Result<(), CheckpointError> {
    let mut names = HashSet::new();
    if let Some((name, _)) = tensors.iter().find(|(name, _)| !names.insert(name)) {
        let problem = format!("two tensors are called {name}, and one would be lost");
        return Err(CheckpointError::Content {
            path: path.to_owned(),
            problem,
        });
    }
    storage
        .write_tensors(path, tensors)
        .map_err(|error| match error {
            safetensors::SafeTensorError::IoError(source) => {
                CheckpointError::io("write", path)(source)
            }
            other => CheckpointError::Content {
                path: path.to_owned(),
                problem: other.to_string(),
            },
        })
}

fn read_tensors(stored: &TensorFile) -> Result<Vec<NamedTensor>, CheckpointError> {
    let mut named = Vec::new();
    for (name, view) in stored.tensors()?.iter() {
        let bytes = view.data();
        let values = match view.dtype() {
            Dtype::F32 => TensorValues::F32(bytemuck::allocation::pod_collect_to_vec(bytes)),
            Dtype::F64 => TensorValues::F64(bytemuck::allocation::pod_collect_to_vec(bytes)),
            Dtype::I64 => TensorValues::I64(bytemuck::allocation::pod_collect_to_vec(bytes)),
            other => {
                return Err(stored.unusable(format!("tensor {name} has values of type {other:?}")));
            }
        };
        named.push(NamedTensor {
            name: name.to_owned(),
            shape: view.shape().to_vec(),
            values,
        });
    }
    // The file orders tensors by type and does not keep the given order, so one is chosen here.
    named.sort_by(|left, right| left.name.cmp(&right.name));
    Ok(named)
}

/// A safetensors file in memory, its checksum verified.
struct TensorFile {
    path: PathBuf,
    bytes: Vec<u8>,
}

impl TensorFile {
    fn open(
        storage: &impl Storage,
        directory: &Path,
        name: &str,
        manifest: &Manifest,
    ) -> Result<Self, CheckpointError> {
        Ok(Self {
            path: directory.join(name),
            bytes: manifest.read_file(storage, directory, name)?,
        })
    }

    fn tensors(&self) -> Result<SafeTensors<'_>, CheckpointError> {
        SafeTensors::deserialize(&self.bytes).map_err(|error| self.unusable(error.to_string()))
    }

    fn tensor<'a>(
        &self,
        tensors: &SafeTensors<'a>,
        name: &str,
        dtype: Dtype,
    ) -> Result<TensorView<'a>, CheckpointError> {
        let view = tensors
            .tensor(name)
            .map_err(|error| self.unusable(error.to_string()))?;
        if view.dtype() != dtype {
            let found = view.dtype();
            return Err(self.unusable(format!(
                "tensor {name} has values of type {found:?} instead of {dtype:?}"
            )));
        }
        Ok(view)
    }

    fn unusable(&self, problem: String) -> CheckpointError {
        CheckpointError::Content {
            path: self.path.clone(),
            problem,
        }
    }
}

/// Values as they lie in memory, written to the file without a copy.
struct BorrowedTensor<'a> {
    dtype: Dtype,
    shape: Vec<usize>,
    bytes: &'a [u8],
}

impl<'a> BorrowedTensor<'a> {
    fn of(tensor: &'a NamedTensor) -> Self {
        let (dtype, bytes) = match &tensor.values {
            TensorValues::F32(values) => (Dtype::F32, bytemuck::cast_slice(values)),
            TensorValues::F64(values) => (Dtype::F64, bytemuck::cast_slice(values)),
            TensorValues::I64(values) => (Dtype::I64, bytemuck::cast_slice(values)),
        };
        Self {
            dtype,
            shape: tensor.shape.clone(),
            bytes,
        }
    }

    fn flat<T: bytemuck::Pod>(dtype: Dtype, values: &'a [T]) -> Self {
        Self {
            dtype,
            shape: vec![values.len()],
            bytes: bytemuck::cast_slice(values),
        }
    }
}

impl View for BorrowedTensor<'_> {
    fn dtype(&self) -> Dtype {
        self.dtype
    }

    fn shape(&self) -> &[usize] {
        &self.shape
    }

    fn data(&self) -> Cow<'_, [u8]> {
        Cow::Borrowed(self.bytes)
    }

    fn data_len(&self) -> usize {
        self.bytes.len()
    }
}
