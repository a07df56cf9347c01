//! Suite that the best snapshot of every run of an experiment flies after training.

use std::path::{Path, PathBuf};

use skein_protocol::files::{self, SETTINGS_BYTES};
use skein_run::failure::with_causes;
use skein_simulator::simulator::SimulatorSettings;
use skein_simulator::suite::Suite;
use toml::{Table, Value};

use super::Arm;

/// A suite, and the name of its results.
#[derive(Debug, Clone, PartialEq)]
pub struct FlownSuite {
    /// Path of its file.
    pub path: PathBuf,
    /// Entries of the suite.
    pub suite: Suite,
    /// Number of episodes per entry, if it differs from the suite's own.
    pub each: Option<u64>,
    /// Name of a run's result: the suite file's name, `each`, and a checksum of all that is flown.
    /// A changed suite therefore has a new name, and old results stay untouched.
    pub result_name: String,
}

impl FlownSuite {
    /// Reads the suite at `path`; `each` overrides the number of episodes per entry.
    ///
    /// # Errors
    /// Returns the reason why it cannot be flown or shown in a table.
    pub fn load(path: &Path, each: Option<u64>) -> Result<Self, String> {
        let mut suite = Suite::load(path).map_err(|error| with_causes(&error))?;
        for entry in &mut suite.entries {
            entry.episodes = each.unwrap_or(entry.episodes);
        }
        let stem = path.file_stem().unwrap_or_default().to_string_lossy();
        let each_in_name = each.map_or_else(String::new, |each| format!("-{each}"));
        Ok(Self {
            result_name: format!("{stem}{each_in_name}-{:08x}", checksum(path)?),
            path: path.to_owned(),
            suite,
            each,
        })
    }

    /// Returns the file's name, for readers.
    pub fn file_name(&self) -> String {
        self.path
            .file_name()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned()
    }

    /// Number of episodes of all entries.
    pub fn episodes(&self) -> u64 {
        self.suite.entries.iter().map(|entry| entry.episodes).sum()
    }

    /// Checks that policies trained by `arm` can fly the suite. Otherwise the problem would only
    /// show when the suite is flown, after all of the training.
    ///
    /// # Errors
    /// Names the entry and its problem with this arm.
    pub(super) fn check(&self, arm: &Arm) -> Result<(), String> {
        let settings: SimulatorSettings = Value::Table(arm.config.simulator.clone())
            .try_into()
            .map_err(|error: toml::de::Error| error.to_string())?;
        for entry in &self.suite.entries {
            let flown = entry
                .disturbances
                .validate(&settings.vehicle, settings.camera.range_m);
            flown.map_err(|fault| format!("entry \"{}\": {}", entry.name, with_causes(&fault)))?;
            let reached = entry.courses.check_reach(&entry.settings(&settings));
            reached.map_err(|fault| format!("entry \"{}\": {fault}", entry.name))?;
        }
        Ok(())
    }
}

/// Returns a checksum of the suite file and every course file that it names, comments excluded.
fn checksum(path: &Path) -> Result<u32, String> {
    let suite = content(path)?;
    let folder = path.parent().unwrap_or(Path::new(""));
    let entries = suite.get("entry").and_then(Value::as_array);
    let mut all = suite.to_string();
    for entry in entries.into_iter().flatten() {
        for key in ["course", "orders_of"] {
            if let Some(course) = entry.get(key).and_then(Value::as_str) {
                all.push_str(&content(&folder.join(course))?.to_string());
            }
        }
    }
    Ok(crc32c::crc32c(all.as_bytes()))
}

fn content(path: &Path) -> Result<Table, String> {
    let text = files::read_text(path, SETTINGS_BYTES)
        .map_err(|error| format!("{}: {error}", path.display()))?;
    text.parse()
        .map_err(|error| format!("{}: {error}", path.display()))
}
