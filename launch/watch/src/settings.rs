//! Settings of runs: one line a key, so that two runs can be compared.

use std::collections::BTreeMap;

/// Returns the settings in `text`, a `config.toml`, by their whole key.
///
/// # Errors
/// Says where the text is no TOML.
pub(crate) fn flat(text: &str) -> anyhow::Result<BTreeMap<String, String>> {
    let table: toml::Table = text.parse()?;
    let mut settings = BTreeMap::new();
    add("", &toml::Value::Table(table), &mut settings);
    Ok(settings)
}

fn add(key: &str, value: &toml::Value, settings: &mut BTreeMap<String, String>) {
    match value {
        toml::Value::Table(table) => {
            for (name, value) in table {
                let whole = match key {
                    "" => name.clone(),
                    key => format!("{key}.{name}"),
                };
                add(&whole, value, settings);
            }
        }
        value => {
            settings.insert(key.to_owned(), value.to_string());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_setting_has_its_whole_key() {
        let settings = flat("[sac]\nwidth = 8\n[simulator.reward]\ntime = -0.5\n").unwrap();
        assert_eq!(settings["sac.width"], "8");
        assert_eq!(settings["simulator.reward.time"], "-0.5");
        assert!(flat("[sac").is_err());
    }
}
