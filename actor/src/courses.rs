//! The courses of a run, and a simulator for each, built when a ticket first asks for it.

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::path::Path;
use std::sync::Arc;

use skein_protocol::config::{Config, CoursesSection};
use skein_protocol::ticket::CourseChoice;
use skein_simulator::course::{Course, CourseError, RangesError};
use skein_simulator::simulator::{Simulator, SimulatorError, SimulatorSettings};

/// The courses a ticket may name, and how they are flown. Shared by the threads that fly them.
#[derive(Debug)]
pub struct Courses {
    settings: SimulatorSettings,
    training: Option<Arc<Course>>,
    evaluation: Vec<EvaluationCourse>,
}

/// A course that evaluations fly.
#[derive(Debug)]
pub struct EvaluationCourse {
    /// What reports call it: its file's name without the extension.
    pub name: String,
    /// The course.
    pub course: Arc<Course>,
}

/// Simulators of one thread.
pub struct Simulators {
    courses: Arc<Courses>,
    fixed: HashMap<CourseChoice, Simulator>,
    /// A generated course is flown once, so only the last is kept: a ticket issued again may come back to it.
    generated: Option<(u64, Simulator)>,
}

impl Courses {
    /// The courses that a run's configuration names.
    ///
    /// # Errors
    /// [`CoursesError`] names the file or the key.
    pub fn of_run(config: &Config) -> Result<Self, CoursesError> {
        Ok(Self {
            settings: simulator_settings(config)?,
            training: Some(load(&config.courses.training)?),
            evaluation: evaluation_courses(&config.courses.evaluation)?,
        })
    }

    /// The courses in the files `paths`, as evaluation courses, and no others.
    ///
    /// # Errors
    /// [`CoursesError`] names the file or the key.
    pub fn of_files<P: AsRef<Path>>(config: &Config, paths: &[P]) -> Result<Self, CoursesError> {
        Ok(Self {
            settings: simulator_settings(config)?,
            training: None,
            evaluation: evaluation_courses(paths)?,
        })
    }

    /// The evaluation courses in order.
    pub fn evaluation(&self) -> &[EvaluationCourse] {
        &self.evaluation
    }

    fn course(&self, choice: CourseChoice) -> Result<Arc<Course>, NoCourse> {
        match choice {
            CourseChoice::Training => self.training.clone().ok_or(NoCourse::NotLoaded { choice }),
            CourseChoice::Evaluation(index) => self
                .evaluation
                .get(index as usize)
                .map(|evaluated| Arc::clone(&evaluated.course))
                .ok_or(NoCourse::NotLoaded { choice }),
            CourseChoice::Generated(seed) => Ok(Arc::new(Course::generate(seed, &self.settings.generator)?)),
        }
    }
}

impl Simulators {
    /// No simulator yet of any of `courses`.
    pub fn new(courses: Arc<Courses>) -> Self {
        Self {
            courses,
            fixed: HashMap::new(),
            generated: None,
        }
    }

    /// How courses are flown.
    pub fn settings(&self) -> &SimulatorSettings {
        &self.courses.settings
    }

    /// The simulator of the course a ticket names.
    ///
    /// # Errors
    /// [`NoCourse`] says what is wrong with the choice.
    pub fn of(&mut self, choice: CourseChoice) -> Result<&mut Simulator, NoCourse> {
        let Self {
            courses,
            fixed,
            generated,
        } = self;
        let build = || Ok::<_, NoCourse>(Simulator::new(courses.course(choice)?, &courses.settings)?);
        match choice {
            CourseChoice::Generated(seed) => {
                if generated.as_ref().is_none_or(|(built, _)| *built != seed) {
                    *generated = Some((seed, build()?));
                }
                Ok(&mut generated.as_mut().expect("it was built in the lines above").1)
            }
            CourseChoice::Training | CourseChoice::Evaluation(_) => Ok(match fixed.entry(choice) {
                Entry::Occupied(entry) => entry.into_mut(),
                Entry::Vacant(entry) => entry.insert(build()?),
            }),
        }
    }
}

fn evaluation_courses<P: AsRef<Path>>(paths: &[P]) -> Result<Vec<EvaluationCourse>, CoursesError> {
    let load = |path: &P| {
        let name = CoursesSection::name_of(path.as_ref());
        Ok(EvaluationCourse {
            name,
            course: load(path.as_ref())?,
        })
    };
    paths.iter().map(load).collect()
}

fn load(path: &Path) -> Result<Arc<Course>, CoursesError> {
    Ok(Arc::new(Course::load(path)?))
}

fn simulator_settings(config: &Config) -> Result<SimulatorSettings, CoursesError> {
    toml::Value::Table(config.simulator.clone())
        .try_into()
        .map_err(|error: toml::de::Error| CoursesError::Settings(error.to_string().trim_end().replace('\n', " ")))
}

/// Why the courses of a run or an evaluation cannot be had.
#[derive(Debug, thiserror::Error)]
pub enum CoursesError {
    /// A course file cannot be read or flown.
    #[error(transparent)]
    Course(#[from] CourseError),
    /// The configuration's simulator section is wrong.
    #[error("[simulator] {0}")]
    Settings(String),
}

/// Why a ticket's course cannot be flown.
#[derive(Debug, thiserror::Error)]
pub enum NoCourse {
    /// There is none of this number.
    #[error("the ticket names {choice:?}, which this process has not loaded")]
    NotLoaded {
        /// What the ticket names.
        choice: CourseChoice,
    },
    /// None can be generated.
    #[error(transparent)]
    Ranges(#[from] RangesError),
    /// It cannot be simulated.
    #[error(transparent)]
    Simulator(#[from] SimulatorError),
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::config;

    fn refused(config: &Config) -> String {
        Courses::of_run(config).unwrap_err().to_string()
    }

    #[test]
    fn what_is_wrong_is_named() {
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
    fn evaluation_courses_go_by_their_files_names_in_order() {
        let courses = Courses::of_run(&config("")).unwrap();
        let names: Vec<_> = courses
            .evaluation()
            .iter()
            .map(|evaluated| evaluated.name.as_str())
            .collect();
        assert_eq!(
            names,
            ["training", "rearranged_34125", "rearranged_53412", "non_rectangular"]
        );
    }

    #[test]
    fn a_simulator_is_built_once_and_only_the_last_generated_one_is_kept() {
        let mut simulators = Simulators::new(Arc::new(Courses::of_run(&config("")).unwrap()));
        let address = |simulator: &mut Simulator| std::ptr::from_ref(simulator.course()) as usize;
        let training = address(simulators.of(CourseChoice::Training).unwrap());
        for seed in 0..3 {
            simulators.of(CourseChoice::Generated(seed)).unwrap();
        }
        assert_eq!(address(simulators.of(CourseChoice::Training).unwrap()), training);
        assert_eq!(
            (simulators.fixed.len(), simulators.generated.as_ref().unwrap().0),
            (1, 2)
        );
    }
}
