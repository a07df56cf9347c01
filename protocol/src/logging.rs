//! One tracing subscriber, set up in one place; one log file a process.

use std::fs::OpenOptions;
use std::path::Path;
use std::sync::Mutex;

use tracing_subscriber::EnvFilter;

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
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("info"));
    let subscriber = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_ansi(false)
        .with_writer(file);
    match format {
        LogFormat::Text => subscriber.init(),
        LogFormat::Json => subscriber.json().init(),
    }
    // A panic is a defect; it must not only scroll away on a terminal.
    let default_hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        tracing::error!(%panic, "panic");
        default_hook(panic);
    }));
    Ok(())
}
