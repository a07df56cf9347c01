//! Output files of the final evaluation: the report, the trajectories, and images with their
//! reconstructions.

use std::io;
use std::path::{Path, PathBuf};

use safetensors::tensor::{Dtype, TensorView};
use serde::Serialize;
use skein_inference::Decoder;
use skein_protocol::config::{Config, CoursesSection};
use skein_protocol::evaluation::{CourseEvaluation, EpisodeScore, EvaluationReport};
use skein_protocol::ids::PolicyVersion;
use skein_protocol::transition::Outcome;
use skein_protocol::{IMAGE_HEIGHT, IMAGE_PIXELS, IMAGE_WIDTH};
use skein_run::RunDirectory;
use skein_run::durable;

use crate::episode::CommittedEpisode;
use crate::trainer::Trainer;

/// Episodes per course whose trajectory is written.
const TRAJECTORIES: usize = 25;
/// Number of images shown beside their reconstructions.
const PICTURES: usize = 8;

/// Reason why an evaluation cannot be written.
#[derive(Debug, thiserror::Error)]
#[error("cannot write {}: {source}", path.display())]
pub struct EvaluationWriteError {
    /// Path of the file.
    pub path: PathBuf,
    /// Cause.
    #[source]
    pub source: io::Error,
}

/// Replaces the file at `path` by `content`, completely or not at all.
fn replace<E>(path: &Path, content: Result<Vec<u8>, E>) -> Result<(), EvaluationWriteError>
where
    E: Into<Box<dyn std::error::Error + Send + Sync>>,
{
    content
        .map_err(io::Error::other)
        .and_then(|bytes| durable::replace(path, &bytes))
        .map_err(|source| EvaluationWriteError {
            path: path.to_owned(),
            source,
        })
}

/// A row of `evaluation_trajectories.csv`.
#[derive(Debug, Serialize)]
struct TrajectoryPoint<'a> {
    course: &'a str,
    episode: usize,
    step: usize,
    x_m: f32,
    y_m: f32,
    z_m: f32,
    outcome: Outcome,
}

/// Writes `evaluation.json` and `evaluation_trajectories.csv` from the evaluation episodes of all
/// courses, course by course.
///
/// # Errors
/// [`EvaluationWriteError`] names the file.
pub(crate) fn write_report(
    directory: &RunDirectory,
    config: &Config,
    policy_version: PolicyVersion,
    policy_sha256: &str,
    flown: &[CommittedEpisode],
) -> Result<EvaluationReport, EvaluationWriteError> {
    let mut trajectories = csv::Writer::from_writer(Vec::new());
    let mut rows = Ok(());
    let mut courses = Vec::new();
    for (name, episodes) in CoursesSection::names(&config.courses.evaluation)
        .iter()
        .zip(flown.chunks(config.evaluation.episodes as usize))
    {
        let scores: Vec<EpisodeScore> = episodes.iter().map(score).collect();
        courses.push(CourseEvaluation::of(name, &scores));
        for (number, episode) in episodes.iter().take(TRAJECTORIES).enumerate() {
            rows = rows.and_then(|()| write_trajectory(&mut trajectories, name, number, episode));
        }
    }
    let trajectories = rows.map_err(io::Error::from).and_then(|()| {
        trajectories
            .into_inner()
            .map_err(|error| io::Error::other(error.to_string()))
    });
    replace(&directory.evaluation_trajectories_csv(), trajectories)?;
    let report = EvaluationReport {
        policy_version,
        policy_sha256: policy_sha256.to_owned(),
        courses,
    };
    replace(
        &directory.evaluation_json(),
        serde_json::to_vec_pretty(&report),
    )?;
    Ok(report)
}

fn score(episode: &CommittedEpisode) -> EpisodeScore {
    EpisodeScore {
        walls_passed: episode.walls_passed.into(),
        walls: episode.course_walls.into(),
        episode_return: episode.total_reward().into(),
        outcome: episode.ending(),
        hit_wall: episode.hit_wall,
    }
}

fn write_trajectory(
    trajectories: &mut csv::Writer<Vec<u8>>,
    course: &str,
    number: usize,
    episode: &CommittedEpisode,
) -> Result<(), csv::Error> {
    for (step, observation) in episode.observations.iter().enumerate() {
        let [x_m, y_m, z_m] = observation.position_m;
        trajectories.serialize(TrajectoryPoint {
            course,
            episode: number,
            step,
            x_m,
            y_m,
            z_m,
            outcome: episode.ending(),
        })?;
    }
    Ok(())
}

/// Depth images and their reconstructions, `[n, 72, 128]` each.
pub(crate) struct Reconstructions {
    pub(crate) depth: Vec<u8>,
    pub(crate) reconstruction: Vec<u8>,
}

/// Writes some depth images beside their reconstructions, `reconstructions.safetensors`, and
/// returns them. Of an encoder from a file, `decoder` draws them; without one and without a VAE,
/// nothing is written.
///
/// # Errors
/// [`EvaluationWriteError`] names the file.
pub(crate) fn write_reconstructions(
    directory: &RunDirectory,
    trainer: &mut Trainer,
    decoder: Option<&Decoder>,
    episodes: &[CommittedEpisode],
) -> Result<Option<Reconstructions>, EvaluationWriteError> {
    let seen = episodes.iter().flat_map(|episode| {
        let depth = episode.depth.as_deref().unwrap_or_default();
        depth.chunks(IMAGE_PIXELS).zip(&episode.observations)
    });
    let seen: Vec<_> = seen.collect();
    let stride = (seen.len() / PICTURES).max(1);
    let shown = || seen.iter().step_by(stride).take(PICTURES);
    let chosen: Vec<u8> = shown().flat_map(|(depth, _)| *depth).copied().collect();
    let latent = trainer.latent();
    let decoded = |decoder: &Decoder| {
        let codes = shown().map(|(_, seen)| &seen.latent[..latent]);
        codes.flat_map(|code| decoder.decode(code)).collect()
    };
    let Some(reconstruction) = trainer
        .reconstruct(&chosen)
        .or_else(|| decoder.map(decoded))
    else {
        return Ok(None);
    };
    let shape = vec![chosen.len() / IMAGE_PIXELS, IMAGE_HEIGHT, IMAGE_WIDTH];
    let view = |bytes| TensorView::new(Dtype::U8, shape.clone(), bytes);
    let file = view(&chosen)
        .and_then(|depth| Ok([("depth", depth), ("reconstruction", view(&reconstruction)?)]))
        .and_then(|tensors| safetensors::serialize(tensors, None));
    replace(&directory.reconstructions(), file)?;
    Ok(Some(Reconstructions {
        depth: chosen,
        reconstruction,
    }))
}
