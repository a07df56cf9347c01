//! Runs that can be prepared, and runs that cannot.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use serde::Deserialize;
use skein_protocol::config::ParameterKey;
use skein_protocol::decoder_file::{DECODER_FILE, TrainedDecoder};
use skein_protocol::encoder_file::TrainedEncoder;
use skein_protocol::snapshot::SnapshotLayout;
use skein_simulator::course::Course;

use super::*;

fn shipped(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../configs/courses")
        .join(name)
}

/// Writes a configuration file that flies one shipped course.
fn config_file(directory: &Path, text: &str) -> PathBuf {
    let path = directory.join("test.toml");
    let course = shipped("training.toml");
    let courses = format!("[courses]\ntraining = {course:?}\nevaluation = [{course:?}]\n{text}");
    fs::write(&path, courses).unwrap();
    path
}

#[test]
fn a_prepared_run_holds_copies_of_all_its_inputs() {
    let directory = tempfile::tempdir().unwrap();
    let config = config_file(directory.path(), "");
    let prepared = prepare(
        &config,
        &["run.seed=7".to_owned()],
        &directory.path().join("run"),
        2,
    )
    .unwrap();
    assert_eq!(prepared.config.run.seed, 7);
    let root = directory.path().join("run").canonicalize().unwrap();
    assert_eq!(
        prepared.config.courses.training,
        root.join("courses/training.toml")
    );
    assert_eq!(
        Course::load(&prepared.config.courses.evaluation[0]).unwrap(),
        Course::load(shipped("training.toml")).unwrap()
    );
    assert_eq!(prepared.run.open().unwrap().0, prepared.identity);
    let copy = fs::metadata(prepared.run.courses().join("training.toml")).unwrap();
    assert_eq!(copy.permissions().mode() & 0o777, 0o600);
}

#[test]
fn a_run_keeps_the_encoder_that_it_starts_from() {
    let directory = tempfile::tempdir().unwrap();
    let original = directory.path().join("mine.safetensors");
    let text = "[vae]\ntrain_steps = 0\nstart_from = \"mine.safetensors\"";
    let config = config_file(directory.path(), text);
    let start = || prepare(&config, &[], &directory.path().join("run"), 2);
    let error = start().unwrap_err().to_string();
    for part in [
        "test.toml",
        "vae.start_from",
        "mine.safetensors",
        "No such file",
    ] {
        assert!(error.contains(part), "{error}");
    }

    let trained = TrainedEncoder {
        values: vec![0.25; SnapshotLayout::of(&Config::default()).encoder().len()],
        latent: Config::default().vae.latent,
    };
    fs::write(&original, trained.to_file(&Config::default(), 9)).unwrap();
    let prepared = start().unwrap();
    fs::remove_file(&original).unwrap();
    let (identity, config) = prepared.run.open().unwrap();
    assert!(identity.parameters.contains_key("encoder.safetensors"));
    assert_eq!(
        config.vae.start_from,
        Some(prepared.run.parameters(ParameterKey::Encoder))
    );
    assert_eq!(TrainedEncoder::of(&config).unwrap(), Some(trained));
    let copy = fs::metadata(prepared.run.parameters(ParameterKey::Encoder)).unwrap();
    assert_eq!(copy.permissions().mode() & 0o777, 0o600);
    assert!(!prepared.run.decoder().exists(), "none was beside it");
}

#[test]
fn a_run_keeps_the_decoder_of_the_encoder_that_it_starts_from() {
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name);
    let text = "[vae]\ntrain_steps = 0\nstart_from = \"mine.safetensors\"";
    let config = config_file(directory.path(), text);
    let latent = Config::default().vae.latent;
    let encoder = TrainedEncoder {
        values: vec![0.25; SnapshotLayout::of(&Config::default()).encoder().len()],
        latent,
    };
    fs::write(
        at("mine.safetensors"),
        encoder.to_file(&Config::default(), 9),
    )
    .unwrap();
    let start = |run: &str| prepare(&config, &[], &at(run), 2);
    let numbers = TrainedDecoder::tensors(latent).last().unwrap().range.end;
    for (run, encoder_sha256, is_kept) in [
        ("own", encoder.sha256(), true),
        ("foreign", "another encoder's".to_owned(), false),
    ] {
        let values = vec![0.5; numbers];
        let decoder = TrainedDecoder {
            values,
            latent,
            encoder_sha256,
        };
        fs::write(at(DECODER_FILE), decoder.to_file()).unwrap();
        assert_eq!(start(run).unwrap().run.decoder().exists(), is_kept, "{run}");
    }
    fs::write(at(DECODER_FILE), "no tensors").unwrap();
    let error = start("damaged").unwrap_err().to_string();
    for part in [DECODER_FILE, "remove it"] {
        assert!(error.contains(part), "{error}");
    }
}

#[test]
fn the_simulators_defaults_are_written_out_to_the_last_bit() {
    let mut settings = SimulatorSettings::default();
    settings.vehicle.control_period_secs = 0.1;
    let written = written_out(&settings);
    assert_eq!(written["vehicle"]["control_period_secs"].to_string(), "0.1");
    assert_eq!(SimulatorSettings::deserialize(written).unwrap(), settings);
}

#[test]
fn two_courses_with_the_same_file_name_stay_apart() {
    let directory = tempfile::tempdir().unwrap();
    let other = directory.path().join("training.toml");
    fs::copy(shipped("non_rectangular.toml"), &other).unwrap();
    let config = config_file(directory.path(), "");
    let set = format!(
        "courses.evaluation=[{:?}, {other:?}]",
        shipped("training.toml")
    );
    let prepared = prepare(&config, &[set], &directory.path().join("run"), 1).unwrap();
    let [first, second] = &prepared.config.courses.evaluation[..] else {
        panic!("{:?}", prepared.config.courses.evaluation);
    };
    assert!(first.ends_with("training.toml") && second.ends_with("training_2.toml"));
    assert_ne!(Course::load(first).unwrap(), Course::load(second).unwrap());
}

#[test]
fn an_impossible_run_is_refused_before_anything_is_created() {
    let directory = tempfile::tempdir().unwrap();
    for (text, set, actors, expected) in [
        (
            "[run]\nseed = -1",
            "",
            1,
            vec!["test.toml", "[run]", "seed"],
        ),
        (
            "[simulator]\nmax_step = 1",
            "",
            1,
            vec!["test.toml", "[simulator]", "max_step"],
        ),
        ("[simulator]\nmax_steps = 0", "", 1, vec!["max_steps = 0"]),
        (
            "[simulator]\nmax_steps = 256",
            "",
            1,
            vec![
                "max_steps = 256",
                "transport.max_records_per_episode = 256",
                "257",
            ],
        ),
        (
            "",
            "courses.training=\"missing/course.toml\"",
            1,
            vec!["with --set courses.training=", "missing/course.toml"],
        ),
        (
            "",
            "simulator.max_step=1",
            1,
            vec![
                "with --set simulator.max_step=1, ",
                "test.toml",
                "[simulator]",
            ],
        ),
        (
            "",
            "simulator.max_steps=256",
            1,
            vec![
                "with --set simulator.max_steps=256, ",
                "max_records_per_episode",
            ],
        ),
        (
            "[learning]\nlevels = 6",
            "",
            1,
            vec![
                "test.toml",
                "learning.levels = 6",
                "5 walls",
                "training.toml",
            ],
        ),
        (
            "[simulator.generator]\nwall_x_m = [10.0, 20.0]",
            "courses.generated_share=0.5",
            1,
            vec!["learning.levels = 5", "2 walls", "wall_x_m"],
        ),
        (
            "[simulator.generator]\nshapes = [\"star\", \"circle\", \"star\"]",
            "courses.generated_share=0.5",
            1,
            vec!["[simulator.generator] shapes", "\"star\" twice"],
        ),
        (
            "[simulator.generator]\nclearance_m = [3.4, 3.4]",
            "evaluation.confirm_on=generated",
            1,
            vec!["generator", "no opening drawn for wall 1"],
        ),
        (
            "[run]\nepisodes = 12",
            "",
            1,
            vec![
                "test.toml: run.episodes = 12",
                "max_steps = 160",
                "1920 steps",
                "learning.warmup_steps = 2000",
                "raise run.episodes",
            ],
        ),
        (
            "",
            "simulator.vehicle.control_period_secs=0.1",
            1,
            vec![
                "with --set simulator.vehicle.control_period_secs=0.1, ",
                "training.toml",
                "58.0 m from the start",
                "at most 16.0 m",
                "max_steps to 581 or more",
            ],
        ),
        (
            "[simulator.vehicle]\nforward_speed_mps = 0.3",
            "",
            1,
            vec!["training.toml", "at most 24.0 m", "forward_speed_mps = 0.3"],
        ),
        (
            "[simulator.generator]\n\
             corridor = { length_m = 100.0, width_m = 6.0, height_m = 7.0 }",
            "courses.generated_share=0.5",
            1,
            vec!["[simulator.generator]", "corridor.length_m = 100"],
        ),
        (
            "[simulator.generator.layout]\nwalls = [1, 8]\nspacing_m = [6.0, 15.0]",
            "courses.generated_share=0.5",
            1,
            vec![
                "[simulator.generator.layout], the longest course",
                "corridor.length_m = 130",
                "max_steps to 257 or more",
            ],
        ),
        (
            "[simulator.generator.layout]\nwalls = [1, 4]",
            "courses.generated_share=0.5",
            1,
            vec!["learning.levels = 5", "4 walls", "layout.walls"],
        ),
        (
            "[transport]\nmax_actors = 3",
            "",
            4,
            vec!["4 actors", "transport.max_actors = 3"],
        ),
    ] {
        let config = config_file(directory.path(), text);
        let overrides: Vec<_> = [set]
            .iter()
            .filter(|set| !set.is_empty())
            .map(ToString::to_string)
            .collect();
        let run = directory.path().join("run");
        let error = prepare(&config, &overrides, &run, actors)
            .unwrap_err()
            .to_string();
        for part in expected {
            assert!(error.contains(part), "`{error}` does not mention `{part}`");
        }
        assert!(!run.exists());
    }
}

#[test]
fn a_used_directory_is_refused_with_a_remedy() {
    let directory = tempfile::tempdir().unwrap();
    let config = config_file(directory.path(), "");
    let error = prepare(&config, &[], directory.path(), 1)
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("not empty") && error.contains("--run-dir"),
        "{error}"
    );
    for directory in [config.clone(), config.join("run")] {
        let error = prepare(&config, &[], &directory, 1).unwrap_err();
        let error = error.to_string();
        assert!(
            error.contains("test.toml") && error.contains("new or empty directory with --run-dir"),
            "{error}"
        );
    }
}

#[test]
fn of_two_starts_in_one_empty_directory_one_is_refused() {
    for _ in 0..50 {
        let directory = tempfile::tempdir().unwrap();
        let make = || NewDirectory::make(directory.path());
        let made = std::thread::scope(|scope| {
            let other = scope.spawn(make);
            [make(), other.join().unwrap()]
        });
        let refused: Vec<_> = made.iter().filter_map(|made| made.as_ref().err()).collect();
        assert!(
            matches!(refused[..], [PrepareError::NotEmpty(_)]),
            "{refused:?}"
        );
    }
}
