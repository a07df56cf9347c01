//! One tracing subscriber, set up in one place; one log file a process.

use std::fs::OpenOptions;
use std::path::Path;
use std::sync::Mutex;

use tracing::level_filters::LevelFilter;
use tracing_subscriber::filter::Targets;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{Layer, fmt};

/// How log lines are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum LogFormat {
    /// For people.
    #[default]
    Text,
    /// One JSON object a line.
    Json,
}

impl LogFormat {
    /// JSON when the environment variable `SKEIN_LOG_FORMAT` is `json`.
    pub fn from_environment() -> Self {
        match std::env::var("SKEIN_LOG_FORMAT") {
            Ok(format) if format == "json" => Self::Json,
            _ => Self::Text,
        }
    }
}

/// Sends this process's log to `path`, appending; `RUST_LOG` says what is logged, `info` by
/// default.
///
/// # Errors
/// When the file cannot be opened.
///
/// # Panics
/// When called twice.
pub fn log_to_file(path: &Path, format: LogFormat) -> std::io::Result<()> {
    let file = Mutex::new(OpenOptions::new().create(true).append(true).open(path)?);
    let wanted = std::env::var("RUST_LOG").ok();
    let (filter, fault) = filter(wanted.as_deref());
    let lines = fmt::layer().with_ansi(false).with_writer(file);
    let lines = match format {
        LogFormat::Text => lines.boxed(),
        LogFormat::Json => lines.json().boxed(),
    };
    tracing_subscriber::registry()
        .with(lines)
        .with(filter)
        .init();
    if let Some(fault) = fault {
        tracing::warn!("{fault}");
    }
    // A panic is a defect; it must not only scroll away on a terminal.
    let default_hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        tracing::error!(%panic, "panic");
        default_hook(panic);
    }));
    Ok(())
}

/// What `RUST_LOG` asks for, `info` if it is not set. If it cannot be read, `info` and the fault.
fn filter(wanted: Option<&str>) -> (Targets, Option<String>) {
    let default = Targets::new().with_default(LevelFilter::INFO);
    match wanted.map(str::parse) {
        None => (default, None),
        Some(Ok(filter)) => (filter, None),
        Some(Err(error)) => {
            let fault = format!(
                "RUST_LOG={} cannot be read: {error}; logging at level info. \
                 Write it as \"debug\" or \"skein_actor=debug,info\"",
                wanted.unwrap_or_default()
            );
            (default, Some(fault))
        }
    }
}

#[cfg(test)]
mod tests {
    use tracing::Level;

    use super::*;

    #[test]
    fn what_is_logged_follows_rust_log_and_a_malformed_value_is_named() {
        let (by_default, fault) = filter(None);
        assert_eq!(fault, None);
        assert!(by_default.would_enable("skein_actor", &Level::INFO));
        assert!(!by_default.would_enable("skein_actor", &Level::DEBUG));

        let (asked, fault) = filter(Some("skein_actor=debug,warn"));
        assert_eq!(fault, None);
        assert!(asked.would_enable("skein_actor::service", &Level::DEBUG));
        assert!(!asked.would_enable("skein_learner", &Level::INFO));

        let (fallen_back, fault) = filter(Some("skein_actor=loudly"));
        assert!(fault.unwrap().contains("RUST_LOG=skein_actor=loudly"));
        assert!(fallen_back.would_enable("skein_actor", &Level::INFO));
    }
}
