//! Task of an environment: settings, courses, levels, encoder.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use pyo3::exceptions::{PyIndexError, PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyString};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use skein_inference::{Encoder, trained_encoder};
use skein_protocol::ActionSpace;
use skein_protocol::config::Config;
use skein_protocol::encoder_file::TrainedEncoder;
use skein_protocol::ids::{Attempt, EpisodeId, PolicyVersion, RunId};
use skein_protocol::seeds::{Purpose, derive};
use skein_protocol::ticket::{CourseChoice, Exploration, Ticket};
use skein_rollout::courses::{Courses, settings_of};
use skein_simulator::course::Course;
use skein_simulator::simulator::Simulator;

use crate::values::{dict_of, table_of};

/// Courses of the repository, by the names of their files.
const SHIPPED: [(&str, &str); 4] = [
    (
        "training",
        include_str!("../../../configs/courses/training.toml"),
    ),
    (
        "rearranged_34125",
        include_str!("../../../configs/courses/rearranged_34125.toml"),
    ),
    (
        "rearranged_53412",
        include_str!("../../../configs/courses/rearranged_53412.toml"),
    ),
    (
        "non_rectangular",
        include_str!("../../../configs/courses/non_rectangular.toml"),
    ),
];

/// Task to fly; immutable, shared by all environments that fly it.
#[pyclass(frozen, module = "skein_rl._core")]
pub(crate) struct Task {
    pub(crate) flown: Arc<Flown>,
}

/// Content of a [`Task`].
pub(crate) struct Flown {
    pub(crate) courses: Arc<Courses>,
    /// The listed courses, in order.
    pub(crate) listed: Vec<Arc<Course>>,
    /// Probability that an episode's course is generated.
    generated_share: f64,
    /// Levels that an episode may start at.
    levels: Vec<u8>,
    /// Encoder of latent observations, and the length of its code.
    pub(crate) encoder: Option<(Arc<Encoder>, usize)>,
}

/// A caller's wishes for one episode; what is `None` is drawn from the episode's seed.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Choice {
    pub(crate) course: Option<CoursePick>,
    pub(crate) course_seed: Option<u64>,
    pub(crate) level: Option<u8>,
}

/// Course of one episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum CoursePick {
    /// The listed course of this index.
    Listed(u32),
    Generated,
}

#[pymethods]
impl Task {
    #[new]
    fn new(
        simulator: &Bound<'_, PyDict>,
        courses: Vec<Bound<'_, PyAny>>,
        generated_share: f64,
        levels: Vec<u8>,
        encoder: Option<PathBuf>,
    ) -> PyResult<Self> {
        let settings = settings_of(table_of(simulator, "simulator")?).map_err(refused)?;
        let listed = (0..)
            .zip(&courses)
            .map(|(place, course)| load_course(course, place).map(Arc::new))
            .collect::<PyResult<Vec<_>>>()?;
        let courses = Arc::new(Courses::of_courses(settings, listed.clone()));
        let encoder = encoder.map(|path| load_encoder(&path)).transpose()?;
        let flown = Flown {
            courses,
            listed,
            generated_share,
            levels,
            encoder,
        };
        flown.check()?;
        let flown = Arc::new(flown);
        Ok(Self { flown })
    }

    /// Names of the listed courses.
    #[getter]
    fn course_names(&self) -> Vec<&str> {
        self.flown
            .listed
            .iter()
            .map(|course| course.name())
            .collect()
    }

    /// Length of the latent code; 0 without an encoder.
    #[getter]
    fn latent(&self) -> usize {
        self.flown.encoder.as_ref().map_or(0, |(_, latent)| *latent)
    }

    /// Names of the numbers of an action, in order.
    #[getter]
    fn action_names(&self) -> Vec<&'static str> {
        let axes = self.flown.action().axes().iter();
        axes.map(|axis| axis.name()).collect()
    }

    /// All settings of the simulator, defaults included.
    #[getter]
    fn settings<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let table = toml::Table::try_from(self.flown.courses.settings()).map_err(refused)?;
        dict_of(py, &table)
    }
}

impl Flown {
    /// Returns the numbers of an action.
    pub(crate) fn action(&self) -> ActionSpace {
        self.courses.settings().vehicle.action
    }

    fn check(&self) -> PyResult<()> {
        let settings = self.courses.settings();
        if !(0.0..=1.0).contains(&self.generated_share) {
            return Err(refused(format!(
                "generated_share = {} is outside [0, 1]: it is a share of the episodes",
                self.generated_share
            )));
        }
        if self.listed.is_empty() && self.generated_share < 1.0 {
            return Err(refused(
                "courses = [] lists no course: name one, or \"random\"",
            ));
        }
        if self.levels.is_empty() {
            return Err(refused("levels = [] lists no level: list at least one"));
        }
        self.courses.check().map_err(refused)?;
        if self.generated_share > 0.0 {
            let ranges = &settings.generator;
            ranges
                .check()
                .map_err(|error| refused(format!("[simulator.generator] {error}")))?;
            let (corridor, start) = ranges.longest();
            settings.check_reach(corridor, start).map_err(refused)?;
            self.check_levels("random courses", ranges.most_walls())?;
            let course = Course::generate(0, ranges).map_err(refused)?;
            Simulator::new(Arc::new(course), settings).map_err(refused)?;
        }
        self.listed
            .iter()
            .try_for_each(|course| self.check_levels(course.name(), course.levels().into()))
    }

    /// Checks that a course of `walls` walls has all levels.
    fn check_levels(&self, course: &str, walls: usize) -> PyResult<()> {
        let wrong = |level: &&u8| !(1..=walls).contains(&usize::from(**level));
        match self.levels.iter().find(wrong) {
            Some(level) => Err(refused(format!(
                "levels: {level} is no level of {course}: it has the levels 1 to {walls}"
            ))),
            None => Ok(()),
        }
    }

    /// Returns the ticket of the episode of `seed`, with what `choice` leaves open drawn from it.
    pub(crate) fn ticket(&self, seed: u64, episode: u64, choice: &Choice) -> PyResult<Ticket> {
        // Everything is drawn, so that one wish does not change the rest.
        let mut rng = Pcg64Mcg::seed_from_u64(derive(seed, Purpose::Course, 0));
        let generated = rng.random::<f64>() < self.generated_share;
        // Not above what the signed integers of frameworks hold.
        let course_seed = rng.random::<u64>() >> 1;
        let (place, level): (u64, u64) = (rng.random(), rng.random());
        let drawn = match self.listed.len() as u64 {
            0 => CoursePick::Generated,
            _ if generated => CoursePick::Generated,
            listed => CoursePick::Listed((place % listed) as u32),
        };
        let drawn_level = self.levels[(level % self.levels.len() as u64) as usize];
        let course = match (choice.course, choice.course_seed) {
            (Some(CoursePick::Listed(place)), None) => CourseChoice::Evaluation(place),
            (Some(CoursePick::Listed(_)), Some(_)) => {
                return Err(refused(
                    "options: course_seed goes with course = \"random\" alone: leave one out",
                ));
            }
            (_, Some(seed)) => CourseChoice::Generated(seed),
            (Some(CoursePick::Generated), None) => CourseChoice::Generated(course_seed),
            (None, None) => match drawn {
                CoursePick::Generated => CourseChoice::Generated(course_seed),
                CoursePick::Listed(place) => CourseChoice::Evaluation(place),
            },
        };
        Ok(Ticket {
            run: RunId(0),
            episode: EpisodeId(episode),
            attempt: Attempt(0),
            policy_version: PolicyVersion(0),
            course,
            start_level: choice.level.unwrap_or(drawn_level),
            exploration: Exploration::Mode,
            seed,
            teacher_share: None,
            segment: None,
        })
    }

    /// Reads `course` and `course_seed` and `level` as a caller of `reset` gives them.
    ///
    /// # Errors
    /// Names the option, its value and what it may be.
    pub(crate) fn choice(
        &self,
        course: Option<&Bound<'_, PyAny>>,
        course_seed: Option<u64>,
        level: Option<u8>,
    ) -> PyResult<Choice> {
        let course = course.map(|course| self.pick(course)).transpose()?;
        Ok(Choice {
            course,
            course_seed,
            level,
        })
    }

    fn pick(&self, course: &Bound<'_, PyAny>) -> PyResult<CoursePick> {
        let names = || -> Vec<_> { self.listed.iter().map(|course| course.name()).collect() };
        if let Ok(place) = course.extract::<u32>() {
            return match (place as usize) < self.listed.len() {
                true => Ok(CoursePick::Listed(place)),
                false => Err(PyIndexError::new_err(format!(
                    "options: course = {place}, but the courses are {:?}, counted from 0",
                    names()
                ))),
            };
        }
        let name: String = course.extract().map_err(|_| {
            PyTypeError::new_err(format!(
                "options: course = {course} is neither an index nor a name"
            ))
        })?;
        if name == "random" {
            return Ok(CoursePick::Generated);
        }
        let place = self.listed.iter().position(|course| course.name() == name);
        place
            .map(|place| CoursePick::Listed(place as u32))
            .ok_or_else(|| {
                refused(format!(
                    "options: course = {name:?} is not among {:?}, nor is it \"random\"",
                    names()
                ))
            })
    }
}

/// Reads the part of a run's configuration that an environment needs.
///
/// # Errors
/// `ValueError` names file, key, value and remedy.
#[pyfunction]
pub(crate) fn read_config(py: Python<'_>, path: PathBuf) -> PyResult<Bound<'_, PyDict>> {
    let config = Config::load(&path, &[]).map_err(refused)?;
    let dict = PyDict::new(py);
    dict.set_item("simulator", dict_of(py, &config.simulator)?)?;
    dict.set_item("courses", vec![config.courses.training])?;
    dict.set_item("generated_share", config.courses.generated_share)?;
    dict.set_item("levels", (1..=config.learning.levels).collect::<Vec<_>>())?;
    Ok(dict)
}

/// Reads TOML, for Pythons without a reader of their own.
///
/// # Errors
/// `ValueError` names the line and the problem.
#[pyfunction]
pub(crate) fn parse_toml<'py>(py: Python<'py>, text: &str) -> PyResult<Bound<'py, PyDict>> {
    let table: toml::Table = toml::from_str(text).map_err(refused)?;
    dict_of(py, &table)
}

pub(crate) fn shipped_names() -> Vec<&'static str> {
    SHIPPED.iter().map(|(name, _)| *name).collect()
}

/// Loads a course: a shipped one by its name, a file by its path, or one given as a dictionary.
fn load_course(course: &Bound<'_, PyAny>, place: usize) -> PyResult<Course> {
    if let Ok(keys) = course.cast::<PyDict>() {
        let name = format!("courses[{place}]");
        let text = toml::to_string(&table_of(keys, &name)?).map_err(refused)?;
        return Course::parse(&text, name).map_err(with_source);
    }
    let name = course.cast::<PyString>().ok().map(|name| name.to_string());
    let shipped = |(stem, _): &&(&str, &str)| name.as_deref() == Some(*stem);
    if let Some((stem, text)) = SHIPPED.iter().find(shipped) {
        return Course::parse(text, stem).map_err(with_source);
    }
    let path: PathBuf = course.extract().map_err(|_| {
        PyTypeError::new_err(format!(
            "courses[{place}] = {course} is neither a name, a path nor a dictionary"
        ))
    })?;
    Course::load(&path).map_err(|error| match path.exists() {
        true => with_source(error),
        false => refused(format!(
            "courses[{place}] = {:?} is no file, nor one of {:?}, nor \"random\"",
            path.display().to_string(),
            shipped_names()
        )),
    })
}

fn load_encoder(path: &Path) -> PyResult<(Arc<Encoder>, usize)> {
    let trained = TrainedEncoder::load(path).map_err(|error| {
        refused(format!(
            "encoder: {error}; name a snapshot or a file that launch/encoder.sh wrote"
        ))
    })?;
    Ok((Arc::new(trained_encoder(&trained)), trained.latent))
}

/// Returns a `ValueError` with this message.
pub(crate) fn refused(message: impl ToString) -> PyErr {
    PyValueError::new_err(message.to_string())
}

/// Returns a `ValueError` with the error and its cause.
fn with_source(error: impl std::error::Error) -> PyErr {
    match error.source() {
        Some(source) if !error.to_string().contains(&source.to_string()) => {
            refused(format!("{error}: {source}"))
        }
        _ => refused(error),
    }
}
