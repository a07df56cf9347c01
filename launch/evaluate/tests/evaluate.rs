//! Tests of `skein-evaluate` as a user runs it.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use skein_protocol::config::Config;
use skein_protocol::decoder_file::TrainedDecoder;
use skein_protocol::encoder_file::TrainedEncoder;
use skein_protocol::evaluation::{CourseEvaluation, EvaluationReport, WallFailures};
use skein_protocol::ids::PolicyVersion;
use skein_protocol::snapshot::{Snapshot, SnapshotLayout};
use skein_run::RunDirectory;

fn shipped(course: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../configs/courses")
        .join(course)
}

/// Returns a run's folder with a snapshot of an untrained policy. Its evaluation courses lie beside
/// it, as in a run that was moved.
fn run_folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    for name in ["snapshots", "courses"] {
        std::fs::create_dir(folder.path().join(name)).unwrap();
    }
    let mut config = Config::default();
    config.sac.hidden_width = 8;
    config.courses.evaluation = ["training.toml", "non_rectangular.toml"]
        .map(|name| Path::new("/elsewhere").join(name))
        .to_vec();
    for course in &config.courses.evaluation {
        let name = course.file_name().unwrap();
        std::fs::copy(
            shipped(name.to_str().unwrap()),
            folder.path().join("courses").join(name),
        )
        .unwrap();
    }
    let layout = SnapshotLayout::of(&config);
    let values = (0..layout.values())
        .map(|index| (index as f32 * 0.7).sin() * 0.02)
        .collect();
    let snapshot = Snapshot {
        version: PolicyVersion(17),
        values,
    };
    std::fs::write(
        folder.path().join("snapshots/latest.safetensors"),
        snapshot.to_file(&layout, &config),
    )
    .unwrap();
    folder
}

fn evaluate(folder: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_skein-evaluate"))
        .current_dir(folder)
        .args(arguments)
        .output()
        .unwrap()
}

fn error_of(folder: &Path, arguments: &[&str]) -> String {
    let output = evaluate(folder, arguments);
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    String::from_utf8(output.stderr).unwrap()
}

#[test]
fn a_run_is_evaluated_on_its_own_courses_with_the_same_result_on_any_number_of_threads() {
    let folder = run_folder();
    for threads in ["1", "3"] {
        let json = format!("{threads}.json");
        let output = evaluate(
            folder.path(),
            &[
                "--run",
                ".",
                "--episodes",
                "4",
                "--threads",
                threads,
                "--json",
                &json,
            ],
        );
        assert!(output.status.success(), "{output:?}");
        let table = String::from_utf8(output.stdout).unwrap();
        assert!(
            table.contains("training") && table.contains("non-rectangular"),
            "{table}"
        );
    }
    let read = |name: &str| std::fs::read_to_string(folder.path().join(name)).unwrap();
    assert_eq!(read("1.json"), read("3.json"));
    let report: EvaluationReport = serde_json::from_str(&read("1.json")).unwrap();
    assert_eq!(report.policy_version, PolicyVersion(17));
    assert_eq!(
        report
            .courses
            .iter()
            .map(|course| course.episodes)
            .collect::<Vec<_>>(),
        [4, 4]
    );
}

#[test]
fn failed_episodes_are_drawn_and_their_approaches_counted() {
    let folder = run_folder();
    let arguments = ["--run", ".", "--episodes", "3", "--failures", "why.png"];
    let output = evaluate(folder.path(), &arguments);
    assert!(output.status.success(), "{output:?}");
    let picture = std::fs::read(folder.path().join("why.png")).unwrap();
    assert!(picture.starts_with(b"\x89PNG") && picture.ends_with(b"IEND\xaeB`\x82"));
    let printed = String::from_utf8(output.stdout).unwrap();
    let rows = |of: &str| printed.lines().filter(|line| line.contains(of)).count();
    assert!(rows("shape: ") > 0 && rows("clearance: ") > 0, "{printed}");
    assert!(rows("offset: ") > 0, "{printed}");
}

#[test]
fn a_snapshot_file_alone_is_flown_and_recorded() {
    let folder = run_folder();
    let course = shipped("rearranged_34125.toml");
    let arguments = [
        "--snapshot",
        "snapshots/latest.safetensors",
        "--episodes",
        "2",
        "--record",
        "episodes.npz",
        "--course",
    ];
    let output = evaluate(
        folder.path(),
        &[arguments.as_slice(), &[course.to_str().unwrap()]].concat(),
    );
    assert!(output.status.success(), "{output:?}");
    let recording = std::fs::File::open(folder.path().join("episodes.npz")).unwrap();
    let mut arrays = zip::ZipArchive::new(recording).unwrap();
    assert!(arrays.by_name("depth.npy").is_ok());
}

/// Returns the data of an array of a recording.
fn array(recording: &Path, name: &str) -> Vec<u8> {
    let mut arrays = zip::ZipArchive::new(std::fs::File::open(recording).unwrap()).unwrap();
    let mut bytes = Vec::new();
    let mut array = arrays.by_name(&format!("{name}.npy")).unwrap();
    array.read_to_end(&mut bytes).unwrap();
    let header = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
    bytes.split_off(header)
}

#[test]
fn an_mcap_recording_has_every_observation_of_the_npz_with_its_image_and_its_numbers() {
    let folder = run_folder();
    for record in ["episodes.npz", "episodes.mcap"] {
        let arguments = ["--run", ".", "--episodes", "2", "--record", record];
        let output = evaluate(folder.path(), &arguments);
        assert!(output.status.success(), "{output:?}");
    }
    let at = |name: &str| folder.path().join(name);
    assert!(!at("episodes.mcap.tmp").exists());
    let recording = std::fs::read(at("episodes.mcap")).unwrap();
    let messages: Vec<_> = mcap::MessageStream::new(&recording)
        .unwrap()
        .collect::<Result<_, _>>()
        .unwrap();
    let of = |topic: &str| -> Vec<&mcap::Message<'_>> {
        let of_topic = |message: &&mcap::Message<'_>| message.channel.topic == topic;
        messages.iter().filter(of_topic).collect()
    };
    let images = array(&at("episodes.npz"), "depth");
    let images = images.chunks_exact(72 * 128);
    let seen = of("/camera/image");
    assert_eq!(seen.len(), images.len());
    for (message, image) in seen.iter().zip(images) {
        let mut places = message.data.windows(image.len());
        assert!(places.any(|place| place == image), "an image differs");
    }
    let oracle = array(&at("episodes.npz"), "oracle_action");
    assert!(oracle.iter().any(|&byte| byte != 0), "the oracle was asked");
    for name in [
        "position_m",
        "latent",
        "action",
        "oracle_action",
        "reward_terms",
    ] {
        let values = array(&at("episodes.npz"), name);
        let steps = of("/drone/step");
        let rows = values.chunks_exact(values.len() / steps.len());
        for (message, row) in steps.iter().zip(rows) {
            let mut places = message.data.windows(row.len());
            assert!(places.any(|place| place == row), "{name} differs");
        }
    }
    for topic in [
        "/frames",
        "/camera/calibration",
        "/camera/depth",
        "/drone/reward",
    ] {
        assert_eq!(of(topic).len(), seen.len(), "{topic}");
    }
    assert!(
        of("/events").len() >= 8,
        "each of four episodes begins and ends"
    );
    assert!(of("/camera/reconstruction").is_empty(), "no decoder");
}

#[test]
fn a_recording_and_a_moving_picture_show_what_the_decoder_makes_of_the_codes() {
    let folder = run_folder();
    let at = folder.path();
    let run = RunDirectory::new(at);
    let encoder = TrainedEncoder::load(&run.latest_snapshot()).unwrap();
    let mut decoder = TrainedDecoder {
        values: vec![
            0.0;
            TrainedDecoder::tensors(encoder.latent)
                .last()
                .unwrap()
                .range
                .end
        ],
        latent: encoder.latent,
        encoder_sha256: "another encoder's".to_owned(),
    };
    let reconstructions = |decoder: &TrainedDecoder| {
        std::fs::write(run.decoder(), decoder.to_file()).unwrap();
        let files = ["--record", "episodes.mcap", "--gif", "film.gif"];
        let arguments = [&["--run", ".", "--episodes", "1"], &files[..]].concat();
        let output = evaluate(at, &arguments);
        assert!(output.status.success(), "{output:?}");
        assert!(at.join("film.gif").exists());
        let recording = std::fs::read(at.join("episodes.mcap")).unwrap();
        let messages = mcap::MessageStream::new(&recording).unwrap();
        let topics = messages.map(|message| message.unwrap().channel.topic.clone());
        let topics: Vec<_> = topics.collect();
        ["/camera/reconstruction", "/camera/image"]
            .map(|topic| topics.iter().filter(|other| *other == topic).count())
    };
    assert_eq!(reconstructions(&decoder)[0], 0, "of another encoder");
    decoder.encoder_sha256 = encoder.sha256();
    let [reconstructed, seen] = reconstructions(&decoder);
    assert!(
        seen > 0 && reconstructed == seen,
        "{reconstructed} of {seen}"
    );
    std::fs::write(run.decoder(), "no decoder").unwrap();
    let error = error_of(at, &["--run", ".", "--gif", "film.gif"]);
    for part in ["decoder.safetensors", "remove it"] {
        assert!(error.contains(part), "{error}");
    }
}

#[test]
fn an_evaluation_is_drawn_whatever_is_flown() {
    let folder = run_folder();
    let at = folder.path();
    // Names as users may have them.
    let strange = at.join("courses/zig zag\n\u{17c}\u{f3}\u{142}w.toml");
    std::fs::copy(shipped("non_rectangular.toml"), &strange).unwrap();
    let suite = "name = \"s\"\nepisodes = 2\n[[entry]]\nname = \"orders\"\norders_of = \
                 \"courses/training.toml\"\n[[entry]]\nname = \"new\"\n[entry.generated]\nshapes \
                 = [\"circle\"]\nclearance_m = [1.0, 1.0]\n";
    std::fs::write(at.join("suite.toml"), suite).unwrap();
    for (name, subject) in [
        ("own.png", &["--episodes", "1"][..]),
        (
            "no extension",
            &["--episodes", "2", "--course", strange.to_str().unwrap()],
        ),
        ("suite.png", &["--suite", "suite.toml"]),
        ("recorded.png", &["--episodes", "1", "--record", "r.npz"]),
    ] {
        let plot = [&["--run", ".", "--json", "r.json", "--plot", name], subject].concat();
        let output = evaluate(at, &plot);
        assert!(output.status.success(), "{name}: {output:?}");
        let picture = std::fs::read(at.join(name)).unwrap();
        assert!(picture.starts_with(b"\x89PNG"), "{name}");
        let partial = std::fs::read_dir(at).unwrap().filter(|entry| {
            let name = entry.as_ref().unwrap().file_name();
            name.to_string_lossy().contains("partial")
        });
        assert_eq!(partial.count(), 0, "{name}");
    }
}

#[test]
fn a_picture_replaces_no_device_and_no_other_result() {
    let folder = run_folder();
    let at = folder.path();
    let refused = |more: &[&str]| error_of(at, &[&["--run", "."], more].concat());
    let device = refused(&["--plot", "/dev/null"]);
    assert!(
        device.contains("/dev/null: it is not a regular file"),
        "{device}"
    );
    for option in ["--json", "--record"] {
        let same = refused(&["--plot", "one", option, "courses/../one"]);
        assert!(
            same.contains(&format!("{option} and --plot are the same file, ")),
            "{same}"
        );
    }
    assert!(!at.join("one").exists());
    // Nor a file of the run.
    for (option, file) in [("--gif", "a.png"), ("--failures", "a.gif")] {
        let other = refused(&[option, file]);
        assert!(other.contains("give it a name that ends in ."), "{other}");
    }
    for (option, file) in [("--json", "decoder.safetensors"), ("--gif", "config.toml")] {
        let own = refused(&[option, file]);
        let message = format!("{option} and a file of the run are the same");
        assert!(own.contains(&message), "{own}");
    }
}

#[test]
fn a_suite_has_the_same_result_on_any_number_of_threads() {
    let folder = run_folder();
    let text = r#"
        name = "three ways"
        episodes = 3
        [[entry]]
        name = "as it is"
        course = "courses/training.toml"
        [[entry]]
        name = "in any order"
        orders_of = "courses/training.toml"
        episodes = 5
        [entry.disturbances]
        latency_periods = 1
        gust.force_rms_n = 0.15
        depth.model = "stereo"
        [[entry]]
        name = "new courses"
        [entry.generated]
        shapes = ["circle"]
        clearance_m = [1.0, 1.0]
    "#;
    std::fs::write(folder.path().join("suite.toml"), text).unwrap();
    for threads in ["1", "3"] {
        let json = format!("{threads}.json");
        let output = evaluate(
            folder.path(),
            &[
                "--run",
                ".",
                "--suite",
                "suite.toml",
                "--threads",
                threads,
                "--json",
                &json,
            ],
        );
        assert!(output.status.success(), "{output:?}");
        let announced = String::from_utf8(output.stderr).unwrap();
        assert!(
            announced.contains("11 episodes in 3 entries"),
            "{announced}"
        );
    }
    let read = |name: &str| std::fs::read_to_string(folder.path().join(name)).unwrap();
    assert_eq!(read("1.json"), read("3.json"));
    let report: EvaluationReport = serde_json::from_str(&read("1.json")).unwrap();
    let flown: Vec<_> = report
        .courses
        .iter()
        .map(|entry| (entry.course.as_str(), entry.episodes))
        .collect();
    assert_eq!(
        flown,
        [("as it is", 3), ("in any order", 5), ("new courses", 3)]
    );
    for entry in &report.courses {
        let failed = |failures: &WallFailures| {
            failures.hit_wall + failures.hit_corridor + failures.timed_out
        };
        let failures: u64 = entry.failures.iter().map(failed).sum();
        assert_eq!(failures + entry.reached_end, entry.episodes, "{entry:?}");
        assert_eq!(entry.failures.len(), 6);
    }
    // The first entry is the course file, flown without disturbances.
    let output = evaluate(
        folder.path(),
        &[
            "--run",
            ".",
            "--course",
            "courses/training.toml",
            "--episodes",
            "3",
            "--json",
            "file.json",
        ],
    );
    assert!(output.status.success(), "{output:?}");
    let alone: EvaluationReport = serde_json::from_str(&read("file.json")).unwrap();
    let as_it_is = CourseEvaluation {
        course: "training".to_owned(),
        ..report.courses[0].clone()
    };
    assert_eq!(alone.courses, [as_it_is]);
}

#[test]
fn a_suite_that_cannot_be_flown_is_refused_by_file_and_entry() {
    let folder = run_folder();
    let at = folder.path();
    let refused = |text: &str| {
        std::fs::write(at.join("suite.toml"), text).unwrap();
        error_of(at, &["--run", ".", "--suite", "suite.toml"])
    };
    let head = "name = \"x\"\nepisodes = 1\n[[entry]]\nname = \"one\"\n";
    let no_course = refused(head);
    assert!(
        no_course.contains("suite.toml: entry \"one\": names its courses by 0"),
        "{no_course}"
    );
    let strong = refused(&format!(
        "{head}course = \"courses/training.toml\"\ndisturbances.mass_spread = 3.0\n"
    ));
    assert!(
        strong.contains("suite.toml")
            && strong.contains("entry \"one\"")
            && strong.contains("mass_spread = 3"),
        "{strong}"
    );
    assert!(error_of(at, &["--run", ".", "--suite", "none.toml"]).contains("none.toml"));
}

#[test]
fn files_that_cannot_be_written_are_refused_before_anything_is_flown() {
    let folder = run_folder();
    let at = folder.path();
    // Neither can be written, not even by root.
    std::os::unix::fs::symlink("none/result", at.join("link.json")).unwrap();
    std::fs::create_dir(at.join("blocked.npz.tmp")).unwrap();
    for (option, file) in [
        ("--json", "link.json"),
        ("--record", "blocked.npz"),
        ("--json", "none/result"),
        ("--record", "none/result"),
        ("--json", "courses"),
        ("--record", "courses"),
        ("--plot", "none/result"),
        ("--plot", "courses"),
    ] {
        let error = error_of(at, &["--run", ".", option, file]);
        assert!(error.contains(&format!("{file}: ")), "{error}");
        assert!(!error.contains("episodes on each of"), "{error}");
    }
}

#[test]
fn an_output_that_is_another_output_or_an_input_is_refused() {
    let folder = run_folder();
    let at = folder.path();
    let snapshot = "snapshots/latest.safetensors";
    let content = std::fs::read(at.join(snapshot)).unwrap();
    std::fs::hard_link(at.join(snapshot), at.join("linked")).unwrap();
    std::fs::create_dir(at.join("folder")).unwrap();
    for (link, target) in [
        ("one", "folder/new"),
        ("two", "three"),
        ("three", "folder/new"),
    ] {
        std::os::unix::fs::symlink(target, at.join(link)).unwrap();
    }
    for (outputs, other) in [
        // Both lead to a file that does not exist yet.
        (vec!["--json", "one", "--plot", "two"], "--plot"),
        (vec!["--json", "one", "--record", "folder/new"], "--record"),
        (
            vec!["--json", "a.png.partial", "--plot", "a.png"],
            "unfinished",
        ),
        (
            vec!["--json", "a.npz", "--record", "folder/../a.npz"],
            "--record",
        ),
        (
            vec!["--json", "a.npz.tmp", "--record", "a.npz"],
            "unfinished",
        ),
        (vec!["--json", snapshot], "the snapshot"),
        (vec!["--record", "linked"], "the snapshot"),
        (
            vec![
                "--course",
                "courses/training.toml",
                "--json",
                "courses/training.toml",
            ],
            "--course",
        ),
    ] {
        let error = error_of(at, &[["--run", "."].as_slice(), &outputs].concat());
        assert!(
            error.contains("the same file") && error.contains(other),
            "{error}"
        );
    }
    assert_eq!(std::fs::read(at.join(snapshot)).unwrap(), content);
}

#[test]
fn a_recording_that_does_not_fit_into_memory_is_refused() {
    let folder = run_folder();
    let more = ["--run", ".", "--episodes", "1000000", "--record", "all.npz"];
    let error = error_of(folder.path(), &more);
    for part in ["--record", "2000000 episodes", "GiB are free", "--episodes"] {
        assert!(error.contains(part), "{error}");
    }
}

#[test]
fn settings_of_the_simulator_can_be_changed_and_others_are_refused() {
    let folder = run_folder();
    let at = folder.path();
    let flown = |settings: &[&str], json: &str| {
        let mut arguments = vec!["--run", ".", "--episodes", "2", "--json", json];
        settings
            .iter()
            .for_each(|set| arguments.extend(["--set", set]));
        let output = evaluate(at, &arguments);
        assert!(output.status.success(), "{output:?}");
        std::fs::read_to_string(at.join(json)).unwrap()
    };
    let (as_trained, changed) = (
        flown(&[], "a.json"),
        flown(&["simulator.vehicle.preset=point"], "b.json"),
    );
    assert!(!as_trained.contains("changed_settings"), "{as_trained}");
    assert!(
        changed.contains("simulator.vehicle.preset=point"),
        "{changed}"
    );
    let report = |text: &str| {
        serde_json::from_str::<EvaluationReport>(text)
            .unwrap()
            .courses
    };
    assert_ne!(report(&as_trained), report(&changed));
    for (set, part) in [
        (
            "learning.observation=latent+velocity",
            "would change the networks",
        ),
        ("simulator.max_step=200", "max_step"),
        ("simulator.max_steps=0", "max_steps = 0"),
        ("simulator.max_steps=50", "58.0 m from the start"),
        ("simulator.vehicle.forward_speed_mps=0.3", "at most 24.0 m"),
        ("simulator.vehicle.preset=rocket", "rocket"),
    ] {
        let error = error_of(at, &["--run", ".", "--set", set]);
        assert!(error.contains("--set") && error.contains(part), "{error}");
    }
}

#[test]
fn of_several_settings_the_one_at_fault_is_named_whatever_is_flown() {
    let folder = run_folder();
    let at = folder.path();
    let suite = "name = \"s\"\nepisodes = 1\n[[entry]]\nname = \"one\"\ncourse = \
                 \"courses/training.toml\"\n[[entry]]\nname = \"new\"\n[entry.generated]\n";
    std::fs::write(at.join("suite.toml"), suite).unwrap();
    std::fs::write(at.join("broken.toml"), "name = 1").unwrap();
    let sound = [
        "--set",
        "run.seed=3",
        "--set",
        "simulator.vehicle.preset=point",
    ];
    let flown = [
        &["--suite", "suite.toml"][..],
        &["--course", "courses/training.toml"],
        &[],
    ];
    for subject in flown {
        for (set, part) in [
            (
                "simulator.vehicle.forward_speed_mps=-1",
                "forward_speed_mps = -1",
            ),
            ("simulator.vehicle.preset=rocket", "rocket"),
            ("simulator.generator.clearance_m=[3,1]", "no effect"),
            ("simulator.camera.range_m=-2", "range_m = -2"),
            ("simulator.camera.range_m=[1]", "range_m"),
            ("simulator.reward.collision=nan", "collision"),
            ("simulator.max_steps=0", "max_steps = 0"),
            ("simulator.max_steps=20", "from the start"),
            ("vae.latent=9", "vae.latent = 9"),
        ] {
            let last = [
                "--set",
                set,
                "--set",
                "simulator.vehicle.control_period_secs=0.4",
            ];
            let all = [&["--run", "."], subject, &sound, &last].concat();
            let error = error_of(at, &all);
            assert!(
                error.contains(&format!("--set {set}")) && error.contains(part),
                "{subject:?}: {error}"
            );
            assert!(!error.contains("--set run.seed"), "{error}");
            assert!(!error.contains("networks are computed"), "{error}");
        }
        // A fault of the file is not blamed on a setting.
        let broken = error_of(
            at,
            &[&["--run", "."], &sound[..], &["--course", "broken.toml"]].concat(),
        );
        assert!(!broken.contains("--set"), "{broken}");
    }
}

#[test]
fn a_failed_evaluation_creates_and_changes_no_file() {
    let folder = run_folder();
    let at = folder.path();
    std::fs::write(at.join("earlier.json"), "earlier").unwrap();
    std::os::unix::fs::symlink("later.json", at.join("link.json")).unwrap();
    for json in ["new.json", "earlier.json", "link.json"] {
        let outputs = ["--json", json, "--record", "new.npz"];
        let error = error_of(
            at,
            &[["--run", ".", "--course", "none.toml"].as_slice(), &outputs].concat(),
        );
        assert!(error.contains("none.toml"), "{error}");
    }
    for name in ["new.json", "later.json", "new.npz", "new.npz.tmp"] {
        assert!(!at.join(name).exists(), "{name}");
    }
    assert!(at.join("link.json").is_symlink());
    assert_eq!(
        std::fs::read_to_string(at.join("earlier.json")).unwrap(),
        "earlier"
    );
}

#[test]
fn more_threads_than_episodes_are_not_started() {
    let folder = run_folder();
    let arguments = ["--run", ".", "--episodes", "3", "--threads", "100000"];
    let output = evaluate(folder.path(), &arguments);
    assert!(output.status.success(), "{output:?}");
    let announced = String::from_utf8(output.stderr).unwrap();
    assert!(
        announced.contains("on each of 2 courses, 6 threads"),
        "{announced}"
    );
    assert!(announced.contains("images are drawn with "), "{announced}");
}

#[test]
fn a_thread_that_cannot_be_started_is_an_error() {
    let folder = run_folder();
    let output = Command::new(env!("CARGO_BIN_EXE_skein-evaluate"))
        .current_dir(folder.path())
        .args(["--run", ".", "--episodes", "2", "--threads", "2"])
        // A stack larger than the address space.
        .env("RUST_MIN_STACK", (1u64 << 60).to_string())
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    let error = String::from_utf8(output.stderr).unwrap();
    assert!(error.contains("cannot start thread 1 of 2"), "{error}");
}

#[test]
fn errors_name_the_file_and_the_remedy() {
    let folder = run_folder();
    let at = folder.path();
    let snapshot = ["--snapshot", "snapshots/latest.safetensors"];
    let with = |more: &[&str]| error_of(at, &[snapshot.as_slice(), more].concat());

    assert!(error_of(at, &["--run", "courses"]).contains("courses holds neither"));
    assert!(error_of(at, &["--snapshot", "none.safetensors"]).contains("none.safetensors"));
    assert!(with(&["--course", "none.toml"]).contains("none.toml"));
    assert!(with(&["--json", "none/report.json"]).contains("none/report.json"));
    std::fs::write(at.join("bent.toml"), "wals = 3").unwrap();
    let bent = with(&["--course", "bent.toml"]);
    assert!(
        bent.contains("bent.toml") && bent.contains("wals"),
        "{bent}"
    );
    std::fs::remove_dir_all(at.join("courses")).unwrap();
    let gone = with(&[]);
    assert!(
        gone.contains("/courses/training.toml") && gone.contains("--course"),
        "{gone}"
    );
    std::fs::write(
        at.join("snapshots/latest.safetensors"),
        b"nothing of the kind",
    )
    .unwrap();
    assert!(with(&[]).contains("snapshots/latest.safetensors"));
}

#[test]
fn help_documents_the_recording() {
    let help = String::from_utf8(evaluate(Path::new("."), &["--help"]).stdout).unwrap();
    for word in ["reward_terms", "course_names", "[n, 72, 128]"] {
        assert!(help.contains(word), "{help}");
    }
}

#[test]
fn a_write_beyond_the_limit_of_file_sizes_is_an_error_with_its_remedy() {
    let folder = run_folder();
    let arguments = "--run . --episodes 1 --threads 1 --record r.npz";
    let program = env!("CARGO_BIN_EXE_skein-evaluate");
    let output = Command::new("sh")
        .args(["-c", &format!("ulimit -f 8; exec {program} {arguments}")])
        .current_dir(folder.path())
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    let said = String::from_utf8(output.stderr).unwrap();
    for part in ["r.npz", "File too large", "ulimit -f"] {
        assert!(said.contains(part), "{part} is missing in {said}");
    }
    let left = std::fs::read_dir(folder.path()).unwrap();
    assert_eq!(left.count(), 2, "the snapshots and the courses");
}

#[test]
fn a_result_that_cannot_be_written_costs_no_other_and_the_first_is_named() {
    let folder = run_folder();
    let at = folder.path();
    // In the place of the unfinished picture: writing fails at the end, after the checks.
    std::fs::create_dir(at.join("p.png.partial")).unwrap();
    let fly = |json: &str| {
        let arguments = [
            "--run",
            ".",
            "--episodes",
            "1",
            "--plot",
            "p.png",
            "--json",
            json,
        ];
        let output = evaluate(at, &arguments);
        assert_eq!(output.status.code(), Some(1), "{output:?}");
        let table = String::from_utf8(output.stdout).unwrap();
        assert!(table.contains("non-rectangular"), "{table}");
        let said = String::from_utf8(output.stderr).unwrap();
        said.lines().last().unwrap().to_owned()
    };
    let said = fly("r.json");
    assert!(said.contains("cannot write p.png"), "{said}");
    let report = std::fs::read(at.join("r.json")).unwrap();
    serde_json::from_slice::<EvaluationReport>(&report).unwrap();
    let said = fly("/dev/full");
    assert!(said.contains("cannot write /dev/full"), "{said}");
}
