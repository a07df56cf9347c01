//! Files that a learner resumes from: each file of a checkpoint under a matching manifest, so that
//! the code behind the checksums is reached; and the metrics that it continues.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, LazyLock};

use skein_learner::checkpoint::{
    CheckpointState, CheckpointStore, EpochOrder, TrainingProgress, checkpoint_directory,
};
use skein_learner::disk::Disk;
use skein_learner::episodes::assembly::KeptData;
use skein_learner::metrics::{EpisodeRow, EpisodesCsv, EventFile, EventWriter};
use skein_learner::replay::Replay;
use skein_learner::state::{NamedTensor, StatePart, Stateful, TensorValues};
use skein_protocol::config::Config;
use skein_protocol::ids::PolicyVersion;
use skein_protocol::snapshot::Snapshot;
use skein_protocol::ticket::Exploration;
use skein_protocol::transition::Outcome;
use tch::Tensor;
use tempfile::TempDir;

use super::replay::{config, episode};
use super::{ReaderDecision, Target, USUAL, tagged};
use crate::scratch::{folder, with_files};

pub(super) const FILES: Target = Target {
    name: "checkpoint",
    reads: "the files of a checkpoint, selected by the first byte (only the header of tensors); \
            what is loaded is used",
    longest_bytes: 4096,
    weight: USUAL / 4,
    samples,
    run: checkpoint,
};

pub(super) const EPISODES_CSV: Target = Target {
    name: "episodes_csv",
    reads: "episodes.csv, after a byte with the number of episodes to continue from",
    longest_bytes: 2048,
    weight: USUAL / 2,
    samples: csv_samples,
    run: episodes_csv,
};

pub(super) const EVENT_FILES: Target = Target {
    name: "event_files",
    reads: "names and lengths of the event files of a checkpoint, one per line",
    longest_bytes: 256,
    weight: USUAL / 5,
    samples: || {
        vec![
            b"events.out.tfevents.1.skein.000000 4\nevents.out.tfevents.2.skein.000000 1".to_vec(),
            b"../outside 0".to_vec(),
        ]
    },
    run: event_files,
};

/// Number of episodes before the checkpoint.
const EPISODES: u64 = 7;
/// Files that the first byte of an input selects. The configuration is only read to report
/// differences; the manifest is read first of all.
const FILE_NAMES: [&str; 6] = [
    "tensors.safetensors",
    "replay.safetensors",
    "snapshots.safetensors",
    "progress.bin",
    "config.toml",
    "manifest.json",
];

/// Returns a small state with all kinds of content.
fn state() -> CheckpointState {
    let mut replay = Replay::new(&config());
    replay.insert(episode()).unwrap();
    let tensor = |name: &str, shape: &[usize], values| NamedTensor {
        name: name.to_owned(),
        shape: shape.to_vec(),
        values,
    };
    CheckpointState {
        progress: TrainingProgress {
            episodes: EPISODES,
            epochs: 2,
            version: 2,
            in_flight: vec![EpochOrder {
                epoch: 2,
                policy_version: 1,
                exploration: Exploration::Sample,
                teacher_share: None,
                keep: KeptData::Depth,
            }],
            latest_candidate: Some(5),
            ..TrainingProgress::start(config().evaluation.window_episodes as usize)
        },
        tensors: vec![
            tensor("single", &[3, 2], TensorValues::F32(vec![0.5; 6])),
            tensor("flat", &[6], TensorValues::F32(vec![0.5; 6])),
            tensor("count", &[1], TensorValues::I64(vec![3])),
            tensor("double", &[2], TensorValues::F64(vec![0.25; 2])),
            tensor("whole", &[], TensorValues::I64(vec![3])),
        ],
        replay: replay.state(),
        snapshots: vec![Snapshot {
            version: PolicyVersion(2),
            values: vec![1.0; 4],
        }],
    }
}

/// A folder with one valid checkpoint, and the contents of its files.
struct ValidCheckpoint {
    folder: TempDir,
    files: BTreeMap<&'static str, Vec<u8>>,
}

impl ValidCheckpoint {
    fn write() -> Self {
        let folder = folder();
        let place = store(folder.path(), &config()).save(&state(), &[]).unwrap();
        let files = FILE_NAMES.map(|name| (name, fs::read(place.join(name)).unwrap()));
        Self {
            folder,
            files: files.into(),
        }
    }

    fn place(&self) -> PathBuf {
        checkpoint_directory(self.folder.path(), EPISODES)
    }
}

thread_local! {
    static SOUND: ValidCheckpoint = ValidCheckpoint::write();
}

fn store(folder: &Path, config: &Config) -> CheckpointStore {
    CheckpointStore::new(folder, config)
}

/// Splits a safetensors file: length, header, values.
fn parts(file: &[u8]) -> (&[u8], &[u8], &[u8]) {
    let (length, rest) = file.split_at(8);
    let (header, values) = rest.split_at(u64::from_le_bytes(length.try_into().unwrap()) as usize);
    (length, header, values)
}

/// Returns the part of the manifest before its own checksum, which is recomputed for any contents.
fn manifest_body(manifest: &[u8]) -> &[u8] {
    let before = b",\n  \"xxh3\"";
    &manifest[..manifest
        .windows(before.len())
        .rposition(|window| window == before)
        .unwrap()]
}

fn manifest(body: &[u8]) -> Vec<u8> {
    let checksum = format!("{:016x}", xxhash_rust::xxh3::xxh3_64(body));
    [body, b",\n  \"xxh3\": \"", checksum.as_bytes(), b"\"\n}\n"].concat()
}

fn samples() -> Vec<Vec<u8>> {
    SOUND.with(|sound| {
        let content = |name: &str| {
            let file = &sound.files[name];
            match name {
                "manifest.json" => {
                    assert_eq!(
                        &manifest(manifest_body(file)),
                        file,
                        "the format of manifests has changed"
                    );
                    manifest_body(file).to_vec()
                }
                _ if name.ends_with(".safetensors") => parts(file).1.to_vec(),
                _ => file.clone(),
            }
        };
        (0..)
            .zip(FILE_NAMES)
            .map(|(kind, name)| tagged(kind, &content(name)))
            .collect()
    })
}

fn checkpoint(bytes: &[u8]) -> ReaderDecision {
    let Some((&kind, content)) = bytes.split_first() else {
        return ReaderDecision::Refused;
    };
    let name = FILE_NAMES[usize::from(kind) % FILE_NAMES.len()];
    SOUND.with(|sound| {
        let file = match name {
            "manifest.json" => manifest(content),
            _ if name.ends_with(".safetensors") => {
                let values = parts(&sound.files[name]).2;
                [&(content.len() as u64).to_le_bytes(), content, values].concat()
            }
            _ => content.to_vec(),
        };
        let path = sound.place().join(name);
        fs::write(&path, file).unwrap();
        if name != "manifest.json" {
            store(sound.folder.path(), &config())
                .seal(&sound.place(), EPISODES)
                .unwrap();
        }
        let mut reader = config();
        // It is only compared if the configurations differ.
        reader.run.seed += u64::from(name == "config.toml");
        let loaded = store(sound.folder.path(), &reader).load(EPISODES);
        fs::write(path, &sound.files[name]).unwrap();
        if let Err(error) = &loaded {
            let folder = sound.folder.path().display().to_string();
            assert!(error.to_string().contains(&folder), "{error}");
        }
        ReaderDecision::of(loaded.ok().map(go_on))
    })
}

/// Uses the loaded state as far as possible without networks.
fn go_on(state: CheckpointState) {
    assert_eq!(state.progress.episodes, EPISODES);
    let mut windows = state.progress.metrics.windows;
    let is_full = windows.walls_passed.is_full();
    windows.walls_passed.push(1.0);
    assert!(windows.walls_passed.mean().is_some());
    assert!(windows.walls_passed.is_full() || !is_full);
    for part in Own::ALL {
        let mut own = Own {
            part,
            tensor: Tensor::from_slice(&[0.0_f32; 6]).reshape([3, 2]),
            numbers: vec![0.0; 6],
            count: 0,
        };
        if own.load_named(&state.tensors).is_ok() {
            let stored = state.tensors.iter().find(|tensor| tensor.name == part);
            let shape = stored.map(|stored| &stored.shape);
            assert_eq!(own.named_tensors().first().map(|own| &own.shape), shape);
        }
    }
    if let Ok(mut replay) = Replay::restore(&config(), state.replay) {
        let _ = replay.insert(episode());
    }
}

/// A state of one part, of each existing kind.
struct Own {
    part: &'static str,
    tensor: Tensor,
    numbers: Vec<f32>,
    count: u64,
}

impl Own {
    const ALL: [&'static str; 3] = ["single", "flat", "count"];
}

impl Stateful for Own {
    fn parts(&mut self) -> Vec<(String, StatePart<'_>)> {
        let part = match self.part {
            "single" => StatePart::Tensor(self.tensor.shallow_clone()),
            "flat" => StatePart::Numbers(&mut self.numbers),
            _ => StatePart::Count(&mut self.count),
        };
        vec![(self.part.to_owned(), part)]
    }
}

/// A disk on which no write waits.
static DISK: LazyLock<Disk> = LazyLock::new(|| Disk::new(Arc::new(AtomicBool::new(true))));

fn row(episode: u64) -> EpisodeRow {
    EpisodeRow {
        episode,
        epoch: 0,
        policy_version: 0,
        actor: 1,
        level: 1,
        steps: 12,
        walls_passed: 1,
        total_reward: -0.5,
        outcome: Outcome::TimedOut,
    }
}

fn csv_samples() -> Vec<Vec<u8>> {
    let folder = folder();
    let path = folder.path().join("episodes.csv");
    let mut csv = EpisodesCsv::create(&path, &DISK).unwrap();
    (0..4).for_each(|episode| csv.write(&row(episode)).unwrap());
    csv.flush().unwrap();
    let file = fs::read(path).unwrap();
    vec![
        tagged(4, &file),
        tagged(2, &file),
        tagged(0, &file),
        tagged(4, &file[..file.len() - 1]),
    ]
}

fn episodes_csv(bytes: &[u8]) -> ReaderDecision {
    let Some((&episodes, content)) = bytes.split_first() else {
        return ReaderDecision::Refused;
    };
    let episodes = u64::from(episodes);
    with_files(&[("episodes.csv", content)], |folder| {
        let path = folder.join("episodes.csv");
        let mut csv = match EpisodesCsv::resume(&path, episodes, &DISK, |_| {}) {
            Ok(csv) => csv,
            Err(error) => {
                assert!(error.to_string().contains("episodes.csv"), "{error}");
                return ReaderDecision::Refused;
            }
        };
        csv.write(&row(episodes)).unwrap();
        csv.flush().unwrap();
        EpisodesCsv::resume(&path, episodes + 1, &DISK, |_| {}).unwrap();
        ReaderDecision::Accepted
    })
}

fn event_files(bytes: &[u8]) -> ReaderDecision {
    let file = |line: &[u8]| {
        let line = String::from_utf8_lossy(line).into_owned();
        let (name, bytes) = line.rsplit_once(' ')?;
        Some(EventFile {
            name: name.to_owned(),
            bytes: bytes.parse().ok()?,
        })
    };
    let files: Vec<EventFile> = bytes
        .split(|byte| *byte == b'\n')
        .filter_map(file)
        .collect();
    with_files(&[("outside", b"untouched")], |folder| {
        let curves = folder.join("tensorboard");
        fs::create_dir_all(&curves).unwrap();
        fs::write(
            curves.join("events.out.tfevents.1.skein.000000"),
            b"12345678",
        )
        .unwrap();
        let mut resumed = EventWriter::resume(&curves, files.clone(), 0, &DISK).ok();
        if let Some(writer) = &mut resumed {
            writer.scalars(1, &[("a", 1.0)]).unwrap();
            writer.flush().unwrap();
        }
        fs::remove_dir_all(curves).unwrap();
        assert_eq!(
            fs::read(folder.join("outside")).unwrap(),
            b"untouched",
            "{files:?}"
        );
        // The last file is the one just begun.
        ReaderDecision::of(resumed.filter(|writer| writer.files().len() == files.len() + 1))
    })
}
