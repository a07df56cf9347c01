//! Reads a configuration file with overrides, and writes it back.

use std::io;
use std::path::{Path, PathBuf};

use toml::{Table, Value};

use super::{Config, InvalidValue, MAX_NESTING};
use crate::files::{SETTINGS_BYTES, read_text};

/// Reason why a configuration cannot be used. Every variant names the file or the override.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read the configuration {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Cause.
        #[source]
        source: io::Error,
    },
    /// The file is not TOML.
    #[error("{} is not valid TOML: {source}", path.display())]
    Syntax {
        /// The file.
        path: PathBuf,
        /// Position and cause.
        #[source]
        source: Box<toml::de::Error>,
    },
    /// A key is unknown or has a value of the wrong kind.
    #[error("{}: {message}", path.display())]
    Key {
        /// The file.
        path: PathBuf,
        /// The key, and what was expected.
        message: String,
    },
    /// A value is out of bounds, or contradicts another key.
    #[error("{}: {source}", path.display())]
    Invalid {
        /// The file.
        path: PathBuf,
        /// The key, the value and the bound.
        #[source]
        source: InvalidValue,
    },
    /// The variable that names the folder of the default courses is wrong.
    #[error(
        "{SHIPPED_CONFIGS}={} names no folder with courses/, where the courses lie that {} does \
         not name: correct or unset the variable",
        folder.display(),
        path.display()
    )]
    Shipped {
        /// The configuration file.
        path: PathBuf,
        /// Value of the variable.
        folder: PathBuf,
    },
    /// An override cannot be parsed.
    #[error("--set {text}: {problem}; write it as section.key=value")]
    Override {
        /// The override as given.
        text: String,
        /// The problem.
        problem: String,
    },
    /// The file is valid without an override.
    #[error("with --set {text}, {source}")]
    Overridden {
        /// The override as given.
        text: String,
        /// The error with the override.
        #[source]
        source: Box<ConfigError>,
    },
}

/// Returns the override that causes the failure of `attempt` with all of `overrides`: the first
/// that makes the attempt fail with this message, whatever numbers it names. Returns `None` when
/// the file alone fails with exactly this message.
///
/// `attempt` receives the first overrides, from none to all; it returns the error message, or
/// `None` when it succeeds.
pub fn failing_override(
    overrides: &[String],
    attempt: impl Fn(&[String]) -> Option<String>,
) -> Option<&String> {
    let messages: Vec<_> = (0..=overrides.len())
        .map(|count| attempt(&overrides[..count]))
        .collect();
    // A later override may change the numbers of a failure that it does not cause.
    let unnumbered = |message: &Option<String>| {
        let message = message.as_ref()?;
        Some(message.replace(|character: char| character.is_ascii_digit(), ""))
    };
    let unnumbered: Vec<_> = messages.iter().map(unnumbered).collect();
    [unnumbered, messages].iter().find_map(|messages| {
        let (failure, before) = messages.split_last()?;
        let cause = before.iter().rposition(|message| message != failure)?;
        overrides.get(cause)
    })
}

/// Environment variable that names the folder of the shipped configurations, whose `courses/` holds
/// the default courses. The scripts in `launch/` set it. Without it, the folder of the
/// configuration file is used.
const SHIPPED_CONFIGS: &str = "SKEIN_CONFIGS";

impl Config {
    /// Reads `path`, applies `overrides` (`section.key=value`, the value in TOML's notation or a
    /// bare word) and validates the result. Paths in the file are relative to the file, those in an
    /// override to the working directory.
    ///
    /// # Errors
    /// [`ConfigError`] names file, key, value and remedy, and the override that caused it.
    pub fn load(path: &Path, overrides: &[String]) -> Result<Self, ConfigError> {
        let error = match Self::resolve(path, overrides) {
            Err(error) if !matches!(error, ConfigError::Override { .. }) => error,
            other => return other,
        };
        let message = |overrides: &[String]| {
            Self::resolve(path, overrides)
                .err()
                .map(|error| error.to_string())
        };
        Err(match failing_override(overrides, message) {
            Some(text) => ConfigError::Overridden {
                text: text.clone(),
                source: Box::new(error),
            },
            None => error,
        })
    }

    fn resolve(path: &Path, overrides: &[String]) -> Result<Self, ConfigError> {
        let text = read_text(path, SETTINGS_BYTES).map_err(|source| ConfigError::Read {
            path: path.to_owned(),
            source,
        })?;
        Self::parse(&text, path, overrides)
    }

    /// Reads a configuration from the `text` of a configuration file at `path`. Unlike
    /// [`Config::load`], an error does not name the override that caused it.
    ///
    /// # Errors
    /// [`ConfigError`] names file, key, value and remedy.
    pub fn parse(text: &str, path: &Path, overrides: &[String]) -> Result<Self, ConfigError> {
        let shipped = std::env::var_os(SHIPPED_CONFIGS).map(PathBuf::from);
        Self::parse_with(text, path, overrides, shipped.as_deref())
    }

    /// Reads as [`Config::parse`] does. Courses that the file does not name lie in `shipped`, or
    /// beside the file.
    fn parse_with(
        text: &str,
        path: &Path,
        overrides: &[String],
        shipped: Option<&Path>,
    ) -> Result<Self, ConfigError> {
        let mut table: Table =
            toml::from_str(text).map_err(|error| syntax_error(path, text, error))?;
        for text in overrides {
            apply_override(&mut table, text)?;
        }
        let named = |key: &str| {
            table
                .get("courses")
                .is_some_and(|courses| courses.get(key).is_some())
        };
        let named = [named("training"), named("evaluation")];
        let mut config = from_table(table).map_err(|message| ConfigError::Key {
            path: path.to_owned(),
            message,
        })?;
        config.validate().map_err(|source| ConfigError::Invalid {
            path: path.to_owned(),
            source,
        })?;
        if let Some(folder) = shipped
            && named.contains(&false)
            && !folder.join("courses").is_dir()
        {
            return Err(ConfigError::Shipped {
                path: path.to_owned(),
                folder: folder.to_owned(),
            });
        }
        let directory = path.parent().unwrap_or(Path::new(""));
        let shipped = shipped.unwrap_or(directory);
        let [training, evaluation] = named.map(|named| if named { directory } else { shipped });
        config.courses.training = training.join(&config.courses.training);
        for course in &mut config.courses.evaluation {
            *course = evaluation.join(&*course);
        }
        for (_, path) in config.parameter_files_mut() {
            *path = directory.join(&*path);
        }
        for file in config.files() {
            if file.to_str().is_none() {
                let message = format!(
                    "{} is not UTF-8 and cannot be stored in the files of a run; rename the folder",
                    file.display()
                );
                return Err(ConfigError::Key {
                    path: path.to_owned(),
                    message,
                });
            }
        }
        Ok(config)
    }

    /// Returns this configuration, read from `path`, with `overrides` as in [`Config::load`].
    /// Paths stay as they are.
    ///
    /// # Errors
    /// [`ConfigError`] names file, key, value and remedy.
    pub fn overridden(&self, path: &Path, overrides: &[String]) -> Result<Self, ConfigError> {
        let mut changed = Self::parse_with(&self.to_toml(), path, overrides, None)?;
        changed.courses.clone_from(&self.courses);
        changed.vae.start_from.clone_from(&self.vae.start_from);
        changed.teacher.snapshot.clone_from(&self.teacher.snapshot);
        let start_from = &mut changed.learning.start_from;
        start_from.clone_from(&self.learning.start_from);
        Ok(changed)
    }

    /// Returns the whole configuration as TOML, defaults included.
    pub fn to_toml(&self) -> String {
        toml::to_string_pretty(self)
            .expect("every field of the configuration is representable in TOML")
    }
}

fn syntax_error(path: &Path, text: &str, error: toml::de::Error) -> ConfigError {
    let path = path.to_owned();
    match integer_too_large(text, &error) {
        Some(message) => ConfigError::Key { path, message },
        None => ConfigError::Syntax {
            path,
            source: Box::new(error),
        },
    }
}

/// Returns line, key, value and remedy if `error`, the parser's on `text`, is an integer that TOML
/// does not hold: the parser knows only the type.
pub fn integer_too_large(text: &str, error: &toml::de::Error) -> Option<String> {
    let place = error.span()?;
    let value = text.get(place.clone()).filter(|value| is_integer(value))?;
    // One that TOML holds was refused for another reason.
    if toml::from_str::<Table>(&format!("value = {value}")).is_ok() {
        return None;
    }
    Some(format!(
        "line {}: {} = {value} {INTEGER_TOO_LARGE}",
        1 + text[..place.start].matches('\n').count(),
        key_before(text, place.start)
    ))
}

/// Deserializes section by section, so that an error names its section: the parser itself knows
/// only the key.
fn from_table(mut table: Table) -> Result<Config, String> {
    let mut config = Config::default();
    fn section<T: serde::de::DeserializeOwned>(
        table: &mut Table,
        name: &str,
        into: &mut T,
    ) -> Result<(), String> {
        if let Some(value) = table.remove(name) {
            *into = value.try_into().map_err(|error: toml::de::Error| {
                format!(
                    "[{name}] {}",
                    error.to_string().trim_end().replace('\n', " ")
                )
            })?;
        }
        Ok(())
    }
    section(&mut table, "run", &mut config.run)?;
    section(&mut table, "courses", &mut config.courses)?;
    section(&mut table, "learning", &mut config.learning)?;
    section(&mut table, "sac", &mut config.sac)?;
    section(&mut table, "td3", &mut config.td3)?;
    section(&mut table, "distill", &mut config.distill)?;
    section(&mut table, "teacher", &mut config.teacher)?;
    section(&mut table, "vae", &mut config.vae)?;
    section(&mut table, "encoder", &mut config.encoder)?;
    section(&mut table, "replay", &mut config.replay)?;
    section(&mut table, "evaluation", &mut config.evaluation)?;
    section(&mut table, "checkpoints", &mut config.checkpoints)?;
    section(&mut table, "transport", &mut config.transport)?;
    section(&mut table, "simulator", &mut config.simulator)?;
    match table.keys().next() {
        None => Ok(config),
        Some(unknown) => Err(format!(
            "unknown section [{unknown}]; known are run, courses, learning, sac, td3, \
            distill, teacher, vae, encoder, replay, evaluation, checkpoints, transport, simulator"
        )),
    }
}

fn apply_override(table: &mut Table, text: &str) -> Result<(), ConfigError> {
    let fail = |problem: &str| ConfigError::Override {
        text: text.to_owned(),
        problem: problem.to_owned(),
    };
    let (path, value) = text.split_once('=').ok_or_else(|| fail("has no `=`"))?;
    let (sections, key) = path
        .trim()
        .rsplit_once('.')
        .ok_or_else(|| fail("names no section"))?;
    if sections.split('.').count() > MAX_NESTING {
        return Err(fail("nests sections deeper than any section lies"));
    }
    let mut target = table;
    for section in sections.split('.') {
        target = target
            .entry(section)
            .or_insert_with(|| Value::Table(Table::new()))
            .as_table_mut()
            .ok_or_else(|| fail("names a value where a section is expected"))?;
    }
    let mut value = parse_value(value.trim()).map_err(fail)?;
    if FILE_KEYS.contains(&path.trim()) {
        make_absolute(&mut value)
            .map_err(|error| fail(&format!("is not a usable path ({error})")))?;
    }
    target.insert(key.to_owned(), value);
    Ok(())
}

/// Keys that name files.
pub const FILE_KEYS: [&str; 5] = [
    "courses.training",
    "courses.evaluation",
    "vae.start_from",
    "teacher.snapshot",
    "learning.start_from",
];

/// Makes paths absolute: paths on the command line are relative to the working directory, not to
/// the configuration file. Other values are left for validation to refuse.
fn make_absolute(value: &mut Value) -> io::Result<()> {
    match value {
        Value::String(path) => {
            *path = std::path::absolute(&*path)?.to_string_lossy().into_owned();
            Ok(())
        }
        Value::Array(values) => values.iter_mut().try_for_each(make_absolute),
        _ => Ok(()),
    }
}

/// Parses a value in TOML's notation, or else takes the text itself: `--set run.device=cpu` needs
/// no quotes.
///
/// # Errors
/// The problem, if a part of the text would be ignored or the number does not fit.
fn parse_value(text: &str) -> Result<Value, &'static str> {
    let Ok(mut table) = toml::from_str::<Table>(&format!("value = {text}")) else {
        return if text.contains(['\n', '\r']) {
            Err("holds a line break: give each setting a --set with one value")
        } else if is_integer(text) {
            Err(INTEGER_TOO_LARGE)
        } else {
            Ok(Value::String(text.to_owned()))
        };
    };
    // A further key on the next line and a comment are TOML, but no part of the value. In brackets,
    // neither is possible.
    let bracketed = toml::from_str::<Table>(&format!("value = [{text}]"));
    let is_one_value = bracketed.is_ok_and(
        |table| matches!(table.get("value"), Some(Value::Array(values)) if values.len() == 1),
    );
    match table.remove("value") {
        Some(value) if is_one_value && table.is_empty() => Ok(value),
        _ => Err(
            "holds more than one value, and the rest would be ignored: give each setting a \
            --set with one value",
        ),
    }
}

/// Problem of an integer that TOML does not hold.
const INTEGER_TOO_LARGE: &str = "is an integer outside -9223372036854775808 to \
    9223372036854775807 (64 bits with a sign), which TOML does not hold: choose one within";

/// `true` for an integer in TOML's notation, of any size.
fn is_integer(text: &str) -> bool {
    let unsigned = text.strip_prefix(['+', '-']).unwrap_or(text);
    let (digits, radix) = match unsigned.get(..2) {
        Some("0x") => (&unsigned[2..], 16),
        Some("0o") => (&unsigned[2..], 8),
        Some("0b") => (&unsigned[2..], 2),
        _ => (unsigned, 10),
    };
    digits.starts_with(|first: char| first.is_digit(radix))
        && digits
            .chars()
            .all(|digit| digit.is_digit(radix) || digit == '_')
}

/// Returns the key whose value begins at byte `start` of the TOML `text`.
fn key_before(text: &str, start: usize) -> &str {
    let before = text.get(..start).unwrap_or_default();
    let key = before
        .rsplit_once('=')
        .map_or("", |(key, _)| key.trim_end());
    let ends = |sign: char| sign.is_whitespace() || ",{".contains(sign);
    key.rsplit(ends).next().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::config::{Device, Engine, TargetEntropy};

    fn load(text: &str, overrides: &[&str]) -> Result<Config, String> {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("test.toml");
        fs::write(&path, text).unwrap();
        let overrides: Vec<_> = overrides.iter().map(ToString::to_string).collect();
        Config::load(&path, &overrides).map_err(|error| error.to_string())
    }

    #[test]
    fn an_empty_file_is_the_defaults_and_they_are_valid() {
        let mut config = load("", &[]).unwrap();
        config.courses = Config::default().courses;
        assert_eq!(config, Config::default());
    }

    #[test]
    fn a_written_configuration_reads_back_the_same() {
        let mut config = Config::default();
        config.sac.target_entropy = TargetEntropy::Nats(-1.5);
        config.run.device = Device::Cuda(3);
        let read: Config = toml::from_str(&config.to_toml()).unwrap();
        assert_eq!(read, config);
        assert_eq!(read.digest(), config.digest());
    }

    #[test]
    fn each_device_has_a_default_engine_that_a_key_overrides() {
        let engine = |overrides: &[&str]| load("", overrides).unwrap().run.engine();
        assert_eq!(engine(&[]), Engine::Native);
        assert_eq!(engine(&["run.device=cuda:1"]), Engine::Libtorch);
        assert_eq!(engine(&["run.engine=libtorch"]), Engine::Libtorch);
    }

    #[test]
    fn only_parts_without_native_kernels_are_computed_by_libtorch() {
        let engines = |overrides: &[&str]| {
            let config = load("", overrides).unwrap();
            (config.policy_engine(), config.vae.engine(&config.run))
        };
        let (native, libtorch) = (Engine::Native, Engine::Libtorch);
        assert_eq!(engines(&[]), (native, native));
        assert_eq!(engines(&["vae.decoder=u-net"]), (native, libtorch));
        assert_eq!(engines(&["learning.algorithm=td3"]), (libtorch, native));
        for algorithm in ["sac", "td3"] {
            let algorithm = format!("learning.algorithm={algorithm}");
            assert_eq!(
                engines(&["learning.encoder=end-to-end", &algorithm]).0,
                libtorch
            );
            assert_eq!(engines(&["run.engine=libtorch", &algorithm]).0, libtorch);
        }
    }

    #[test]
    fn paths_are_relative_to_the_file() {
        let text = "[courses]\ntraining = \"a/b.toml\"\n\
            [vae]\ntrain_steps = 0\nstart_from = \"c.safetensors\"";
        let config = load(text, &[]).unwrap();
        let folder = config.courses.training.ancestors().nth(2).unwrap();
        assert!(folder.is_absolute() && config.courses.training.ends_with("a/b.toml"));
        assert_eq!(config.vae.start_from, Some(folder.join("c.safetensors")));
    }

    #[test]
    fn courses_that_are_not_named_are_the_shipped_ones() {
        let shipped = tempfile::tempdir().unwrap();
        let folder = shipped.path().join("courses");
        let parse = |text| {
            let path = Path::new("/mine/own.toml");
            Config::parse_with(text, path, &[], Some(shipped.path()))
        };
        let error = parse("").unwrap_err().to_string();
        let blamed = format!("SKEIN_CONFIGS={} names no folder", shipped.path().display());
        assert!(
            error.contains(&blamed) && error.contains("own.toml"),
            "{error}"
        );
        assert!(parse("courses = { training = \"a\", evaluation = [\"b\"] }").is_ok());
        fs::create_dir(&folder).unwrap();
        let parse = |text| parse(text).unwrap();
        let courses = parse("").courses;
        assert!(courses.paths().all(|course| course.starts_with(&folder)));
        let courses = parse("[courses]\ntraining = \"a.toml\"").courses;
        assert_eq!(courses.training, Path::new("/mine/a.toml"));
        assert_eq!(courses.evaluation[0], folder.join("training.toml"));
        let courses = parse("[courses]\nevaluation = [\"b.toml\"]").courses;
        assert_eq!(courses.evaluation, [Path::new("/mine/b.toml")]);
        assert_eq!(courses.training, folder.join("training.toml"));
    }

    #[test]
    fn paths_in_overrides_are_relative_to_the_working_directory() {
        let here = std::env::current_dir().unwrap();
        let config = load(
            "",
            &[
                "courses.training=a/b.toml",
                "courses.evaluation=[\"c.toml\", \"/d.toml\"]",
                "vae.start_from=e.safetensors",
                "vae.train_steps=0",
            ],
        )
        .unwrap();
        assert_eq!(config.vae.start_from, Some(here.join("e.safetensors")));
        assert_eq!(config.courses.training, here.join("a/b.toml"));
        assert_eq!(
            config.courses.evaluation,
            [here.join("c.toml"), "/d.toml".into()]
        );
        let error = load("", &["courses.training="]).unwrap_err();
        assert!(error.contains("--set courses.training="), "{error}");
    }

    #[test]
    fn a_folder_name_that_is_not_utf8_is_refused() {
        use std::os::unix::ffi::OsStrExt;
        let path = Path::new(std::ffi::OsStr::from_bytes(b"/runs/\xff/config.toml"));
        let error = Config::parse_with("", path, &[], None)
            .unwrap_err()
            .to_string();
        assert!(
            error.contains("is not UTF-8") && error.contains("rename"),
            "{error}"
        );
    }

    #[test]
    fn the_override_that_causes_an_error_is_named_and_no_other() {
        for (text, overrides, blamed) in [
            (
                "",
                vec!["run.seed=2", "run.sed=3", "sac.discount=0.9"],
                Some("run.sed=3"),
            ),
            ("[rum]", vec!["run.sed=3"], Some("run.sed=3")),
            ("[run]\nsed = 1", vec!["run.seed=2"], None),
            ("[run]\nseed = -1", vec!["run.seed=-2"], Some("run.seed=-2")),
            (
                "",
                vec!["run.seed=-2", "run.seed=-1", "run.seed=1", "run.seed=-2"],
                Some("run.seed=-2"),
            ),
            (
                "[learning]\nwarmup_steps = 200",
                vec!["run.seed=2", "replay.capacity=100"],
                Some("replay.capacity=100"),
            ),
            ("", vec!["run.device=gpu"], Some("run.device=gpu")),
        ] {
            let error = load(text, &overrides).unwrap_err();
            match blamed {
                Some(blamed) => assert!(
                    error.starts_with(&format!("with --set {blamed}, ")),
                    "{error}"
                ),
                None => assert!(!error.contains("--set"), "{error}"),
            }
            assert!(error.contains("test.toml"), "{error}");
        }
    }

    #[test]
    fn overrides_take_toml_and_bare_words() {
        let config = load(
            "",
            &[
                "run.seed=7",
                "run.device=cuda:1",
                "simulator.vehicle.preset=point",
            ],
        )
        .unwrap();
        assert_eq!(config.run.seed, 7);
        assert_eq!(config.run.device, Device::Cuda(1));
        assert_eq!(
            config.simulator["vehicle"]["preset"].as_str(),
            Some("point")
        );
    }

    #[test]
    fn an_override_is_used_whole_or_refused() {
        let refused = |text: &str, parts: &[&str]| {
            let error = load("", &[text]).unwrap_err();
            assert!(error.contains("--set "), "{error}");
            for part in parts {
                assert!(error.contains(part), "`{error}` does not mention `{part}`");
            }
        };
        for text in [
            "run.seed=7\n[sac]",
            "run.seed=7\nepisodes=3",
            "run.seed=7 # the best",
            "run.seed=7#8",
            "learning.history_steps=[2] # [4]",
        ] {
            refused(text, &["more than one value", "would be ignored"]);
        }
        refused("run.device=cpu\nrun.seed=3", &["a line break"]);
        refused("run.seed=7\nvalue=3", &["a line break"]);
        let lines = "learning.history_steps=[\n  2, # half a second\n  4,\n]";
        assert_eq!(load("", &[lines]).unwrap().learning.history_steps, [2, 4]);
        let path = load("", &["courses.training=a#b.toml"])
            .unwrap()
            .courses
            .training;
        assert!(path.ends_with("a#b.toml"), "{}", path.display());
    }

    #[test]
    fn an_integer_that_toml_does_not_hold_is_named_as_such() {
        for seed in [
            "9223372036854775808",
            "18446744073709551616",
            "-9223372036854775809",
            "0xffff_ffff_ffff_ffff",
            "0o7777777777777777777777",
        ] {
            let set = load("", &[&format!("run.seed={seed}")]).unwrap_err();
            assert!(
                set.contains(&format!("--set run.seed={seed}: is an integer")),
                "{set}"
            );
            let file = load(&format!("[run]\nepisodes = 9\nseed = {seed} # x"), &[]).unwrap_err();
            assert!(
                file.contains(&format!(
                    "test.toml: line 3: seed = {seed} is an integer outside"
                )),
                "{file}"
            );
        }
        let inline = load("run = { episodes = 9, seed = 9223372036854775808 }", &[]);
        let inline = inline.unwrap_err();
        assert!(
            inline.contains("line 1: seed = 9223372036854775808"),
            "{inline}"
        );
        let largest = load("", &["run.seed=9223372036854775807"]).unwrap();
        assert_eq!(largest.run.seed, i64::MAX as u64);
    }

    #[test]
    fn a_configuration_with_overrides_keeps_its_courses() {
        let here = Config::default();
        let there = Path::new("best.safetensors");
        let other = here
            .overridden(there, &["simulator.max_steps=200".to_owned()])
            .unwrap();
        assert_eq!(other.courses, here.courses);
        assert_eq!(other.simulator["max_steps"].as_integer(), Some(200));
    }

    #[test]
    fn errors_name_file_key_and_remedy() {
        for (text, overrides, expected) in [
            (
                "[run]\nsed = 1",
                vec![],
                vec!["test.toml", "[run]", "unknown field `sed`", "seed"],
            ),
            (
                "[rum]",
                vec![],
                vec!["test.toml", "unknown section [rum]", "run"],
            ),
            (
                "[run]\nseed = \"x\"",
                vec![],
                vec!["test.toml", "[run]", "seed"],
            ),
            (
                "",
                vec!["seed=1"],
                vec!["--set seed=1", "section.key=value"],
            ),
            ("", vec!["run.seed"], vec!["--set run.seed", "no `=`"]),
            (
                "[learning]\nwarmup_steps = 200000",
                vec![],
                vec!["learning.warmup_steps = 200000", "replay.capacity"],
            ),
            ("[run]\ndevice = \"gpu\"", vec![], vec!["gpu", "cuda:N"]),
            (
                "[run]\nengine = \"jax\"",
                vec![],
                vec!["jax", "native", "libtorch"],
            ),
            (
                "[run]\nengine = \"native\"",
                vec!["run.device=cuda:1"],
                vec![
                    "run.engine = native",
                    "run.device = cuda:1",
                    "leave run.engine out",
                ],
            ),
            ("[sac]\ndiscount = nan", vec![], vec!["sac.discount = NaN"]),
            (
                "[learning]\nsegment_steps = 1",
                vec![],
                vec![
                    "learning.episodes_per_epoch = 10",
                    "segment_steps = 1",
                    "set it to 1",
                ],
            ),
            (
                "[learning]\nsegment_steps = 1\nepisodes_per_epoch = 1",
                vec!["learning.policy_lag=1"],
                vec![
                    "--set learning.policy_lag=1",
                    "learning.policy_lag = 1",
                    "segment_steps = 1",
                    "set it to 0",
                ],
            ),
            (
                "[learning]\nsegment_steps = 2\nepisodes_per_epoch = 1\n\
                [replay]\nsuccess = \"approach\"",
                vec![],
                vec!["replay.success = approach", "segment_steps = 2", "level-up"],
            ),
            (
                "[learning]\nsegment_steps = 1\nepisodes_per_epoch = 1\n\
                [transport]\nmax_records_per_episode = 300",
                vec![],
                vec!["transport.max_records_per_episode = 300", "256", "lower it"],
            ),
            (
                "[learning]\nsegment_steps = 1\nepisodes_per_epoch = 1\nhistory_steps = [2]",
                vec![],
                vec![
                    "learning.history_steps = [2]",
                    "segment_steps = 1",
                    "set it to []",
                ],
            ),
            (
                "[learning]\nsegment_steps = 1\nepisodes_per_epoch = 1\nmirror = true",
                vec![],
                vec![
                    "learning.mirror = true",
                    "segment_steps = 1",
                    "set it to false",
                ],
            ),
            (
                "[learning]\nhistory_steps = [4, 2]",
                vec![],
                vec!["learning.history_steps = [4, 2]", "must rise"],
            ),
            (
                "[learning]\nhistory_steps = [0, 2]",
                vec![],
                vec!["learning.history_steps = [0, 2]", "always seen"],
            ),
            (
                "",
                vec!["learning.history_steps=[1,2,3,4,5,6,7,8,9,10,11,12,13,14,15,16,17]"],
                vec!["learning.history_steps", "more than 16"],
            ),
            (
                "[sac]\ncritic_networks = 3",
                vec![],
                vec!["sac.critic_networks = 3", "neither 1 nor 2"],
            ),
            (
                "",
                vec!["vae.latent=48"],
                vec![
                    "test.toml",
                    "--set vae.latent=48",
                    "vae.latent = 48",
                    "[8, 16, 32, 64]",
                    "set it to one of them",
                ],
            ),
            (
                "[vae]\nlatent = 0",
                vec![],
                vec!["test.toml", "vae.latent = 0"],
            ),
            (
                "[vae]\ntrain_steps = 0",
                vec![],
                vec!["vae.train_steps = 0", "vae.start_from"],
            ),
            (
                "[vae]\ntrain_steps = 10",
                vec!["vae.start_from=e.safetensors"],
                vec![
                    "--set vae.start_from=e.safetensors",
                    "vae.train_steps = 10",
                    "e.safetensors",
                    "set it to 0",
                ],
            ),
            (
                "[learning]\nencoder = \"end-to-end\"\n[vae]\ntrain_steps = 0",
                vec!["vae.start_from=e.safetensors"],
                vec!["vae.start_from = ", "end-to-end", "leave it out"],
            ),
            (
                "[td3]\ncritic_networks = 0",
                vec![],
                vec!["td3.critic_networks = 0", "neither 1 nor 2"],
            ),
            (
                "[learning]\nencoder = \"end-to-end\"\nhistory_steps = [2]",
                vec![],
                vec!["learning.history_steps = [2]", "end-to-end", "set it to []"],
            ),
            (
                "[learning]\nencoder = \"end-to-end\"",
                vec!["learning.critic_input=ground-truth"],
                vec![
                    "learning.critic_input = ground-truth",
                    "end-to-end",
                    "sees no image",
                ],
            ),
            (
                "[learning]\nencoder = \"end-to-end\"\naverage_updates = 10",
                vec![],
                vec![
                    "learning.average_updates = 10",
                    "end-to-end",
                    "not averaged",
                ],
            ),
            (
                "[learning]\naverage_updates = 2000000",
                vec![],
                vec!["learning.average_updates = 2000000", "is above 1000000"],
            ),
            (
                "[learning]\nencoder = \"end-to-end\"",
                vec!["vae.decoder=u-net"],
                vec!["vae.decoder = u-net", "end-to-end", "there is no VAE"],
            ),
            (
                "[learning]\nencoder = \"end-to-end\"",
                vec!["replay.capacity=200001"],
                vec!["replay.capacity = 200001", "end-to-end", "9 KiB"],
            ),
            (
                "[learning]\nencoder = \"end-to-end\"",
                vec!["run.engine=native"],
                vec!["run.engine = native", "end-to-end", "leave run.engine out"],
            ),
            (
                "[learning]\nalgorithm = \"td3\"",
                vec!["run.engine=native"],
                vec!["run.engine = native", "td3", "leave run.engine out"],
            ),
            (
                "[vae]\ndecoder = \"u-net\"",
                vec!["run.engine=native"],
                vec!["run.engine = native", "u-net", "leave run.engine out"],
            ),
            (
                "[vae]\ndecoder = \"unet\"",
                vec![],
                vec!["[vae]", "unet", "u-net", "plain"],
            ),
            (
                "[learning]\nsegment_steps = 257",
                vec![],
                vec!["learning.segment_steps = 257", "256"],
            ),
            (
                "",
                vec!["simulator.................x=1"],
                vec!["--set simulator....", "deeper"],
            ),
            (
                "[simulator]\na = [[[[[[[[[[[[[[[[[1]]]]]]]]]]]]]]]]]",
                vec![],
                vec!["simulator = nested 18 deep", "16"],
            ),
        ] {
            let error = load(text, &overrides).unwrap_err();
            for part in expected {
                assert!(error.contains(part), "`{error}` does not mention `{part}`");
            }
        }
    }
}
