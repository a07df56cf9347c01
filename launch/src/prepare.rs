//! Everything that can be checked before the first process of a run is started, and the run's directory.
//!
//! A mistake in a configuration or a course file is found here, in the terminal of whoever made it, and not in the log of the third actor.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use skein_protocol::config::{Config, ConfigError, CoursesSection, culprit};
use skein_protocol::run::{RunDirectory, RunError, RunIdentity};
use skein_simulator::course::{Course, CourseError, RangesError};
use skein_simulator::simulator::{Simulator, SimulatorError, SimulatorSettings};

/// Why a run cannot be started.
#[derive(Debug, thiserror::Error)]
pub enum PrepareError {
    /// The configuration cannot be used.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The `[simulator]` section cannot be used.
    #[error("{}: [simulator] {problem}", config.display())]
    Simulator {
        /// The configuration file.
        config: PathBuf,
        /// Which key, and what is wrong with it.
        problem: String,
    },
    /// A course cannot be flown.
    #[error(transparent)]
    Course(#[from] CourseError),
    /// A vehicle or camera setting makes no sense.
    #[error("{}: {source}", config.display())]
    Settings {
        /// The configuration file.
        config: PathBuf,
        /// Why.
        #[source]
        source: SimulatorError,
    },
    /// Courses cannot be generated from the ranges given.
    #[error("{}: [simulator.generator] {source}", config.display())]
    Ranges {
        /// The configuration file.
        config: PathBuf,
        /// Why.
        #[source]
        source: RangesError,
    },
    /// A flight may become longer than an actor can send.
    #[error(
        "[simulator] max_steps = {max_steps} makes flights of up to {} records, but transport.max_records_per_flight = {records}: set it to {} or more",
        max_steps + 1,
        max_steps + 1
    )]
    FlightTooLong {
        /// The simulator's limit.
        max_steps: u32,
        /// The transport's limit.
        records: usize,
    },
    /// Training would start from a level that its course does not have.
    #[error(
        "{}: learning.levels = {levels} is more than the {walls} walls of {}: no flight could start from the last level; set it to {walls} or fewer",
        config.display(),
        course
    )]
    TooManyLevels {
        /// The configuration file.
        config: PathBuf,
        /// Start levels asked for.
        levels: u8,
        /// The course, or the ranges of generated ones.
        course: String,
        /// Its walls.
        walls: u8,
    },
    /// More actors than the transport has room for.
    #[error("{actors} actors are more than transport.max_actors = {max}: start fewer, or raise it")]
    TooManyActors {
        /// Asked for.
        actors: usize,
        /// The limit.
        max: usize,
    },
    /// There is something in the run's directory.
    #[error("{} is not empty: choose another --run-dir, or remove it if nobody needs it", .0.display())]
    NotEmpty(PathBuf),
    /// A file or folder of the run cannot be written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The path.
        path: PathBuf,
        /// Why.
        #[source]
        source: io::Error,
    },
    /// The run's directory cannot be set up.
    #[error(transparent)]
    Run(#[from] RunError),
    /// The run could be started, were it not for an override.
    #[error("with --set {text}, {source}")]
    Overridden {
        /// The override as given.
        text: String,
        /// What is wrong now.
        #[source]
        source: Box<PrepareError>,
    },
}

/// A run that is ready to be started.
#[derive(Debug)]
pub struct Prepared {
    /// Its directory, with an absolute path.
    pub run: RunDirectory,
    /// Who it is.
    pub identity: RunIdentity,
    /// Its resolved configuration.
    pub config: Config,
    /// The courses of its final evaluation.
    pub courses: Vec<NamedCourse>,
}

/// Checks the configuration in `config_file` with `overrides`, the courses it names and the number of `actors`; then creates `run_directory` with
/// copies of it all.
///
/// # Errors
/// [`PrepareError`] names file, key and remedy; nothing was created then, unless creating itself failed.
pub fn prepare(
    config_file: &Path,
    overrides: &[String],
    run_directory: &Path,
    actors: usize,
) -> Result<Prepared, PrepareError> {
    let mut config = Config::load(config_file, overrides)?;
    let settings = check(config_file, &config, actors).map_err(|error| blame(error, config_file, overrides, actors))?;
    config.simulator = written_out(&settings);
    let root = create_empty(run_directory)?;
    copy_courses(&root, &mut config)?;
    let run = RunDirectory::new(root);
    let identity = run.create(&config)?;
    let (_, config) = run.open()?;
    let courses = load_courses(&config)?;
    Ok(Prepared {
        run,
        identity,
        config,
        courses,
    })
}

/// A course of the final evaluation, under the name it has in the run's reports.
#[derive(Debug, Clone, PartialEq)]
pub struct NamedCourse {
    /// [`CoursesSection::name_of`] its file.
    pub name: String,
    /// The course.
    pub course: Course,
}

/// The courses of the final evaluation.
///
/// # Errors
/// [`CourseError`] names the file, the wall and the key.
pub fn load_courses(config: &Config) -> Result<Vec<NamedCourse>, CourseError> {
    let load = |path: &PathBuf| {
        Ok(NamedCourse {
            name: CoursesSection::name_of(path),
            course: Course::load(path)?,
        })
    };
    config.courses.evaluation.iter().map(load).collect()
}

/// Walls that an agent which passes every wall of the training course would pass a flight, on average over all start levels.
///
/// # Errors
/// [`CourseError`] names the file, the wall and the key.
pub fn ideal_walls_passed(config: &Config) -> Result<f64, CourseError> {
    let walls = Course::load(&config.courses.training)?.levels();
    // From level l, all but the first l - 1 walls lie ahead.
    Ok(f64::from(walls) - (f64::from(config.learning.levels) - 1.0) / 2.0)
}

/// The `[simulator]` section with the defaults of all that was not set: what was flown stays known when the defaults change.
fn written_out(settings: &SimulatorSettings) -> toml::Table {
    // By way of text: a number of single precision would drag the digits of its double along.
    let text = toml::to_string(settings).expect("every setting is representable in TOML");
    toml::from_str(&text).expect("what was written as TOML is TOML")
}

/// Adds to the `error` of a check the override that brought it about, if one did.
fn blame(error: PrepareError, config_file: &Path, overrides: &[String], actors: usize) -> PrepareError {
    let told = |overrides: &[String]| {
        let checked = Config::load(config_file, overrides)
            .map_err(PrepareError::from)
            .and_then(|config| check(config_file, &config, actors));
        checked.err().map(|error| error.to_string())
    };
    match culprit(overrides, told) {
        Some(text) => PrepareError::Overridden {
            text: text.clone(),
            source: Box::new(error),
        },
        None => error,
    }
}

/// Checks everything that must hold for `actors` actors to fly for `config`, which was read from `config_file`, and returns the simulator's settings.
pub(crate) fn check(config_file: &Path, config: &Config, actors: usize) -> Result<SimulatorSettings, PrepareError> {
    let in_file = || config_file.to_owned();
    let settings: SimulatorSettings =
        config
            .simulator
            .clone()
            .try_into()
            .map_err(|error: toml::de::Error| PrepareError::Simulator {
                config: in_file(),
                problem: error.to_string().trim_end().replace('\n', " "),
            })?;
    for path in config.courses.evaluation.iter().chain([&config.courses.training]) {
        let course = Arc::new(Course::load(path)?);
        Simulator::new(course, &settings).map_err(|source| PrepareError::Settings {
            config: in_file(),
            source,
        })?;
    }
    check_level_count(
        config_file,
        config,
        &Course::load(&config.courses.training)?,
        &config.courses.training.display(),
    )?;
    if config.courses.generated_share > 0.0 {
        let course = Course::generate(0, &settings.generator).map_err(|source| PrepareError::Ranges {
            config: in_file(),
            source,
        })?;
        check_level_count(config_file, config, &course, &"[simulator.generator] wall_x_m")?;
    }
    let records = config.transport.max_records_per_flight;
    if settings.max_steps as usize + 1 > records {
        return Err(PrepareError::FlightTooLong {
            max_steps: settings.max_steps,
            records,
        });
    }
    if actors > config.transport.max_actors {
        return Err(PrepareError::TooManyActors {
            actors,
            max: config.transport.max_actors,
        });
    }
    Ok(settings)
}

/// Whether training can start from every level it is to start from on `course`, which the user knows as `name`.
fn check_level_count(
    config_file: &Path,
    config: &Config,
    course: &Course,
    name: &dyn std::fmt::Display,
) -> Result<(), PrepareError> {
    let (levels, walls) = (config.learning.levels, course.levels());
    if levels <= walls {
        return Ok(());
    }
    Err(PrepareError::TooManyLevels {
        config: config_file.to_owned(),
        levels,
        course: name.to_string(),
        walls,
    })
}

/// Creates `directory` unless it is there and empty, and returns its absolute path.
fn create_empty(directory: &Path) -> Result<PathBuf, PrepareError> {
    let io = |source| PrepareError::Io {
        path: directory.to_owned(),
        source,
    };
    fs::create_dir_all(directory).map_err(io)?;
    if fs::read_dir(directory).map_err(io)?.next().is_some() {
        return Err(PrepareError::NotEmpty(directory.to_owned()));
    }
    directory.canonicalize().map_err(io)
}

/// Copies the course files into the run's directory and has the configuration name the copies: what was flown stays known when the originals change.
fn copy_courses(root: &Path, config: &mut Config) -> Result<(), PrepareError> {
    let folder = RunDirectory::new(root).courses();
    fs::create_dir_all(&folder).map_err(|source| PrepareError::Io {
        path: folder.clone(),
        source,
    })?;
    let mut copies: BTreeMap<OsString, PathBuf> = BTreeMap::new();
    for path in config.courses.paths_mut() {
        let stem = CoursesSection::name_of(path);
        let mut name = OsString::from(format!("{stem}.toml"));
        for number in 2.. {
            if copies.get(&name).is_none_or(|original| original == path) {
                break;
            }
            name = format!("{stem}_{number}.toml").into();
        }
        let copy = folder.join(&name);
        fs::copy(&*path, &copy).map_err(|source| PrepareError::Io { path: copy, source })?;
        let relative = Path::new("courses").join(&name);
        copies.insert(name, std::mem::replace(path, relative));
    }
    Ok(())
}

#[cfg(test)]
pub(crate) mod tests {
    use serde::Deserialize;

    use super::*;

    fn shipped(name: &str) -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../configs/courses")
            .join(name)
    }

    /// A configuration file that flies one shipped course.
    fn config_file(directory: &Path, text: &str) -> PathBuf {
        let path = directory.join("test.toml");
        let course = shipped("training.toml");
        let courses = format!("[courses]\ntraining = {course:?}\nevaluation = [{course:?}]\n{text}");
        fs::write(&path, courses).unwrap();
        path
    }

    /// A run of one course, ready to be started, in a folder of `directory`.
    pub(crate) fn prepared_run(directory: &Path) -> Prepared {
        prepare(&config_file(directory, ""), &[], &directory.join("run"), 1).unwrap()
    }

    #[test]
    fn a_prepared_run_holds_copies_of_all_it_needs() {
        let directory = tempfile::tempdir().unwrap();
        let config = config_file(directory.path(), "");
        let prepared = prepare(&config, &["run.seed=7".to_owned()], &directory.path().join("run"), 2).unwrap();
        assert_eq!(prepared.config.run.seed, 7);
        let root = directory.path().join("run").canonicalize().unwrap();
        assert_eq!(prepared.config.courses.training, root.join("courses/training.toml"));
        assert_eq!(
            prepared.courses[0].course,
            Course::load(shipped("training.toml")).unwrap()
        );
        assert_eq!(prepared.run.open().unwrap().0, prepared.identity);
    }

    #[test]
    fn the_simulators_defaults_are_written_out_to_the_last_bit() {
        let mut settings = SimulatorSettings::default();
        settings.vehicle.control_period_secs = 0.1;
        let written = written_out(&settings);
        assert_eq!(written["vehicle"]["control_period_secs"].to_string(), "0.1");
        assert_eq!(SimulatorSettings::deserialize(written).unwrap(), settings);
    }

    #[test]
    fn two_courses_of_one_file_name_stay_two() {
        let directory = tempfile::tempdir().unwrap();
        let other = directory.path().join("training.toml");
        fs::copy(shipped("non_rectangular.toml"), &other).unwrap();
        let config = config_file(directory.path(), "");
        let set = format!("courses.evaluation=[{:?}, {other:?}]", shipped("training.toml"));
        let prepared = prepare(&config, &[set], &directory.path().join("run"), 1).unwrap();
        assert_eq!(prepared.courses.len(), 2);
        assert_ne!(prepared.courses[0].course, prepared.courses[1].course);
        assert_eq!(
            (&*prepared.courses[0].name, &*prepared.courses[1].name),
            ("training", "training_2")
        );
    }

    #[test]
    fn what_cannot_run_is_refused_before_anything_is_created() {
        let directory = tempfile::tempdir().unwrap();
        for (text, set, actors, expected) in [
            ("[run]\nseed = -1", "", 1, vec!["test.toml", "[run]", "seed"]),
            (
                "[simulator]\nmax_step = 1",
                "",
                1,
                vec!["test.toml", "[simulator]", "max_step"],
            ),
            ("[simulator]\nmax_steps = 0", "", 1, vec!["max_steps = 0"]),
            (
                "[simulator]\nmax_steps = 256",
                "",
                1,
                vec!["max_steps = 256", "transport.max_records_per_flight = 256", "257"],
            ),
            (
                "",
                "courses.training=\"/nowhere.toml\"",
                1,
                vec!["with --set courses.training=", "/nowhere.toml"],
            ),
            (
                "",
                "simulator.max_step=1",
                1,
                vec!["with --set simulator.max_step=1, ", "test.toml", "[simulator]"],
            ),
            (
                "",
                "simulator.max_steps=256",
                1,
                vec!["with --set simulator.max_steps=256, ", "max_records_per_flight"],
            ),
            (
                "[learning]\nlevels = 6",
                "",
                1,
                vec!["test.toml", "learning.levels = 6", "5 walls", "training.toml"],
            ),
            (
                "[simulator.generator]\nwall_x_m = [10.0, 20.0]",
                "courses.generated_share=0.5",
                1,
                vec!["learning.levels = 5", "2 walls", "wall_x_m"],
            ),
            (
                "[transport]\nmax_actors = 3",
                "",
                4,
                vec!["4 actors", "transport.max_actors = 3"],
            ),
        ] {
            let config = config_file(directory.path(), text);
            let overrides: Vec<_> = [set]
                .iter()
                .filter(|set| !set.is_empty())
                .map(ToString::to_string)
                .collect();
            let run = directory.path().join("run");
            let error = prepare(&config, &overrides, &run, actors).unwrap_err().to_string();
            for part in expected {
                assert!(error.contains(part), "`{error}` does not mention `{part}`");
            }
            assert!(!run.exists());
        }
    }

    #[test]
    fn a_used_directory_is_refused_with_a_remedy() {
        let directory = tempfile::tempdir().unwrap();
        let config = config_file(directory.path(), "");
        let error = prepare(&config, &[], directory.path(), 1).unwrap_err().to_string();
        assert!(error.contains("not empty") && error.contains("--run-dir"), "{error}");
    }
}
