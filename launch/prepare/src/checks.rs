//! Checks that a configuration can be flown: its simulator settings, its courses, its encoder, and
//! their combination.

use std::path::Path;
use std::sync::Arc;

use skein_protocol::config::{Config, ConfirmOn, failing_override};
use skein_protocol::encoder_file::TrainedEncoder;
use skein_protocol::policy_file::{start_policy, teacher_policy};
use skein_simulator::course::Course;
use skein_simulator::simulator::{Simulator, SimulatorSettings};
use skein_simulator::text::first_repeated;

use super::PrepareError;

/// Checks that `actors` actors can fly with `config`, which was read from `config_file`, and
/// returns the simulator's settings.
///
/// # Errors
/// [`PrepareError`] names file, key and remedy.
pub fn check(
    config_file: &Path,
    config: &Config,
    actors: usize,
) -> Result<SimulatorSettings, PrepareError> {
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
    for path in config
        .courses
        .evaluation
        .iter()
        .chain([&config.courses.training])
    {
        let course = Arc::new(Course::load(path)?);
        let (corridor, start) = (course.corridor(), course.start());
        Simulator::new(course, &settings).map_err(|source| PrepareError::Settings {
            config: in_file(),
            source,
        })?;
        settings
            .check_reach(corridor, start)
            .map_err(|source| PrepareError::OutOfReach {
                config: in_file(),
                course: path.display().to_string(),
                source,
            })?;
    }
    let encoder = TrainedEncoder::of(config).map_err(|source| PrepareError::Encoder {
        config: in_file(),
        source,
    })?;
    start_policy(config, encoder.as_ref())
        .and_then(|_| teacher_policy(config))
        .map_err(|source| PrepareError::Policy {
            config: in_file(),
            source,
        })?;
    check_level_count(
        config_file,
        config,
        Course::load(&config.courses.training)?.levels().into(),
        &config.courses.training.display(),
    )?;
    let trains_on_generated = config.courses.generated_share > 0.0;
    if trains_on_generated || config.evaluation.confirm_on == ConfirmOn::Generated {
        if let Some(shape) = first_repeated(&settings.generator.shapes) {
            return Err(PrepareError::RepeatedShape {
                config: in_file(),
                shape: shape.name(),
            });
        }
        let ranges = &settings.generator;
        ranges.check().map_err(|source| PrepareError::Ranges {
            config: in_file(),
            source,
        })?;
        let (corridor, start) = ranges.longest();
        settings
            .check_reach(corridor, start)
            .map_err(|source| PrepareError::OutOfReach {
                config: in_file(),
                course: match ranges.layout {
                    Some(_) => "[simulator.generator.layout], the longest course".to_owned(),
                    None => "[simulator.generator]".to_owned(),
                },
                source,
            })?;
        if trains_on_generated {
            check_level_count(
                config_file,
                config,
                ranges.most_walls(),
                &match ranges.layout {
                    Some(_) => "[simulator.generator] layout.walls",
                    None => "[simulator.generator] wall_x_m",
                },
            )?;
        }
    }
    check_warmup(config_file, config, settings.max_steps)?;
    let records = config.transport.max_records_per_episode;
    if settings.max_steps as usize + 1 > records {
        return Err(PrepareError::EpisodeTooLong {
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

/// Checks that the longest episodes that `max_steps` allows outlast the warm-up, so that something
/// is learned.
fn check_warmup(config_file: &Path, config: &Config, max_steps: u32) -> Result<(), PrepareError> {
    let (episodes, warmup_steps) = (config.run.episodes, config.learning.warmup_steps);
    let most_steps = episodes.saturating_mul(max_steps.into());
    if most_steps > warmup_steps as u64 || config.learning.updates_per_step == 0.0 {
        return Ok(());
    }
    Err(PrepareError::OnlyWarmup {
        config: config_file.to_owned(),
        episodes,
        max_steps,
        most_steps,
        warmup_steps,
    })
}

/// Checks that a course with `walls` walls, called `name` in messages, has all start levels of the
/// training.
fn check_level_count(
    config_file: &Path,
    config: &Config,
    walls: usize,
    name: &dyn std::fmt::Display,
) -> Result<(), PrepareError> {
    let levels = config.learning.levels;
    if usize::from(levels) <= walls {
        return Ok(());
    }
    Err(PrepareError::TooManyLevels {
        config: config_file.to_owned(),
        levels,
        course: name.to_string(),
        walls,
    })
}

/// Adds the override that caused `error`, if one did.
pub(super) fn blame(
    error: PrepareError,
    config_file: &Path,
    overrides: &[String],
    actors: usize,
) -> PrepareError {
    let message_for = |overrides: &[String]| {
        let checked = Config::load(config_file, overrides)
            .map_err(PrepareError::from)
            .and_then(|config| check(config_file, &config, actors));
        checked.err().map(|error| error.to_string())
    };
    match failing_override(overrides, message_for) {
        Some(text) => PrepareError::Overridden {
            text: text.clone(),
            source: Box::new(error),
        },
        None => error,
    }
}
