//! Checks everything that can be checked before the first process of a run starts, and creates the
//! run's directory.
//!
//! A mistake in a configuration or a course file is therefore reported in the user's terminal, not
//! in an actor's log.

mod checks;
mod directory;
mod error;
pub mod room;
#[cfg(test)]
mod tests;

use std::path::Path;

use skein_protocol::config::Config;
use skein_run::{RunDirectory, RunIdentity};
use skein_simulator::simulator::SimulatorSettings;

pub use checks::check;
pub use directory::NewDirectory;
pub use error::PrepareError;

/// A run that is ready to start.
#[derive(Debug)]
pub struct Prepared {
    /// Its directory, with an absolute path.
    pub run: RunDirectory,
    /// Its identity.
    pub identity: RunIdentity,
    /// Its resolved configuration.
    pub config: Config,
    /// Its directory if it was just created; `None` for a resumed run.
    pub new: Option<NewDirectory>,
}

/// Checks the configuration in `config_file` with `overrides`, its courses, the number of `actors`
/// and the machine's room for them. Then creates `run_directory` with copies of all inputs.
///
/// # Errors
/// [`PrepareError`] names file, key and remedy; in this case nothing was created.
pub fn prepare(
    config_file: &Path,
    overrides: &[String],
    run_directory: &Path,
    actors: usize,
) -> Result<Prepared, PrepareError> {
    let config = resolve(config_file, overrides, actors)?;
    room::check_shared_memory(&config, actors)?;
    room::check_folders()?;
    room::check_file_size(&config, actors)?;
    room::check_address_space(&config, actors)?;
    let new = NewDirectory::make(run_directory)?;
    match fill(&new, config) {
        Ok(prepared) => Ok(Prepared {
            new: Some(new),
            ..prepared
        }),
        Err(error) => {
            // The first error matters more than a failed removal.
            let _ = new.take_back();
            Err(error)
        }
    }
}

/// Returns the configuration in `config_file` with `overrides`, checked for a run with `actors`
/// actors, with the simulator's defaults written out.
///
/// # Errors
/// [`PrepareError`] names file, key and remedy, and the override at fault.
pub fn resolve(
    config_file: &Path,
    overrides: &[String],
    actors: usize,
) -> Result<Config, PrepareError> {
    let mut config = Config::load(config_file, overrides)?;
    let settings = check(config_file, &config, actors)
        .map_err(|error| checks::blame(error, config_file, overrides, actors))?;
    config.simulator = written_out(&settings);
    Ok(config)
}

/// Fills a new run's directory with the files that its processes need.
fn fill(new: &NewDirectory, mut config: Config) -> Result<Prepared, PrepareError> {
    directory::copy_inputs(new.root(), &mut config)?;
    let run = RunDirectory::new(new.root());
    let identity = run.create(&config)?;
    let (_, config) = run.open()?;
    Ok(Prepared {
        run,
        identity,
        config,
        new: None,
    })
}

/// Returns the `[simulator]` section with all defaults written out, so that the run stays
/// reproducible when the defaults change.
fn written_out(settings: &SimulatorSettings) -> toml::Table {
    // By way of text: a single-precision number would otherwise show the digits of its double.
    let text = toml::to_string(settings).expect("every setting is representable in TOML");
    toml::from_str(&text).expect("what was written as TOML is TOML")
}
