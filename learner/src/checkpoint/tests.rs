//! What is saved is what is loaded, bit for bit, or it is refused.

use std::fs;

use skein_protocol::config::Config;
use skein_protocol::transition::Outcome;

use super::*;
use crate::flight::samples::{flight, with_images};
use crate::replay::Replay;

const DIGEST: u64 = 0xfedc_ba98_7654_3210;

/// With bit patterns that only survive a copy: a negative zero, the smallest number, a NaN with a payload.
fn state(flights: u64) -> CheckpointState {
    let mut replay = Replay::new(&Config::default());
    for number in 0..4 {
        let mut flight = with_images(flight(number, 3, Outcome::Collided));
        flight.level_up[1] = true;
        replay.insert(flight).unwrap();
    }
    let mut windows = Windows::new(50);
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
        progress: Progress {
            flights,
            epochs: 7,
            policy_version: 7,
            environment_steps: 12,
            vae_steps: 3,
            sac_updates: u64::MAX,
            evaluations: 1,
            latest_candidate: Some(5),
            best: Some(BestSnapshot {
                policy_version: 6,
                flights: 60,
                window_walls_passed: 0.1,
                confirmed_walls_passed: 2.5,
            }),
            windows,
        },
        tensors: vec![
            tensor("adam.steps", &[1], TensorValues::I64(vec![-9_007_199_254_740_993])),
            tensor("log_alpha", &[], TensorValues::F64(vec![-1.0 / 3.0])),
            tensor("policy", &[2, 3], TensorValues::F32(odd)),
        ],
        replay: replay.state(),
    }
}

/// Bits instead of numbers, because a NaN equals nothing.
fn bits(state: &CheckpointState) -> Vec<(String, Vec<u64>)> {
    let bits = |values: &TensorValues| match values {
        TensorValues::F32(values) => values.iter().map(|value| value.to_bits().into()).collect(),
        TensorValues::F64(values) => values.iter().map(|value| value.to_bits()).collect(),
        TensorValues::I64(values) => values.iter().map(|value| value.cast_unsigned()).collect(),
    };
    state
        .tensors
        .iter()
        .map(|tensor| (format!("{} {:?}", tensor.name, tensor.shape), bits(&tensor.values)))
        .collect()
}

fn assert_same(left: &CheckpointState, right: &CheckpointState) {
    assert_eq!(bits(left), bits(right));
    assert_eq!(left.progress, right.progress);
    assert!(left.replay == right.replay, "the replay buffers differ");
}

fn store(keep: usize) -> (tempfile::TempDir, CheckpointStore) {
    let directory = tempfile::tempdir().unwrap();
    let store = CheckpointStore::new(&directory.path().join("checkpoints"), DIGEST, keep);
    (directory, store)
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
fn what_is_saved_is_what_is_loaded() {
    let (_directory, store) = store(2);
    store.save(&state(500)).unwrap();
    assert_same(&store.load(500).unwrap(), &state(500));
    assert_same(&store.load_newest().unwrap().unwrap(), &state(500));
}

#[test]
fn two_tensors_of_one_name_are_refused_before_anything_is_in_place() {
    let (_directory, store) = store(2);
    let mut ambiguous = state(500);
    ambiguous.tensors.push(ambiguous.tensors[0].clone());
    let error = store.save(&ambiguous).unwrap_err().to_string();
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
    store.save(&frozen).unwrap();
    assert_same(&store.load(500).unwrap(), &frozen);
}

#[test]
fn one_state_is_always_the_same_bytes() {
    let ((_left, left), (_right, right)) = (store(2), store(2));
    let (left, right) = (left.save(&state(500)).unwrap(), right.save(&state(500)).unwrap());
    for name in files::NAMES.iter().chain([&manifest::NAME]) {
        assert_eq!(
            fs::read(left.join(name)).unwrap(),
            fs::read(right.join(name)).unwrap(),
            "{name}"
        );
    }
}

#[test]
fn a_damaged_byte_is_refused_and_its_file_named() {
    let (_directory, store) = store(2);
    let place = store.save(&state(500)).unwrap();
    for name in files::NAMES.iter().chain([&manifest::NAME]) {
        let path = place.join(name);
        let sound = fs::read(&path).unwrap();
        let step = sound.len().div_ceil(200);
        for index in (0..sound.len()).step_by(step).chain([sound.len() - 1]) {
            let mut damaged = sound.clone();
            damaged[index] ^= 0x01;
            fs::write(&path, &damaged).unwrap();
            let error = store.load(500).expect_err(&format!("{name}, byte {index}")).to_string();
            // A manifest that says something else may make another file look wrong; all else is blamed on the file itself.
            assert!(error.contains(place.to_str().unwrap()), "{error}");
            assert!(error.contains(name) || *name == manifest::NAME, "{name}: {error}");
        }
        fs::write(&path, &sound[..sound.len() - 1]).unwrap();
        store.load(500).expect_err(&format!("{name} cut short"));
        fs::remove_file(&path).unwrap();
        let error = store.load(500).expect_err(&format!("{name} missing")).to_string();
        assert!(error.contains(name), "{error}");
        fs::write(&path, &sound).unwrap();
    }
    store.load(500).unwrap();
}

#[test]
fn another_configuration_is_refused_and_both_are_named() {
    let (_directory, store) = store(2);
    store.save(&state(500)).unwrap();
    let other = CheckpointStore::new(store.directory(), 1, 2);
    let error = other.load_newest().unwrap_err().to_string();
    for part in ["flight-500/manifest.json", "fedcba9876543210", "0000000000000001"] {
        assert!(error.contains(part), "`{error}` does not mention `{part}`");
    }
}

#[test]
fn another_format_is_refused_before_anything_else_is_believed() {
    let (_directory, store) = store(2);
    let path = store.save(&state(500)).unwrap().join(manifest::NAME);
    fs::write(&path, r#"{ "format": 9, "something": "new" }"#).unwrap();
    let error = store.load(500).unwrap_err();
    assert!(
        matches!(
            error,
            CheckpointError::Format {
                found: 9,
                expected: 1,
                ..
            }
        ),
        "{error}"
    );
}

#[test]
fn only_the_newest_few_are_kept_and_nothing_else_remains() {
    let (_directory, store) = store(2);
    for flights in [500, 1000, 1500] {
        store.save(&state(flights)).unwrap();
    }
    assert_eq!(names(store.directory()), ["flight-1000", "flight-1500"]);
    assert_eq!(store.list().unwrap(), [1500, 1000]);
}

#[test]
fn a_damaged_newest_is_passed_over_and_replaced_when_its_flight_is_reached_again() {
    let (_directory, store) = store(2);
    store.save(&state(500)).unwrap();
    let newest = store.save(&state(1000)).unwrap();
    fs::write(newest.join("progress.bin"), "").unwrap();
    assert_eq!(store.load_newest().unwrap().unwrap().progress.flights, 500);
    store.save(&state(1000)).unwrap();
    assert_same(&store.load_newest().unwrap().unwrap(), &state(1000));
}

#[test]
fn checkpoints_of_an_abandoned_future_do_not_push_out_the_present() {
    let (_directory, store) = store(1);
    store.save(&state(1000)).unwrap();
    store.save(&state(600)).unwrap();
    assert_eq!(names(store.directory()), ["flight-600"]);
}

#[test]
fn what_an_interrupted_write_left_is_never_read_and_then_cleared() {
    let (_directory, store) = store(2);
    let interrupted = store.save(&state(437)).unwrap();
    fs::write(interrupted.join("tensors.safetensors.part"), "half").unwrap();
    fs::rename(interrupted, store.directory().join(".writing")).unwrap();
    assert!(store.load_newest().unwrap().is_none());
    let place = store.save(&state(500)).unwrap();
    assert_eq!(names(store.directory()), ["flight-500"]);
    assert_eq!(
        names(&place),
        [
            "manifest.json",
            "progress.bin",
            "replay.safetensors",
            "tensors.safetensors"
        ]
    );
}

#[test]
fn a_run_without_checkpoints_has_none() {
    let (_directory, store) = store(2);
    assert!(store.load_newest().unwrap().is_none());
}

#[test]
fn the_writing_thread_has_everything_on_disk_when_it_is_finished() {
    let (_directory, store) = store(3);
    let mut writer = CheckpointWriter::start(store.clone()).unwrap();
    for flights in [500, 1000] {
        writer.save(state(flights)).unwrap();
    }
    writer.finish().unwrap();
    for flights in [500, 1000] {
        assert_same(&store.load(flights).unwrap(), &state(flights));
    }
}

#[test]
fn a_failed_write_is_told_by_the_next_save_or_the_end() {
    let directory = tempfile::tempdir().unwrap();
    let in_the_way = directory.path().join("checkpoints");
    fs::write(&in_the_way, "a file, not a folder").unwrap();
    let start = || CheckpointWriter::start(CheckpointStore::new(&in_the_way, DIGEST, 2)).unwrap();

    let mut writer = start();
    writer.save(state(500)).unwrap();
    let error = writer.save(state(1000)).unwrap_err();
    assert!(error.to_string().contains("checkpoints"), "{error}");

    let mut writer = start();
    writer.save(state(500)).unwrap();
    assert!(matches!(writer.finish().unwrap_err(), CheckpointError::Io { .. }));
}
