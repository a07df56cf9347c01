//! Configuration files, command-line overrides, the simulator's section, and experiments.

use std::path::Path;
use std::sync::{Arc, LazyLock};

use skein_experiments::definition::{Experiment, MOST_ARMS};
use skein_protocol::config::{Config, ConfigError, failing_override};
use skein_protocol::snapshot::SnapshotLayout;
use skein_simulator::course::Course;
use skein_simulator::simulator::{Simulator, SimulatorSettings};

use super::courses::{assert_flyable, fly};
use super::{ReaderDecision, Target, USUAL, shipped, text};
use crate::scratch::with_files;

pub(super) const CONFIG: Target = Target {
    name: "config",
    reads: "configuration files",
    longest_bytes: 8192,
    weight: USUAL,
    samples: config_samples,
    run: |bytes| match text(bytes) {
        Some(text) => check(Config::parse(text, file(), &[])),
        None => ReaderDecision::Refused,
    },
};

pub(super) const OVERRIDES: Target = Target {
    name: "overrides",
    reads: "--set arguments, one per line",
    longest_bytes: 4096,
    weight: USUAL,
    samples: override_samples,
    run: overridden,
};

pub(super) const SIMULATOR: Target = Target {
    name: "simulator",
    reads: "the configuration's [simulator] section; accepted settings are flown",
    longest_bytes: 4096,
    weight: USUAL,
    samples: simulator_samples,
    run: simulated,
};

pub(super) const EXPERIMENT: Target = Target {
    name: "experiment",
    reads: "the file of an experiment",
    longest_bytes: 2048,
    // Reading the courses of every valid arm takes time.
    weight: USUAL / 10,
    samples: experiment_samples,
    run: |bytes| {
        with_files(&[("fuzzed.toml", bytes)], |folder| {
            match Experiment::load(folder, "fuzzed", None) {
                Ok(experiment) => {
                    assert!((1..=MOST_ARMS).contains(&experiment.arms.len()));
                    assert!(
                        experiment
                            .arms
                            .iter()
                            .all(|arm| arm.config.validate().is_ok())
                    );
                    ReaderDecision::Accepted
                }
                Err(error) => {
                    assert!(error.to_string().contains("fuzzed.toml"), "{error}");
                    ReaderDecision::Refused
                }
            }
        })
    },
};

/// Returns the shipped experiments, with the path of their base configuration on this machine.
fn experiment_samples() -> Vec<Vec<u8>> {
    let configs = concat!(env!("CARGO_MANIFEST_DIR"), "/../../configs/");
    ["paper", "success-share", "vae-freeze", "rivals"]
        .map(|name| shipped(&format!("configs/experiments/{name}.toml")))
        .map(|bytes| {
            String::from_utf8(bytes)
                .unwrap()
                .replace("\"../", &format!("\"{configs}"))
                .into_bytes()
        })
        .to_vec()
}

fn file() -> &'static Path {
    Path::new("/somewhere/fuzzed.toml")
}

fn config_samples() -> Vec<Vec<u8>> {
    let mut samples = [
        "configs/generalist.toml",
        "configs/smoke.toml",
        "configs/paper.toml",
        "tests/small.toml",
    ]
    .map(shipped)
    .to_vec();
    samples.push(Config::default().to_toml().into_bytes());
    samples.push(Vec::new());
    samples
}

/// An accepted configuration reads back equal; a refusal names the file.
fn check(read: Result<Config, ConfigError>) -> ReaderDecision {
    match read {
        Ok(config) => {
            let again = Config::parse(&config.to_toml(), file(), &[]).unwrap();
            // As text, because the simulator's section is passed on unread and may hold values,
            // such as NaN, that differ from themselves.
            assert_eq!(again.to_toml(), config.to_toml());
            assert_eq!(again.digest(), config.digest());
            assert!(SnapshotLayout::of(&config).values() > 0);
            assert!(!config.transport.heartbeat().is_zero());
            ReaderDecision::Accepted
        }
        Err(error) => {
            let message = error.to_string();
            assert!(
                message.contains("fuzzed.toml") || message.contains("--set"),
                "{message}"
            );
            ReaderDecision::Refused
        }
    }
}

fn override_samples() -> Vec<Vec<u8>> {
    [
        "run.seed=7\nrun.device=cuda:1\nsimulator.vehicle.preset=point",
        "courses.training=a/b.toml\ncourses.evaluation=[\"c.toml\", \"/d.toml\"]\n\
         sac.target_entropy=auto",
        "learning.observation=latent+velocity\nvae.latent=16\nlearning.warmup_steps=100000\n\
         replay.capacity=1000",
        "simulator.generator.shapes=[\"cross\", \"l\"]\ncheckpoints.keep = 3\n\
         transport.actor_silence_secs=0.5",
    ]
    .map(|text| text.as_bytes().to_vec())
    .to_vec()
}

fn overridden(bytes: &[u8]) -> ReaderDecision {
    let Some(text) = text(bytes) else {
        return ReaderDecision::Refused;
    };
    let overrides: Vec<String> = text.split('\n').take(8).map(str::to_owned).collect();
    let parse = |overrides: &[String]| Config::parse("", file(), overrides);
    let read = parse(&overrides);
    if read.is_err() {
        // The empty file is valid, so an override must cause any error.
        let problem = |overrides: &[String]| parse(overrides).err().map(|error| error.to_string());
        assert!(failing_override(&overrides, problem).is_some());
    }
    check(read)
}

fn simulator_samples() -> Vec<Vec<u8>> {
    let mut samples = vec![
        toml::to_string(&SimulatorSettings::default())
            .unwrap()
            .into_bytes(),
    ];
    samples.extend(
        [
            "max_steps = 3\n[vehicle]\npreset = \"hummingbird\"\nforward_speed_mps = 10.0\n\
             control_period_secs = 0.01\n",
            "[disturbances]\nmass_spread = 0.5\nlatency_periods = 8\n[disturbances.gust]\n\
             force_rms_n = 10.0\n[disturbances.depth]\nmodel = \"stereo\"\ndropout_share = 0.5\n",
            "[vehicle]\npreset = \"point\"\npoint_time_constant_secs = 0.01\nphysics_hz = \
             10000.0\n",
            "[camera]\nhorizontal_fov_deg = 150.0\nmount_m = [2.0, -2.0, 2.0]\nmount_pitch_deg = \
             90.0\n[reward]\ncollision = -1e6\n",
        ]
        .map(|text| text.as_bytes().to_vec()),
    );
    samples
}

static TRAINING: LazyLock<Arc<Course>> = LazyLock::new(|| {
    let text = String::from_utf8(shipped("configs/courses/training.toml")).unwrap();
    Arc::new(Course::parse(&text, "training.toml").unwrap())
});

/// Accepted settings can be flown.
fn simulated(bytes: &[u8]) -> ReaderDecision {
    let Some(Ok(settings)) = text(bytes).map(toml::from_str::<SimulatorSettings>) else {
        return ReaderDecision::Refused;
    };
    let simulator = Simulator::new(Arc::clone(&TRAINING), &settings).ok();
    if let Ok(course) = Course::generate(0, &settings.generator) {
        assert_flyable(course);
    }
    ReaderDecision::of(simulator.map(|mut simulator| fly(&mut simulator, &settings, 1)))
}
