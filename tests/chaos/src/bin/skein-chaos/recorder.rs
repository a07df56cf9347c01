//! Recording of everything that was done to a run, as one JSON object per line, so that a failure
//! can be studied.

use std::fs::File;
use std::io::{self, Write};
use std::path::Path;
use std::time::Instant;

use serde::Serialize;
use serde_json::{Map, Value};

/// Writes events as they happen.
#[derive(Debug)]
pub(crate) struct Recorder {
    /// Output file; `None` for an undisturbed run.
    file: Option<File>,
    started: Instant,
}

impl Recorder {
    /// Creates a recording in a new file.
    ///
    /// # Errors
    /// Returns an error if the file cannot be created.
    pub(crate) fn create(path: &Path) -> io::Result<Self> {
        Ok(Self {
            file: Some(File::create(path)?),
            started: Instant::now(),
        })
    }

    /// Returns a recorder that writes nothing, for an undisturbed run.
    pub(crate) fn silent() -> Self {
        Self {
            file: None,
            started: Instant::now(),
        }
    }

    /// Records an event: seconds since the start, episodes learned from, `event`, and the fields of
    /// `details`.
    ///
    /// # Errors
    /// Returns an error if it cannot be written.
    pub(crate) fn note(
        &mut self,
        episodes: u64,
        event: &str,
        details: &impl Serialize,
    ) -> io::Result<()> {
        let Some(file) = &mut self.file else {
            return Ok(());
        };
        let mut line = Map::new();
        let secs = (self.started.elapsed().as_secs_f64() * 1000.0).round() / 1000.0;
        line.insert("secs".to_owned(), secs.into());
        line.insert("episodes".to_owned(), episodes.into());
        line.insert("event".to_owned(), event.into());
        match serde_json::to_value(details)? {
            Value::Object(fields) => line.extend(fields),
            Value::Null => {}
            other => {
                line.insert("details".to_owned(), other);
            }
        }
        // One unbuffered write per line, so that the recording is complete even if this program is
        // killed.
        file.write_all(format!("{}\n", Value::Object(line)).as_bytes())
    }
}
