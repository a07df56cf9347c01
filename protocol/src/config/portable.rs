//! The part of a configuration that does not depend on the location of the run's directory, for
//! comparing configurations.

use std::collections::BTreeMap;
use std::path::PathBuf;

use toml::{Table, Value};
use xxhash_rust::xxh3::xxh3_64;

use super::Config;

impl Config {
    /// Returns the whole configuration as TOML, with only the names of the files that it names, so
    /// that a run's directory can be moved.
    pub fn portable(&self) -> String {
        let mut portable = self.clone();
        for file in portable.files_mut() {
            *file = file.file_name().map(PathBuf::from).unwrap_or_default();
        }
        portable.to_toml()
    }

    /// Returns a fingerprint of the [portable](Config::portable) configuration. Processes of one
    /// run compare it.
    pub fn digest(&self) -> u64 {
        Self::digest_of(&self.portable())
    }

    /// Returns the digest of the configuration whose portable text is `portable`.
    pub fn digest_of(portable: &str) -> u64 {
        xxh3_64(portable.as_bytes())
    }

    /// Returns `run.episodes` of `other`, the portable text of another configuration, if that is
    /// smaller than this one's and nothing else differs.
    pub fn lengthened_from(&self, other: &str) -> Option<u64> {
        let table: toml::Table = toml::from_str(other).ok()?;
        let episodes = table.get("run")?.get("episodes")?.as_integer()?;
        let mut shorter = self.clone();
        shorter.run.episodes = episodes.try_into().ok()?;
        (shorter.run.episodes < self.run.episodes && shorter.portable() == other)
            .then_some(shorter.run.episodes)
    }

    /// Returns the settings that differ from the defaults, in TOML's notation by their full keys.
    pub fn changed_settings(&self) -> BTreeMap<String, String> {
        let values = |config: &Self| {
            flat(&toml::from_str(&config.portable()).expect("what was written as TOML is TOML"))
        };
        let defaults = values(&Self::default());
        let mut changed = values(self);
        changed.retain(|key, value| defaults.get(key) != Some(value));
        changed
    }

    /// Returns the keys in which `other`, the portable text of another configuration, differs from
    /// this one: for each key `section.key = value there, value here`.
    ///
    /// # Errors
    /// If `other` is not TOML.
    pub fn differences(&self, other: &str) -> Result<Vec<String>, toml::de::Error> {
        let there = flat(&toml::from_str(other)?);
        let here =
            flat(&toml::from_str(&self.portable()).expect("what was written as TOML is TOML"));
        let keys: std::collections::BTreeSet<&String> = there.keys().chain(here.keys()).collect();
        let value = |values: &BTreeMap<String, String>, key: &str| {
            values
                .get(key)
                .cloned()
                .unwrap_or_else(|| "nothing".to_owned())
        };
        Ok(keys
            .into_iter()
            .filter(|&key| there.get(key) != here.get(key))
            .map(|key| {
                format!(
                    "{key} = {} there, {} here",
                    value(&there, key),
                    value(&here, key)
                )
            })
            .collect())
    }
}

/// Returns the values in TOML's notation by their full keys.
fn flat(table: &Table) -> BTreeMap<String, String> {
    let mut values = BTreeMap::new();
    for (key, value) in table {
        match value {
            Value::Table(inner) => {
                values.extend(
                    flat(inner)
                        .into_iter()
                        .map(|(rest, value)| (format!("{key}.{rest}"), value)),
                );
            }
            value => {
                values.insert(key.clone(), value.to_string());
            }
        }
    }
    values
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_configurations_differ_in_the_keys_that_differ() {
        let here = Config::default();
        assert_eq!(
            here.differences(&here.portable()).unwrap(),
            Vec::<String>::new()
        );
        let mut there = here.clone();
        there.sac.discount = 0.5;
        there.simulator.insert(
            "vehicle".into(),
            Value::Table(Table::from_iter([(
                "preset".to_owned(),
                Value::from("point"),
            )])),
        );
        let differences = here.differences(&there.portable()).unwrap();
        assert_eq!(
            differences,
            [
                format!("sac.discount = 0.5 there, {} here", here.sac.discount),
                "simulator.vehicle.preset = \"point\" there, nothing here".to_owned()
            ]
        );
    }

    #[test]
    fn only_settings_that_differ_from_the_defaults_are_changed() {
        let mut config = Config::default();
        assert!(config.changed_settings().is_empty());
        config.sac.discount = 0.5;
        config.run.record_every = Some(7);
        let changed = config.changed_settings();
        let changed: Vec<_> = changed
            .iter()
            .map(|(key, value)| (key.as_str(), value.as_str()))
            .collect();
        assert_eq!(
            changed,
            [("run.record_every", "7"), ("sac.discount", "0.5")]
        );
    }

    #[test]
    fn the_digest_does_not_depend_on_the_courses_folder() {
        let here = Config::default();
        let mut moved = here.clone();
        moved.courses.training =
            PathBuf::from("/elsewhere").join(here.courses.training.file_name().unwrap());
        assert_eq!(moved.digest(), here.digest());
        assert!(here.differences(&moved.portable()).unwrap().is_empty());
    }
}
