//! The file of an experiment, as written.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use serde::Deserialize;
use skein_protocol::config::{FILE_KEYS, integer_too_large};
use skein_protocol::files::{self, SETTINGS_BYTES};
use toml::{Table, Value};

use super::{CurveSpec, DefinitionError, FactorPoint, TableKind};

/// Contents of an experiment's file.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ExperimentFile {
    pub(super) question: String,
    /// Path relative to the file.
    pub(super) base: PathBuf,
    #[serde(default = "three")]
    pub(super) seeds: u64,
    /// Path relative to the file.
    pub(super) suite: Option<PathBuf>,
    /// Number of episodes per suite entry, if it differs from the suite's own.
    pub(super) suite_episodes: Option<u64>,
    /// Number of training episodes of the paper's own runs, for experiments that reproduce these.
    pub(super) paper_episodes: Option<u64>,
    /// Settings in which all arms differ from the base.
    #[serde(default)]
    pub(super) settings: Table,
    pub(super) tables: Vec<TableKind>,
    pub(super) curves: Vec<CurveSpec>,
    /// Name and unit of the number of which each arm states its own.
    pub(super) factor: Option<String>,
    #[serde(rename = "arm")]
    pub(super) arms: Vec<ArmFile>,
}

/// An `[[arm]]` of the file.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ArmFile {
    pub(super) name: String,
    pub(super) label: String,
    pub(super) at: Option<FactorPoint>,
    #[serde(default)]
    pub(super) settings: Table,
}

/// Smallest number of seeds that supports any conclusion.
const fn three() -> u64 {
    3
}

/// Returns the names of the experiments in `folder`, in alphabetical order.
///
/// # Errors
/// [`DefinitionError::Read`] names the folder.
pub fn names(folder: &Path) -> Result<Vec<String>, DefinitionError> {
    let fail = |source| DefinitionError::Read {
        path: folder.to_owned(),
        source,
    };
    let mut names = Vec::new();
    for entry in fs::read_dir(folder).map_err(fail)? {
        let path = entry.map_err(fail)?.path();
        if path
            .extension()
            .is_some_and(|extension| extension == "toml")
            && let Some(name) = path.file_stem().and_then(|stem| stem.to_str())
        {
            names.push(name.to_owned());
        }
    }
    names.sort();
    Ok(names)
}

/// Returns `true` if `named` is the path of an experiment's file and not the name of an experiment:
/// it holds a slash or ends in `.toml`.
pub fn is_path(named: &str) -> bool {
    named.contains('/') || named.ends_with(".toml")
}

/// Returns the path and the name of the experiment `named`: the path of its file, or its name in
/// `folder`.
pub(super) fn find(folder: &Path, named: &str) -> Result<(PathBuf, String), DefinitionError> {
    let path = match is_path(named) {
        true => PathBuf::from(named),
        false => known(folder, named)?,
    };
    // Its runs get a folder of this name.
    let name = path.file_stem().unwrap_or_default().to_string_lossy();
    match names_folder(&name) {
        true => Ok((path.clone(), name.into_owned())),
        false => Err(DefinitionError::FileName { path }),
    }
}

/// Returns `true` if a folder of runs can be called `name` on every system and in every command.
pub(super) fn names_folder(name: &str) -> bool {
    let is_plain = |character: char| character.is_ascii_alphanumeric() || "-_.".contains(character);
    name.starts_with(|first: char| first.is_ascii_alphanumeric()) && name.chars().all(is_plain)
}

/// Returns the path of the experiment called `name` in `folder`.
fn known(folder: &Path, name: &str) -> Result<PathBuf, DefinitionError> {
    let names = names(folder)?;
    if names.iter().any(|known| known == name) {
        return Ok(folder.join(format!("{name}.toml")));
    }
    Err(DefinitionError::Unknown {
        name: name.to_owned(),
        folder: folder.to_owned(),
        known: match names.as_slice() {
            [] => "none".to_owned(),
            names => names.join(", "),
        },
    })
}

pub(super) fn read(path: &Path) -> Result<ExperimentFile, DefinitionError> {
    let text = files::read_text(path, SETTINGS_BYTES).map_err(|source| {
        let path = path.to_owned();
        match source.kind() {
            io::ErrorKind::NotFound => DefinitionError::Missing { path, source },
            _ => DefinitionError::Read { path, source },
        }
    })?;
    parse_whole(&text).map_err(|source| match integer_too_large(&text, &source) {
        Some(problem) => DefinitionError::Integer {
            path: path.to_owned(),
            problem,
        },
        None => DefinitionError::Syntax {
            path: path.to_owned(),
            source: Box::new(source),
        },
    })
}

/// Parses TOML of which every part is used: the parser alone ignores the end of a list that is too
/// long for the table it stands for.
fn parse_whole(text: &str) -> Result<ExperimentFile, toml::de::Error> {
    let parsed = toml::from_str(text)?;
    let table: Table = toml::from_str(text)?;
    table.try_into::<ExperimentFile>()?;
    Ok(parsed)
}

/// Returns `settings` as overrides, `section.key=value`. Paths of course files are relative to
/// `folder`.
///
/// # Errors
/// Returns the problem as text.
pub(super) fn as_overrides(settings: &Table, folder: &Path) -> Result<Vec<String>, String> {
    let mut overrides = Vec::new();
    flatten("", settings, folder, &mut overrides)?;
    Ok(overrides)
}

/// Deepest nesting of tables: more than any setting needs, and small enough for recursion.
const DEEPEST: usize = 16;

fn flatten(
    section: &str,
    table: &Table,
    folder: &Path,
    into: &mut Vec<String>,
) -> Result<(), String> {
    if section.split('.').count() > DEEPEST {
        return Err(format!(
            "{section} is nested deeper than any setting: write section.key = value"
        ));
    }
    for (name, value) in table {
        let is_plain = |sign: char| sign.is_ascii_alphanumeric() || "_-.".contains(sign);
        if name.is_empty() || !name.chars().all(is_plain) {
            return Err(format!(
                "{name:?} is no key of a setting: write section.key = value, without quotes"
            ));
        }
        let key = match section {
            "" => name.clone(),
            section => format!("{section}.{name}"),
        };
        match value {
            Value::Table(inner) if inner.is_empty() => {
                return Err(format!("{key} holds no setting: remove it"));
            }
            Value::Table(inner) => flatten(&key, inner, folder, into)?,
            value if FILE_KEYS.contains(&key.as_str()) => {
                into.push(format!("{key}={}", within(value, folder)));
            }
            value => into.push(format!("{key}={value}")),
        }
    }
    Ok(())
}

/// Returns `value` with every path in it relative to `folder`.
fn within(value: &Value, folder: &Path) -> Value {
    match value {
        Value::String(path) => Value::String(folder.join(path).to_string_lossy().into_owned()),
        Value::Array(values) => {
            Value::Array(values.iter().map(|value| within(value, folder)).collect())
        }
        value => value.clone(),
    }
}
