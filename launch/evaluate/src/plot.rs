//! Picture of an evaluation: trajectories on the courses that were flown.

use std::path::Path;

use skein_reports::{FlownCourse, ReportError, Trajectory, draw_trajectories};
use skein_rollout::courses::Courses;
use skein_rollout::evaluation::EvaluatedEpisode;
use skein_simulator::course::RangesError;
use skein_simulator::suite::{EntryCourses, SuiteEntry};

/// Reason why an evaluation could not be drawn.
#[derive(Debug, thiserror::Error)]
pub(crate) enum PlotError {
    /// The picture cannot be drawn or written.
    #[error(transparent)]
    Picture(#[from] ReportError),
    /// A course cannot be generated.
    #[error(transparent)]
    Course(#[from] RangesError),
}

/// Draws the episodes, entry by entry, to `file`.
///
/// # Errors
/// [`PlotError`] names the file.
pub(crate) fn draw(
    courses: &Courses,
    episodes: &[Vec<EvaluatedEpisode>],
    file: &Path,
) -> Result<(), PlotError> {
    let mut flown = Vec::new();
    for (entry, episodes) in courses.evaluation().zip(episodes) {
        let course = entry.courses.of_episode(0)?;
        flown.push((caption(entry), course, on_the_first_course(entry, episodes)));
    }
    let drawn: Vec<_> = flown
        .iter()
        .map(|(name, course, episodes)| FlownCourse {
            name,
            course,
            episodes,
        })
        .collect();
    Ok(draw_trajectories(&drawn, file)?)
}

/// Returns the name of an entry, and which of its courses is drawn if it has several.
fn caption(entry: &SuiteEntry) -> String {
    let several = match &entry.courses {
        EntryCourses::Listed(courses) => entry.episodes.min(courses.len() as u64),
        EntryCourses::Generated { .. } => entry.episodes,
    };
    match several {
        1 => entry.name.clone(),
        several => format!("{}, course 1 of {several}", entry.name),
    }
}

/// Returns the trajectories of the episodes on the first course of an entry.
fn on_the_first_course(entry: &SuiteEntry, episodes: &[EvaluatedEpisode]) -> Vec<Trajectory> {
    (0..)
        .zip(episodes)
        .filter(|(number, _)| entry.courses.number_of(*number) == 0)
        .map(|(_, episode)| Trajectory {
            points_m: episode.positions_m.clone(),
            outcome: episode.score.outcome,
        })
        .collect()
}
