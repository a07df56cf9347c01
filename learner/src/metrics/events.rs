//! TensorBoard event files.
//!
//! An event file is a sequence of framed messages; [`super::messages`] defines them.

use std::fs::{self, File, OpenOptions};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use prost::Message;
use serde::{Deserialize, Serialize};
use skein_run::{durable, write_event_record};

use super::messages::{Event, SESSION_START, SessionLog, Summary, SummaryValue, event};
use crate::disk::{Disk, PatientWriter};
use crate::notice::notify_user;

/// Start of our files' names, before the second of their creation. TensorBoard reads files whose
/// name contains `tfevents`.
const NAME: &str = "events.out.tfevents.";

/// Appends scalars to a new event file.
#[derive(Debug)]
pub struct EventWriter {
    /// Files of earlier incarnations, then the present one.
    files: Vec<EventFile>,
    path: PathBuf,
    file: BufWriter<PatientWriter<File>>,
}

/// An event file, as far as it belongs to the run.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct EventFile {
    /// Name in the folder.
    pub name: String,
    /// Length in bytes.
    pub bytes: u64,
}

/// Reason why events cannot be written.
#[derive(Debug, thiserror::Error)]
#[error("cannot write TensorBoard events to {}: {source}", path.display())]
pub struct EventError {
    /// Path of the file.
    pub path: PathBuf,
    /// Cause.
    #[source]
    pub source: io::Error,
}

impl EventWriter {
    /// Starts a new event file in `directory`, after cutting existing ones back to `files`: later
    /// content belongs to episodes whose learning was lost. TensorBoard reads all files of a
    /// directory as one, and drops points of earlier files at `first_step` or later.
    ///
    /// A file that has lost a part of `files` causes a warning with its name. Its curves then have
    /// a hole, but training continues.
    ///
    /// # Errors
    /// [`EventError`] when a file cannot be cut back or created.
    pub fn resume(
        directory: &Path,
        files: Vec<EventFile>,
        first_step: u64,
        disk: &Disk,
    ) -> Result<Self, EventError> {
        let at = |path: PathBuf| move |source| EventError { path, source };
        durable::create_private_directory(directory).map_err(at(directory.to_owned()))?;
        let (files, others): (Vec<_>, Vec<_>) = files
            .into_iter()
            .partition(|file| CreationStamp::of(&file.name).is_some());
        // A damaged list may name other files; those are not cut.
        for EventFile { name, .. } in others {
            tracing::warn!(name, "not the name of one of our event files: left alone");
        }
        let (path, file) = begin(directory, cut_back(directory, &files)?);
        let file = BufWriter::new(disk.patient(&path, file.map_err(at(path.clone()))?));
        let mut writer = Self { files, path, file };
        writer.files.push(EventFile {
            name: writer
                .path
                .file_name()
                .unwrap_or_default()
                .to_string_lossy()
                .into_owned(),
            bytes: 0,
        });
        writer.write(
            first_step,
            event::What::FileVersion("brain.Event:2".to_owned()),
        )?;
        writer.write(
            first_step,
            event::What::SessionLog(SessionLog {
                status: SESSION_START,
            }),
        )?;
        Ok(writer)
    }

    /// All files of the run with their lengths, which include what is not
    /// [flushed](EventWriter::flush) yet.
    pub fn files(&self) -> &[EventFile] {
        &self.files
    }

    /// Appends one value per tag at `step`.
    ///
    /// # Errors
    /// [`EventError`].
    pub fn scalars(&mut self, step: u64, values: &[(&str, f64)]) -> Result<(), EventError> {
        let value = values
            .iter()
            .map(|&(tag, value)| SummaryValue::scalar(tag, value))
            .collect();
        self.write(step, event::What::Summary(Summary { value }))
    }

    /// Appends values other than scalars at `step`.
    ///
    /// # Errors
    /// [`EventError`].
    pub(super) fn summary(
        &mut self,
        step: u64,
        value: Vec<SummaryValue>,
    ) -> Result<(), EventError> {
        self.write(step, event::What::Summary(Summary { value }))
    }

    /// Hands everything written to the operating system.
    ///
    /// # Errors
    /// [`EventError`].
    pub fn flush(&mut self) -> Result<(), EventError> {
        self.file.flush().map_err(|source| EventError {
            path: self.path.clone(),
            source,
        })
    }

    fn write(&mut self, step: u64, what: event::What) -> Result<(), EventError> {
        let event = Event {
            wall_time: now_secs(),
            step: step.cast_signed(),
            what: Some(what),
        };
        let bytes =
            write_event_record(&mut self.file, &event.encode_to_vec()).map_err(|source| {
                EventError {
                    path: self.path.clone(),
                    source,
                }
            })?;
        if let Some(present) = self.files.last_mut() {
            present.bytes += bytes;
        }
        Ok(())
    }
}

/// Creates a file in `directory` whose name sorts after the one created at `latest`, even if the
/// clock has gone back. TensorBoard reads files in alphabetical order. The number distinguishes
/// files created within one second.
fn begin(directory: &Path, latest: Option<CreationStamp>) -> (PathBuf, io::Result<File>) {
    let now = now_secs() as u64;
    let first = match latest {
        Some(latest) if latest.second >= now => CreationStamp {
            number: latest.number.saturating_add(1),
            ..latest
        },
        _ => CreationStamp {
            second: now,
            number: 0,
        },
    };
    (first.number..first.number.saturating_add(1000))
        .map(|number| directory.join(CreationStamp { number, ..first }.name()))
        .find_map(|path| match File::create_new(&path) {
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => None,
            result => Some((path, result)),
        })
        .unwrap_or_else(|| {
            (
                directory.to_owned(),
                Err(io::ErrorKind::AlreadyExists.into()),
            )
        })
}

/// Creation time of one of our event files, as in its name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct CreationStamp {
    second: u64,
    number: u32,
}

impl CreationStamp {
    fn name(self) -> String {
        format!("{NAME}{}.skein.{:06}", self.second, self.number)
    }

    /// Parses a file name; `None` if the file is not ours.
    fn of(name: &str) -> Option<Self> {
        let (second, number) = name.strip_prefix(NAME)?.split_once(".skein.")?;
        Some(Self {
            second: second.parse().ok()?,
            number: number.parse().ok()?,
        })
    }
}

/// Cuts our files in `directory` back to `files` and removes all others of ours. Returns the
/// creation time of the latest of `files`.
fn cut_back(directory: &Path, files: &[EventFile]) -> Result<Option<CreationStamp>, EventError> {
    let at = |path: &Path| {
        let path = path.to_owned();
        move |source| EventError { path, source }
    };
    for entry in fs::read_dir(directory).map_err(at(directory))? {
        let name = entry.map_err(at(directory))?.file_name();
        let known = |file: &EventFile| name == file.name.as_str();
        if name.to_str().and_then(CreationStamp::of).is_some() && !files.iter().any(known) {
            let path = directory.join(&name);
            fs::remove_file(&path).map_err(at(&path))?;
        }
    }
    for EventFile { name, bytes } in files {
        let path = directory.join(name);
        let found = fs::metadata(&path).map_or(0, |metadata| metadata.len());
        if found < *bytes {
            let path = path.display();
            notify_user(&format!(
                "{path} ends after {found} of {bytes} bytes: TensorBoard's curves have a hole"
            ));
        } else if found > *bytes {
            let file = OpenOptions::new()
                .write(true)
                .open(&path)
                .map_err(at(&path))?;
            file.set_len(*bytes).map_err(at(&path))?;
        }
    }
    Ok(files
        .iter()
        .filter_map(|file| CreationStamp::of(&file.name))
        .max())
}

pub(super) fn now_secs() -> f64 {
    SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .map_or(0.0, |elapsed| elapsed.as_secs_f64())
}

/// Reads back what was written.
#[cfg(test)]
pub(super) mod testing {
    use skein_run::split_event_record;

    use super::*;

    /// Reads records back, checking every length and checksum.
    pub(in super::super::events) fn read_records(mut bytes: &[u8]) -> Result<Vec<Event>, String> {
        let mut events = Vec::new();
        while !bytes.is_empty() {
            let (message, rest) = split_event_record(bytes).map_err(|error| error.to_string())?;
            events.push(Event::decode(message).map_err(|error| error.to_string())?);
            bytes = rest;
        }
        Ok(events)
    }

    /// Every point of a curve: its tag, its step, and the bits of its value.
    pub(in super::super) fn points(bytes: &[u8]) -> Vec<(String, i64, u32)> {
        let mut points = Vec::new();
        for event in read_records(bytes).unwrap() {
            if let Some(event::What::Summary(summary)) = event.what {
                let point = |value: &SummaryValue| {
                    let bits = value.simple_value?.to_bits();
                    Some((value.tag.clone(), event.step, bits))
                };
                points.extend(summary.value.iter().filter_map(point));
            }
        }
        points
    }
}

#[cfg(test)]
mod tests {
    use super::testing::read_records;
    use super::*;

    fn create(directory: &Path, first_step: u64) -> EventWriter {
        EventWriter::resume(
            directory,
            Vec::new(),
            first_step,
            &Disk::new(std::sync::Arc::default()),
        )
        .unwrap()
    }

    fn sample_file(first_step: u64) -> Vec<u8> {
        let directory = tempfile::tempdir().unwrap();
        let mut writer = create(directory.path(), first_step);
        writer
            .scalars(7, &[("episode/return", -1.5), ("episode/steps", 12.0)])
            .unwrap();
        writer.scalars(8, &[("episode/return", 0.0)]).unwrap();
        writer.flush().unwrap();
        std::fs::read(&writer.path).unwrap()
    }

    #[test]
    fn written_events_read_back() {
        let events = read_records(&sample_file(5)).unwrap();
        let what: Vec<_> = events
            .iter()
            .map(|event| event.what.clone().unwrap())
            .collect();
        let value = SummaryValue::scalar;
        assert_eq!(
            what,
            [
                event::What::FileVersion("brain.Event:2".to_owned()),
                event::What::SessionLog(SessionLog {
                    status: SESSION_START
                }),
                event::What::Summary(Summary {
                    value: vec![value("episode/return", -1.5), value("episode/steps", 12.0)]
                }),
                event::What::Summary(Summary {
                    value: vec![value("episode/return", 0.0)]
                }),
            ]
        );
        assert_eq!(
            events.iter().map(|event| event.step).collect::<Vec<_>>(),
            [5, 5, 7, 8]
        );
        assert!(events.iter().all(|event| event.wall_time > 1.7e9));
    }

    #[test]
    fn lengths_are_those_of_the_file() {
        let directory = tempfile::tempdir().unwrap();
        let mut writer = create(directory.path(), 0);
        writer.scalars(3, &[("a", 1.0), ("b", 2.0)]).unwrap();
        writer.flush().unwrap();
        let [file] = writer.files() else {
            panic!("{:?}", writer.files())
        };
        assert_eq!(
            file.bytes,
            fs::metadata(directory.path().join(&file.name))
                .unwrap()
                .len()
        );
    }

    #[test]
    fn a_file_elsewhere_is_left_alone_even_if_listed() {
        let directory = tempfile::tempdir().unwrap();
        let outside = directory.path().join("outside");
        fs::write(&outside, "untouched").unwrap();
        let files = ["../outside", &outside.display().to_string()].map(|name| EventFile {
            name: name.to_owned(),
            bytes: 0,
        });
        let curves = directory.path().join("tensorboard");
        let writer =
            EventWriter::resume(&curves, files.to_vec(), 0, &Disk::new(Default::default()))
                .unwrap();
        assert_eq!(fs::read_to_string(outside).unwrap(), "untouched");
        assert_eq!(writer.files().len(), 1);
    }

    #[test]
    fn a_later_incarnation_has_a_file_of_a_later_name_even_when_the_clock_went_back() {
        let directory = tempfile::tempdir().unwrap();
        let ahead = format!("{NAME}99999999999.skein.000000");
        fs::write(directory.path().join(&ahead), "0123456789").unwrap();
        let known = vec![EventFile {
            name: ahead.clone(),
            bytes: 4,
        }];
        let writer = EventWriter::resume(
            directory.path(),
            known,
            7,
            &Disk::new(std::sync::Arc::default()),
        )
        .unwrap();
        assert!(writer.files()[1].name > ahead, "{:?}", writer.files());
        assert_eq!(fs::read(directory.path().join(ahead)).unwrap(), b"0123");
    }
}
