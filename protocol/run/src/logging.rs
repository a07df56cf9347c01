//! Logging: one tracing subscriber and one log file per process.

use std::fs::OpenOptions;
use std::path::Path;
use std::sync::Mutex;

use tracing::Subscriber;
use tracing::level_filters::LevelFilter;
use tracing_subscriber::filter::{ParseError, Targets};
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{Layer, fmt};

use crate::terminal::BestEffort;

/// Format of log lines.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum LogFormat {
    /// Text for people.
    #[default]
    Text,
    /// One JSON object per line.
    Json,
}

impl LogFormat {
    /// Returns [`LogFormat::Json`] if the environment variable `SKEIN_LOG_FORMAT` is `json`, else
    /// text.
    pub fn from_environment() -> Self {
        match variable("SKEIN_LOG_FORMAT").as_deref() {
            Some("json") => Self::Json,
            _ => Self::Text,
        }
    }
}

/// Returns what is wrong with the variables `RUST_LOG` and `SKEIN_LOG_FORMAT`, for the program that
/// starts the logging ones: nobody looks for it in a log.
pub fn environment_faults() -> Vec<String> {
    let (_, filter) = filter(variable("RUST_LOG").as_deref());
    let format = format_fault(variable("SKEIN_LOG_FORMAT").as_deref());
    filter.into_iter().chain(format).collect()
}

fn variable(name: &str) -> Option<String> {
    std::env::var_os(name).map(|value| value.to_string_lossy().into_owned())
}

fn format_fault(wanted: Option<&str>) -> Option<String> {
    let format = wanted.filter(|format| !["", "json", "text"].contains(format))?;
    Some(format!(
        "SKEIN_LOG_FORMAT={format} is unknown; logging as text. Set it to json or text"
    ))
}

/// Appends this process's log to `path`. `RUST_LOG` filters it, `info` by default.
///
/// # Errors
/// If the file cannot be opened.
///
/// # Panics
/// If called twice.
pub fn log_to_file(path: &Path, format: LogFormat) -> std::io::Result<()> {
    let (subscriber, fault) = subscriber(path, format)?;
    subscriber.init();
    if let Some(fault) = fault {
        tracing::warn!("{fault}");
    }
    // A panic is a defect and must appear in the log, not only on the terminal.
    let default_hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        tracing::error!(%panic, "panic");
        default_hook(panic);
    }));
    Ok(())
}

/// Appends what this thread logs during `work` to `path`: for a guest in another's process.
///
/// # Errors
/// If the file cannot be opened.
pub fn log_within<T>(
    path: &Path,
    format: LogFormat,
    work: impl FnOnce() -> T,
) -> std::io::Result<T> {
    let (subscriber, fault) = subscriber(path, format)?;
    Ok(tracing::subscriber::with_default(subscriber, || {
        if let Some(fault) = fault {
            tracing::warn!("{fault}");
        }
        work()
    }))
}

/// Returns what writes to `path`, and what is wrong with `RUST_LOG`.
fn subscriber(
    path: &Path,
    format: LogFormat,
) -> std::io::Result<(impl Subscriber + Send + Sync + 'static, Option<String>)> {
    let file = OpenOptions::new().create(true).append(true).open(path)?;
    // A full disk loses lines of the log and must not end the process.
    let file = Mutex::new(BestEffort(file));
    let (filter, fault) = filter(variable("RUST_LOG").as_deref());
    let lines = fmt::layer().with_ansi(false).with_writer(file);
    let lines = match format {
        LogFormat::Text => lines.boxed(),
        LogFormat::Json => lines.json().boxed(),
    };
    let subscriber = tracing_subscriber::registry().with(lines).with(filter);
    Ok((subscriber, fault))
}

/// Returns the filter in `RUST_LOG`, `info` if it is not set. If it is malformed, returns `info`
/// and a warning.
fn filter(wanted: Option<&str>) -> (Targets, Option<String>) {
    let default = Targets::new().with_default(LevelFilter::INFO);
    let Some(wanted) = wanted else {
        return (default, None);
    };
    let parsed = wanted
        .parse()
        .map_err(|error: ParseError| error.to_string());
    match parsed.and_then(check_targets) {
        Ok(filter) => (filter, None),
        Err(problem) => {
            let fault = format!(
                "RUST_LOG={wanted} cannot be read: {problem}; logging at level info. \
                 Write it as \"debug\" or \"skein_actor=debug,info\""
            );
            (default, Some(fault))
        }
    }
}

/// Refuses a filter that names what can be no module: the parser takes any word for a module, and
/// nothing at all would be logged.
fn check_targets(filter: Targets) -> Result<Targets, String> {
    let is_module = |name: &str| {
        let part_of_one = |sign: char| sign.is_alphanumeric() || "_-:".contains(sign);
        name.starts_with(|first: char| first.is_alphabetic() || first == '_')
            && name.chars().all(part_of_one)
    };
    let unknown = filter
        .iter()
        .find(|(name, _)| !is_module(name))
        .map(|(name, _)| format!("{name:?} is neither a level nor a module"));
    unknown.map_or(Ok(filter), Err)
}

#[cfg(test)]
mod tests {
    use tracing::Level;

    use super::*;

    #[test]
    fn rust_log_filters_the_log_and_a_malformed_value_is_named() {
        let (by_default, fault) = filter(None);
        assert_eq!(fault, None);
        assert!(by_default.would_enable("skein_actor", &Level::INFO));
        assert!(!by_default.would_enable("skein_actor", &Level::DEBUG));

        let (asked, fault) = filter(Some("skein_actor=debug,warn"));
        assert_eq!(fault, None);
        assert!(asked.would_enable("skein_actor::service", &Level::DEBUG));
        assert!(!asked.would_enable("skein_learner", &Level::INFO));

        assert_eq!(format_fault(None), None);
        assert_eq!(format_fault(Some("json")), None);
        assert!(
            format_fault(Some("xml"))
                .unwrap()
                .contains("SKEIN_LOG_FORMAT=xml")
        );

        for malformed in [
            "skein_actor=loudly",
            "[[",
            "debug;info",
            "a b",
            "=",
            "{}=debug",
        ] {
            let (fallen_back, fault) = filter(Some(malformed));
            let fault = fault.unwrap_or_else(|| panic!("{malformed} is taken"));
            assert!(fault.contains(&format!("RUST_LOG={malformed} ")), "{fault}");
            assert!(fallen_back.would_enable("skein_actor", &Level::INFO));
        }
        for sound in ["", "off", "trace", "skein_actor::service=debug", "2"] {
            assert_eq!(filter(Some(sound)).1, None, "{sound}");
        }
    }
}
