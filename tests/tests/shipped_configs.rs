//! The shipped configurations can run, and `paper.toml` has the paper's values.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use std::path::PathBuf;
use std::sync::Arc;

use skein_protocol::config::{Config, Observation};
use skein_simulator::course::{Course, GeneratedShape};
use skein_simulator::simulator::{Simulator, SimulatorSettings};
use skein_simulator::suite::Suite;
use skein_simulator::vehicle::Preset;
use skein_tests::repository;

fn shipped() -> Vec<PathBuf> {
    let mut files: Vec<_> = std::fs::read_dir(repository().join("configs"))
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.is_file())
        .collect();
    files.sort();
    files
}

fn load(name: &str) -> Config {
    Config::load(&repository().join("configs").join(name), &[]).unwrap()
}

#[test]
fn the_shipped_configurations_exist() {
    let names: Vec<_> = shipped()
        .iter()
        .map(|path| path.file_name().unwrap().to_str().unwrap().to_owned())
        .collect();
    assert_eq!(
        names,
        [
            "encoder.toml",
            "generalist.toml",
            "local.toml",
            "one-course.toml",
            "paper.toml",
            "slalom.toml",
            "smoke.toml"
        ]
    );
}

#[test]
fn every_shipped_configuration_can_be_flown_unchanged() {
    for file in shipped() {
        let config = Config::load(&file, &[]).unwrap();
        let settings: SimulatorSettings = toml::Value::Table(config.simulator)
            .try_into()
            .unwrap_or_else(|error| panic!("{}: {error}", file.display()));
        for path in config
            .courses
            .evaluation
            .iter()
            .chain([&config.courses.training])
        {
            let course = Arc::new(Course::load(path).unwrap());
            assert!(
                course.levels() >= config.learning.levels,
                "{}: more start levels than {} has walls",
                file.display(),
                path.display()
            );
            Simulator::new(course, &settings).unwrap();
        }
        Course::generate(0, &settings.generator).unwrap();
        assert!((settings.max_steps as usize) < config.transport.max_records_per_episode);
    }
}

#[test]
fn the_paper_configuration_has_the_papers_values() {
    let paper = load("paper.toml");
    assert_eq!(paper.run.episodes, 4000);
    assert_eq!(paper.learning.episodes_per_epoch, 1);
    assert_eq!(paper.learning.policy_lag, 0);
    assert_eq!(paper.learning.warmup_steps, 2000);
    assert_eq!(paper.learning.episodes_per_level, 10);
    assert_eq!(paper.learning.levels, 5);
    assert_eq!(paper.learning.observation, Observation::Latent);
    assert_eq!(paper.vae.train_steps, 10_000);
    assert_eq!(paper.replay.capacity, 131_072);
    assert_eq!(paper.replay.success_share, 0.125);
    assert_eq!(paper.evaluation.window_episodes, 50);
    assert_eq!(paper.evaluation.episodes, 100);
    assert_eq!(paper.courses.generated_share, 0.0);
    assert_eq!(
        paper.courses.evaluation.len(),
        4,
        "training order, two rearranged, non-rectangular"
    );
    let settings: SimulatorSettings = toml::Value::Table(paper.simulator).try_into().unwrap();
    assert_eq!(settings.vehicle.preset, Preset::Airsim);
}

#[test]
fn every_shipped_suite_can_be_flown_and_one_has_an_entry_per_family_of_shapes() {
    let suite =
        |name: &str| Suite::load(repository().join("configs/evaluations").join(name)).unwrap();
    let [generalist, shapes, untried] =
        ["generalist.toml", "shapes.toml", "untried.toml"].map(suite);
    let [paper, slalom, worlds] = ["paper.toml", "slalom.toml", "worlds.toml"].map(suite);
    let all = [&generalist, &shapes, &untried, &paper, &slalom, &worlds];
    for entry in all.into_iter().flat_map(|suite| &suite.entries) {
        entry.courses.of_episode(0).unwrap();
    }
    let named: Vec<&str> = shapes
        .entries
        .iter()
        .map(|entry| entry.name.as_str())
        .collect();
    let families = GeneratedShape::HELD_OUT
        .into_iter()
        .chain(GeneratedShape::TRAINED);
    assert_eq!(
        named,
        families.map(GeneratedShape::name).collect::<Vec<_>>()
    );
}
