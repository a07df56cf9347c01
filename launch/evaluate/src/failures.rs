//! Failed episodes of an evaluation: their picture, and the rates by kind of approach.

use std::path::Path;

use skein_reports::failures::{FlownEpisode, approaches_table, draw_failures};
use skein_rollout::courses::Courses;
use skein_rollout::evaluation::{EvaluatedEpisode, Keep};
use skein_simulator::simulator::SimulatorSettings;
use skein_simulator::suite::EntryCourses;

use crate::plot::PlotError;

/// Time before the end at which the depth image is shown, seconds.
const BEFORE_END_SECS: f32 = 1.0;

/// Returns what must be kept of an evaluation with `settings`, so that its failures can be drawn.
pub(crate) fn to_keep(settings: &SimulatorSettings) -> Keep {
    Keep::Failures(steps_before_end(settings))
}

/// Draws the failed ones of `episodes`, entry by entry, to `file`. Returns the table of approaches,
/// of at most `columns`.
///
/// # Errors
/// [`PlotError`] names the file or the entry.
pub(crate) fn draw(
    courses: &Courses,
    episodes: &[Vec<EvaluatedEpisode>],
    file: &Path,
    columns: usize,
) -> Result<String, PlotError> {
    let before_end = steps_before_end(courses.settings());
    let mut flown = Vec::new();
    for (entry, episodes) in courses.evaluation().zip(episodes) {
        for (number, episode) in episodes.iter().enumerate() {
            let seen = episode.records.iter().rev().nth(before_end);
            flown.push(FlownEpisode {
                course_name: &entry.name,
                number,
                course: entry.courses.of_episode(number as u64)?,
                generated_shape: only_shape(&entry.courses),
                points_m: &episode.positions_m,
                outcome: episode.score.outcome,
                walls_passed: episode.score.walls_passed as usize,
                hit_wall: episode.score.hit_wall,
                // An episode shorter than that shows its first image.
                seen_before_end: seen
                    .or(episode.records.first())
                    .map(|record| &record.depth[..]),
            });
        }
    }
    draw_failures(&flown, file)?;
    Ok(approaches_table(&flown, columns))
}

/// Returns the shape of all openings of generated courses, if there is only one.
fn only_shape(courses: &EntryCourses) -> Option<&'static str> {
    match courses {
        EntryCourses::Generated { ranges, .. } => match &ranges.shapes[..] {
            [shape] => Some(shape.name()),
            _ => None,
        },
        EntryCourses::Listed(_) => None,
    }
}

/// Returns the number of control periods in [`BEFORE_END_SECS`], at least one.
fn steps_before_end(settings: &SimulatorSettings) -> usize {
    let periods = BEFORE_END_SECS / settings.vehicle.control_period_secs;
    (periods.round() as usize).max(1)
}
