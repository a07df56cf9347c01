//! A loaded checkpoint equals the saved one bit for bit, or it is refused.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use skein_protocol::config::Config;
use skein_protocol::transition::Outcome;

use super::*;
use crate::disk::Disk;
use crate::episode::samples::{episode, with_images};
use crate::metrics::{EpisodeWindows, EventFile};
use crate::replay::Replay;
use crate::state::TensorValues;

/// A state with bit patterns that only a copy preserves: negative zero, the smallest number, a NaN
/// with a payload.
fn state(episodes: u64) -> CheckpointState {
    let mut replay = Replay::new(&Config::default());
    for number in 0..4 {
        let mut episode = with_images(episode(number, 3, Outcome::Collided));
        episode.level_up[1] = true;
        replay.insert(episode).unwrap();
    }
    let mut windows = EpisodeWindows::new(50);
    windows.walls_passed.push(3.0);
    let odd = vec![
        -0.0,
        f32::from_bits(1),
        f32::MAX,
        1.0 / 3.0,
        f32::INFINITY,
        f32::from_bits(0x7fc0_1234),
    ];
    let tensor = |name: &str, shape: &[usize], values| NamedTensor {
        name: name.into(),
        shape: shape.into(),
        values,
    };
    CheckpointState {
        progress: TrainingProgress {
            episodes,
            epochs: 7,
            version: 9,
            policy_sha256: "0123".into(),
            environment_steps: 12,
            vae_steps: 3,
            policy_updates: u64::MAX,
            in_flight: vec![EpochOrder {
                epoch: 7,
                policy_version: 6,
                exploration: Exploration::Sample,
                teacher_share: Some(0.5),
                keep: KeptData::Depth,
            }],
            evaluations: 1,
            evaluation_episodes: 5,
            latest_candidate: Some(5),
            best: Some(BestSnapshot {
                policy_version: 6,
                episodes: 60,
                window_walls_passed: 0.1,
                confirmed: vec![EpisodeWalls { passed: 2, of: 5 }],
            }),
            trained: Some(skein_protocol::summary::Trained {
                rate: 0.92,
                confirmation_episodes: 20,
                episodes: 60,
                steps: 11,
                updates: 2,
                wall_secs: 0.5,
            }),
            metrics: MetricsState {
                episodes,
                episodes_extent: crate::metrics::EpisodesExtent::empty(),
                events: vec![EventFile {
                    name: "events.out.tfevents.1.skein.000000".into(),
                    bytes: 77,
                }],
                windows,
            },
            spent: RunCosts::default(),
        },
        snapshots: vec![
            Snapshot {
                version: PolicyVersion(6),
                values: odd.clone(),
            },
            Snapshot {
                version: PolicyVersion(17),
                values: vec![0.5; 3],
            },
        ],
        tensors: vec![
            tensor(
                "adam.steps",
                &[1],
                TensorValues::I64(vec![-9_007_199_254_740_993]),
            ),
            tensor("log_alpha", &[], TensorValues::F64(vec![-1.0 / 3.0])),
            tensor("policy", &[2, 3], TensorValues::F32(odd)),
        ],
        replay: replay.state(),
    }
}

/// Compares bits instead of numbers, because NaN equals nothing.
fn bits(state: &CheckpointState) -> Vec<(String, Vec<u64>)> {
    let bits = |values: &TensorValues| match values {
        TensorValues::F32(values) => values.iter().map(|value| value.to_bits().into()).collect(),
        TensorValues::F64(values) => values.iter().map(|value| value.to_bits()).collect(),
        TensorValues::I64(values) => values.iter().map(|value| value.cast_unsigned()).collect(),
    };
    let tensors = state.tensors.iter().map(|tensor| {
        (
            format!("{} {:?}", tensor.name, tensor.shape),
            bits(&tensor.values),
        )
    });
    let snapshots = state.snapshots.iter().map(|snapshot| {
        let bits = snapshot
            .values
            .iter()
            .map(|value| value.to_bits().into())
            .collect();
        (format!("snapshot {}", snapshot.version), bits)
    });
    tensors.chain(snapshots).collect()
}

fn assert_same(left: &CheckpointState, right: &CheckpointState) {
    assert_eq!(bits(left), bits(right));
    assert_eq!(left.progress, right.progress);
    assert!(left.replay == right.replay, "the replay buffers differ");
}

fn config(keep: usize) -> Config {
    let mut config = Config::default();
    config.checkpoints.keep = keep;
    config
}

fn store(keep: usize) -> (tempfile::TempDir, CheckpointStore) {
    let directory = tempfile::tempdir().unwrap();
    let store = CheckpointStore::new(&directory.path().join("checkpoints"), &config(keep));
    (directory, store)
}

fn writer(store: CheckpointStore) -> CheckpointWriter {
    CheckpointWriter::start(store, Disk::new(Arc::default())).unwrap()
}

/// Names of all files of a checkpoint.
fn all_files() -> impl Iterator<Item = &'static str> {
    files::NAMES.into_iter().chain([manifest::NAME])
}

fn names(directory: &std::path::Path) -> Vec<String> {
    let entries = fs::read_dir(directory).unwrap();
    let mut names: Vec<_> = entries
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    names
}

#[test]
fn a_loaded_checkpoint_equals_the_saved_one() {
    let (_directory, store) = store(2);
    store.save(&state(500), &[]).unwrap();
    assert_same(&store.load(500).unwrap(), &state(500));
    assert_same(
        &store.load_newest(|_| Ok(()), |_| {}).unwrap().unwrap(),
        &state(500),
    );
}

#[test]
fn two_tensors_of_one_name_are_refused_before_anything_is_in_place() {
    let (_directory, store) = store(2);
    let mut ambiguous = state(500);
    ambiguous.tensors.push(ambiguous.tensors[0].clone());
    let error = store.save(&ambiguous, &[]).unwrap_err().to_string();
    assert!(error.contains("adam.steps"), "{error}");
    assert!(store.list().unwrap().is_empty());
}

#[test]
fn a_frozen_vaes_checkpoint_has_no_images_and_says_so() {
    let (_directory, store) = store(2);
    let mut frozen = state(500);
    frozen.replay.images = None;
    frozen.replay.success.images.clear();
    frozen.replay.regular.images.clear();
    store.save(&frozen, &[]).unwrap();
    assert_same(&store.load(500).unwrap(), &frozen);
}

#[test]
fn one_state_is_always_the_same_bytes() {
    let ((_left, left), (_right, right)) = (store(2), store(2));
    let (left, right) = (
        left.save(&state(500), &[]).unwrap(),
        right.save(&state(500), &[]).unwrap(),
    );
    for name in all_files() {
        assert_eq!(
            fs::read(left.join(name)).unwrap(),
            fs::read(right.join(name)).unwrap(),
            "{name}"
        );
    }
}

#[test]
fn a_damaged_byte_anywhere_is_refused_and_its_file_named() {
    let (_directory, store) = store(2);
    let place = store.save(&state(500), &[]).unwrap();
    for name in all_files() {
        let path = place.join(name);
        let sound = fs::read(&path).unwrap();
        let refused = |bytes: &[u8], what: String| {
            fs::write(&path, bytes).unwrap();
            let error = store
                .load(500)
                .expect_err(&format!("{name}, {what}"))
                .to_string();
            assert!(
                error.contains(path.to_str().unwrap()),
                "{name}, {what}: {error}"
            );
        };
        // At a thousand positions or more, if the file has so many bits.
        for bit in (0..8 * sound.len()).step_by((8 * sound.len() / 1000).max(1)) {
            let mut damaged = sound.clone();
            damaged[bit / 8] ^= 1 << (bit % 8);
            refused(&damaged, format!("bit {bit}"));
        }
        for length in (0..sound.len())
            .step_by(sound.len().div_ceil(50))
            .chain([sound.len() - 1])
        {
            refused(&sound[..length], format!("cut to {length} bytes"));
        }
        let mut longer = sound.clone();
        longer.push(b'\n');
        refused(&longer, "a byte more".to_owned());
        fs::remove_file(&path).unwrap();
        let error = store
            .load(500)
            .expect_err(&format!("{name} missing"))
            .to_string();
        assert!(error.contains(name), "{error}");
        fs::write(&path, &sound).unwrap();
    }
    store.load(500).unwrap();
}

#[test]
fn another_configuration_is_refused_by_key_with_both_values() {
    let (_directory, store) = store(2);
    store.save(&state(500), &[]).unwrap();
    let mut config = config(2);
    config.sac.discount = 0.5;
    let other = CheckpointStore::new(store.directory(), &config);
    let error = other
        .load_newest(|_| Ok(()), |_| {})
        .unwrap_err()
        .to_string();
    for part in ["episode-500", "sac.discount = 0.99 there, 0.5 here"] {
        assert!(error.contains(part), "`{error}` does not mention `{part}`");
    }
    assert!(!error.contains("batch_size"), "{error}");
}

#[test]
fn a_lengthened_run_resumes_from_before_the_end_of_the_shorter_one() {
    let (_directory, short) = store(2);
    let mut longer = config(2);
    (longer.run.episodes, longer.learning.episodes_per_epoch) = (500, 10);
    let short = CheckpointStore::new(short.directory(), &longer);
    for episodes in [400, 500] {
        let mut state = state(episodes);
        state.progress.epochs = episodes / 10;
        short.save(&state, &[]).unwrap();
    }
    longer.run.episodes = 1000;
    let store = CheckpointStore::new(short.directory(), &longer);
    let mut passed_over = Vec::new();
    let found = store
        .load_newest(|_| Ok(()), |error| passed_over.push(error.to_string()))
        .unwrap()
        .unwrap();
    assert_eq!(found.progress.episodes, 400);
    assert!(
        passed_over[0].contains("end of the run of 500 episodes"),
        "{passed_over:?}"
    );
    // A shorter run, or one that differs in anything else, refuses it.
    let shorter = |config: &mut Config| config.run.episodes = 499;
    let other_seed = |config: &mut Config| {
        (config.run.episodes, config.run.seed) = (1000, 99);
    };
    let changes: [fn(&mut Config); 2] = [shorter, other_seed];
    for change in changes {
        let mut other = config(2);
        other.learning.episodes_per_epoch = 10;
        change(&mut other);
        let refused = CheckpointStore::new(short.directory(), &other)
            .load_newest(|_| Ok(()), |_| {})
            .unwrap_err();
        assert!(
            matches!(refused, CheckpointError::Configuration { .. }),
            "{refused}"
        );
    }
}

#[test]
fn another_format_is_refused_before_anything_else_is_believed() {
    let (_directory, store) = store(2);
    store.save(&state(400), &[]).unwrap();
    let path = store.save(&state(500), &[]).unwrap().join(manifest::NAME);
    let body = "{\n  \"format\": 9,\n  \"something\": \"new\"";
    let checksum = xxhash_rust::xxh3::xxh3_64(body.as_bytes());
    fs::write(
        &path,
        format!("{body},\n  \"xxh3\": \"{checksum:016x}\"\n}}\n"),
    )
    .unwrap();
    // An older checkpoint could not help: nothing is damaged.
    let error = store.load_newest(|_| Ok(()), |_| {}).unwrap_err();
    let expected = manifest::FORMAT;
    assert!(
        matches!(
            error,
            CheckpointError::Format { found: 9, expected: ours, .. } if ours == expected
        ),
        "{error}"
    );
}

#[test]
fn a_run_whose_checkpoints_are_all_damaged_is_not_started_again() {
    let (_directory, store) = store(2);
    for episodes in [500, 1000] {
        let place = store.save(&state(episodes), &[]).unwrap();
        fs::write(place.join("progress.bin"), "").unwrap();
    }
    let error = store
        .load_newest(|_| Ok(()), |_| {})
        .unwrap_err()
        .to_string();
    for part in [
        "none of the 2 checkpoints",
        "episode-1000/progress.bin",
        "remove that folder and episodes.csv",
    ] {
        assert!(error.contains(part), "`{error}` does not mention `{part}`");
    }
}

#[test]
fn nobody_else_can_read_a_checkpoint() {
    let (_directory, store) = store(2);
    let place = store.save(&state(500), &[]).unwrap();
    let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode() & 0o777;
    assert_eq!((mode(store.directory()), mode(&place)), (0o700, 0o700));
    for name in all_files() {
        assert_eq!(mode(&place.join(name)), 0o600, "{name}");
    }
}

#[test]
fn only_the_newest_few_are_kept_and_nothing_else_remains() {
    let (_directory, store) = store(2);
    for episodes in [500, 1000, 1500] {
        store.save(&state(episodes), &[]).unwrap();
    }
    assert_eq!(names(store.directory()), ["episode-1000", "episode-1500"]);
    assert_eq!(store.list().unwrap(), [1500, 1000]);
}

#[test]
fn a_damaged_checkpoint_does_not_count_among_those_kept() {
    let (_directory, store) = store(2);
    for episodes in [500, 1000] {
        store.save(&state(episodes), &[]).unwrap();
    }
    fs::write(store.directory().join("episode-1000/progress.bin"), "").unwrap();
    store.save(&state(1500), &[]).unwrap();
    assert_eq!(
        names(store.directory()),
        ["episode-1000", "episode-1500", "episode-500"]
    );
    store.save(&state(2000), &[]).unwrap();
    assert_eq!(names(store.directory()), ["episode-1500", "episode-2000"]);
}

#[test]
fn a_checkpoint_that_is_written_again_is_never_missed() {
    let (_directory, store) = store(1);
    let place = store.save(&state(500), &[]).unwrap();
    // The first half of the exchange, then the process is killed.
    let replaced = store.directory().join("episode-500.replaced");
    fs::rename(&place, &replaced).unwrap();
    assert_same(
        &store.load_newest(|_| Ok(()), |_| {}).unwrap().unwrap(),
        &state(500),
    );
    assert_eq!(store.list().unwrap(), [500]);
    // The second half, then damage to the new one.
    let place = store.save(&state(500), &[]).unwrap();
    assert_eq!(names(store.directory()), ["episode-500"]);
    fs::rename(&place, &replaced).unwrap();
    fs::create_dir(&place).unwrap();
    fs::write(place.join("progress.bin"), "").unwrap();
    assert_same(
        &store.load_newest(|_| Ok(()), |_| {}).unwrap().unwrap(),
        &state(500),
    );
    store.save(&state(500), &[]).unwrap();
    assert_same(&store.load(500).unwrap(), &state(500));
    assert_eq!(names(store.directory()), ["episode-500"]);
}

#[test]
fn a_damaged_newest_is_passed_over_and_replaced_when_its_episode_is_reached_again() {
    let (_directory, store) = store(2);
    store.save(&state(500), &[]).unwrap();
    let newest = store.save(&state(1000), &[]).unwrap();
    fs::write(newest.join("progress.bin"), "").unwrap();
    assert_eq!(
        store
            .load_newest(|_| Ok(()), |_| {})
            .unwrap()
            .unwrap()
            .progress
            .episodes,
        500
    );
    store.save(&state(1000), &[]).unwrap();
    assert_same(
        &store.load_newest(|_| Ok(()), |_| {}).unwrap().unwrap(),
        &state(1000),
    );
}

#[test]
fn checkpoints_of_an_abandoned_future_do_not_push_out_the_present() {
    let (_directory, store) = store(1);
    store.save(&state(1000), &[]).unwrap();
    store.save(&state(600), &[]).unwrap();
    assert_eq!(names(store.directory()), ["episode-600"]);
}

#[test]
fn leftovers_of_an_interrupted_write_are_never_read_and_then_removed() {
    let (_directory, store) = store(2);
    let interrupted = store.save(&state(437), &[]).unwrap();
    fs::write(interrupted.join("tensors.safetensors.part"), "half").unwrap();
    fs::rename(interrupted, store.directory().join(".writing")).unwrap();
    assert!(store.load_newest(|_| Ok(()), |_| {}).unwrap().is_none());
    let place = store.save(&state(500), &[]).unwrap();
    assert_eq!(names(store.directory()), ["episode-500"]);
    assert_eq!(
        names(&place),
        [
            "config.toml",
            "manifest.json",
            "progress.bin",
            "replay.safetensors",
            "snapshots.safetensors",
            "tensors.safetensors"
        ]
    );
}

#[test]
fn a_run_without_checkpoints_has_none() {
    let (_directory, store) = store(2);
    assert!(store.load_newest(|_| Ok(()), |_| {}).unwrap().is_none());
}

#[test]
fn the_writing_thread_has_everything_on_disk_when_it_is_finished() {
    let (_directory, store) = store(3);
    let mut writer = writer(store.clone());
    for episodes in [500, 1000] {
        writer.save(state(episodes), Vec::new()).unwrap();
    }
    writer.finish().unwrap();
    for episodes in [500, 1000] {
        assert_same(&store.load(episodes).unwrap(), &state(episodes));
    }
}

#[test]
fn a_failed_write_is_returned_by_the_next_save_or_the_end() {
    let directory = tempfile::tempdir().unwrap();
    let in_the_way = directory.path().join("checkpoints");
    fs::write(&in_the_way, "a file, not a folder").unwrap();
    let start = || writer(CheckpointStore::new(&in_the_way, &config(2)));

    let mut writer = start();
    writer.save(state(500), Vec::new()).unwrap();
    let error = writer.save(state(1000), Vec::new()).unwrap_err();
    assert!(error.to_string().contains("checkpoints"), "{error}");

    let mut writer = start();
    writer.save(state(500), Vec::new()).unwrap();
    assert!(matches!(
        writer.finish().unwrap_err(),
        CheckpointError::Io { .. }
    ));
}

#[test]
fn files_that_a_checkpoint_relies_on_must_exist() {
    let (directory, store) = store(2);
    let rows = directory.path().join("episodes.csv");
    store
        .save(&state(500), std::slice::from_ref(&rows))
        .unwrap_err();
    assert!(store.list().unwrap().is_empty());
    fs::write(&rows, "").unwrap();
    store.save(&state(500), &[rows]).unwrap();
}

/// A file system of 2 MB in memory; only root can make one.
struct SmallDisk(tempfile::TempDir);

impl SmallDisk {
    fn mount() -> Option<Self> {
        let directory = tempfile::tempdir().unwrap();
        let mut mount = std::process::Command::new("mount");
        mount
            .args(["-t", "tmpfs", "-o", "size=2m", "none"])
            .arg(directory.path());
        let mounted = mount.output().is_ok_and(|output| output.status.success());
        mounted.then_some(Self(directory))
    }

    fn path(&self) -> &Path {
        self.0.path()
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = std::process::Command::new("umount")
            .arg(self.0.path())
            .status();
    }
}

#[test]
fn a_full_disk_pauses_the_writing_until_there_is_room_or_the_run_is_stopped() {
    let Some(small) = SmallDisk::mount() else {
        println!("skipped: no file system can be mounted here");
        return;
    };
    let store = CheckpointStore::new(&small.path().join("checkpoints"), &config(2));
    store.save(&state(500), &[]).unwrap();
    let ballast = small.path().join("ballast");
    let free = |ballast: &Path| fs::write(ballast, vec![0; 4 << 20]).unwrap_err();
    assert_eq!(free(&ballast).kind(), std::io::ErrorKind::StorageFull);

    let stop = Arc::new(AtomicBool::new(false));
    let disk = Disk::new(stop.clone());
    let mut writer = CheckpointWriter::start(store.clone(), disk.clone()).unwrap();
    writer.save(state(600), Vec::new()).unwrap();
    wait_for(|| disk.waiting().is_some());
    assert_eq!(
        store
            .load_newest(|_| Ok(()), |_| {})
            .unwrap()
            .unwrap()
            .progress
            .episodes,
        500
    );
    fs::remove_file(&ballast).unwrap();
    writer.finish().unwrap();
    assert_same(
        &store.load_newest(|_| Ok(()), |_| {}).unwrap().unwrap(),
        &state(600),
    );

    free(&ballast);
    let mut writer = CheckpointWriter::start(store.clone(), disk.clone()).unwrap();
    writer.save(state(700), Vec::new()).unwrap();
    wait_for(|| disk.waiting().is_some());
    stop.store(true, std::sync::atomic::Ordering::Relaxed);
    let error = writer.finish().unwrap_err().to_string();
    assert!(error.contains("No space left on device"), "{error}");
    assert_same(
        &store.load_newest(|_| Ok(()), |_| {}).unwrap().unwrap(),
        &state(600),
    );
}

fn wait_for(condition: impl Fn() -> bool) {
    let end = std::time::Instant::now() + std::time::Duration::from_secs(10);
    while !condition() {
        assert!(std::time::Instant::now() < end, "it never came");
        std::thread::sleep(std::time::Duration::from_millis(10));
    }
}

#[test]
fn a_checkpoint_that_does_not_fit_the_files_beside_it_is_passed_over_and_reported() {
    let (_directory, store) = store(2);
    store.save(&state(500), &[]).unwrap();
    store.save(&state(1000), &[]).unwrap();
    let check = |state: &CheckpointState| match state.progress.episodes {
        1000 => Err(CheckpointError::Unfit {
            episodes: 1000,
            problem: "episodes.csv ends after 3 bytes".to_owned(),
        }),
        _ => Ok(()),
    };
    let mut reported = Vec::new();
    let newest = store
        .load_newest(check, |error| reported.push(error.to_string()))
        .unwrap();
    assert_same(&newest.unwrap(), &state(500));
    assert_eq!(
        reported,
        ["the checkpoint of episode 1000 does not fit: episodes.csv ends after 3 bytes"]
    );
}

#[test]
fn other_files_among_the_checkpoints_do_no_harm() {
    let (_directory, store) = store(2);
    store.save(&state(500), &[]).unwrap();
    for name in ["episode-9999", ".writing", ".removing", "notes.txt"] {
        fs::write(store.directory().join(name), "").unwrap();
    }
    store.save(&state(1000), &[]).unwrap();
    store.save(&state(1500), &[]).unwrap();
    assert_eq!(store.list().unwrap(), [1500, 1000]);
    assert!(store.directory().join("episode-9999").exists());
}
