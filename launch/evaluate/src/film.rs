//! Moving picture of an evaluation's first episode.

use std::num::NonZeroUsize;
use std::path::Path;
use std::sync::Arc;

use anyhow::Context;
use skein_inference::Decoder;
use skein_protocol::config::Config;
use skein_protocol::snapshot::Snapshot;
use skein_protocol::transition::{Outcome, TransitionRecord};
use skein_reports::flight::{CodeView, FlightStep, draw_flight};
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
    decoder: Option<&Decoder>,
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
    let codes = episode.records.iter().map(|at| &at.latent[..latent]);
    let decoded = |code| decoder.map(|decoder| decoder.decode(code));
    let images: Vec<_> = codes.clone().map(decoded).collect();
    let views = codes.zip(&images).map(|(code, image)| match image {
        Some(image) => CodeView::Image(image),
        None => CodeView::Numbers(code),
    });
    let steps = episode.records.iter().zip(views);
    let steps: Vec<_> = steps.map(|(record, code)| step(record, code)).collect();
    let ending = match episode.score.outcome {
        Outcome::ReachedEnd => "reached the end",
        Outcome::Collided => "collided",
        Outcome::TimedOut => "timed out",
    };
    Ok(draw_flight(&course, &steps, &entry.name, ending, file)?)
}

fn step<'a>(record: &'a TransitionRecord, code: CodeView<'a>) -> FlightStep<'a> {
    FlightStep {
        position_m: record.position_m,
        depth: &record.depth,
        code,
        walls_passed: record.walls_passed,
    }
}
