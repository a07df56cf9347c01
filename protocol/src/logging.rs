//! Logging: one tracing subscriber and one log file per process.

use std::fs::OpenOptions;
use std::path::Path;
use std::sync::Mutex;

use tracing_subscriber::EnvFilter;

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
        match std::env::var("SKEIN_LOG_FORMAT") {
            Ok(format) if format == "json" => Self::Json,
            _ => Self::Text,
        }
    }
}

/// Appends this process's log to `path`. `RUST_LOG` filters it, `info` by default.
///
/// # Errors
/// If the file cannot be opened.
///
/// # Panics
/// If called twice.
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
    // A panic is a defect and must appear in the log, not only on the terminal.
    let default_hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        tracing::error!(%panic, "panic");
        default_hook(panic);
    }));
    Ok(())
}
