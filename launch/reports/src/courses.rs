//! Courses of a run, with their names in reports.

use std::path::PathBuf;

use skein_protocol::config::{Config, CoursesSection};
use skein_simulator::course::{Course, CourseError};

/// A course of the final evaluation, with its name in the run's reports.
#[derive(Debug, Clone, PartialEq)]
pub struct NamedCourse {
    /// Name of the course: see [`CoursesSection::names`].
    pub name: String,
    /// The course.
    pub course: Course,
}

/// Loads the courses of the final evaluation.
///
/// # Errors
/// [`CourseError`] names the file, the wall and the key.
pub fn load_courses(config: &Config) -> Result<Vec<NamedCourse>, CourseError> {
    let load = |(name, path): (String, &PathBuf)| {
        Ok(NamedCourse {
            name,
            course: Course::load(path)?,
        })
    };
    let files = &config.courses.evaluation;
    CoursesSection::names(files)
        .into_iter()
        .zip(files)
        .map(load)
        .collect()
}

/// Returns the walls per episode that an agent would pass on average if it passed every wall of the
/// training course, over all start levels.
///
/// # Errors
/// [`CourseError`] names the file, the wall and the key.
pub fn ideal_walls_passed(config: &Config) -> Result<f64, CourseError> {
    let walls = Course::load(&config.courses.training)?.levels();
    // From level l, all but the first l - 1 walls lie ahead.
    Ok(f64::from(walls) - (f64::from(config.learning.levels) - 1.0) / 2.0)
}
