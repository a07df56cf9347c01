//! Everything that can be checked before the first process of a run is started, and the run's
//! directory.
//!
//! A mistake in a configuration or a course file is found here, in the terminal of whoever made it,
//! and not in the log of the third actor.

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

/// A run that is ready to be started.
#[derive(Debug)]
pub struct Prepared {
    /// Its directory, with an absolute path.
    pub run: RunDirectory,
    /// Who it is.
    pub identity: RunIdentity,
    /// Its resolved configuration.
    pub config: Config,
    /// The directory that was made for it; `None` for a run that was there before.
    pub new: Option<NewDirectory>,
}

/// Checks the configuration in `config_file` with `overrides`, the courses it names, the number of
/// `actors` and the machine's room for them; then creates `run_directory` with copies of it all.
///
/// # Errors
/// [`PrepareError`] names file, key and remedy; nothing was created then.
pub fn prepare(
    config_file: &Path,
    overrides: &[String],
    run_directory: &Path,
    actors: usize,
) -> Result<Prepared, PrepareError> {
    let config = resolve(config_file, overrides, actors)?;
    room::check_shared_memory(&config, actors)?;
    room::check_folders()?;
    let new = NewDirectory::make(run_directory)?;
    match fill(&new, config) {
        Ok(prepared) => Ok(Prepared {
            new: Some(new),
            ..prepared
        }),
        Err(error) => {
            // What went wrong first is what there is to tell.
            let _ = new.take_back();
            Err(error)
        }
    }
}

/// The configuration in `config_file` with `overrides`, checked as that of a run with `actors`
/// actors is, with all that the simulator was not told written out.
///
/// # Errors
/// [`PrepareError`] names file, key and remedy, and the override that is to blame.
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

/// Puts everything into a new run's directory that its processes begin with.
fn fill(new: &NewDirectory, mut config: Config) -> Result<Prepared, PrepareError> {
    directory::copy_courses(new.root(), &mut config)?;
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

/// The `[simulator]` section with the defaults of all that was not set: what was flown stays known
/// when the defaults change.
fn written_out(settings: &SimulatorSettings) -> toml::Table {
    // By way of text: a number of single precision would drag the digits of its double along.
    let text = toml::to_string(settings).expect("every setting is representable in TOML");
    toml::from_str(&text).expect("what was written as TOML is TOML")
}
