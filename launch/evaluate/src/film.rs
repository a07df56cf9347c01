//! Moving picture of an evaluation's first episode.

use std::num::NonZeroUsize;
use std::path::Path;
use std::sync::Arc;

use anyhow::Context;
use skein_protocol::config::Config;
use skein_protocol::snapshot::Snapshot;
use skein_protocol::transition::TransitionRecord;
use skein_reports::flight::{FlightStep, draw_flight};
use skein_rollout::courses::Courses;
use skein_rollout::evaluation::{Evaluation, Keep};

/// Flies the first episode of `courses` again, which takes a moment, and draws it to `file`. So
/// nothing of the other episodes has to be kept.
///
/// # Errors
/// Names the file, or the episode that cannot be flown.
pub(crate) fn draw(
    snapshot: &Snapshot,
    config: &Config,
    courses: Courses,
    file: &Path,
) -> anyhow::Result<()> {
    let courses = Arc::new(courses);
    let evaluation = Evaluation {
        snapshot,
        config,
        courses: Arc::clone(&courses),
        threads: NonZeroUsize::MIN,
        keep: Keep::Records,
    };
    let episodes = evaluation.run()?.episodes;
    let episode = episodes.first().and_then(|episodes| episodes.first());
    let (episode, entry) = episode
        .zip(courses.evaluation().next())
        .context("there is no episode to draw")?;
    let course = entry.courses.of_episode(0)?;
    let latent = config.vae.latent;
    let steps: Vec<_> = episode.records.iter().map(|at| step(at, latent)).collect();
    Ok(draw_flight(&course, &steps, &entry.name, file)?)
}

fn step(record: &TransitionRecord, latent: usize) -> FlightStep<'_> {
    FlightStep {
        position_m: record.position_m,
        depth: &record.depth,
        latent: &record.latent[..latent],
        walls_passed: record.walls_passed,
    }
}
