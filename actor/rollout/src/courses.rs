//! The courses of a run, and a simulator for each, built when a ticket first names it.

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::path::Path;
use std::sync::Arc;

use skein_protocol::config::{Config, CoursesSection};
use skein_protocol::ids::EpisodeId;
use skein_protocol::ticket::{CourseChoice, Ticket};
use skein_simulator::course::{Course, CourseError, RangesError};
use skein_simulator::disturbances::DisturbanceSettingsError;
use skein_simulator::simulator::{OutOfReach, Simulator, SimulatorError, SimulatorSettings};
use skein_simulator::suite::{EntryCourses, Suite, SuiteEntry};

/// Courses that a ticket may name, with simulator settings. Shared by all threads.
#[derive(Debug)]
pub struct Courses {
    settings: SimulatorSettings,
    training: Option<Arc<Course>>,
    evaluation: Vec<EvaluationEntry>,
}

/// Evaluation entry, named by a ticket of [`CourseChoice::Evaluation`]: one course, or several that
/// its episodes fly in turn.
#[derive(Debug)]
pub struct EvaluationEntry {
    /// Courses, and their name in reports.
    pub entry: SuiteEntry,
    /// Simulator settings: the run's, with the entry's disturbances and step limit.
    settings: SimulatorSettings,
}

/// Simulators of one thread.
pub struct Simulators {
    courses: Arc<Courses>,
    fixed: HashMap<CourseChoice, Simulator>,
    /// The last simulator of a course that one episode flies: a reissued ticket may need it again.
    one_off: Option<(OneOffCourse, Simulator)>,
}

/// A course flown once or rarely: the choice, and its number within that choice.
type OneOffCourse = (CourseChoice, u64);

impl Courses {
    /// Loads the courses that a run's configuration names.
    ///
    /// # Errors
    /// [`CoursesError`] names the file or the key.
    pub fn of_run(config: &Config) -> Result<Self, CoursesError> {
        Ok(Self {
            training: Some(load(&config.courses.training)?),
            ..Self::of_files(config, &config.courses.evaluation)?
        })
    }

    /// Takes `courses` as the only evaluation courses.
    pub fn of_courses(settings: SimulatorSettings, courses: Vec<Arc<Course>>) -> Self {
        let entry = |course: Arc<Course>| EvaluationEntry {
            entry: SuiteEntry {
                name: course.name().to_owned(),
                episodes: 1,
                courses: EntryCourses::Listed(vec![course]),
                disturbances: settings.disturbances.clone(),
                max_steps: None,
            },
            settings: settings.clone(),
        };
        let evaluation = courses.into_iter().map(entry).collect();
        Self {
            settings,
            training: None,
            evaluation,
        }
    }

    /// Loads the files `paths` as the only evaluation courses, with the run's simulator settings.
    ///
    /// # Errors
    /// [`CoursesError`] names the file or the key.
    pub fn of_files<P: AsRef<Path>>(config: &Config, paths: &[P]) -> Result<Self, CoursesError> {
        let settings = simulator_settings(config)?;
        let entry = |(name, path): (String, &P)| {
            let entry = SuiteEntry {
                name,
                episodes: config.evaluation.episodes,
                courses: EntryCourses::Listed(vec![load(path.as_ref())?]),
                disturbances: settings.disturbances.clone(),
                max_steps: None,
            };
            Ok(EvaluationEntry {
                entry,
                settings: settings.clone(),
            })
        };
        let evaluation = CoursesSection::names(paths)
            .into_iter()
            .zip(paths)
            .map(entry)
            .collect::<Result<_, CoursesError>>()?;
        Ok(Self {
            settings,
            training: None,
            evaluation,
        })
    }

    /// Loads the entries of `suite`, with the run's drone and camera and the suite's disturbances.
    ///
    /// # Errors
    /// [`CoursesError`] names the key.
    pub fn of_suite(config: &Config, suite: Suite) -> Result<Self, CoursesError> {
        let settings = simulator_settings(config)?;
        let entry = |entry: SuiteEntry| {
            entry
                .disturbances
                .validate(&settings.vehicle, settings.camera.range_m)
                .map_err(|source| CoursesError::Disturbances {
                    entry: entry.name.clone(),
                    source,
                })?;
            let settings = entry.settings(&settings);
            Ok(EvaluationEntry { entry, settings })
        };
        let evaluation = suite
            .entries
            .into_iter()
            .map(entry)
            .collect::<Result<_, CoursesError>>()?;
        Ok(Self {
            settings,
            training: None,
            evaluation,
        })
    }

    /// Sets the number of evaluation episodes of each entry.
    #[must_use]
    pub fn with_episodes(mut self, episodes: u64) -> Self {
        for evaluated in &mut self.evaluation {
            evaluated.entry.episodes = episodes;
        }
        self
    }

    /// Checks that each evaluation course can be simulated, and that an episode can reach its end.
    ///
    /// # Errors
    /// [`CoursesError`] names the setting at fault, or the entry, the distances and their keys.
    pub fn check(&self) -> Result<(), CoursesError> {
        self.evaluation.iter().try_for_each(|evaluated| {
            // Of an entry's courses, one is enough: what they differ in was checked with them.
            let course = evaluated.entry.courses.of_episode(0)?;
            Simulator::new(course, &evaluated.settings)?;
            let reached = evaluated.entry.courses.check_reach(&evaluated.settings);
            reached.map_err(|source| CoursesError::OutOfReach {
                entry: evaluated.entry.name.clone(),
                source,
            })
        })
    }

    /// Returns the largest number of records of an evaluation: of each episode its steps and a
    /// closing record.
    pub fn most_records(&self) -> u64 {
        let of_entry = |evaluated: &EvaluationEntry| {
            let steps = u64::from(evaluated.settings.max_steps);
            evaluated.entry.episodes.saturating_mul(steps + 1)
        };
        self.evaluation
            .iter()
            .map(of_entry)
            .fold(0, u64::saturating_add)
    }

    /// Returns the evaluation entries, in order.
    pub fn evaluation(&self) -> impl ExactSizeIterator<Item = &SuiteEntry> {
        self.evaluation.iter().map(|evaluated| &evaluated.entry)
    }

    /// Returns the run's simulator settings.
    pub fn settings(&self) -> &SimulatorSettings {
        &self.settings
    }

    fn entry(
        &self,
        choice: CourseChoice,
        index: u32,
    ) -> Result<&EvaluationEntry, CourseChoiceError> {
        self.evaluation
            .get(index as usize)
            .ok_or(CourseChoiceError::NotLoaded { choice })
    }

    /// Builds a simulator of the course that `ticket` names.
    fn build(&self, ticket: &Ticket) -> Result<Simulator, CourseChoiceError> {
        let (course, settings) = self.course(ticket)?;
        Ok(Simulator::new(course, settings)?)
    }

    /// Returns the course that `ticket` names, and the settings that it is flown with.
    ///
    /// # Errors
    /// [`CourseChoiceError`] says what is wrong with the choice.
    pub fn course(
        &self,
        ticket: &Ticket,
    ) -> Result<(Arc<Course>, &SimulatorSettings), CourseChoiceError> {
        let choice = ticket.course;
        Ok(match choice {
            CourseChoice::Training => {
                let course = self
                    .training
                    .clone()
                    .ok_or(CourseChoiceError::NotLoaded { choice })?;
                (course, &self.settings)
            }
            CourseChoice::Evaluation(index) => {
                let EvaluationEntry { entry, settings } = self.entry(choice, index)?;
                (
                    entry.courses.of_episode(evaluation_episode(ticket))?,
                    settings,
                )
            }
            CourseChoice::Generated(seed) => {
                let (level, ranges) = (ticket.start_level, &self.settings.generator);
                let course = Course::generate_from_level(seed, level, ranges)?;
                (Arc::new(course), &self.settings)
            }
        })
    }

    /// Returns the key of a one-off course; `None` for a course that is flown again and again.
    fn one_off(&self, ticket: &Ticket) -> Result<Option<OneOffCourse>, CourseChoiceError> {
        let choice = ticket.course;
        Ok(match choice {
            CourseChoice::Training => None,
            CourseChoice::Generated(_) => Some((choice, ticket.start_level.into())),
            CourseChoice::Evaluation(index) => match &self.entry(choice, index)?.entry.courses {
                EntryCourses::Listed(courses) if courses.len() == 1 => None,
                several => Some((choice, several.number_of(evaluation_episode(ticket)))),
            },
        })
    }
}

/// Returns the episode's number within its evaluation, from 0. It selects one of several courses.
fn evaluation_episode(ticket: &Ticket) -> u64 {
    ticket
        .episode
        .0
        .saturating_sub(EpisodeId::FIRST_EVALUATION.0)
}

impl Simulators {
    /// Starts without simulators: each is built at its first use.
    pub fn new(courses: Arc<Courses>) -> Self {
        Self {
            courses,
            fixed: HashMap::new(),
            one_off: None,
        }
    }

    /// Returns the run's simulator settings.
    pub fn settings(&self) -> &SimulatorSettings {
        self.courses.settings()
    }

    /// Returns the simulator of the course that a ticket names.
    ///
    /// # Errors
    /// [`CourseChoiceError`] says what is wrong with the choice.
    pub fn of(&mut self, ticket: &Ticket) -> Result<&mut Simulator, CourseChoiceError> {
        let Self {
            courses,
            fixed,
            one_off,
        } = self;
        match courses.one_off(ticket)? {
            Some(wanted) => {
                if one_off.as_ref().is_none_or(|(built, _)| *built != wanted) {
                    *one_off = Some((wanted, courses.build(ticket)?));
                }
                Ok(&mut one_off.as_mut().expect("it was built in the lines above").1)
            }
            None => Ok(match fixed.entry(ticket.course) {
                Entry::Occupied(entry) => entry.into_mut(),
                Entry::Vacant(entry) => entry.insert(courses.build(ticket)?),
            }),
        }
    }
}

fn load(path: &Path) -> Result<Arc<Course>, CoursesError> {
    Ok(Arc::new(Course::load(path)?))
}

fn simulator_settings(config: &Config) -> Result<SimulatorSettings, CoursesError> {
    settings_of(config.simulator.clone())
}

/// Reads a `[simulator]` section.
///
/// # Errors
/// [`CoursesError::Settings`] names the key.
pub fn settings_of(section: toml::Table) -> Result<SimulatorSettings, CoursesError> {
    toml::Value::Table(section)
        .try_into()
        .map_err(|error: toml::de::Error| {
            CoursesError::Settings(error.to_string().trim_end().replace('\n', " "))
        })
}

/// Reason why the courses of a run or an evaluation cannot be loaded.
#[derive(Debug, thiserror::Error)]
pub enum CoursesError {
    /// A course file cannot be read or flown.
    #[error(transparent)]
    Course(#[from] CourseError),
    /// The configuration's simulator section is invalid.
    #[error("[simulator] {0}")]
    Settings(String),
    /// A setting of drone, camera, reward or disturbances is out of bounds.
    #[error(transparent)]
    Simulator(#[from] SimulatorError),
    /// A course cannot be generated.
    #[error(transparent)]
    Ranges(#[from] RangesError),
    /// No episode can finish a course.
    #[error("\"{entry}\": {source}")]
    OutOfReach {
        /// The course or entry.
        entry: String,
        /// Cause.
        source: OutOfReach,
    },
    /// The drone does not support the disturbances of an entry of a suite.
    #[error("entry \"{entry}\": {source}")]
    Disturbances {
        /// The entry.
        entry: String,
        /// Cause.
        source: DisturbanceSettingsError,
    },
}

/// Reason why a ticket's course cannot be flown.
#[derive(Debug, thiserror::Error)]
pub enum CourseChoiceError {
    /// The course is not loaded.
    #[error("the ticket names {choice:?}, which this process has not loaded")]
    NotLoaded {
        /// The ticket's choice.
        choice: CourseChoice,
    },
    /// The course cannot be generated.
    #[error(transparent)]
    Ranges(#[from] RangesError),
    /// The course cannot be simulated.
    #[error(transparent)]
    Simulator(#[from] SimulatorError),
}

#[cfg(test)]
mod tests {
    use skein_protocol::ids::{Attempt, PolicyVersion, RunId};
    use skein_protocol::ticket::Exploration;

    use super::*;
    use crate::testing::config;

    /// Returns the ticket of episode `episode` of an evaluation, or of a training episode on
    /// `course`.
    fn ticket(course: CourseChoice, episode: u64) -> Ticket {
        Ticket {
            run: RunId(0),
            episode: EpisodeId(EpisodeId::FIRST_EVALUATION.0 + episode),
            attempt: Attempt(0),
            policy_version: PolicyVersion(0),
            course,
            start_level: 1,
            exploration: Exploration::Mode,
            seed: 1,
            teacher_share: None,
            segment: None,
        }
    }

    fn refused(config: &Config) -> String {
        Courses::of_run(config).unwrap_err().to_string()
    }

    #[test]
    fn errors_name_the_wrong_key_or_file() {
        let unknown = refused(&config("max_stepps = 3"));
        assert!(
            unknown.contains("[simulator]") && unknown.contains("max_stepps"),
            "{unknown}"
        );
        let mut missing = config("");
        missing.courses.evaluation.push("nowhere.toml".into());
        assert!(refused(&missing).contains("nowhere.toml"));
    }

    #[test]
    fn evaluation_courses_are_called_by_their_names_in_order() {
        let courses = Courses::of_run(&config("")).unwrap();
        let names: Vec<_> = courses
            .evaluation()
            .map(|entry| entry.name.as_str())
            .collect();
        assert_eq!(
            names,
            [
                "training",
                "rearranged 34125",
                "rearranged 53412",
                "non-rectangular"
            ]
        );
    }

    #[test]
    fn a_simulator_is_built_once_and_only_the_last_generated_one_is_kept() {
        let mut simulators = Simulators::new(Arc::new(Courses::of_run(&config("")).unwrap()));
        let address = |simulator: &mut Simulator| std::ptr::from_ref(simulator.course()) as usize;
        let mut of = |choice| address(simulators.of(&ticket(choice, 0)).unwrap());
        let training = of(CourseChoice::Training);
        for seed in 0..3 {
            of(CourseChoice::Generated(seed));
        }
        assert_eq!(of(CourseChoice::Training), training);
        assert_eq!(simulators.fixed.len(), 1);
        assert_eq!(
            simulators.one_off.unwrap().0,
            (CourseChoice::Generated(2), 1)
        );
    }

    #[test]
    fn episodes_of_an_entry_cycle_through_its_courses_with_its_disturbances() {
        let text = r#"
            name = "two orders and what is generated"
            episodes = 4
            [[entry]]
            name = "orders"
            orders_of = "training.toml"
            [[entry]]
            name = "generated"
            first_seed = 7
            [entry.generated]
            shapes = ["circle"]
            [entry.disturbances]
            latency_periods = 1
        "#;
        let path = config("").courses.training;
        let suite = Suite::parse(text, &path).unwrap();
        let courses =
            Arc::new(Courses::of_suite(&config("disturbances.mass_spread = 0.1"), suite).unwrap());
        let mut simulators = Simulators::new(Arc::clone(&courses));
        let mut order = |entry, episode| {
            let simulator = simulators
                .of(&ticket(CourseChoice::Evaluation(entry), episode))
                .unwrap();
            let walls = simulator.course().walls().iter();
            walls.map(|wall| wall.safe_point()).collect::<Vec<_>>()
        };
        assert_ne!(order(0, 0), order(0, 1));
        assert_eq!(order(0, 0), order(0, 120));
        assert_ne!(order(1, 0), order(1, 120));
        let disturbances = |entry: usize| &courses.evaluation[entry].settings.disturbances;
        assert_eq!(
            (disturbances(0).latency_periods, disturbances(0).mass_spread),
            (0, 0.0)
        );
        assert_eq!(
            (disturbances(1).latency_periods, disturbances(1).mass_spread),
            (1, 0.0)
        );
    }
}
