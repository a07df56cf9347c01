//! An experiment from its file to its report: interrupted, gone on with, told, published, and refused once it is another.

#![allow(clippy::unwrap_used, reason = "a test's helpers fail by panicking, as tests do")]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use skein_launch::inspection::compare;
use skein_protocol::run::RunDirectory;
use skein_protocol::summary::{Ending, Summary};
use skein_tests::{Output, Recipe, flights, leftovers, program, repository, run_program};

/// An experiment of four runs takes a tenth of it on an idle machine.
const LIMIT: Duration = Duration::from_secs(300);
/// Beside `tests/small.toml`, in both arms.
const SETTINGS: [&str; 2] = ["run.flights=60", "evaluation.window_flights=10"];

/// A repository with one experiment, and no other content than it needs.
struct Scene {
    folder: tempfile::TempDir,
}

impl Scene {
    fn new() -> Self {
        let scene = Self {
            folder: tempfile::tempdir().unwrap(),
        };
        fs::create_dir_all(scene.path("configs/experiments")).unwrap();
        fs::write(scene.path("RESULTS.md"), "# Results\n\nBefore.\n").unwrap();
        scene.write("0.5");
        scene
    }

    /// Writes the experiment's file, whose second arm has this share of success experience.
    fn write(&self, share: &str) {
        let base = repository().join("tests/small.toml");
        let text = format!(
            "question = \"What for?\"\nbase = {base:?}\nseeds = 2\ntables = [\"evaluation\", \"outcomes\", \"learning\", \"cost\"]\n\
             curves = [{{ measure = \"walls_passed\", over = \"flights\" }}]\nsettings.run.flights = 60\nsettings.evaluation.window_flights = 10\n\
             [[arm]]\nname = \"one-part\"\nlabel = \"one part\"\nsettings.replay.success_share = 0.0\n\
             [[arm]]\nname = \"half\"\nlabel = \"half\"\nsettings.replay.success_share = {share}\n"
        );
        fs::write(self.path("configs/experiments/tiny.toml"), text).unwrap();
    }

    fn path(&self, within: &str) -> PathBuf {
        self.folder.path().canonicalize().unwrap().join(within)
    }

    fn run(&self, arm: &str, seed: u64) -> RunDirectory {
        RunDirectory::new(self.path(&format!("runs/experiments/tiny/{arm}/seed-{seed}")))
    }

    fn results(&self) -> String {
        fs::read_to_string(self.path("RESULTS.md")).unwrap()
    }

    fn arguments(&self, more: &[&str]) -> Vec<String> {
        let repository = self.path("").display().to_string();
        let all = ["--repository", repository.as_str(), "tiny"];
        all.iter().chain(more).map(ToString::to_string).collect()
    }

    /// Runs it to its end.
    fn finish(&self, more: &[&str]) -> Output {
        run_program("skein-experiment", &self.arguments(more))
    }

    fn start(&self) -> Child {
        Command::new(program("skein-experiment"))
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
    Summary::of(run).is_some_and(|summary| summary.ending == Ending::Completed)
}

#[test]
fn an_experiment_is_interrupted_gone_on_with_told_and_published() {
    let scene = Scene::new();
    let runs: Vec<_> = [1, 2]
        .iter()
        .flat_map(|&seed| ["one-part", "half"].map(|arm| scene.run(arm, seed)))
        .collect();

    let mut experiment = scene.start();
    until("the first run has flights", || {
        (flights(&runs[0]).len() >= 20).then_some(())
    });
    kill_process(Pid::from_raw(experiment.id().cast_signed()).unwrap(), Signal::INT).unwrap();
    let status = until("the experiment stops", || experiment.try_wait().unwrap());
    assert_eq!(status.code(), Some(130));
    assert!(!runs.iter().all(completed), "nothing was left to go on with");
    for run in &runs {
        assert!(leftovers(run).is_empty(), "left behind: {:?}", leftovers(run));
    }

    let output = scene.finish(&[]);
    assert_eq!(output.code, Some(0), "{}", output.stderr);
    assert!(runs.iter().all(completed));
    assert_eq!(
        scene.results(),
        "# Results\n\nBefore.\n",
        "nothing is published unasked"
    );
    let report = scene.path("runs/experiments/tiny/report");
    let text = fs::read_to_string(report.join("report.md")).unwrap();
    assert!(output.stdout.contains(text.trim_end()));
    for part in [
        "**What for?**",
        "| one part |",
        "`replay.success_share=0.0`",
        "non_rectangular",
        "| hit wall 1, 2, … | hit the corridor | timed out |",
        "2 seeds an arm",
    ] {
        assert!(text.contains(part), "`{part}` is missing in\n{text}");
    }
    let picture = fs::read(report.join("walls_passed_over_flights.png")).unwrap();
    assert!(picture.starts_with(b"\x89PNG"));

    // What was interrupted came to the same as a run of a user who set the same and was left in peace.
    let mut alone = Recipe::small()
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
    assert_refused_when_changed(&scene);
}

/// Telling it again runs nothing, gives the same report, and replaces what was published before.
fn assert_published(scene: &Scene, report: &str) {
    for _ in 0..2 {
        let output = scene.finish(&["--report", "--publish"]);
        assert_eq!(output.code, Some(0), "{}", output.stderr);
    }
    let results = scene.results();
    assert!(results.starts_with("# Results\n\nBefore.\n\n## Experiment: tiny\n\n<!-- experiment: tiny -->\n"));
    assert_eq!(results.matches("<!-- end -->").count(), 1);
    let picture = "launch/pictures/experiments/tiny_walls_passed_over_flights.png";
    assert!(results.contains(picture) && scene.path(picture).is_file());
    let published = results.replace("launch/pictures/experiments/tiny_", "");
    assert!(published.contains(report.trim_end()), "{published}\n---\n{report}");
}

/// What was learned from another configuration is never mixed with what the file says now, and never removed.
fn assert_refused_when_changed(scene: &Scene) {
    scene.write("0.25");
    for arguments in [&[][..], &["--report"]] {
        let changed = scene.run("half", 1);
        let directory = changed.root().display().to_string();
        scene
            .finish(arguments)
            .assert_refused(&[&directory, "replay.success_share = 0.5 there, 0.25 here", "mv "]);
        assert!(completed(&changed));
    }
    scene
        .finish(&["--flights", "60"])
        .assert_refused(&["tiny.toml", "--flights = 60 shortens nothing"]);
    let nothing: &Path = &scene.path("runs/experiments/tiny_20_flights");
    scene
        .finish(&["--flights", "20", "--report"])
        .assert_refused(&["no run in", &nothing.display().to_string()]);
}
