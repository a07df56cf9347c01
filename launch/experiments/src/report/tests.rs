//! Reports made from the files that runs leave.

use std::fs;
use std::path::Path;

use skein_protocol::evaluation::{CourseEvaluation, EpisodeScore, EvaluationReport};
use skein_protocol::ids::PolicyVersion;
use skein_protocol::transition::Outcome;

use super::*;
use crate::definition::{Axis, CurveSpec, FactorPoint, Measure, TableKind};
use crate::plan::{PlannedRun, RunState};
use crate::results;

const SUMMARY: &str = r#"{"skein_version":"0","run":7,"seed":1,"ending":"completed",
        "policy_sha256":"",
        "final_version":8,"best_version":7,
    "best_confirmed_walls_passed":4.9,"episodes":8,"steps":4,"updates":2,
        "vae_updates":4,"evaluation_episodes":4,
    "tickets_reissued":0,"records_refused":0,"wall_secs":3.3}"#;

/// Returns an entry of four episodes: `completed` of them passed both walls, the others none.
fn entry_result(entry: &str, completed: usize) -> CourseEvaluation {
    let score = |number: usize| EpisodeScore {
        walls_passed: if number < completed { 2 } else { 0 },
        walls: 2,
        episode_return: 0.0,
        outcome: match number < completed {
            true => Outcome::ReachedEnd,
            false => Outcome::TimedOut,
        },
        hit_wall: None,
    };
    let episodes: Vec<_> = (0..4).map(score).collect();
    CourseEvaluation::of(entry, &episodes)
}

fn leave(run: &PlannedRun, suite: &[CourseEvaluation]) {
    let result = run.suite_json.as_ref().unwrap();
    fs::create_dir_all(result.parent().unwrap()).unwrap();
    let report = |courses: &[CourseEvaluation]| {
        let report = EvaluationReport {
            policy_version: PolicyVersion(7),
            policy_sha256: String::new(),
            courses: courses.to_vec(),
        };
        serde_json::to_string(&report).unwrap()
    };
    fs::write(result, report(suite)).unwrap();
    fs::write(run.directory.evaluation_json(), report(&[])).unwrap();
    fs::write(run.directory.summary_json(), SUMMARY).unwrap();
    fs::write(
        run.directory.episodes_csv(),
        "steps,walls_passed,return\n4,2,1.0\n",
    )
    .unwrap();
}

/// Creates an experiment in `folder` with one arm and two complete runs: the first completed half
/// of its calm episodes, the second all.
fn two_runs(folder: &Path) -> (Experiment, ExperimentPlan) {
    runs(folder, "", &[2, 4])
}

/// Creates an experiment in `folder` with arm A and `more_arms`, two seeds each, and complete runs
/// in the plan's order. Of four calm episodes, run i completed `calm[i]`.
fn runs(folder: &Path, more_arms: &str, calm: &[usize]) -> (Experiment, ExperimentPlan) {
    let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs");
    let (base, course) = (
        configs.join("smoke.toml"),
        configs.join("courses/training.toml"),
    );
    let entry = |name: &str| format!("[[entry]]\nname = \"{name}\"\ncourse = {course:?}\n");
    let suite = format!(
        "name = \"few\"\nepisodes = 4\n{}{}",
        entry("calm"),
        entry("windy")
    );
    fs::write(folder.join("few.toml"), suite).unwrap();
    let experiment = format!(
        "question = \"?\"\nbase = {base:?}\nseeds = 2\nsuite = \"few.toml\"\ntables = \
         [\"suite\"]\npaper_episodes = 4000\ncurves = []\n[settings]\nevaluation.window_episodes \
         = 2\nlearning.warmup_steps = 20\nsac.batch_size = 16\n[[arm]]\nname = \"a\"\nlabel = \
         \"A\"\n{more_arms}"
    );
    fs::write(folder.join("test.toml"), experiment).unwrap();
    let experiment = Experiment::load(folder, "test", None).unwrap();
    let mut plan = ExperimentPlan::new(&experiment, &folder.join("runs"), 2).unwrap();
    for (run, &calm) in plan.runs.iter_mut().zip(calm) {
        leave(run, &[entry_result("calm", calm), entry_result("windy", 1)]);
        run.state = RunState::Complete;
    }
    (experiment, plan)
}

/// Returns the results of all complete runs.
fn read(plan: &ExperimentPlan) -> Vec<RunResult> {
    let (results, failures) = results::read(plan);
    assert!(failures.is_empty(), "{failures:?}");
    results
}

pub(super) fn findings<'a>(
    experiment: &'a Experiment,
    plan: &'a ExperimentPlan,
    results: &'a [RunResult],
) -> Findings<'a> {
    Findings {
        experiment,
        plan,
        results,
        command: String::new(),
    }
}

#[test]
fn a_suite_has_a_row_per_entry_over_the_seeds() {
    let folder = tempfile::tempdir().unwrap();
    let (experiment, mut plan) = two_runs(folder.path());
    let report_text = |plan: &ExperimentPlan| {
        let runs = read(plan);
        let findings = findings(&experiment, plan, &runs);
        let tables = findings.tables(TableKind::Suite);
        assert!(
            tables[0].title.contains("`few.toml`"),
            "{}",
            tables[0].title
        );
        tables[0].table.clone()
    };
    let compact = |line: &str| line.split_whitespace().collect::<Vec<_>>().join(" ");
    let rows: Vec<_> = report_text(&plan).lines().map(compact).collect();
    assert_eq!(
        [&*rows[0], &*rows[2], &*rows[3]],
        [
            "| arm | entry | seeds | episodes | completed, mean | completed | R |",
            "| A | calm | 2 | 4 | 75.0 % [50.0 %, 100.0 %] | 75.0 % [50.0 %, 100.0 %] \
             | 0.750 [0.500, 1.000] |",
            "| A | windy | 2 | 4 | 25.0 % [25.0 %, 25.0 %] | 25.0 % [25.0 %, 25.0 %] \
             | 0.250 [0.250, 0.250] |",
        ]
    );
    // A run without a suite result contributes nothing.
    plan.runs[1].state = RunState::Trained;
    assert!(
        report_text(&plan).contains("| 1 of 2 |"),
        "{}",
        report_text(&plan)
    );

    let result = plan.runs[0].suite_json.clone().unwrap();
    fs::write(&result, "{").unwrap();
    // Nor does one whose suite result is damaged. It is named.
    plan.runs[1].state = RunState::Complete;
    let (results, failures) = results::read(&plan);
    assert_eq!(results.iter().map(|run| run.seed).collect::<Vec<_>>(), [2]);
    let [error] = &failures[..] else {
        panic!("{failures:?}")
    };
    let error = error.to_string();
    assert!(
        error.contains(&result.display().to_string()) && error.contains("move this file away"),
        "{error}"
    );
    let left = findings(&experiment, &plan, &results);
    assert!(!left.is_whole());
    let body = left.body(&[], "runs.csv");
    assert!(body.contains("1 of 2 runs are complete"), "{body}");
}

#[test]
fn a_run_whose_last_episode_is_cut_off_is_left_out_and_named() {
    let folder = tempfile::tempdir().unwrap();
    let (_, plan) = two_runs(folder.path());
    let damaged = plan.runs[0].directory.episodes_csv();
    fs::write(&damaged, "steps,walls_passed,return\n4,2,1.0\n4,2,").unwrap();
    let (results, failures) = results::read(&plan);
    assert_eq!((results.len(), failures.len()), (1, 1));
    let error = failures[0].to_string();
    assert!(
        error.contains(&damaged.display().to_string()) && error.contains("cut off"),
        "{error}"
    );
}

/// Arm B completes one calm episode more than arm A with either seed. The arms' intervals overlap.
#[test]
fn an_arm_is_compared_with_the_first_seed_by_seed() {
    let folder = tempfile::tempdir().unwrap();
    let b = "[[arm]]\nname = \"b\"\nlabel = \"B\"\nsettings.replay.success_share = 0.25\n";
    let (experiment, mut plan) = runs(folder.path(), b, &[1, 2, 3, 4]);
    let compact = |line: &str| line.split_whitespace().collect::<Vec<_>>().join(" ");
    let lines = |plan: &ExperimentPlan, kind| {
        let results = read(plan);
        let tables = findings(&experiment, plan, &results).tables(kind);
        let lines: Vec<_> = tables[0].table.lines().map(compact).collect();
        lines
    };
    let suite = lines(&plan, TableKind::Suite);
    assert_eq!(
        suite[6],
        "| B, difference to A | calm | 2 | 4 | +25.0 [+25.0, +25.0] points \
         | +25.0 [+25.0, +25.0] points | +0.250 [+0.250, +0.250] |"
    );
    assert!(
        suite[7].contains("| +0.000 [+0.000, +0.000] |"),
        "{}",
        suite[7]
    );
    for kind in [TableKind::Learning, TableKind::Steadiness] {
        let lines = lines(&plan, kind);
        assert_eq!(lines.len(), 5, "{lines:?}");
        assert!(
            lines[4].starts_with("| B, difference to A | 2 |"),
            "{}",
            lines[4]
        );
    }
    let results = read(&plan);
    let body = findings(&experiment, &plan, &results).body(&[], "runs.csv");
    assert!(body.contains("A row \"difference to A\""), "{body}");
    // Without B's second run only the first seed is compared: no evidence about other seeds.
    plan.runs[3].state = RunState::Begun;
    let suite = lines(&plan, TableKind::Suite);
    assert!(
        suite[6].starts_with("| B, difference to A | calm | 1 of 2 | 4 | +25.0 points |"),
        "{}",
        suite[6]
    );
}

#[test]
fn a_picture_that_cannot_be_drawn_costs_only_itself() {
    let folder = tempfile::tempdir().unwrap();
    let (mut experiment, plan) = two_runs(folder.path());
    let curve = |over| CurveSpec {
        measure: Measure::Return,
        over,
    };
    experiment.curves = vec![curve(Axis::Steps), curve(Axis::Episodes)];
    let rows = "steps,walls_passed,return\n4,2,1.0\n4,2,1.0\n4,2,1.0\n4,2,1.0\n";
    for run in &plan.runs {
        fs::write(run.directory.episodes_csv(), rows).unwrap();
    }
    let report = plan.root.join(crate::plan::REPORT);
    // In the place of a picture.
    fs::create_dir_all(report.join("return_over_steps.png")).unwrap();
    let results = read(&plan);
    let written = findings(&experiment, &plan, &results).write().unwrap();
    let files: Vec<_> = written
        .pictures
        .iter()
        .map(|picture| &picture.file[..])
        .collect();
    assert_eq!(files, ["return_over_episodes.png"]);
    let [failure] = &written.failures[..] else {
        panic!("{:?}", written.failures)
    };
    assert!(
        failure.to_string().contains("return_over_steps.png"),
        "{failure}"
    );
    assert!(written.document.is_file() && report.join("runs.csv").is_file());
}

#[test]
fn runs_of_several_builds_are_marked() {
    let folder = tempfile::tempdir().unwrap();
    let (experiment, plan) = two_runs(folder.path());
    let report_text = || {
        let runs = read(&plan);
        findings(&experiment, &plan, &runs).body(&[], "runs.csv")
    };
    let (one, several) = (report_text(), "**Several builds**");
    let shortened = "**Shortened**: 300 training episodes a run instead of the 4000 of the paper.";
    assert!(one.contains(shortened), "{one}");
    assert!(
        one.contains("Skein 0.\n") && !one.contains(several),
        "{one}"
    );

    let newer = SUMMARY.replace(r#""skein_version":"0""#, r#""skein_version":"0+b873565""#);
    fs::write(plan.runs[1].directory.summary_json(), newer).unwrap();
    let two = report_text();
    assert!(
        two.contains("Skein 0, 0+b873565.\n") && two.contains(several),
        "{two}"
    );
}

#[test]
fn each_line_of_a_factor_has_a_picture_of_the_courses_over_it() {
    let folder = tempfile::tempdir().unwrap();
    let more = "[[arm]]\nname = \"b\"\nlabel = \"B\"\nsettings.replay.success_share = 0.3\n";
    let (mut experiment, plan) = runs(folder.path(), more, &[2; 4]);
    experiment.factor = Some("width, m".to_owned());
    for (arm, value) in experiment.arms.iter_mut().zip([3.0, 2.0]) {
        let line = "narrow".to_owned();
        arm.at = Some(FactorPoint { line, value });
    }
    for (run, completed) in plan.runs.iter().zip([1, 2, 3, 4]) {
        let report = EvaluationReport {
            policy_version: PolicyVersion(7),
            policy_sha256: String::new(),
            courses: vec![entry_result("training", completed)],
        };
        let report = serde_json::to_string(&report).unwrap();
        fs::write(run.directory.evaluation_json(), report).unwrap();
    }
    let results = read(&plan);
    let findings = findings(&experiment, &plan, &results);
    // First seeds come first: A completed 1 and 3 of 4 episodes, B 2 and 4.
    let points = findings.course_over_factor("narrow", "training");
    let placed: Vec<_> = points.iter().map(|point| (point.x, point.value)).collect();
    assert_eq!(placed, [(2.0, 0.75), (3.0, 0.5)]);
    let (pictures, failures) = findings.draw(folder.path());
    assert!(failures.is_empty(), "{failures:?}");
    assert_eq!(pictures[0].caption, "R by course over the width, m: narrow");
    assert!(folder.path().join(&pictures[0].file).exists());
}

#[test]
fn every_run_has_its_own_row() {
    let folder = tempfile::tempdir().unwrap();
    let (experiment, plan) = two_runs(folder.path());
    let mut calm = entry_result("calm", 2);
    calm.r = 0.75;
    leave(&plan.runs[0], &[calm, entry_result("windy", 1)]);
    let learned = SUMMARY.replace(r#""policy_sha256":"""#, r#""policy_sha256":"ab""#);
    fs::write(plan.runs[1].directory.summary_json(), learned).unwrap();
    let runs = read(&plan);
    let file = folder.path().join("runs.csv");
    findings(&experiment, &plan, &runs)
        .write_runs(&file)
        .unwrap();
    let mut reader = csv::Reader::from_path(file).unwrap();
    let header = reader.headers().unwrap().clone();
    let rows: Vec<_> = reader.records().map(Result::unwrap).collect();
    let column = |name: &str| {
        let place = header.iter().position(|column| column == name).unwrap();
        rows.iter()
            .map(|row| row[place].to_owned())
            .collect::<Vec<_>>()
    };
    assert_eq!(column("seed"), ["1", "2"]);
    assert_eq!(column("policy_sha256"), ["", "ab"]);
    assert_eq!(column("completed calm"), ["0.5000", "1.0000"]);
    assert_eq!(column("R calm"), ["0.7500", "1.0000"]);
    assert_eq!(column("R windy"), ["0.2500", "0.2500"]);
    assert_eq!(column("trained_episodes"), ["", ""], "never");
    assert_eq!(
        column("one_wall_episodes"),
        ["", ""],
        "one episode is not two"
    );
}

/// Two runs of ten episodes: the first rises and is trained after six of them, the second never
/// reaches a wall.
#[test]
fn learning_steadiness_and_cost_match_the_runs_files() {
    let folder = tempfile::tempdir().unwrap();
    let (experiment, plan) = two_runs(folder.path());
    let episodes = |walls: [u8; 10], steps: u32| {
        let row = |walls: u8| format!("{steps},{walls},{walls}.5\n");
        format!("steps,walls_passed,return\n{}", walls.map(row).concat())
    };
    let summary = |steps: u64, updates: u64, trained: &str| {
        let counts = format!(r#""episodes":10,"steps":{steps},"updates":{updates}"#);
        SUMMARY
            .replace(r#""episodes":8,"steps":4,"updates":2"#, &counts)
            .replace(
                r#""wall_secs":3.3}"#,
                &format!(r#""wall_secs":70.0{trained}}}"#),
            )
    };
    let trained =
        r#","trained":{"rate":0.95,"episodes":6,"steps":60,"updates":20,"wall_secs":30.0}"#;
    for (run, walls, steps, summary) in [
        (
            &plan.runs[0],
            [0, 0, 1, 3, 3, 3, 2, 2, 2, 3],
            10,
            summary(100, 40, trained),
        ),
        (
            &plan.runs[1],
            [0, 0, 1, 0, 0, 0, 0, 1, 0, 1],
            20,
            summary(200, 60, ""),
        ),
    ] {
        fs::write(run.directory.episodes_csv(), episodes(walls, steps)).unwrap();
        fs::write(run.directory.summary_json(), summary).unwrap();
    }
    let runs = read(&plan);
    let findings = findings(&experiment, &plan, &runs);
    let row = |kind| {
        let table = findings.tables(kind)[0].table.clone();
        let cells = table
            .lines()
            .nth(2)
            .unwrap()
            .split('|')
            .map(|cell| cell.trim().to_owned());
        cells.filter(|cell| !cell.is_empty()).collect::<Vec<_>>()
    };
    // Averages of two episodes: 0, 2, 3, 2, 2.5, whose level is 2.5, and 0, 0.5, 0, 0.5, 0.5, whose
    // is 0.5. Once risen they change by -1 and 0.5, and by -0.5, 0.5 and 0: the root mean squares
    // are 0.79 and 0.41, the interquartile ranges 0.75 and 0.5.
    let volatility = "0.60 [0.41, 0.79]";
    assert_eq!(
        row(TableKind::Learning),
        [
            "A",
            "2",
            "≥ 7 [4, 10]",
            "1 of 2",
            "≥ 8 [6, 10]",
            "≥ 130 [60, 200]",
            "≥ 40 [20, 60]",
            "≥ 0:50 [0:30, 1:10]",
            "1.50 [0.50, 2.50]",
            "2.00 [1.00, 3.00]",
            volatility
        ]
    );
    assert_eq!(
        row(TableKind::Steadiness),
        [
            "A",
            "2",
            "1.50 [0.50, 2.50]",
            volatility,
            "0.62 [0.50, 0.75]",
            "0.75 [0.50, 1.00]"
        ]
    );
    assert_eq!(
        row(TableKind::Cost),
        ["A", "2", "10", "150", "50", "4", "4", "1:10"]
    );

    let walls = |axis| runs[0].curve(Measure::WallsPassed, axis);
    let averages = [0.0, 0.5, 2.0, 3.0, 3.0, 2.5, 2.0, 2.0, 2.5];
    let over = |places: [f64; 9]| places.into_iter().zip(averages).collect::<Vec<_>>();
    assert_eq!(
        walls(Axis::Episodes),
        over([2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0])
    );
    assert_eq!(
        walls(Axis::Steps),
        over([20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0, 90.0, 100.0])
    );
    // None before the warm-up ends, all of them after the last episode.
    assert_eq!(
        walls(Axis::Updates),
        over([0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0])
    );
    assert_eq!(
        runs.iter()
            .map(RunResult::one_wall_after)
            .collect::<Vec<_>>(),
        [Some(4.0), None]
    );
}

#[test]
fn returns_with_different_rewards_are_not_tabulated() {
    let folder = tempfile::tempdir().unwrap();
    let (mut experiment, plan) = two_runs(folder.path());
    let runs = read(&plan);
    let report_text = |experiment: &Experiment| {
        let tables = findings(experiment, &plan, &runs).tables(TableKind::Learning);
        tables[0].table.contains("return, last 2")
    };
    assert!(report_text(&experiment));
    let mut other = experiment.arms[0].clone();
    other
        .config
        .simulator
        .insert("reward".to_owned(), toml::Table::new().into());
    experiment.arms.push(other);
    assert!(!report_text(&experiment));
}
