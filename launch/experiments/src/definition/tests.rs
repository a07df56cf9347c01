//! Experiments that can run, and experiments that cannot.

use std::fs;

use super::*;

fn shipped(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../configs")
        .join(path)
}

/// Head of an experiment's file, based on the shipped smoke configuration.
fn head() -> String {
    format!(
        "question = \"What for?\"\nbase = {:?}\ntables = [\"evaluation\"]\ncurves = [{{ measure = \
         \"return\", over = \"steps\" }}]\n",
        shipped("smoke.toml")
    )
}

fn load(text: &str, episodes: Option<u64>) -> Result<Experiment, String> {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("test.toml"), text).unwrap();
    Experiment::load(folder.path(), "test", episodes)
        .map_err(|error| skein_run::failure::with_causes(&error))
}

const ARM: &str = "[[arm]]\nname = \"a\"\nlabel = \"A\"\n";

#[test]
fn every_shipped_experiment_can_run() {
    let folder = shipped("experiments");
    let names = names(&folder).unwrap();
    assert!(names.contains(&"paper".to_owned()), "{names:?}");
    for name in names {
        let experiment = Experiment::load(&folder, &name, None).unwrap();
        let fewest = experiment
            .arms
            .iter()
            .map(|arm| arm.config.run.episodes)
            .min()
            .unwrap();
        assert!(
            experiment.seeds >= 3,
            "{name}: too few seeds for any conclusion"
        );
        assert!(
            Experiment::load(&folder, &name, Some(fewest - 1))
                .is_ok_and(|short| short.shortened().is_some())
        );
    }
}

#[test]
fn an_experiment_is_found_by_its_name_or_by_its_path() {
    let folder = tempfile::tempdir().unwrap();
    let text = format!("{}{ARM}", head());
    let at = |name: &str| folder.path().join(name).display().to_string();
    for name in [
        "plain.toml",
        "strange name.toml",
        "zi\u{119}ba\n.toml",
        ".toml",
    ] {
        fs::write(at(name), &text).unwrap();
    }
    let load = |named: &str| {
        // The catalogue does not exist: a path needs none.
        Experiment::load(Path::new("/proc/none"), named, None).map_err(|error| error.to_string())
    };
    assert_eq!(load(&at("plain.toml")).unwrap().name, "plain");
    let by_name = Experiment::load(folder.path(), "plain", None).unwrap();
    assert_eq!(by_name, load(&at("plain.toml")).unwrap());
    for name in ["strange name.toml", "zi\u{119}ba\n.toml", ".toml"] {
        let error = load(&at(name)).unwrap_err();
        assert!(
            error.contains(name) && error.contains("rename the file"),
            "{error}"
        );
    }
    for missing in ["none.toml", "no/such", "/"] {
        assert!(load(missing).unwrap_err().contains(missing));
    }
    let unknown = Experiment::load(folder.path(), "other", None)
        .unwrap_err()
        .to_string();
    assert!(
        unknown.contains("plain") && unknown.contains("path of a file"),
        "{unknown}"
    );
}

#[test]
fn an_arm_combines_the_base_the_common_settings_and_its_own() {
    let text = format!(
        "{}[settings]\nrun.episodes = 90\nreplay = {{ success_share = 0.5, success = \"approach\" \
         }}\n{ARM}settings.\"replay.success_share\" = 0.25\n\
         settings.simulator.reward.open_view = 2.0\n[[arm]]\nname = \"b\"\nlabel = \"B\"\n",
        head().replace("\"return\"", "\"walls_passed\"")
    );
    let experiment = load(&text, None).unwrap();
    let [a, b] = &experiment.arms[..] else {
        panic!("{experiment:?}")
    };
    assert_eq!(
        (a.config.replay.success_share, b.config.replay.success_share),
        (0.25, 0.5)
    );
    assert_eq!(
        (a.config.run.episodes, a.config.run.learner_threads),
        (90, 1)
    );
    assert_eq!(
        a.config.simulator["reward"]["open_view"].as_float(),
        Some(2.0)
    );
    assert_eq!(
        b.config.simulator["reward"]["open_view"].as_float(),
        Some(1.0),
        "written out"
    );
    assert_eq!(
        (experiment.seeds, b.settings.len(), experiment.base_episodes),
        (3, 0, 300)
    );
    assert_eq!(
        experiment.shortened().unwrap().to_string(),
        "90 training episodes a run instead of the 300 of `configs/smoke.toml`"
    );
    assert!(
        !experiment.has_one_reward(),
        "arm a has twice the reward for the view ahead"
    );
    let short = load(&text, Some(40)).unwrap();
    assert_eq!(short.arms[1].config.run.episodes, 40);
    let episodes = |setting: &&String| setting.starts_with("run.episodes");
    assert_eq!(
        short.settings.iter().filter(episodes).collect::<Vec<_>>(),
        ["run.episodes=40"]
    );
}

#[test]
fn only_runs_with_fewer_episodes_than_the_paper_are_shortened() {
    let shortened = |keys: &str| {
        load(&format!("{keys}{}{ARM}", head()), None)
            .unwrap()
            .shortened()
    };
    assert_eq!(shortened(""), None);
    assert_eq!(shortened("paper_episodes = 300\n"), None);
    assert_eq!(
        shortened("paper_episodes = 4000\n").unwrap().to_string(),
        "300 training episodes a run instead of the 4000 of the paper"
    );
}

#[test]
fn the_example_in_the_documents_can_run() {
    let document = fs::read_to_string(shipped("../docs/experiments.md")).unwrap();
    let example = document
        .split("```toml\n")
        .find(|part| part.starts_with("question = "))
        .unwrap();
    let (example, _) = example.split_once("```").unwrap();
    let text = example.replace(
        "../one-course.toml",
        shipped("one-course.toml").to_str().unwrap(),
    );
    let experiment = load(&text, None).unwrap();
    assert_eq!(
        (experiment.seeds, experiment.arms[1].config.sac.batch_size),
        (5, 512)
    );
}

#[test]
fn course_files_are_named_relative_to_the_experiment() {
    let folder = tempfile::tempdir().unwrap();
    fs::copy(
        shipped("courses/training.toml"),
        folder.path().join("mine.toml"),
    )
    .unwrap();
    let text = format!(
        "{}{ARM}[settings]\ncourses.training = \"mine.toml\"\ncourses.evaluation = \
         [\"mine.toml\"]\n",
        head()
    );
    fs::write(folder.path().join("test.toml"), text).unwrap();
    let config = &Experiment::load(folder.path(), "test", None).unwrap().arms[0].config;
    assert_eq!(config.courses.training, folder.path().join("mine.toml"));
    assert_eq!(config.courses.evaluation, [folder.path().join("mine.toml")]);
}

#[test]
fn a_suite_path_is_relative_and_its_result_name_covers_all_that_is_flown() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| fs::write(folder.path().join(name), text).unwrap();
    let course = fs::read_to_string(shipped("courses/training.toml")).unwrap();
    let suite =
        "name = \"x\"\nepisodes = 5\n[[entry]]\nname = \"as it is\"\ncourse = \"mine.toml\"\n";
    write(
        "test.toml",
        &format!(
            "suite = \"few.toml\"\n{}{ARM}",
            head().replace("evaluation", "suite")
        ),
    );
    write("mine.toml", &course);
    write("few.toml", suite);
    let load = || {
        Experiment::load(folder.path(), "test", None)
            .unwrap()
            .suite
            .unwrap()
    };
    let first = load();
    assert_eq!(
        (first.path.clone(), first.episodes()),
        (folder.path().join("few.toml"), 5)
    );
    assert!(
        first.result_name.starts_with("few-"),
        "{}",
        first.result_name
    );
    // Comments do not change the name.
    write("few.toml", &format!("# Few episodes.\n{suite}"));
    write("mine.toml", &format!("# Five walls.\n{course}"));
    assert_eq!(load(), first);
    write("few.toml", &suite.replace('5', "6"));
    assert_ne!(load().result_name, first.result_name);
    write("few.toml", suite);
    let fewer = format!(
        "suite_episodes = 2\nsuite = \"few.toml\"\n{}{ARM}",
        head().replace("evaluation", "suite")
    );
    write("fewer.toml", &fewer);
    let fewer = Experiment::load(folder.path(), "fewer", None)
        .unwrap()
        .suite
        .unwrap();
    assert_eq!((fewer.each, fewer.episodes()), (Some(2), 2));
    assert_ne!(fewer.result_name, first.result_name);
    write(
        "mine.toml",
        &fs::read_to_string(shipped("courses/rearranged_34125.toml")).unwrap(),
    );
    assert_ne!(load().result_name, first.result_name);
}

#[test]
fn an_invalid_experiment_is_refused_with_file_key_value_and_remedy() {
    let with_arm = |rest: &str| format!("{}{ARM}{rest}", head());
    let with_suite = |suite: &Path| {
        let head = head().replace("\"evaluation\"", "\"evaluation\", \"suite\"");
        format!("suite = {suite:?}\n{head}{ARM}")
    };
    for (text, episodes, expected) in [
        (
            "question = 1".to_owned(),
            None,
            vec!["test.toml is not an experiment", "question = 1"],
        ),
        (
            with_arm("sed = 1"),
            None,
            vec!["unknown field `sed`", "settings"],
        ),
        (
            head() + "arms = 1\n" + ARM,
            None,
            vec!["unknown field `arms`"],
        ),
        (head(), None, vec!["missing field `arm`"]),
        (
            head().replace("evaluation", "evaluations") + ARM,
            None,
            vec!["unknown variant `evaluations`", "outcomes"],
        ),
        (
            head().replace("steps", "step") + ARM,
            None,
            vec!["unknown variant `step`", "steps"],
        ),
        (
            head().replace("What for?", " ") + ARM,
            None,
            vec!["question = \"\" is empty"],
        ),
        (
            head().replace("What for?", "What\\nfor?") + ARM,
            None,
            vec![
                "question = \"What\\nfor?\" cannot be a report's heading",
                "one line",
            ],
        ),
        (
            head().replace("What for?", "<!-- end -->") + ARM,
            None,
            vec!["cannot be a report's heading", "and <!--"],
        ),
        (
            format!("paper_episodes = 0\n{}{ARM}", head()),
            None,
            vec!["paper_episodes = 0 is not a run", "leave it out"],
        ),
        (
            format!("seeds = 0\n{}{ARM}", head()),
            None,
            vec!["seeds = 0", "1..=100"],
        ),
        (
            head() + &ARM.repeat(2),
            None,
            vec!["arm.name = a occurs twice"],
        ),
        (
            head() + ARM + &ARM.replace("\"a\"", "\"b\"").replace("\"A\"", "\"B\""),
            None,
            vec!["arm b: is the same training as arm a", "or remove it"],
        ),
        (
            head() + &ARM.replace("\"a\"", "\"../a\""),
            None,
            vec!["arm.name = \"../a\"", "letter or digit"],
        ),
        (
            head() + &ARM.replace("\"a\"", "\"report\""),
            None,
            vec!["arm.name = \"report\""],
        ),
        (
            head() + &ARM.replace("\"A\"", "\"a|b\""),
            None,
            vec!["arm.label = \"a|b\"", "without |"],
        ),
        (
            head() + &ARM.replace("\"A\"", "\"<!-- end -->\""),
            None,
            vec!["arm.label = \"<!-- end -->\"", "without | and <!--"],
        ),
        (
            head() + &ARM.replace("\"A\"", "\"\\u001b[2J\""),
            None,
            vec!["arm.label = \"\\u{1b}[2J\"", "one line"],
        ),
        (
            head() + &ARM.replace("\"a\"", "\"\\u001b\""),
            None,
            vec!["arm.name = \"\\u{1b}\"", "letter or digit"],
        ),
        (
            head().replace("What for?", "\\u0007") + ARM,
            None,
            vec!["question = \"\\u{7}\"", "control characters"],
        ),
        (
            head().replace("[\"evaluation\"]", "[\"cost\", \"learning\", \"cost\"]") + ARM,
            None,
            vec!["tables = \"cost\" is listed twice", "once"],
        ),
        (
            head().replace(
                "curves = [",
                "curves = [{ over = \"steps\", measure = \"return\" }, ",
            ) + ARM,
            None,
            vec!["curves = { measure = \"return\", over = \"steps\" } is listed twice"],
        ),
        (
            format!("seeds = 18446744073709551615\n{}{ARM}", head()),
            None,
            vec!["test.toml: line 1: seeds = 18446744073709551615 is an integer outside"],
        ),
        (
            with_arm("settings.run.sed = 1"),
            None,
            vec!["arm a cannot run", "run.sed=1", "unknown field `sed`"],
        ),
        (
            with_arm("settings.replay.success_share = 1.5"),
            None,
            vec![
                "test.toml: arm a",
                "replay.success_share = 1.5",
                "outside [0, 1)",
            ],
        ),
        (
            with_arm("settings.simulator.max_step = 1"),
            None,
            vec!["arm a", "smoke.toml", "max_step"],
        ),
        (
            with_arm("settings.learning.levels = 6"),
            None,
            vec!["arm a", "learning.levels = 6", "5 walls"],
        ),
        (
            with_arm("settings.run.seed = 4"),
            None,
            vec!["arm a: run.seed=4 cannot be set", "`seeds`"],
        ),
        (
            with_arm("settings.run = {}"),
            None,
            vec!["arm a: run holds no setting"],
        ),
        (
            with_arm("settings.run.\"seed \" = 4"),
            None,
            vec!["arm a", "\"seed \" is no key", "without quotes"],
        ),
        (
            with_arm("").replacen(
                "{ measure = \"return\", over = \"steps\" }",
                "[\"return\", \"steps\", 3]",
                1,
            ),
            None,
            vec!["is not an experiment", "curves"],
        ),
        (
            with_arm("settings.seed = 4"),
            None,
            vec!["arm a", "seed=4", "section.key=value"],
        ),
        (
            with_arm("[[arm]]\nname = \"b\"\nlabel = \"B\"\nsettings.evaluation.episodes = 9"),
            None,
            vec!["arm b", "[evaluation]", "arm a", "[settings]"],
        ),
        (
            with_arm(""),
            Some(300),
            vec![
                "--episodes = 300 does not shorten the run",
                "arm a flies 300",
            ],
        ),
        (
            head().replace("smoke.toml", "nowhere.toml") + ARM,
            None,
            vec!["test.toml: base: ", "nowhere.toml"],
        ),
        (
            with_suite(Path::new("nowhere.toml")),
            None,
            vec![
                "test.toml: suite = \"nowhere.toml\" cannot be flown",
                "No such file",
                "relative to this one",
            ],
        ),
        (
            with_suite(&shipped("courses/training.toml")),
            None,
            vec![
                "training.toml\" cannot be flown",
                "unknown field",
                "relative to this one",
            ],
        ),
        // The drone of these configurations has no mass.
        (
            with_suite(&shipped("evaluations/generalist.toml")),
            None,
            vec![
                "by arm a: entry \"all disturbances",
                "mass_spread",
                "name another suite",
            ],
        ),
        (
            format!("suite_episodes = 5\n{}{ARM}", head()),
            None,
            vec!["suite_episodes = 5 needs a suite", "add suite ="],
        ),
        (
            with_arm(
                "[[arm]]\nname = \"b\"\nlabel = \"B\"\nsettings.simulator.generator.clearance_m = \
                 [0.9, 1.25]",
            ),
            None,
            vec![
                "arm b: simulator.generator differs from",
                "arm a",
                "\"suite\"",
            ],
        ),
        (
            with_arm(
                "[[arm]]\nname = \"b\"\nlabel = \"B\"\nsettings.simulator.disturbances.share = 0.5",
            ),
            None,
            vec![
                "arm b: simulator.disturbances differs from",
                "arm a",
                "\"suite\"",
            ],
        ),
        (
            with_arm("[[arm]]\nname = \"b\"\nlabel = \"B\"\nsettings.learning.levels = 3"),
            None,
            vec![
                "arm b: courses.training",
                "learning.levels differ",
                "arm a",
                "\"suite\"",
            ],
        ),
        (
            with_arm(
                "[[arm]]\nname = \"b\"\nlabel = \"B\"\nsettings.courses.generated_share = 0.5",
            ),
            None,
            vec![
                "arm b: courses.training, courses.generated_share",
                "\"suite\"",
            ],
        ),
        (
            with_arm(
                "[[arm]]\nname = \"b\"\nlabel = \"B\"\nsettings.simulator.reward.open_view = 2.0",
            ),
            None,
            vec![
                "arm b: simulator.reward differs from",
                "arm a",
                "walls_passed",
            ],
        ),
        (
            format!(
                "suite_episodes = 0\n{}",
                with_suite(&shipped("evaluations/paper.toml"))
            ),
            None,
            vec!["suite_episodes = 0 is outside 1..=1000000", "leave it out"],
        ),
        (
            format!("suite = \"few.toml\"\n{}{ARM}", head()),
            None,
            vec![
                "suite = \"few.toml\" would be flown but not shown",
                "add \"suite\" to tables",
            ],
        ),
        (
            head().replace("evaluation", "suite") + ARM,
            None,
            vec!["tables = \"suite\" needs a suite", "add suite = "],
        ),
    ] {
        let error = load(&text, episodes).unwrap_err();
        for part in expected {
            assert!(error.contains(part), "`{error}` does not mention `{part}`");
        }
        assert!(error.contains("test.toml"), "{error}");
    }
    let many: String = (0..9)
        .map(|n| ARM.replace("\"a\"", &format!("\"a{n}\"")))
        .collect();
    assert!(
        load(&(head() + &many), None)
            .unwrap_err()
            .contains("[[arm]] = 9")
    );
}

#[test]
fn an_unknown_name_is_refused_with_the_known_names() {
    let error = Experiment::load(&shipped("experiments"), "papre", None)
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("no experiment is called \"papre\"") && error.contains("paper"),
        "{error}"
    );
    assert!(Experiment::load(&shipped("experiments"), "../smoke", None).is_err());
}

#[test]
fn a_missing_file_and_a_link_to_nothing_are_refused_with_what_to_give() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("f.toml");
    let refused = |named: &str, problem: &str| {
        let error = Experiment::load(folder.path(), named, None).unwrap_err();
        let error = error.to_string();
        for part in [path.to_str().unwrap(), problem, "skein experiment --list"] {
            assert!(error.contains(part), "`{error}` does not mention `{part}`");
        }
    };
    refused(path.to_str().unwrap(), "No such file");
    std::os::unix::fs::symlink("g.toml", &path).unwrap();
    for named in ["f", path.to_str().unwrap()] {
        refused(named, "a link to g.toml, which does not exist");
    }
}

/// An arm at `value` that trains on and evaluates a course of its own.
fn arm_at(value: &str, course: &str) -> String {
    format!(
        "[[arm]]\nname = \"{course}\"\nlabel = \"{course}\"\n\
         at = {{ line = \"one\", value = {value} }}\n\
         settings.courses.training = \"{course}.toml\"\n\
         settings.courses.evaluation = [\"{course}.toml\"]\n"
    )
}

#[test]
fn arms_along_a_factor_fly_courses_of_the_same_names() {
    let folder = tempfile::tempdir().unwrap();
    let course = fs::read_to_string(shipped("courses/training.toml")).unwrap();
    let load = |second: &str, factor: &str, arms: &str| {
        fs::write(folder.path().join("narrow.toml"), &course).unwrap();
        fs::write(folder.path().join("wide.toml"), second).unwrap();
        let text = format!("{}{factor}{arms}", head());
        fs::write(folder.path().join("test.toml"), text).unwrap();
        Experiment::load(folder.path(), "test", None)
            .map_err(|error| skein_run::failure::with_causes(&error))
    };
    let wider = course.replace("width_m = 2.2", "width_m = 2.4");
    let arms = arm_at("2.2", "narrow") + &arm_at("2.4", "wide");
    let factor = "factor = \"width, m\"\n";
    let experiment = load(&wider, factor, &arms).unwrap();
    let values = experiment
        .arms
        .iter()
        .map(|arm| arm.at.as_ref().unwrap().value);
    assert_eq!(values.collect::<Vec<_>>(), [2.2, 2.4]);

    let renamed = wider.replace("name = \"training\"", "name = \"other\"");
    for (second, factor, arms, problem) in [
        (&renamed, factor, arms.clone(), "other names"),
        (&wider, "", arms.clone(), "names no factor"),
        (&wider, factor, format!("{arms}{ARM}"), "has no place"),
        (
            &wider,
            "factor = \" \"\n",
            arms.clone(),
            "cannot label an axis",
        ),
        (
            &wider,
            factor,
            arms.replace("2.4 }", "nan }"),
            "no finite number",
        ),
        (
            &wider,
            factor,
            arms.replace("\"one\"", "\"a|b\""),
            "cannot be a caption",
        ),
    ] {
        let error = load(second, factor, &arms).unwrap_err();
        assert!(error.contains(problem), "{error}");
    }
}
