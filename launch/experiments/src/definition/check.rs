//! Checks that an experiment makes sense and that each of its arms can run.

use std::collections::BTreeSet;
use std::path::Path;

use serde::Serialize;
use skein_protocol::config::{Config, CoursesSection};
use skein_simulator::suite::MOST_EPISODES;
use skein_simulator::text::{first_repeated, fits_in_a_table};
use toml::Value;

use super::file::{ArmFile, ExperimentFile, as_overrides, names_folder};
use super::{Arm, DefinitionError, Experiment, FlownSuite, MOST_ARMS, Measure, TableKind};
use crate::plan::{ACTORS, REPORT};
use skein_prepare::PrepareError;

/// Setting of every run, because each gets one core. On libtorch, the number of threads changes the
/// rounding of sums; on the native engine it does not.
const COMMON_SETTING: &str = "run.learner_threads=1";
/// Keys that no file may set, each with the reason.
const RESERVED_KEYS: [(&str, &str); 2] = [
    (
        "run.seed",
        "each arm runs with seeds from 1; set their number with `seeds`",
    ),
    (
        "run.learner_threads",
        "each run has one, because runs share the machine; remove the key",
    ),
];

/// Returns the experiment described by `file`, which was read from `path`.
pub(super) fn resolve(
    file: ExperimentFile,
    path: &Path,
    name: &str,
    episodes: Option<u64>,
) -> Result<Experiment, DefinitionError> {
    check_values(&file, path)?;
    let folder = path.parent().unwrap_or(Path::new(""));
    let base = folder.join(&file.base);
    let settings_of = |whose: &str, settings| {
        as_overrides(settings, folder)
            .and_then(refuse_reserved_keys)
            .map_err(|problem| settings_error(path, whose, problem))
    };
    let mut settings = [
        vec![COMMON_SETTING.to_owned()],
        settings_of("[settings]", &file.settings)?,
    ]
    .concat();
    let base_config = Config::load(&base, &[])
        .map_err(|error| settings_error(path, "base", PrepareError::from(error).to_string()))?;
    let mut arms = Vec::with_capacity(file.arms.len());
    for arm in &file.arms {
        let own = settings_of(&format!("arm {}", arm.name), &arm.settings)?;
        let overrides = [&settings[..], &own].concat();
        arms.push(arm_of(arm, own, overrides, &base, episodes, path)?);
    }
    if let Some(episodes) = episodes {
        state_episodes(episodes, &mut settings, &mut arms);
    }
    check_different(&arms, path)?;
    check_comparable(&arms, path)?;
    check_same_courses(&file, &arms, path)?;
    check_same_episodes(&file, &arms, path)?;
    check_same_reward(&file, &arms, path)?;
    let suite = suite_of(&file, folder, &arms, path)?;
    Ok(Experiment {
        name: name.to_owned(),
        question: file.question,
        base_name: file
            .base
            .file_name()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned(),
        base,
        base_episodes: base_config.run.episodes,
        paper_episodes: file.paper_episodes,
        settings,
        seeds: file.seeds,
        suite,
        tables: file.tables,
        curves: file.curves,
        factor: file.factor,
        arms,
    })
}

fn arm_of(
    arm: &ArmFile,
    settings: Vec<String>,
    mut overrides: Vec<String>,
    base: &Path,
    episodes: Option<u64>,
    path: &Path,
) -> Result<Arm, DefinitionError> {
    let load = |overrides: &[String]| {
        skein_prepare::resolve(base, overrides, ACTORS).map_err(|source| DefinitionError::Arm {
            path: path.to_owned(),
            arm: arm.name.clone(),
            source: Box::new(source),
        })
    };
    let mut config = load(&overrides)?;
    if let Some(episodes) = episodes {
        if episodes >= config.run.episodes {
            let problem = format!(
                "does not shorten the run: arm {} flies {} episodes; give fewer, or leave it out",
                arm.name, config.run.episodes
            );
            return Err(value_error(path, "--episodes", episodes, problem));
        }
        overrides.push(format!("run.episodes={episodes}"));
        config = load(&overrides)?;
    }
    config.run.seed = 1;
    Ok(Arm {
        name: arm.name.clone(),
        label: arm.label.clone(),
        at: arm.at.clone(),
        settings,
        overrides,
        config,
    })
}

/// Replaces the number of episodes in the file by the number flown, for readers.
fn state_episodes(episodes: u64, settings: &mut Vec<String>, arms: &mut [Arm]) {
    let own = arms.iter_mut().map(|arm| &mut arm.settings);
    for settings in own.chain([&mut *settings]) {
        settings.retain(|setting| !setting.starts_with("run.episodes="));
    }
    settings.push(format!("run.episodes={episodes}"));
}

/// Returns the suite that `file` names, if every arm can fly it and a table shows its results.
fn suite_of(
    file: &ExperimentFile,
    folder: &Path,
    arms: &[Arm],
    path: &Path,
) -> Result<Option<FlownSuite>, DefinitionError> {
    let is_shown = file.tables.contains(&TableKind::Suite);
    let nothing = match (file.suite_episodes, &file.suite) {
        (Some(episodes), _) if !(1..=MOST_EPISODES).contains(&episodes) => Some(format!(
            "is outside 1..={MOST_EPISODES}: leave it out to use the suite's own number"
        )),
        (Some(_), None) => Some("needs a suite: add suite = \"FILE\", or leave it out".to_owned()),
        _ => None,
    };
    if let (Some(episodes), Some(problem)) = (file.suite_episodes, nothing) {
        return Err(value_error(path, "suite_episodes", episodes, problem));
    }
    let Some(named) = &file.suite else {
        let problem = "needs a suite: add suite = \"FILE\", or remove the table";
        return match is_shown {
            true => Err(value_error(path, "tables", "\"suite\"", problem.to_owned())),
            false => Ok(None),
        };
    };
    let refuse = |problem| value_error(path, "suite", format!("{named:?}"), problem);
    if !is_shown {
        let problem = "would be flown but not shown: add \"suite\" to tables, or leave it out";
        return Err(refuse(problem.to_owned()));
    }
    let suite = FlownSuite::load(&folder.join(named), file.suite_episodes).map_err(|problem| {
        refuse(format!(
            "cannot be flown: {problem}; \
                 name a suite file, relative to this one, or leave it out"
        ))
    })?;
    for arm in arms {
        suite.check(arm).map_err(|problem| {
            refuse(format!(
                "cannot be flown by arm {}: {problem}; name another suite, or leave it out",
                arm.name
            ))
        })?;
    }
    Ok(Some(suite))
}

fn refuse_reserved_keys(overrides: Vec<String>) -> Result<Vec<String>, String> {
    for setting in &overrides {
        let key = setting
            .split_once('=')
            .map_or(setting.as_str(), |(key, _)| key);
        if let Some((_, why)) = RESERVED_KEYS.iter().find(|(ours, _)| *ours == key) {
            return Err(format!("{setting} cannot be set: {why}"));
        }
    }
    Ok(overrides)
}

fn check_values(file: &ExperimentFile, path: &Path) -> Result<(), DefinitionError> {
    let refuse = |key, value: &dyn std::fmt::Display, problem: &str| {
        Err(value_error(path, key, value, problem.into()))
    };
    if file.question.trim().is_empty() {
        return refuse(
            "question",
            &"\"\"",
            "is empty: write what the experiment shall find out",
        );
    }
    if file.question.contains(char::is_control) || file.question.contains("<!--") {
        return refuse(
            "question",
            &format!("{:?}", file.question),
            "cannot be a report's heading: write one line without control characters and <!--",
        );
    }
    if let Some(kind) = first_repeated(&file.tables) {
        let twice = "is listed twice: name each table once";
        return refuse("tables", &as_written(kind), twice);
    }
    if let Some(curve) = first_repeated(&file.curves) {
        let twice = "is listed twice: name each curve once";
        return refuse("curves", &as_written(curve), twice);
    }
    if file.paper_episodes == Some(0) {
        return refuse(
            "paper_episodes",
            &0,
            "is not a run: write the number of the paper's runs, or leave it out",
        );
    }
    if !(1..=100).contains(&file.seeds) {
        return refuse("seeds", &file.seeds, "is outside 1..=100");
    }
    if !(1..=MOST_ARMS).contains(&file.arms.len()) {
        let problem = format!(
            "are outside 1..={MOST_ARMS} arms: one picture cannot show more distinguishable lines"
        );
        return refuse("[[arm]]", &file.arms.len(), &problem);
    }
    check_factor(file, path)?;
    let (mut names, mut labels) = (BTreeSet::new(), BTreeSet::new());
    for arm in &file.arms {
        if !names_folder(&arm.name) || arm.name == REPORT {
            let problem = format!(
                "cannot name a folder: begin with a letter or digit, \
                      use only letters, digits, -, _ and ., and not {REPORT}"
            );
            return refuse("arm.name", &format!("{:?}", arm.name), &problem);
        }
        if arm.label.trim().is_empty() || !fits_in_a_table(&arm.label) || arm.label.contains("<!--")
        {
            return refuse(
                "arm.label",
                &format!("{:?}", arm.label),
                "cannot be shown in a table: write one line without | and <!--",
            );
        }
        if !names.insert(&arm.name) {
            return refuse(
                "arm.name",
                &arm.name,
                "occurs twice: give each arm a different one",
            );
        }
        if !labels.insert(&arm.label) {
            return refuse(
                "arm.label",
                &arm.label,
                "occurs twice: give each arm a different one",
            );
        }
    }
    Ok(())
}

/// Refuses a factor that an arm lacks, a place without a factor, and what a picture cannot show.
fn check_factor(file: &ExperimentFile, path: &Path) -> Result<(), DefinitionError> {
    let is_text = |text: &str| !text.trim().is_empty() && fits_in_a_table(text);
    if let Some(factor) = &file.factor
        && !is_text(factor)
    {
        let problem = "cannot label an axis: write a name and its unit on one line without |";
        return Err(value_error(
            path,
            "factor",
            format!("{factor:?}"),
            problem.into(),
        ));
    }
    for arm in &file.arms {
        let problem = match (&file.factor, &arm.at) {
            (None, Some(_)) => {
                "has `at`, but the file names no factor: add factor = \"NAME, UNIT\""
            }
            (Some(_), None) => "has no place: add at = { line = \"NAME\", value = NUMBER }",
            (Some(_), Some(at)) if !at.value.is_finite() => "has a value that is no finite number",
            (Some(_), Some(at)) if !is_text(&at.line) => {
                "has a line that cannot be a caption: write one line of text without |"
            }
            _ => continue,
        };
        let whose = format!("arm {}", arm.name);
        return Err(settings_error(path, &whose, problem.to_owned()));
    }
    Ok(())
}

/// Returns `value` as it stands in the file.
fn as_written(value: &impl Serialize) -> String {
    Value::try_from(value).map_or_else(|error| error.to_string(), |value| value.to_string())
}

/// Refuses two arms that are the same training.
fn check_different(arms: &[Arm], path: &Path) -> Result<(), DefinitionError> {
    for (number, arm) in arms.iter().enumerate() {
        if let Some(same) = arms[..number].iter().find(|same| same.config == arm.config) {
            let problem = format!(
                "is the same training as arm {}, so there is nothing to compare: change a \
                 setting of one, or remove it",
                same.name
            );
            return Err(settings_error(path, &format!("arm {}", arm.name), problem));
        }
    }
    Ok(())
}

/// Refuses arms that are evaluated differently.
fn check_comparable(arms: &[Arm], path: &Path) -> Result<(), DefinitionError> {
    let measured = |arm: &Arm| arm.config.evaluation.clone();
    refuse_other(arms, path, measured, |first| {
        format!(
            "[evaluation] differs from that of arm {first}, \
                so the two could not be compared: set it in [settings]"
        )
    })
}

/// Refuses arms that are evaluated on other courses. Where a factor is what changes the courses,
/// only their names must be the same: they are the columns of the tables.
fn check_same_courses(
    file: &ExperimentFile,
    arms: &[Arm],
    path: &Path,
) -> Result<(), DefinitionError> {
    let evaluated = |arm: &Arm| arm.config.courses.evaluation.clone();
    if file.factor.is_none() {
        return refuse_other(arms, path, evaluated, |first| {
            format!(
                "courses.evaluation differs from that of arm {first}, \
                    so the two could not be compared: set it in [settings]"
            )
        });
    }
    let names = |arm: &Arm| CoursesSection::names(&evaluated(arm));
    refuse_other(arms, path, names, |first| {
        format!(
            "courses.evaluation has other names than that of arm {first}, \
                so they could not share a table: give the course files the same `name`"
        )
    })
}

/// Reason why arms that train on different episodes cannot be compared by these, and the remedy.
const ELSEWHERE: &str = ", so the two would be measured on different episodes: \
                         add a suite, and write tables = [\"suite\", \"cost\"] and curves = []";

/// Refuses tables and curves of the arms' own episodes (training and evaluation) if these differ in
/// kind, unless a factor is what makes them differ. A suite flies all arms alike, whatever their
/// training.
fn check_same_episodes(
    file: &ExperimentFile,
    arms: &[Arm],
    path: &Path,
) -> Result<(), DefinitionError> {
    let of_own_episodes = |kind: &TableKind| !matches!(kind, TableKind::Suite | TableKind::Cost);
    let are_shown = !file.curves.is_empty() || file.tables.iter().any(of_own_episodes);
    if file.factor.is_some() || !are_shown {
        return Ok(());
    }
    let courses = |arm: &Arm| {
        let courses = &arm.config.courses;
        (
            courses.training.clone(),
            courses.generated_share,
            arm.config.learning.levels,
        )
    };
    refuse_other(arms, path, courses, |first| {
        format!(
            "courses.training, courses.generated_share and learning.levels differ \
                from those of arm {first}{ELSEWHERE}"
        )
    })?;
    for key in ["generator", "disturbances"] {
        let flown = |arm: &Arm| arm.config.simulator.get(key).cloned();
        refuse_other(arms, path, flown, |first| {
            format!("simulator.{key} differs from that of arm {first}{ELSEWHERE}")
        })?;
    }
    Ok(())
}

/// Refuses returns in one picture if they have different scales.
fn check_same_reward(
    file: &ExperimentFile,
    arms: &[Arm],
    path: &Path,
) -> Result<(), DefinitionError> {
    if file
        .curves
        .iter()
        .all(|curve| curve.measure != Measure::Return)
    {
        return Ok(());
    }
    refuse_other(arms, path, Arm::reward, |first| {
        format!(
            "simulator.reward differs from that of arm {first}, so their returns have \
                different scales: draw walls_passed instead"
        )
    })
}

/// Refuses the first arm whose value differs from the first arm's; `problem` gets the latter's
/// name.
fn refuse_other<T: PartialEq>(
    arms: &[Arm],
    path: &Path,
    of: impl Fn(&Arm) -> T,
    problem: impl Fn(&str) -> String,
) -> Result<(), DefinitionError> {
    let Some(first) = arms.first() else {
        return Ok(());
    };
    match arms.iter().find(|arm| of(arm) != of(first)) {
        None => Ok(()),
        Some(other) => Err(settings_error(
            path,
            &format!("arm {}", other.name),
            problem(&first.name),
        )),
    }
}

fn settings_error(path: &Path, whose: &str, problem: String) -> DefinitionError {
    DefinitionError::Settings {
        path: path.to_owned(),
        whose: whose.to_owned(),
        problem,
    }
}

fn value_error(
    path: &Path,
    key: &'static str,
    value: impl std::fmt::Display,
    problem: String,
) -> DefinitionError {
    DefinitionError::Value {
        path: path.to_owned(),
        key,
        value: value.to_string(),
        problem,
    }
}
