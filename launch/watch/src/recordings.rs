//! Recorded episodes of a run: the list, and an episode to fly again.

use std::fs;
use std::path::{Component, Path};
use std::time::SystemTime;

use anyhow::{Context, bail};
use serde::Serialize;
use serde_json::{Value, json};
use skein_protocol::files;
use skein_recordings::RecordedFlight;
use skein_run::RunDirectory;

use crate::catalogue::Catalogue;

/// Most bytes of a recording that is shown: some hundred episodes.
const RECORDING_BYTES: u64 = 64 << 20;
/// Most recordings in the list.
const MOST_LISTED: usize = 1000;

/// A recording in the list.
#[derive(Debug, Serialize)]
pub(crate) struct ListedRecording {
    name: String,
    changed_secs: u64,
}

/// Returns the recordings of a run, the newest first.
pub(crate) fn list(catalogue: &Catalogue, run: &RunDirectory) -> Vec<ListedRecording> {
    let folder = catalogue.inside(&run.recordings());
    let entries = folder.and_then(fs::read_dir).into_iter().flatten();
    let listed = |entry: fs::DirEntry| {
        let name = entry.file_name().into_string().ok()?;
        let changed = entry.metadata().ok()?.modified().ok()?;
        let since_1970 = changed.duration_since(SystemTime::UNIX_EPOCH).ok()?;
        let is_recording = name.ends_with(".mcap");
        is_recording.then_some((since_1970, name))
    };
    let mut found: Vec<_> = entries.flatten().filter_map(listed).collect();
    found.sort_unstable_by(|one, other| other.cmp(one));
    found.truncate(MOST_LISTED);
    found
        .into_iter()
        .map(|(since_1970, name)| ListedRecording {
            name,
            changed_secs: since_1970.as_secs(),
        })
        .collect()
}

/// Returns the bytes of a recording.
///
/// # Errors
/// If the name is none of a recording of the run, or the file cannot be read.
pub(crate) fn file(
    catalogue: &Catalogue,
    run: &RunDirectory,
    name: &str,
) -> anyhow::Result<Vec<u8>> {
    let mut parts = Path::new(name).components();
    let is_name = matches!(
        (parts.next(), parts.next()),
        (Some(Component::Normal(_)), None)
    );
    if !is_name || !name.ends_with(".mcap") {
        bail!("{name:?} is no name of a recording");
    }
    catalogue
        .inside(&run.recordings().join(name))
        .and_then(|path| files::read(&path, RECORDING_BYTES))
        .with_context(|| format!("cannot read the recording {name}"))
}

/// Returns episode `number` of a recording, and the titles of all.
///
/// # Errors
/// If the recording is damaged, or has no such episode.
pub(crate) fn flight(file: &[u8], number: usize) -> anyhow::Result<Value> {
    let flights = skein_recordings::read(file)?;
    let titles: Vec<_> = flights.iter().map(|flight| &flight.title).collect();
    let flight = nth(&flights, number)?;
    Ok(json!({ "titles": titles, "flight": flight }))
}

/// Returns the latent codes of episode `number`, step by step.
///
/// # Errors
/// As for [`flight`].
pub(crate) fn codes(file: &[u8], number: usize) -> anyhow::Result<Vec<Vec<f32>>> {
    let mut flights = skein_recordings::read(file)?;
    nth(&flights, number)?;
    let steps = flights.swap_remove(number).steps.into_iter();
    let code = |mut step: skein_recordings::RecordedStep| step.numbers.remove("latent");
    steps
        .map(|step| code(step).context("the recording has steps without a latent code"))
        .collect()
}

fn nth(flights: &[RecordedFlight], number: usize) -> anyhow::Result<&RecordedFlight> {
    let count = flights.len();
    flights
        .get(number)
        .with_context(|| format!("the recording has {count} episodes, none of number {number}"))
}
