//! An experiment from its file to its report: interrupted, resumed, reported, published, and
//! refused after changes.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use skein_chaos::compare;
use skein_protocol::evaluation::EvaluationReport;
use skein_protocol::summary::RunEnding;
use skein_run::RunDirectory;
use skein_tests::{
    ProgramOutput, RunRecipe, episodes, leftovers, program, repository, run_program,
};

/// Time limit. On an idle machine, an experiment of four runs takes a tenth of it.
const LIMIT: Duration = Duration::from_secs(300);
/// Settings of both arms beyond `tests/small.toml`.
const SETTINGS: [&str; 2] = ["run.episodes=60", "evaluation.window_episodes=10"];

/// A repository with one experiment and its inputs.
struct Scene {
    folder: tempfile::TempDir,
}

impl Scene {
    fn new() -> Self {
        let scene = Self {
            folder: tempfile::tempdir().unwrap(),
        };
        fs::create_dir_all(scene.path("configs/experiments")).unwrap();
        scene.write_suite(5);
        scene.write("0.5");
        scene
    }

    /// Writes the experiment's file, with this share of success experience in the second arm.
    fn write(&self, share: &str) {
        let base = repository().join("tests/small.toml");
        let text = format!(
            "question = \"What for?\"\nbase = {base:?}\nseeds = 2\nsuite = \"../few.toml\"\n\
             tables = [\"evaluation\", \"outcomes\", \"suite\", \"learning\", \"cost\"]\ncurves = \
             [{{ measure = \"walls_passed\", over = \"episodes\" }}]\nsettings.run.episodes = 60\n\
             settings.evaluation.window_episodes = 10\n[[arm]]\nname = \"one-part\"\nlabel = \
             \"one part\"\nsettings.replay.success_share = 0.0\n[[arm]]\nname = \"half\"\nlabel = \
             \"half\"\nsettings.replay.success_share = {share}\n"
        );
        fs::write(self.path("configs/experiments/tiny.toml"), text).unwrap();
    }

    /// Writes the experiment's suite, with this many episodes per entry.
    fn write_suite(&self, episodes: u64) {
        let course = repository().join("configs/courses/training.toml");
        let text = format!(
            "name = \"few\"\nepisodes = {episodes}\n[[entry]]\nname = \"as it is\"\ncourse = \
             {course:?}\n[[entry]]\nname = \"in any order\"\norders_of = {course:?}\n\
             disturbances.latency_periods = 1\n"
        );
        fs::write(self.path("configs/few.toml"), text).unwrap();
    }

    fn path(&self, within: &str) -> PathBuf {
        self.folder.path().canonicalize().unwrap().join(within)
    }

    fn run(&self, arm: &str, seed: u64) -> RunDirectory {
        RunDirectory::new(self.path(&format!("runs/experiments/tiny/{arm}/seed-{seed}")))
    }

    /// The published document.
    fn document(&self) -> String {
        fs::read_to_string(self.path("docs/results/tiny.md")).unwrap()
    }

    fn arguments(&self, more: &[&str]) -> Vec<String> {
        let repository = self.path("").display().to_string();
        let all = ["experiment", "--repository", repository.as_str(), "tiny"];
        all.iter().chain(more).map(ToString::to_string).collect()
    }

    /// Runs the experiment to its end.
    fn finish(&self, more: &[&str]) -> ProgramOutput {
        run_program("skein", &self.arguments(more))
    }

    fn start(&self) -> Child {
        Command::new(program("skein"))
            .args(self.arguments(&[]))
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap()
    }
}

fn until<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let deadline = Instant::now() + LIMIT;
    loop {
        if let Some(found) = look() {
            return found;
        }
        assert!(Instant::now() < deadline, "never {what}");
        sleep(Duration::from_millis(20));
    }
}

fn completed(run: &RunDirectory) -> bool {
    run.summary()
        .is_some_and(|summary| summary.ending == RunEnding::Completed)
}

#[test]
fn an_experiment_is_interrupted_resumed_reported_and_published() {
    let scene = Scene::new();
    let runs: Vec<_> = [1, 2]
        .iter()
        .flat_map(|&seed| ["one-part", "half"].map(|arm| scene.run(arm, seed)))
        .collect();

    assert_a_job_runs_alone(&scene, &runs);
    let mut experiment = scene.start();
    until("the first run has episodes", || {
        (episodes(&runs[0]).len() >= 20).then_some(())
    });
    kill_process(
        Pid::from_raw(experiment.id().cast_signed()).unwrap(),
        Signal::INT,
    )
    .unwrap();
    let status = until("the experiment stops", || experiment.try_wait().unwrap());
    assert_eq!(status.code(), Some(130));
    assert!(
        !runs.iter().all(completed),
        "all runs were complete before the interruption"
    );
    for run in &runs {
        assert!(
            leftovers(run).is_empty(),
            "left behind: {:?}",
            leftovers(run)
        );
    }

    let output = scene.finish(&[]);
    assert_eq!(output.code, Some(0), "{}", output.stderr);
    assert!(runs.iter().all(completed));
    assert!(
        !scene.path("docs").exists(),
        "nothing is published without --publish"
    );
    let report = scene.path("runs/experiments/tiny/report");
    let text = fs::read_to_string(report.join("report.md")).unwrap();
    assert!(output.stdout.contains(text.trim_end()));
    for part in [
        "# What for?",
        "| one part |",
        "`replay.success_share=0.0`",
        "non-rectangular",
        "The best snapshot in the suite `few.toml`",
        "| in any order |     2 |        5 |",
        "| hit wall 1, 2, … | hit the corridor before 1, …, end | timed out before 1, …, end |",
        "How the episodes of the suite `few.toml` ended",
        "2 seeds an arm",
    ] {
        assert!(text.contains(part), "`{part}` is missing in\n{text}");
    }
    let picture = fs::read(report.join("walls_passed_over_episodes.png")).unwrap();
    assert!(picture.starts_with(b"\x89PNG"));

    // The interrupted run has the same results as an uninterrupted run that a user starts with the
    // same settings.
    let mut alone = RunRecipe::small()
        .set("replay.success_share=0.0")
        .set("run.learner_threads=1");
    for setting in SETTINGS {
        alone = alone.set(setting);
    }
    let alone = alone.finish();
    for check in compare(&alone.directory, &runs[0]) {
        assert!(check.verdict.is_ok(), "{}: {:?}", check.what, check.verdict);
    }

    assert_published(&scene, &text);
    assert_only_the_suite_is_flown_again(&scene, &runs);
    assert_a_suite_is_flown_as_often_as_the_experiment_says(&scene, &runs);
    assert_refused_when_changed(&scene);
}

/// Runs the last of the four commands of the list, which trains `runs[3]` alone.
fn assert_a_job_runs_alone(scene: &Scene, runs: &[RunDirectory]) {
    let listed = || scene.finish(&["--list-jobs"]).stdout;
    let all = listed();
    let jobs: Vec<_> = all.lines().collect();
    assert_eq!(jobs.len(), 4, "{all}");
    let job = jobs[3].strip_prefix("launch/experiment.sh tiny ").unwrap();
    assert_eq!(job, "--job half/seed-2");
    let output = scene.finish(&job.split(' ').collect::<Vec<_>>());
    assert_eq!(output.code, Some(0), "{}", output.stderr);
    assert!(completed(&runs[3]) && !runs[0].root().exists());
    assert!(!scene.path("runs/experiments/tiny/report").exists());
    assert_eq!(listed(), all.replace(&format!("{}\n", jobs[3]), ""));
    let output = scene.finish(&["--job", "half/seed-9"]);
    assert_eq!(output.code, Some(1));
    for part in ["half/seed-9", "one-part/seed-1", "--list-jobs"] {
        assert!(output.stderr.contains(part), "{}", output.stderr);
    }
}

#[test]
fn an_invalid_experiment_does_not_hide_the_others() {
    let scene = Scene::new();
    fs::write(
        scene.path("configs/experiments/broken.toml"),
        "question = 1\n",
    )
    .unwrap();
    let repository = scene.path("").display().to_string();
    let output = run_program(
        "skein",
        &["experiment", "--repository", &repository, "--list"],
    );
    assert_eq!(output.code, Some(1));
    assert!(
        output.stdout.contains("tiny") && output.stdout.contains("What for?"),
        "{}",
        output.stdout
    );
    assert!(
        output.stderr.contains("broken.toml is not an experiment"),
        "{}",
        output.stderr
    );
}

/// A repeated report runs nothing, is identical, and replaces the published one.
fn assert_published(scene: &Scene, report: &str) {
    for answer in ["Because.\n", ""] {
        let output = scene.finish(&["--report", "--publish"]);
        assert_eq!(output.code, Some(0), "{}", output.stderr);
        let answered = scene
            .document()
            .replace("<!-- report", &format!("{answer}<!-- report"));
        fs::write(scene.path("docs/results/tiny.md"), answered).unwrap();
    }
    let document = scene.document();
    assert!(
        document.starts_with("# What for?\n\nBecause.\n<!-- report -->\n"),
        "{document}"
    );
    assert_eq!(document.matches("<!-- end -->").count(), 1);
    let picture = "pictures/tiny_walls_passed_over_episodes.png";
    let folder = scene.path("docs/results");
    assert!(document.contains(picture) && folder.join(picture).is_file());
    let lines = fs::read_to_string(folder.join("runs/tiny.csv")).unwrap();
    for (arm, seed) in [("one-part", 1), ("half", 1), ("one-part", 2), ("half", 2)] {
        let learned = scene.run(arm, seed).summary().unwrap().policy_sha256;
        let line = lines
            .lines()
            .find(|line| line.starts_with(&format!("{arm},{seed},")));
        assert!(line.is_some_and(|line| line.contains(&learned)), "{lines}");
    }
    let published = document
        .replace("(pictures/tiny_", "(")
        .replace("runs/tiny.csv", "runs.csv");
    let (heading, body) = report.split_once("\n\n").unwrap();
    let (body, _) = body.split_once("\n\nHow to read").unwrap();
    assert!(
        heading == "# What for?" && published.contains(body),
        "{published}\n---\n{report}"
    );
    // An incomplete experiment must not replace a complete one.
    for part in [["--seeds", "1"], ["--episodes", "20"]] {
        let output = scene.finish(&[&part[..], &["--report", "--publish"]].concat());
        output.assert_refused(&["--publish", "2 seeds"]);
        assert_eq!(scene.document(), document);
    }
}

/// Returns the suite results of a run.
fn suite_results(run: &RunDirectory) -> Vec<PathBuf> {
    let folder = run.suite_json("any");
    let entries = fs::read_dir(folder.parent().unwrap()).unwrap();
    let mut results: Vec<_> = entries.map(|entry| entry.unwrap().path()).collect();
    results.sort();
    results
}

/// Asserts that a trained run only flies its suite, whether the suite failed before, was
/// interrupted, or has changed.
fn assert_only_the_suite_is_flown_again(scene: &Scene, runs: &[RunDirectory]) {
    let files = |run: &RunDirectory| {
        [run.summary_json(), run.episodes_csv()]
            .map(|file| fs::metadata(file).unwrap().modified().unwrap())
    };
    let before: Vec<_> = runs.iter().map(files).collect();
    let result = suite_results(&runs[1]).pop().unwrap();
    let flown = fs::read(&result).unwrap();
    let report: EvaluationReport = serde_json::from_slice(&flown).unwrap();
    let entries: Vec<_> = report
        .courses
        .iter()
        .map(|entry| (entry.course.as_str(), entry.episodes))
        .collect();
    assert_eq!(entries, [("as it is", 5), ("in any order", 5)]);

    // A suite may fail, like a run.
    fs::remove_file(&result).unwrap();
    let snapshots = [runs[1].snapshots(), runs[1].root().join("aside")];
    fs::rename(&snapshots[0], &snapshots[1]).unwrap();
    let output = scene.finish(&[]);
    assert_eq!(output.code, Some(1), "{}", output.stderr);
    for part in [
        "4 runs of 2 arms with 2 seeds each, 3 complete already, 1 trained already",
        "half/seed-1 failed: its `skein evaluate` exited with status 1",
        "holds neither snapshots/best.safetensors",
        "the same command tries them again",
    ] {
        assert!(
            output.stderr.contains(part),
            "`{part}` is missing in\n{}",
            output.stderr
        );
    }
    assert!(
        output
            .stdout
            .contains("**Incomplete**: 3 of 4 runs are complete.")
    );
    fs::rename(&snapshots[1], &snapshots[0]).unwrap();
    let output = scene.finish(&[]);
    assert_eq!(output.code, Some(0), "{}", output.stderr);
    assert!(
        output
            .stderr
            .contains("half/seed-1 is complete: it completed "),
        "{}",
        output.stderr
    );
    assert!(
        !output.stderr.contains("half/seed-1 is trained"),
        "{}",
        output.stderr
    );
    assert_eq!(
        fs::read(&result).unwrap(),
        flown,
        "the same episodes have other results"
    );

    // Interrupts another suite of the same name, too long to complete. The results of the first
    // stay valid.
    scene.write_suite(1_000_000);
    let mut experiment = scene.start();
    until("a suite is flown", || {
        let said = fs::read_to_string(runs[0].root().with_extension("log")).unwrap();
        said.contains("1000000 episodes on each of 2 entries")
            .then_some(())
    });
    kill_process(
        Pid::from_raw(experiment.id().cast_signed()).unwrap(),
        Signal::INT,
    )
    .unwrap();
    let status = until("the experiment stops", || experiment.try_wait().unwrap());
    assert_eq!(status.code(), Some(130));
    scene
        .finish(&["--report"])
        .assert_refused(&["no run in", "tiny is complete"]);
    scene.write_suite(5);
    let output = scene.finish(&["--report"]);
    assert_eq!(output.code, Some(0), "{}", output.stderr);
    assert_eq!(suite_results(&runs[1]), [result]);
    assert_eq!(
        runs.iter().map(files).collect::<Vec<_>>(),
        before,
        "trained again"
    );
}

/// A different number of episodes is another result, beside the suite's own.
fn assert_a_suite_is_flown_as_often_as_the_experiment_says(scene: &Scene, runs: &[RunDirectory]) {
    let file = scene.path("configs/experiments/tiny.toml");
    let text = fs::read_to_string(&file).unwrap();
    fs::write(&file, format!("suite_episodes = 2\n{text}")).unwrap();
    let output = scene.finish(&[]);
    assert_eq!(output.code, Some(0), "{}", output.stderr);
    for run in runs {
        let results = suite_results(run);
        let flown = |result: &PathBuf| -> Vec<u64> {
            let report: EvaluationReport =
                serde_json::from_slice(&fs::read(result).unwrap()).unwrap();
            report.courses.iter().map(|entry| entry.episodes).collect()
        };
        assert_eq!(
            results
                .iter()
                .filter(|result| flown(result) == [2, 2])
                .count(),
            1,
            "{results:?}"
        );
        assert_eq!(
            results
                .iter()
                .filter(|result| flown(result) == [5, 5])
                .count(),
            1,
            "{results:?}"
        );
    }
}

/// Asserts that runs with another configuration than the file's are never mixed with its runs, and
/// never removed.
fn assert_refused_when_changed(scene: &Scene) {
    scene.write("0.25");
    for arguments in [&[][..], &["--report"]] {
        let changed = scene.run("half", 1);
        let directory = changed.root().display().to_string();
        scene.finish(arguments).assert_refused(&[
            &directory,
            "replay.success_share = 0.5 there, 0.25 here",
            "mv ",
        ]);
        assert!(completed(&changed));
    }
    scene
        .finish(&["--episodes", "60"])
        .assert_refused(&["tiny.toml", "--episodes = 60 does not shorten the run"]);
    let nothing: &Path = &scene.path("runs/experiments/tiny_20_episodes");
    scene
        .finish(&["--episodes", "20", "--report"])
        .assert_refused(&["no run in", &nothing.display().to_string()]);
}
