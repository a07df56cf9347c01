//! `skein-evaluate` reproduces the numbers of a run from its snapshot, and records the flown
//! episodes.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use std::fs::{self, File};
use std::io::Read;
use std::path::Path;
use std::process::Command;

use skein_protocol::config::Config;
use skein_protocol::evaluation::EvaluationReport;
use skein_protocol::snapshot::Snapshot;
use skein_run::tables::evaluation_table;
use skein_tests::{EndedRun, RunRecipe, program, repository, run_program};

/// Evaluates with `arguments` and returns the report.
fn evaluate(folder: &Path, arguments: &[&str]) -> EvaluationReport {
    let json = folder.join("report.json");
    let output = run_program(
        "skein-evaluate",
        &[arguments, &["--json", json.to_str().unwrap()]].concat(),
    );
    assert_eq!(output.code, Some(0), "{}", output.stderr);
    serde_json::from_str(&fs::read_to_string(json).unwrap()).unwrap()
}

#[test]
fn a_runs_snapshot_flies_later_as_it_flew_in_the_run() {
    let run = RunRecipe::small().set("evaluation.episodes=8").finish();
    let in_the_run = run.evaluation();
    let directory = run.directory.root().to_str().unwrap();
    let best = run.directory.best_snapshot();
    let folder = tempfile::tempdir().unwrap();

    for threads in ["1", "2", "5"] {
        let later = evaluate(folder.path(), &["--run", directory, "--threads", threads]);
        assert_eq!(later, in_the_run, "--run on {threads} threads");
    }
    let later = evaluate(folder.path(), &["--snapshot", best.to_str().unwrap()]);
    assert_eq!(later, in_the_run, "--snapshot");
    let fewer = evaluate(folder.path(), &["--run", directory, "--episodes", "3"]);
    assert!(fewer.courses.iter().all(|course| course.episodes == 3));

    a_report_draws_what_the_run_flew(&run, folder.path());
    a_recording_holds_every_step_of_every_episode(&run, 32, folder.path());
}

/// Asserts that `skein report` draws single episodes of the final evaluation, flown again.
fn a_report_draws_what_the_run_flew(run: &EndedRun, folder: &Path) {
    let pictures: [(&str, &[u8]); 2] = [("--failures", b"\x89PNG"), ("--gif", b"GIF89a")];
    let files = pictures.map(|(option, _)| folder.join(option));
    let path = |file: &Path| file.to_str().unwrap().to_owned();
    let mut arguments = vec!["report".to_owned(), "--run".to_owned()];
    arguments.push(path(run.directory.root()));
    for ((option, _), file) in pictures.iter().zip(&files) {
        arguments.extend([(*option).to_owned(), path(file)]);
    }
    let output = run_program("skein", &arguments);
    assert_eq!(output.code, Some(0), "{}", output.stderr);
    let table = evaluation_table(&run.evaluation(), usize::MAX);
    assert!(
        output.stdout.contains(table.trim_end()),
        "{}",
        output.stdout
    );
    for ((option, begins), file) in pictures.iter().zip(&files) {
        assert!(fs::read(file).unwrap().starts_with(begins), "{option}");
    }
}

#[test]
fn a_latent_code_of_another_length_is_learned_flown_and_recorded() {
    for latent in [8, 64] {
        let run = RunRecipe::small()
            .set(&format!("vae.latent={latent}"))
            .set("evaluation.episodes=8")
            .finish();
        let summary = run.summary();
        assert!(
            summary.vae_updates > 0 && summary.updates > 0,
            "{summary:?}"
        );
        let directory = run.directory.root().to_str().unwrap();
        let folder = tempfile::tempdir().unwrap();
        let later = evaluate(folder.path(), &["--run", directory]);
        assert_eq!(later, run.evaluation(), "{latent} numbers");
        a_recording_holds_every_step_of_every_episode(&run, latent, folder.path());
    }
}

/// The shipped snapshot must still fly as its shipped evaluation states.
#[test]
fn the_shipped_generalist_flies_courses_that_it_never_saw() {
    let folder = tempfile::tempdir().unwrap();
    let snapshots = repository().join("configs/snapshots");
    let said: EvaluationReport =
        serde_json::from_str(&fs::read_to_string(snapshots.join("generalist.json")).unwrap())
            .unwrap();
    let (_, config) = Snapshot::load(&snapshots.join("generalist.safetensors")).unwrap();
    let shipped = Config::load(&repository().join("configs/generalist.toml"), &[]).unwrap();
    let mut differences = shipped.differences(&config.portable()).unwrap();
    // The snapshot writes out the simulator's defaults; the file does not. The best of five seeds
    // is shipped.
    differences.retain(|difference| {
        !difference.ends_with("nothing here") && !difference.starts_with("run.seed = ")
    });
    assert_eq!(differences, Vec::<String>::new());

    // By a file name without folder, from its own folder.
    let json = folder.path().join("report.json");
    let output = Command::new(program("skein-evaluate"))
        .args([
            "--snapshot",
            "generalist.safetensors",
            "--episodes",
            "10",
            "--json",
        ])
        .arg(&json)
        .current_dir(&snapshots)
        .output()
        .unwrap();
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    let flown: EvaluationReport = serde_json::from_str(&fs::read_to_string(json).unwrap()).unwrap();
    assert_eq!(flown.policy_sha256, said.policy_sha256);
    assert_eq!(flown.courses.len(), config.courses.evaluation.len());
    for course in &flown.courses {
        assert!(course.reached_end >= 9, "{course:?}");
    }
}

/// Reads the recording by NumPy's documentation of its format, without any of Skein's code.
fn a_recording_holds_every_step_of_every_episode(run: &EndedRun, latent: usize, folder: &Path) {
    let file = folder.join("episodes.npz");
    evaluate(
        folder,
        &[
            "--run",
            run.directory.root().to_str().unwrap(),
            "--record",
            file.to_str().unwrap(),
        ],
    );
    let closing = array(&file, "closing", "|u1");
    let rows = closing.shape[0];
    for (name, kind, row) in [
        ("course", "<i4", &[][..]),
        ("episode", "<i4", &[]),
        ("step", "<i4", &[]),
        ("position_m", "<f4", &[3]),
        ("orientation", "<f4", &[4]),
        ("velocity_mps", "<f4", &[3]),
        ("depth", "|u1", &[72, 128]),
        ("latent", "<f4", &[latent]),
        ("action", "<f4", &[2]),
        ("reward_terms", "<f4", &[skein_protocol::REWARD_TERMS]),
        ("reward", "<f4", &[]),
        ("walls_passed", "|u1", &[]),
        ("terminated", "|u1", &[]),
        ("truncated", "|u1", &[]),
        ("goal_m", "<f4", &[3]),
    ] {
        let array = array(&file, name, kind);
        assert_eq!(array.shape, [&[rows], row].concat(), "{name}");
    }
    let codes = array(&file, "latent", "<f4");
    let last = codes.words().skip(latent - 1).step_by(latent);
    assert!(
        last.map(f32::from_le_bytes).any(|number| number != 0.0),
        "the largest code is implausible"
    );
    let episodes = closing.data.iter().filter(|&&closing| closing == 1).count();
    assert_eq!(episodes, 16, "eight episodes on each of two courses");

    // The rewards of all episodes on the first course equal those of the report.
    let evaluation = run.evaluation();
    let (course, reward) = (array(&file, "course", "<i4"), array(&file, "reward", "<f4"));
    let total: f64 = course
        .words()
        .zip(reward.words())
        .filter(|(course, _)| i32::from_le_bytes(*course) == 0)
        .map(|(_, reward)| f64::from(f32::from_le_bytes(reward)))
        .sum();
    let reported = evaluation.courses[0].mean_return * 8.0;
    assert!(
        (total - reported).abs() < 1e-3,
        "recorded {total}, reported {reported}"
    );
}

/// An array of a recording.
struct Array {
    shape: Vec<usize>,
    data: Vec<u8>,
}

impl Array {
    /// Returns its values, of four bytes each.
    fn words(&self) -> impl Iterator<Item = [u8; 4]> {
        self.data
            .chunks_exact(4)
            .map(|word| word.try_into().unwrap())
    }
}

/// Reads `name` from a `.npz` file: a zip of `.npy` files, whose header is a Python dictionary.
///
/// Source: numpy.lib.format, version 1.0.
fn array(file: &Path, name: &str, kind: &str) -> Array {
    let mut zip = zip::ZipArchive::new(File::open(file).unwrap()).unwrap();
    let mut bytes = Vec::new();
    let mut entry = zip
        .by_name(&format!("{name}.npy"))
        .unwrap_or_else(|_| panic!("no array {name}"));
    entry.read_to_end(&mut bytes).unwrap();
    assert_eq!(&bytes[..8], b"\x93NUMPY\x01\x00", "{name}");
    let data = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
    let header = std::str::from_utf8(&bytes[10..data]).unwrap();
    assert!(
        header.contains(&format!("'descr': '{kind}'")),
        "{name}: {header}"
    );
    assert!(
        header.contains("'fortran_order': False"),
        "{name}: {header}"
    );
    let (_, shape) = header.split_once("'shape': (").unwrap();
    let (shape, _) = shape.split_once(')').unwrap();
    let shape: Vec<usize> = shape
        .split(',')
        .map(str::trim)
        .filter(|axis| !axis.is_empty())
        .map(|axis| axis.parse().unwrap())
        .collect();
    let bytes_per_value: usize = kind[2..].parse().unwrap();
    assert_eq!(
        bytes.len() - data,
        shape.iter().product::<usize>() * bytes_per_value,
        "{name}: {header}"
    );
    Array {
        shape,
        data: bytes.split_off(data),
    }
}
