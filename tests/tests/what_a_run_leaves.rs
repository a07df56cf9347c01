//! Contents of a run's directory, file by file, as documented; and nothing anywhere else.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;
use std::process::Command;

use skein_protocol::config::Config;
use skein_protocol::decoder_file::TrainedDecoder;
use skein_protocol::encoder_file::TrainedEncoder;
use skein_protocol::snapshot::Snapshot;
use skein_protocol::stages::{Stage, ThreadRole};
use skein_protocol::summary::RunEnding;
use skein_run::RunDirectory;
use skein_tests::{EndedRun, RunRecipe};

#[test]
fn a_completed_run_leaves_all_documented_files() {
    let run = RunRecipe::small().set("run.seed=7").finish();
    the_configuration_is_resolved(&run);
    the_episodes_have_the_documented_columns(&run);
    the_summary_agrees_with_the_episodes(&run);
    the_stages_agree_with_the_counts(&run);
    the_snapshots_are_those_of_the_summary(&run);
    the_evaluation_is_of_the_best_snapshot(&run);
    the_newest_checkpoint_is_of_the_end(&run);
    the_curves_are_in_an_event_file(&run);
    the_plots_show_something(&run);
    every_process_has_its_log(&run);
    the_conclusion_shows_the_tables_and_the_paths(&run);
}

/// Puts a file where the folder of the plots is.
fn block_plots(run: &RunDirectory) {
    let _ = fs::remove_dir_all(run.plots());
    fs::write(run.plots(), "").unwrap();
}

#[test]
fn a_plot_that_cannot_be_drawn_changes_no_success() {
    let mut running = RunRecipe::small().start();
    running.until_episodes(1);
    block_plots(running.directory());
    // Its exit status is 0.
    let run = running.finish();
    let stderr = &run.output.stderr;
    assert!(stderr.contains("a plot could not be drawn"), "{stderr}");
    assert_eq!(run.summary().ending, RunEnding::Completed);
    assert!(!run.output.stdout.is_empty());
}

#[test]
fn a_plot_that_cannot_be_drawn_hides_no_failure_of_the_run() {
    let mut running = RunRecipe::small().start();
    running.until("a checkpoint was there", |run| {
        let checkpoints = fs::read_dir(run.directory().checkpoints()).ok()?;
        let mut names = checkpoints.flatten().map(|entry| entry.file_name());
        names
            .any(|name| name.as_encoded_bytes().starts_with(b"episode-"))
            .then_some(())
    });
    running.cut_off();
    let checkpoints = fs::read_dir(running.directory().checkpoints()).unwrap();
    for checkpoint in checkpoints {
        for file in fs::read_dir(checkpoint.unwrap().path()).unwrap() {
            fs::write(file.unwrap().path(), "damaged").unwrap();
        }
    }
    // A folder in a plot's place.
    fs::create_dir_all(running.directory().plots().join("return.png")).unwrap();
    running.resume(1);
    let ended = running.wait();
    let stderr = &ended.output.stderr;
    assert_eq!(ended.output.code, Some(1), "{stderr}");
    let place = |text: &str| {
        let place = stderr.find(text);
        place.unwrap_or_else(|| panic!("`{text}` is missing in {stderr}"))
    };
    let (failure, plot) = (place("checkpoint"), place("a plot could not be drawn"));
    assert!(
        failure < plot,
        "the run's own failure comes first:\n{stderr}"
    );
}

fn the_configuration_is_resolved(run: &EndedRun) {
    let text = fs::read_to_string(run.directory.config()).unwrap();
    let config: toml::Table = toml::from_str(&text).unwrap();
    assert_eq!(config["run"]["seed"].as_integer(), Some(7));
    assert_eq!(
        config["sac"]["hidden_width"].as_integer(),
        Some(32),
        "set in the file"
    );
    for [section, key] in [["sac", "discount"], ["vae", "kl_weight"]] {
        assert!(
            config[section][key].is_float(),
            "the default of {section}.{key} is missing"
        );
    }
    let vehicle = &config["simulator"]["vehicle"];
    assert_eq!(vehicle["preset"].as_str(), Some("point"), "set in the file");
    assert!(
        vehicle["control_period_secs"].is_float() && config["simulator"]["max_steps"].is_integer(),
        "defaults of the simulator are missing:\n{text}"
    );
    assert!(
        text.contains(env!("CARGO_PKG_VERSION")),
        "the version is missing:\n{text}"
    );
    // The courses that it names are in the directory too.
    let config = Config::load(&run.directory.config(), &[]).unwrap();
    for course in config
        .courses
        .evaluation
        .iter()
        .chain([&config.courses.training])
    {
        assert!(
            course.starts_with(run.directory.courses()) && course.is_file(),
            "{course:?}"
        );
    }
}

fn the_episodes_have_the_documented_columns(run: &EndedRun) {
    let text = fs::read_to_string(run.directory.episodes_csv()).unwrap();
    assert_eq!(
        text.lines().next(),
        Some("episode,epoch,policy_version,actor,level,steps,walls_passed,return,outcome")
    );
    let episodes = run.episodes();
    assert_eq!(episodes.len(), 40);
    for (number, episode) in (0u64..).zip(&episodes) {
        // Ten episodes start from each level in turn.
        assert_eq!(u64::from(episode.level), number / 10 % 5 + 1, "{episode:?}");
        assert!((1..=160).contains(&episode.steps), "{episode:?}");
        assert!(episode.walls_passed <= 5, "{episode:?}");
        assert!(
            episode.r#return.parse::<f32>().unwrap().is_finite(),
            "{episode:?}"
        );
        assert!(
            ["collided", "reached_end", "timed_out"].contains(&episode.outcome.as_str()),
            "{episode:?}"
        );
    }
}

/// Returns the last commit that changed the learner's sources; empty outside a clone.
fn last_commit() -> String {
    if !Path::new("../.git").exists() {
        return String::new();
    }
    let sources = ["Cargo.toml", "Cargo.lock", "learner", "protocol", "actor"];
    let output = Command::new("git")
        .args(["-C", "..", "log", "-1", "--format=%h", "--abbrev=12", "--"])
        .args(sources)
        .output()
        .unwrap();
    String::from_utf8(output.stdout).unwrap().trim().to_owned()
}

fn the_summary_agrees_with_the_episodes(run: &EndedRun) {
    let (summary, episodes) = (run.summary(), run.episodes());
    // In a clone, the commit follows the version.
    let (version, commit) = summary
        .skein_version
        .split_once('+')
        .unwrap_or((summary.skein_version.as_str(), ""));
    assert_eq!(version, env!("CARGO_PKG_VERSION"));
    assert_eq!(
        commit.strip_suffix("-dirty").unwrap_or(commit),
        last_commit(),
        "{commit}"
    );
    assert_eq!(summary.seed, 7);
    assert_eq!(summary.ending, RunEnding::Completed);
    assert_eq!(summary.final_version.0, 4);
    assert_eq!(summary.episodes, episodes.len() as u64);
    assert_eq!(
        summary.steps,
        episodes.iter().map(|episode| episode.steps).sum::<u64>()
    );
    assert!(
        summary.updates > 0 && summary.vae_updates > 0,
        "{summary:?}"
    );
    // Three on each of two courses, and at least one that confirmed the best snapshot.
    assert!(summary.evaluation_episodes > 6, "{summary:?}");
}

/// Asserts that each thread's stages add up to its time, and that each stage was counted as often
/// as there was work for it.
fn the_stages_agree_with_the_counts(run: &EndedRun) {
    let summary = run.summary();
    let count = |stage| summary.stages.of(stage).count;
    let secs = |thread| summary.stages.total_nanos(thread) as f64 / 1e9;
    let evaluated = fs::read_to_string(run.directory.evaluation_trajectories_csv()).unwrap();
    // A header, and a row per observation of six episodes.
    let evaluation_steps = evaluated.lines().count() as u64 - 1 - 6;
    let (episodes, steps) = (count(Stage::Reset), count(Stage::Physics));
    let flown = summary.episodes + summary.evaluation_episodes;
    // The last episode's end may not have arrived yet.
    assert!(
        (flown - 1..=flown).contains(&episodes),
        "{episodes} episodes of {summary:?}"
    );
    // Confirmation episodes come in addition.
    assert!(
        steps > summary.steps + evaluation_steps,
        "{steps} steps of {summary:?}"
    );
    assert_eq!(count(Stage::Policy), steps);
    assert_eq!(
        [Stage::Camera, Stage::Encoder].map(count),
        [steps + episodes; 2]
    );
    assert!((steps + episodes - 1..=steps + episodes).contains(&count(Stage::Send)));
    assert!(count(Stage::Assemble) >= summary.steps + summary.episodes);
    assert_eq!(count(Stage::TakeIn), summary.episodes);
    assert_eq!(count(Stage::Evaluate), summary.evaluation_episodes);
    assert_eq!(
        [Stage::Sample, Stage::PolicyUpdate].map(count),
        [summary.updates; 2]
    );
    assert_eq!(
        [Stage::SampleImages, Stage::VaeStep].map(count),
        [summary.vae_updates; 2]
    );
    // One for the initial parameters.
    assert_eq!(count(Stage::Publish), summary.final_version.0 + 1);
    assert_eq!(count(Stage::Recode), 1);
    let (training, receiving) = (secs(ThreadRole::Training), secs(ThreadRole::Receiving));
    assert!(
        (summary.wall_secs - training).abs() < 0.1,
        "{training} s of {summary:?}"
    );
    assert!(
        receiving > 0.5 * training && receiving <= summary.wall_secs,
        "{receiving} s of {summary:?}"
    );
    let actors = secs(ThreadRole::Actors);
    assert!(
        actors > 0.5 * training && actors <= 2.0 * summary.wall_secs,
        "{actors} s of {summary:?}"
    );
}

fn the_snapshots_are_those_of_the_summary(run: &EndedRun) {
    let summary = run.summary();
    let (latest, _) = Snapshot::load(&run.directory.latest_snapshot()).unwrap();
    assert_eq!(latest.version, summary.final_version);
    assert_eq!(latest.sha256(), summary.policy_sha256);
    let (best, config) = Snapshot::load(&run.directory.best_snapshot()).unwrap();
    assert_eq!(Some(best.version), summary.best_version);
    assert_eq!(config.run.seed, 7, "a snapshot carries its configuration");
    let encoder = TrainedEncoder::load(&run.directory.latest_snapshot()).unwrap();
    let decoder = TrainedDecoder::of(&encoder.sha256(), &run.directory.decoder()).unwrap();
    assert!(decoder.is_some(), "the decoder is the newest encoder's");
}

fn the_evaluation_is_of_the_best_snapshot(run: &EndedRun) {
    let evaluation = run.evaluation();
    let (best, _) = Snapshot::load(&run.directory.best_snapshot()).unwrap();
    assert_eq!(evaluation.policy_version, best.version);
    assert_eq!(evaluation.policy_sha256, best.sha256());
    let names: Vec<_> = evaluation
        .courses
        .iter()
        .map(|course| course.course.as_str())
        .collect();
    assert_eq!(names, ["training", "non-rectangular"]);
    for course in &evaluation.courses {
        assert_eq!(course.episodes, 3);
        assert_eq!(course.walls_passed.len(), 5);
        let rate = course.walls_passed.iter().sum::<u64>() as f64 / 15.0;
        assert!((course.r - rate).abs() < 1e-9, "{course:?}");
        let ended = course.collided + course.timed_out + (course.completed * 3.0).round() as u64;
        assert_eq!(ended, 3, "{course:?}");
    }
}

fn the_newest_checkpoint_is_of_the_end(run: &EndedRun) {
    assert_eq!(
        names_in(&run.directory.checkpoints()),
        BTreeSet::from(["episode-20".to_owned(), "episode-40".to_owned()])
    );
}

/// An event file's record is a length, a checksum, the event, and a checksum. The first event names
/// the format; the others hold named curves.
fn the_curves_are_in_an_event_file(run: &EndedRun) {
    let folder = run.directory.tensorboard();
    let mut names = names_in(&folder);
    assert!(names.remove("over_steps"), "{names:?}");
    assert!(
        names.len() == 1 && names.iter().all(|name| name.contains("tfevents")),
        "{names:?}"
    );
    let bytes = fs::read(folder.join(names.first().unwrap())).unwrap();
    let mut events = Vec::new();
    let mut rest = bytes.as_slice();
    while !rest.is_empty() {
        let (length, after) = rest.split_first_chunk::<8>().unwrap();
        let (event, after) = after[4..].split_at(u64::from_le_bytes(*length) as usize);
        events.push(event);
        rest = &after[4..];
    }
    let holds = |event: &[u8], text: &str| {
        event
            .windows(text.len())
            .any(|part| part == text.as_bytes())
    };
    assert!(holds(events[0], "brain.Event:2"));
    for (curve, least) in [
        ("episode/return", 40),
        ("window/walls_passed", 40),
        ("policy/critic_loss", 1),
        ("policy/temperature", 1),
        ("vae/loss", 1),
        ("replay/success_transitions", 4),
    ] {
        let points = events.iter().filter(|event| holds(event, curve)).count();
        assert!(points >= least, "{curve} has {points} points");
    }
}

fn the_plots_show_something(run: &EndedRun) {
    let plots = [
        "trajectories.png",
        "reconstructions.png",
        "return.png",
        "walls_passed.png",
    ];
    assert_eq!(
        names_in(&run.directory.plots()),
        plots.map(str::to_owned).into_iter().collect()
    );
    for plot in plots {
        let file = fs::File::open(run.directory.plots().join(plot)).unwrap();
        let mut reader = png::Decoder::new(std::io::BufReader::new(file))
            .read_info()
            .unwrap();
        let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
        let info = reader.next_frame(&mut pixels).unwrap();
        assert!(info.width >= 300 && info.height >= 150, "{plot}: {info:?}");
        let colours: BTreeSet<_> = pixels.chunks_exact(info.color_type.samples()).collect();
        assert!(
            colours.len() > 20,
            "{plot} has {} colours: it is almost empty",
            colours.len()
        );
    }
}

fn every_process_has_its_log(run: &EndedRun) {
    for log in ["learner.log", "actor-0.log", "actor-1.log"] {
        let text = fs::read_to_string(run.directory.logs().join(log)).unwrap();
        assert!(text.contains("INFO"), "{log} has no information:\n{text}");
        assert!(
            !text.contains("ERROR") && !text.contains("WARN"),
            "{log} has warnings:\n{text}"
        );
    }
}

fn the_conclusion_shows_the_tables_and_the_paths(run: &EndedRun) {
    for part in [
        "non-rectangular",
        &skein_run::tables::stages_table(&run.summary().stages, usize::MAX),
        "episodes.csv",
        "plots/walls_passed.png",
        "snapshots/best.safetensors",
    ] {
        assert!(
            run.output.stdout.contains(part),
            "{part} is missing:\n{}",
            run.output.stdout
        );
    }
}

fn names_in(folder: &Path) -> BTreeSet<String> {
    fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect()
}

#[test]
fn logs_have_the_requested_level_and_format() {
    let run = RunRecipe::small()
        .set("run.episodes=10")
        .actors(1)
        .environment("RUST_LOG", "debug")
        .environment("SKEIN_LOG_FORMAT", "json")
        .finish();
    for log in ["learner.log", "actor-0.log"] {
        let text = fs::read_to_string(run.directory.logs().join(log)).unwrap();
        let levels: BTreeSet<String> = text
            .lines()
            .map(|line| {
                let event: serde_json::Value = serde_json::from_str(line).unwrap();
                event["level"].as_str().unwrap().to_owned()
            })
            .collect();
        assert!(levels.contains("DEBUG"), "{log} has only {levels:?}");
    }
}
